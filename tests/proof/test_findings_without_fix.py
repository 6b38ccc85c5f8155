"""Reasons that no key takes away: a joint that leans on its stop and nothing drives, a machine that falls."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from problem_files import arm, file

import planner
from planner import Limits, Mechanism, Problem, RigidBodyDynamics, SolverOptions, TrackingCost
from planner.problem.problem_parts import PROBLEM_FILE, Recipe
from planner.proof.diagnostics import suggested_fixes
from planner.proof.diagnostics.goals import falling, loses_balance
from planner.proof.diagnostics.limits import fixed_joints
from planner.proof.diagnostics.solving import more_iterations, other_guesses, other_model
from planner.solvers.continuation import DistantContacts

ARM = """
<mujoco>
  <worldbody>
    <body>
      <joint name="turn" axis="0 0 1" damping="1"/>
      <geom type="capsule" size="0.02" fromto="0 0 0 0.3 0 0" mass="0.5" contype="0" conaffinity="0"/>
      <body pos="0.3 0 0">
        <joint name="flap" axis="0 1 0" damping="0.1" limited="true" range="-60 0"/>
        <geom type="capsule" size="0.02" fromto="0 0 0 0.2 0 0" mass="0.3" contype="0" conaffinity="0"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="a" joint="turn"/></actuator>
</mujoco>
"""


def test_a_joint_that_leans_on_its_stop_and_nothing_drives_is_planned():
    """Gravity turns the flap down, which is beyond its range: the stop holds it in the plan as in MuJoCo."""
    dynamics = RigidBodyDynamics(Mechanism.from_mjcf(ARM, contacts="off"), 0.02, substeps=8)
    cost = TrackingCost.joints(dynamics, [0.3, 0.0, 0.0, 0.0], 20, effort=0.01, final_position={"turn": 1e3})
    plan = planner.solve(Problem(dynamics, cost, np.zeros(4), limits=Limits.of_model()), max_iterations=300)
    assert plan.success
    depth = dynamics.mechanism.stops[1].law.rest_depth(0.3 * 9.81 * 0.1)  # by its weight at half of its length
    assert plan.xs[-1, 1] == pytest.approx(depth, rel=0.01)  # rad: it leans there
    assert planner.prove(plan, rollouts=0).passed


FINGER = (
    ARM.replace(' range="-60 0"', ' range="0 60"')
    .replace('name="turn"', 'name="turn" range="0 60" limited="true"')
    .replace("<actuator>", '<equality><joint joint1="turn" joint2="flap" polycoef="0 {} 0 0 0"/></equality><actuator>')
)


@pytest.mark.parametrize(("coefficient", "fixed"), [(-1.0, True), (1.0, False)])
def test_joints_that_equalities_and_ranges_leave_one_value_are_named(coefficient, fixed):
    """Of turn = -flap and two ranges from 0 only 0 is left, and the file's stops hold it there."""
    dynamics = RigidBodyDynamics(Mechanism.from_mjcf(FINGER.format(coefficient), contacts="off"), 0.02)
    cost = TrackingCost.joints(dynamics, [0.0, 0.0, 0.0, 0.0], 5, effort=1.0)
    problem = Problem(dynamics, cost, np.zeros(4))
    failed = SimpleNamespace(your_file=SimpleNamespace(failures=("replayed_angle_miss",)))
    found = fixed_joints(None, problem, failed)
    assert [one.code for one in found] == ["fixed_joints"] * fixed


HOPPER = """
<mujoco>
  <worldbody>
    <geom type="plane" size="1 1 0.1"/>
    <body pos="0 0 0.5">
      <joint name="lift" type="slide" axis="0 0 1"/>
      <geom type="sphere" size="0.05"/>
      <body pos="0 0 -0.2">
        <joint name="leg" type="slide" axis="0 0 1" range="-0.1 0.1"/>
        <geom type="sphere" size="0.03"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="leg" joint="leg"/></actuator>
</mujoco>
"""


def proof(rate=14.7, mode=None, failures=(), contacts="ground", share=12.8):
    """Of a machine whose feedback replay fails at some measurements and whose errors grow."""
    capabilities = SimpleNamespace(mechanism=Mechanism.from_mjcf(HOPPER, contacts=contacts))
    problem = SimpleNamespace(dynamics=SimpleNamespace(capabilities=capabilities))
    return SimpleNamespace(
        mode=mode, plan=SimpleNamespace(passed=True),
        replay=SimpleNamespace(plan=SimpleNamespace(problem=problem, t=np.array([0.0, 1.0]))),
        refined_feedback=SimpleNamespace(
            failures=[SimpleNamespace(name=name) for name in failures], passed=not failures
        ),
        growth=SimpleNamespace(measured=[SimpleNamespace(name="growth_rate_open_loop", value=rate)]),
        errors=SimpleNamespace(
            measured={"feedback": np.array([0.0, share])}
        ),
    )  # fmt: skip


def test_a_machine_that_falls_is_no_matter_of_margins():
    missed = ("end_angle_error",)
    (found,) = falling(None, None, proof(failures=missed))
    assert (found.code, found.value) == ("falls", None)
    assert found.values == {"rate": 14.7, "share": 12.8}
    (held,) = falling(None, None, proof(share=0.3, failures=missed))  # the gains hold it in the plan's model
    assert held.code == "ground_differs"
    assert falling(None, None, proof(share=0.3)) == []  # and in MuJoCo: it misses its goal for another reason
    assert not loses_balance(proof(rate=0.5))  # what is steady does not fall
    assert not loses_balance(proof(mode="feedback"))  # gains hold it
    assert not loses_balance(proof(failures=("position_range_violation",)))  # gains lead it into its stops
    assert not loses_balance(proof(contacts="off"))  # an arm has nothing to fall off


def test_what_is_never_touched_asks_for_no_weight(tmp_path):
    """From rest apart nothing changes the object's way: the gradient is zero, with any weight."""
    model = """<mujoco><worldbody>
      <body><joint name="hand" type="slide" axis="1 0 0" damping="1"/><geom size="0.02" mass="1"/></body>
      <body pos="0.3 0 0"><joint name="puck" type="slide" axis="1 0 0" damping="1"/><geom size=".02" mass=".2"/></body>
    </worldbody><actuator><motor joint="hand" ctrlrange="-5 5"/></actuator></mujoco>"""
    keys = {"start": "[0.0, 0.0]", "goal": "{ puck = 0.1 }", "contacts": "{ penetration = 0.003, friction = 0.8 }"}
    problem = file(tmp_path, model, keys)
    plan = planner.solve(problem, SolverOptions(homotopy=False))
    (found,) = suggested_fixes(plan)
    assert (found.code, found.value) == ("untouched", None)
    weak = file(tmp_path, model, keys | {"goal": "{ hand = 0.1 }"}, {"final_position": 1e-9, "final_velocity": 1e-9})
    away = planner.solve(weak, SolverOptions(homotopy=False))
    assert "untouched" not in [one.code for one in suggested_fixes(away)]  # the puck is in no goal
    pushed = problem.dynamics.step(np.array([[0.265, 0.0, 0.5, 0.0]]), np.zeros((1, 1)))
    assert DistantContacts(problem).touches(pushed)


def test_another_model_than_the_plans_is_no_matter_of_time(tmp_path):
    problem = arm(tmp_path)
    wrong = SimpleNamespace(name="mass_matrix_error")
    proof = SimpleNamespace(parity=SimpleNamespace(failures=[wrong]))
    (found,) = other_model(None, problem, proof)
    assert (found.code, found.value) == ("other_model", None)
    proof.parity.failures = [wrong, SimpleNamespace(name="unmodelled_elements")]
    assert other_model(None, problem, proof) == []


@pytest.mark.parametrize("substeps", [2, 16])
def test_a_solve_that_needs_far_more_than_its_work_is_told_what_its_stages_cost(substeps):
    """What an iteration gains falls by a tenth each time: that trend needs 300 of them, 25 times the 12 that ran."""
    dynamics = RigidBodyDynamics(Mechanism.from_mjcf(ARM, contacts="off"), 0.02, substeps=substeps)
    cost = TrackingCost.joints(dynamics, np.zeros(4), 20, effort=1.0)
    problem = Problem(dynamics, cost, np.zeros(4), recipe=Recipe(PROBLEM_FILE, {}))
    plan = planner.solve(replace(problem, us=np.ones((20, 1))), max_iterations=1)
    lines = [falling_line(plan.history[0], k) for k in range(12)]
    cut = replace(plan, status=planner.Status.WORK_LIMIT, history=tuple(lines), cost=lines[-1].cost,
                  problem=problem, options={"work": 60.0})  # fmt: skip
    (found,) = more_iterations(cut, problem, None)
    assert found.code == "stages_cost_too_much"
    assert (found.key, found.value) == (("integrator", "rosenbrock") if substeps == 16 else ("work", None))
    assert f"20 stages of {substeps} substeps" in found.sentence
    assert not other_guesses(cut, problem, None)


def falling_line(line, k):
    """Iteration k of a solve whose cost and expected reduction fall by a tenth each time."""
    return line._replace(iteration=k, cost=100.0 * 0.9**k, expected=10.0 * 0.9**k, step=1.0)
