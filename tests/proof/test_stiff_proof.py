"""Plans of a machine with a fast joint, in stages that one step of RK4 does not follow: the proof's steps do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from machines import FAST_FINGER

import planner
from planner import Mechanism, RigidBodyDynamics
from planner.cases.problem_file import load
from planner.dynamics.step_stability import IMPLICIT, MAX_RATE_STEP, fastest_mode, implicit_error, substeps_of
from planner.problem.goals import goals_of
from planner.problem.joint_limits import START_OFFSET
from planner.problem.rediscretize import finer, stage_too_long
from planner.proof.error_scales import path_error_bounds
from planner.proof.original_model import your_file
from planner.proof.replay_errors import tracking
from planner.proof.replays.compiled_twin import CompiledTwin, with_model
from planner.proof.replays.replaying import replay_in
from planner.proof.robustness.perturbation import Perturbation, draw
from planner.proof.robustness.rollouts import Rollouts
from planner.proof.same_step import same_step
from planner.proof.step_convergence import step_convergence

DT, N = 0.02, 30
MIN_RATE = 2.78 / DT  # 1/s, above which one step a stage is unstable


@pytest.fixture(scope="module")
def plan():
    m = Mechanism.from_mjcf(FAST_FINGER)
    assert fastest_mode(m, m.home).rate > 3.0 * MIN_RATE
    dynamics = RigidBodyDynamics(m, DT, substeps=substeps_of(fastest_mode(m, m.home), DT))
    goal = np.array([0.8, 0.4, 0.0, 0.0])
    cost = planner.TrackingCost.joints(dynamics, goal, N, effort=0.01, final_position=1e3, final_velocity=1e3)
    plan = planner.solve(planner.Problem(dynamics, cost, np.zeros(4)))
    assert plan.success
    return plan


def test_the_proof_passes(plan):
    assert planner.prove(plan, rollouts=0).passed


def test_at_the_plans_own_steps_mujoco_repeats_it_to_rounding(plan):
    section = same_step(plan, plan.problem, CompiledTwin(plan.twin))
    assert section.passed
    assert {measured.name for measured in section.measured} == {"state_error", "stage_error"}


def test_the_refined_replay_is_finer_than_the_substeps(plan):
    run = replay_in(CompiledTwin(plan.twin), plan)
    assert run.substeps >= 5 * plan.problem.dynamics.substeps
    assert not run.warnings
    longer = replay_in(CompiledTwin(plan.twin), plan, substeps=2)  # as the plan would be without substeps
    assert longer.warnings
    found = step_convergence(plan.problem, run)
    assert found.steps[0] == pytest.approx(DT / plan.problem.dynamics.substeps)
    assert np.isfinite(found.ends).all()
    assert found.section.passed


def test_perturbed_machines_take_at_most_half_a_substep(plan):
    with Rollouts(plan, CompiledTwin(plan.twin), threads=1) as rollouts:
        assert rollouts.step <= 0.5 * DT / plan.problem.dynamics.substeps * (1.0 + 1e-9)


def test_a_plan_of_shorter_stages_has_fewer_substeps(plan):
    problem = replace(plan.problem, us=plan.us)
    assert finer(problem).dynamics.substeps == -(-problem.dynamics.substeps // 2)
    assert finer(problem, keep_substeps=True).dynamics.substeps == problem.dynamics.substeps  # for what is unresolved


HAND = """
<mujoco><option timestep="0.002"/><worldbody><body name="arm"><joint name="arm" axis="0 1 0" damping="1"/>
  <inertial mass="1" pos="0 0 -0.3" diaginertia="0.02 0.02 0.02"/>
  <body name="finger" pos="0 0 -0.3"><joint name="finger" axis="0 1 0" damping="1" range="0 86"/>
    <inertial mass="0.02" pos="0 0 -0.02" diaginertia="1e-6 1e-6 1e-6"/></body></body></worldbody>
  <actuator><position joint="arm" kp="30" kv="2"/><position joint="finger" kp="4" ctrlrange="0 86"/></actuator></mujoco>
"""


@pytest.fixture(scope="module")
def hand(tmp_path_factory):
    """A plan of a finger with the damping of an arm, 1e5 per s, from its stop."""
    folder = tmp_path_factory.mktemp("hand")
    (folder / "hand.xml").write_text(HAND, encoding="utf-8")
    lines = 'model = "hand.xml"\nstart = [0.0, 0.0]\ngoal = [0.2, 0.4]\nduration = 0.6\n'
    (folder / "hand.toml").write_text(lines, encoding="utf-8")
    return planner.solve(load(folder / "hand.toml").problem)


def test_damping_that_rk4_does_not_follow_is_taken_implicitly(hand):
    dynamics = hand.problem.dynamics
    assert fastest_mode(dynamics.mechanism, hand.problem.x0).rate > 1e5 > 16 * MAX_RATE_STEP / 5e-4
    assert (dynamics.integrator, dynamics.dt, dynamics.substeps) == ("rosenbrock", 0.01, 4)
    assert "damping is taken implicitly" in hand.problem.recipe.parameters["resolved"]["reasons"]["substeps"]
    half = finer(hand.problem).dynamics
    assert (half.integrator, half.dt, half.substeps) == ("rosenbrock", 0.005, 16)
    assert hand.problem.x0[1] == pytest.approx(START_OFFSET)  # off its stop


def test_such_a_plan_passes_and_comes_back_from_its_file(hand, tmp_path):
    proof = planner.prove(hand, rollouts=0)
    assert proof.passed, proof.reason
    assert proof.same_step.measured[0].value < 1e-10
    assert proof.replay.integrator == "rosenbrock"
    back = planner.load_plan(hand.save(tmp_path / "plan.npz"))
    assert back.problem.dynamics.integrator == "rosenbrock"
    np.testing.assert_array_equal(back.problem.x0, hand.problem.x0)


def test_a_wrong_damping_does_not_pass(hand):
    other = HAND.replace('axis="0 1 0" damping="1" range', 'axis="0 1 0" damping="1.2" range')
    assert not planner.parity(hand.problem, other).passed
    run = planner.replay(hand, twin=with_model(hand.twin, other))
    assert not tracking(run, hand.problem).passed


def test_its_perturbed_machines_are_mujocos_implicit_ones(hand):
    with Rollouts(hand, CompiledTwin(hand.twin), threads=1) as rollouts:
        assert rollouts.integrator == "IMPLICITFAST"
        none = Perturbation(**dict.fromkeys(Perturbation().to_dict(), 0.0))
        end = rollouts.run(rollouts.batch([draw(none, 0, 0, rollouts.nominal.sizes)]), "feedback")[0, -1]
    assert np.abs(end - hand.xs[-1]).max() < 0.02


def test_a_joint_that_slips_is_faster_than_one_that_is_held():
    light = HAND.replace('damping="1" range', 'damping="0.01" frictionloss="0.1" range')
    m = Mechanism.from_mjcf(light)
    slipping = replace(m, friction_loss=np.zeros(2))
    assert fastest_mode(m, m.home).rate == fastest_mode(slipping, m.home).rate > 500.0


MOBILE_BASE = """
<mujoco><compiler angle="radian"/><option timestep="0.01" integrator="implicitfast"/><worldbody><body name="base">
  <joint name="x" type="slide" axis="1 0 0" range="-2 2"/><joint name="yaw" axis="0 0 1" range="-3 3"/>
  <inertial mass="4" pos="0.02 0 0" diaginertia="0.1 0.1 0.1"/><body name="arm" pos="0.1 0 0.1">
  <joint name="arm" axis="0 1 0" damping="1" range="-2 2"/>
  <inertial mass="1" pos="0 0 0.2" diaginertia="0.01 0.01 0.01"/></body></body></worldbody>
  <actuator><position joint="x" kp="9e6" kv="1.5e6"/><position joint="yaw" kp="2.4e5" kv="4e4"/>
  <position joint="arm" kp="100" kv="5"/></actuator></mujoco>
"""


def mobile_base(folder, more=""):
    (folder / "base.xml").write_text(MOBILE_BASE, encoding="utf-8")
    lines = f'model = "base.xml"\nstart = [0.0, 0.0, 0.3]\ngoal = [0.3, 0.4, 0.5]\nduration = 0.3\n{more}'
    (folder / "base.toml").write_text(lines, encoding="utf-8")
    return load(folder / "base.toml").problem


def test_servos_of_3e5_per_s_are_planned_at_ten_milliseconds_and_pass(tmp_path):
    problem = mobile_base(tmp_path)
    dynamics, goal = problem.dynamics, problem.cost.x_ref[-1]
    assert fastest_mode(dynamics.mechanism, problem.x0).rate > 3e5
    # where servos hold the goal: told to be at zero they would leave it at 6 rad/s, and the arm would feel it
    assert implicit_error(dynamics.mechanism, 0.01, goal) < IMPLICIT
    assert (dynamics.integrator, dynamics.dt, dynamics.substeps) == ("rosenbrock", 0.01, 16)
    proof = planner.prove(planner.solve(problem), rollouts=0)
    assert proof.passed, proof.reason


def test_a_plan_at_the_files_own_step_is_what_the_file_does(tmp_path):
    problem = mobile_base(tmp_path, 'integrator = "implicitfast"\n')
    plan = planner.solve(problem)
    assert (plan.success, problem.dynamics.dt, problem.dynamics.substeps) == (True, 0.01, 1)
    section = same_step(plan, problem, CompiledTwin(plan.twin))
    assert section.passed
    assert all("MuJoCo's IMPLICITFAST" in one.note for one in section.measured[:1])
    assert max(one.value for one in section.measured) < 1e-12
    run = replay_in(CompiledTwin(plan.twin), plan, substeps=1, integrator="IMPLICITFAST", feedback=True)
    assert np.abs(run.error).max() < 1e-12
    assert np.abs(replay_in(CompiledTwin(plan.twin), plan).error).max() > 1e-2  # as refined steps see it
    assert (finer(problem).dynamics.integrator, finer(problem).dynamics.dt) == ("rosenbrock", 0.01)


def test_stages_of_implicitfast_are_limited_by_what_is_not_damping(tmp_path):
    problem = mobile_base(tmp_path, 'integrator = "implicitfast"\n')
    assert stage_too_long(problem) == ""
    m = problem.dynamics.mechanism
    stiff = replace(m, stiffness=np.array([1e9, 0.0, 0.0]))  # sqrt(1e9 N/m / 15005 kg) = 258 per s
    long = replace(problem, dynamics=RigidBodyDynamics(stiff, 0.01, "implicitfast"))
    assert 'expected integrator="rosenbrock"' in stage_too_long(long)


FLOATING = """
<mujoco><option gravity="0 0 0"/><worldbody><body><joint type="free" damping="0.5"/>
  <geom type="box" size="0.3 0.2 0.1" mass="5"/>
  <site name="one" pos="0.2 0.1 0"/><site name="two" pos="-0.1 0.2 0.1"/></body></worldbody>
  <actuator><general site="one" gear="0 0 1 0 0 0.1"/><general site="two" gear="1 0 0 0.2 0 0"/></actuator></mujoco>"""


@pytest.mark.parametrize("case", ["prescribed", "coupled", "floating"])
def test_what_mujoco_has_no_step_for_is_repeated_with_its_accelerations(tmp_path, case):
    if case == "coupled":
        text = MOBILE_BASE.replace("<actuator>", '<equality><joint joint1="arm" joint2="yaw"/></equality><actuator>')
        m = Mechanism.from_mjcf(text)
        x0 = np.zeros(6)
        cost = planner.TrackingCost.joints(
            RigidBodyDynamics(m, 0.01), np.array([0.3, 0.4, 0.4, 0.0, 0.0, 0.0]), 30, effort=0.01,
            final_position=1e3, final_velocity=1e3,
        )  # fmt: skip
        problem = planner.Problem(RigidBodyDynamics(m, 0.01, "implicitfast"), cost, x0)
    elif case == "floating":  # a body alone, which tumbles
        m = Mechanism.from_mjcf(FLOATING)
        x0 = m.home.copy()
        x0[7:] = 0.1, 0.2, 0.3, 2.0, -1.0, 3.0
        dynamics = RigidBodyDynamics(m, 0.01, "implicitfast")
        problem = planner.Problem(dynamics, planner.TrackingCost.joints(dynamics, m.home, 30, effort=0.1), x0)
    else:
        problem = mobile_base(tmp_path, 'prescribed = ["arm"]\nintegrator = "implicitfast"\n')
    plan = planner.solve(problem)
    section = same_step(plan, problem, CompiledTwin(plan.twin))
    assert section.passed, section.failures
    assert "MuJoCo's accelerations" in section.measured[0].note


WRIST = """
<mujoco><option timestep="0.002" gravity="0 0 0"/><worldbody><body><joint name="arm" axis="0 1 0" damping="1"/>
  <inertial mass="1" pos="0 0 -0.3" diaginertia="0.02 0.02 0.02"/>
  <body pos="0 0 -0.3"><joint name="wrist" axis="0 0 1" damping="0.1"/>
    <inertial mass="0.1" pos="0 0 0" diaginertia="1e-5 1e-5 1e-5"/></body></body></worldbody>
  <actuator><motor joint="arm" ctrlrange="-9 9"/><motor joint="wrist" ctrlrange="-1 1"/></actuator></mujoco>
"""


def test_a_joint_that_stops_within_a_step_of_the_simulator_passes_in_the_file(tmp_path):
    """The wrist, of a rate of 1e4 per s, stops in 0.1 ms: MuJoCo's first-order method is off by a part of the jump."""
    (tmp_path / "wrist.xml").write_text(WRIST, encoding="utf-8")
    lines = 'model = "wrist.xml"\nstart = [0.0, 0.0]\ngoal = [0.5, 1.0]\nduration = 0.8\n[weights]\nvelocity = 0.0\n'
    (tmp_path / "wrist.toml").write_text(lines, encoding="utf-8")
    plan = planner.solve(load(tmp_path / "wrist.toml").problem)
    assert np.abs(np.diff(plan.xs[-2:, 3])).max() > 0.5 * np.abs(plan.xs[:, 3]).max()  # it stops in the last stage
    native = replay_in(CompiledTwin(plan.twin), plan, feedback=True, integrator="IMPLICITFAST")
    assert np.any(np.abs(native.error) > path_error_bounds(plan))
    section, run = your_file(plan, plan.problem, goals_of(plan.problem, plan.xs))["feedback"]
    assert run.integrator == "rosenbrock"
    assert section.passed, section.failures
    assert planner.prove(plan, rollouts=0).passed


@pytest.mark.slow
def test_each_mode_passes_in_a_stiff_file_by_an_integrator_of_its_own(tmp_path):
    """Upright, the arm doubles an error every 0.3 s, also that of MuJoCo's first-order method: gains take it back."""
    upright = WRIST.replace(' gravity="0 0 0"', "").replace("0 0 -0.3", "0 0 0.3")
    (tmp_path / "wrist.xml").write_text(upright, encoding="utf-8")
    lines = 'model = "wrist.xml"\nstart = [0.0, 0.0]\ngoal = [0.5, 1.0]\nduration = 2.0\nintegrator = "rosenbrock"\n'
    (tmp_path / "wrist.toml").write_text(lines, encoding="utf-8")
    plan = planner.solve(load(tmp_path / "wrist.toml").problem)
    twin = CompiledTwin(plan.twin)
    native = [replay_in(twin, plan, feedback=fed, integrator="IMPLICITFAST") for fed in (False, True)]
    assert [bool(np.all(np.abs(run.error) <= path_error_bounds(plan))) for run in native] == [False, True]
    proof = planner.prove(plan, rollouts=0)
    assert (proof.verdict, proof.mode) == ("PASS", "open-loop"), proof.reason
    assert any("Rosenbrock" in one.note for one in proof.your_file.measured)
    assert proof.own_step.endswith("it was judged at a step of 0.0005 s.")  # by no method that a file can ask for
