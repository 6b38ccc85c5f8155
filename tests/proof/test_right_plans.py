"""Right plans of unusual kinds pass, and a diverged solve gets FAIL."""

from dataclasses import replace

import numpy as np
import pytest

import planner
from planner import Mechanism, Problem, RigidBodyDynamics, Status, TrackingCost
from planner.cases import problem_file
from planner.dynamics.quasi_static import quasi_static_controls

ARM = """<mujoco><worldbody>{lone}<body><joint name="a" axis="0 1 0" damping=".1"/>
  <geom type="capsule" fromto="0 0 0 .5 0 0" size=".02" mass="1" contype="0" conaffinity="0"/>
  <body pos=".5 0 0"><joint name="b" axis="0 1 0" damping=".1"/>
    <geom type="capsule" fromto="0 0 0 .5 0 0" size=".02" mass="1" contype="0" conaffinity="0"/></body></body>
  </worldbody>{tendon}<actuator>{first}<motor joint="b"/></actuator></mujoco>"""
LONE = """<body name="x"><joint name="s" type="slide" axis="1 0 0"/>
  <geom size=".1" mass="1" contype="0" conaffinity="0"/></body>"""
TENDON = """<tendon><fixed name="t" actuatorfrclimited="true" actuatorfrcrange="-50 50"><joint joint="a" coef="1"/>
  <joint joint="b" coef="-.5"/></fixed></tendon>"""


def arm(lone: str = "", tendon: str = "", first: str = '<motor joint="a"/>') -> str:
    return ARM.format(lone=lone, tendon=tendon, first=first)


def reach(text: str, goal: list[float], prescribed: tuple[str, ...] = (), final: np.ndarray | None = None) -> Problem:
    """From rest at home to rest at joints' positions in 1 s; `final` are weights of the end in place of the usual."""
    m = Mechanism.from_mjcf(text)
    d = RigidBodyDynamics(m, 0.02, prescribed=prescribed)
    there = np.concatenate([goal, np.zeros(m.nv)])
    cost = TrackingCost.joints(d, there, 50, effort=0.001, final_position=1e3, final_velocity=1e2)
    if final is not None:
        Q = np.concatenate([cost.Q[:-1], final[None]])
        cost = TrackingCost(Q, cost.R, cost.x_ref, cost.u_ref, space=cost.space)
    us = None if prescribed else np.tile(quasi_static_controls(m, m.home), (50, 1))
    return Problem(d, cost, m.home, us=us)


def test_a_clamp_of_a_tendons_actuators_is_no_part_of_parity():
    strong = arm(tendon=TENDON, first='<general tendon="t" gainprm="30"/>')
    proof = planner.prove(planner.solve(reach(strong, [0.8, -0.8])), rollouts=0)
    assert proof.parity.passed, proof.reason
    assert proof.passed, proof.reason


def test_a_prescribed_slide_that_carries_nothing():
    """MuJoCo has the mass of such a joint in a constant of its own."""
    plan = planner.solve(reach(arm(LONE), [0.5, 0.5, -0.3], prescribed=("s",)))
    proof = planner.prove(plan, rollouts=0)
    assert proof.passed, proof.reason


def test_a_goal_of_the_sum_of_two_angles_is_judged_by_the_sum():
    """The hand's direction is asked for, at rest: each joint may end anywhere."""
    final = np.diag([0.0, 0.0, 1e2, 1e2])
    final[:2, :2] = 1e3
    problem = reach(arm(), [0.8, 0.4], final=final)
    plan = planner.solve(problem)
    names = [one.name for one in planner.problem.goals.goals_of(problem)]
    assert names[0] == "a + b"
    assert plan.xs[-1, :2].sum() == pytest.approx(1.2, abs=0.01)
    assert np.abs(plan.xs[-1, :2] - [0.8, 0.4]).max() > 0.1
    proof = planner.prove(plan, rollouts=0)
    assert proof.passed, proof.reason
    short = reach(arm(), [0.8, 0.4], final=1e-6 * final)  # hardly asked for, so not met
    assert "a + b is missed by" in planner.solve(short).message


def test_a_full_weight_with_couplings_is_judged_by_joints():
    final = np.diag([1e3, 1e3, 1e2, 1e2])
    final[0, 1] = final[1, 0] = 500.0
    names = [one.name for one in planner.problem.goals.goals_of(reach(arm(), [0.8, 0.4], final=final))]
    assert names[:2] == ["a", "b"]


RHOMBUS = """<mujoco><worldbody><body><joint axis="0 1 0" damping=".01"/>
  <geom type="capsule" fromto="0 0 0 0 0 .05" size=".005" mass=".01" contype="0" conaffinity="0"/>
  <body name="c" pos="0 0 .05"><joint axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 .0500001 0 0" size=".005" mass=".01" contype="0" conaffinity="0"/></body></body>
  <body name="d" pos=".0500001 0 0"><joint name="e" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 0 0 .05" size=".005" mass=".01" contype="0" conaffinity="0"/></body></worldbody>
  <equality><connect body1="c" body2="d" anchor=".0500001 0 0"/></equality>
  <actuator><motor joint="e"/></actuator></mujoco>"""


@pytest.mark.slow
def test_a_chain_nearly_in_line_has_parity_but_not_with_another_mass(monkeypatch):
    m = Mechanism.from_mjcf(RHOMBUS)
    section = planner.parity(m, seed=2)  # its accelerations are off by 1.2e-10 of the terms without the closure's
    assert section.passed, section.failures
    monkeypatch.setattr("planner.proof.compare.model_parity.STATES", 16)  # another mass is wrong at any state
    heavier = planner.parity(m, RHOMBUS.replace('mass=".01"', 'mass=".0101"'))
    assert "acceleration_error" in {one.name for one in heavier.failures}


def test_a_diverged_solve_fails_in_a_sentence():
    plan = planner.solve(reach(arm(), [0.8, -0.8]))
    gone = replace(plan, xs=np.where(plan.t[:, None] > 0.5, np.nan, plan.xs), status=Status.NOT_FINITE)
    proof = planner.prove(gone, rollouts=0)
    assert proof.verdict == "FAIL"
    assert proof.reason.startswith("plan: its states are not finite, so it is not replayed. The first guess rolls out")


@pytest.mark.parametrize("soft", ['{ rl = "soft" }', '{ position = "soft" }', '"soft"'])
def test_a_soft_goal_of_a_problem_file(tmp_path, soft):
    text = arm().replace('name="a"', 'name="rl"').replace('joint="a"', 'joint="rl"')
    (tmp_path / "arm.xml").write_text(text)
    (tmp_path / "p.toml").write_text(
        f'model = "arm.xml"\nstart = {{}}\ngoal = {{ rl = 1.0 }}\nduration = 1.0\ndt = 0.02\ntolerance = {soft}\n'
    )
    goals = planner.problem.goals.goals_of(problem_file.load(tmp_path / "p.toml").problem)
    assert next(one for one in goals if one.name == "rl").tolerance == np.inf
