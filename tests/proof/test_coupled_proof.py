"""Plans of coupled machines pass where they are right, and fail in a model whose coupling is another."""

import numpy as np
import pytest

import planner
from planner.model.couplings import closed_state
from planner.proof.diagnostics import suggested_fixes
from planner.proof.engines.section import _reason
from planner.proof.goal_regulator import hold_gain, hold_section, simulate_regulator
from planner.proof.replays.compiled_twin import CompiledTwin
from planner.proof.replays.replaying import replay_in

TENDON = """<tendon><fixed name="grip"><joint joint="left" coef="1"/><joint joint="right" coef="1"/></fixed>
<fixed name="roll"><joint joint="shoulder" coef="1"/><joint joint="wrist" coef="2"/></fixed></tendon>"""
GRIPPER = """
<mujoco><option gravity="0 0 -9.81" timestep="0.002"><flag contact="disable"/></option>
<worldbody><body><joint name="shoulder" axis="0 1 0" damping=".5"/>
  <inertial pos=".3 0 0" mass="2" diaginertia=".02 .1 .1"/><body pos=".5 0 0"><joint name="wrist" axis="0 1 0"/>
    <inertial pos=".1 0 0" mass=".5" diaginertia=".01 .02 .02"/>
    <body pos=".2 .03 0"><joint name="left" type="slide" axis="0 1 0" damping="2"/>
      <inertial pos=".05 0 0" mass=".1" diaginertia="1e-4 1e-4 1e-4"/></body>
    <body pos=".2 -.03 0"><joint name="right" type="slide" axis="0 -1 0" damping="2"/>
      <inertial pos=".05 0 0" mass=".1" diaginertia="1e-4 1e-4 1e-4"/></body></body></body></worldbody>
{tendon}<equality>{equality}</equality>
<actuator><motor joint="shoulder"/>{wrist}<motor joint="left"/></actuator></mujoco>
"""
MIMIC = '<joint name="mimic" joint1="right" joint2="left" solref=".02 1"/>'
MACHINES = {
    "a gripper": (MIMIC, '<motor joint="wrist"/>', [0.5, -1.0, 0.02, 0.02]),
    "a gripper on a wrist that a belt turns": (
        f'{MIMIC}<tendon name="belt" tendon1="roll" polycoef=".2"/>', "", [0.6, -0.2, 0.02, 0.02],
    ),
}  # fmt: skip


def text(name, equality=""):
    own, wrist, _ = MACHINES[name]
    return GRIPPER.format(tendon=TENDON, equality=equality or own, wrist=wrist)


# The second has all that the first has.
@pytest.fixture(scope="module", params=[pytest.param("a gripper", marks=pytest.mark.slow), list(MACHINES)[1]])
def proven(request):
    mechanism = planner.Mechanism.from_mjcf(text(request.param))
    dynamics = planner.RigidBodyDynamics(mechanism, 0.02)
    start = closed_state(mechanism, mechanism.home)
    goal = np.concatenate([MACHINES[request.param][2], np.zeros(4)])
    cost = planner.TrackingCost.joints(
        dynamics, goal, 50, effort=0.01, final_position=1000.0, final_velocity=100.0, velocity=0.1
    )
    plan = planner.solve(planner.Problem(dynamics, cost, start))
    assert plan.success
    return request.param, plan, planner.prove(plan, rollouts=2)


def measured(section, name):
    return next(one for one in section.measured if one.name == name)


def test_a_right_plan_passes(proven):
    _, plan, proof = proven
    assert proof.passed, proof.reason
    assert measured(proof.parity, "acceleration_error").value < 1e-12
    assert 0.0 < measured(proof.parity, "soft_acceleration_difference").value < 1e-2  # solimp 0.9999: some 1e-4
    assert measured(proof.same_step, "stage_error").value < 1e-13
    m = plan.problem.dynamics.mechanism
    on = np.array([closed_state(m, x) for x in plan.xs])
    np.testing.assert_allclose(on, plan.xs, rtol=0.0, atol=1e-13)
    # the coupling of the replay is a spring of two steps: what it gives is far below the bounds of a path
    run = proof.replays["feedback"]
    assert np.abs(run.error[:, 3]).max() < 1e-6
    assert proof.perturbed.passed


def test_the_replay_is_as_hard_as_its_step(proven):
    """Two steps, which MuJoCo takes at the least, also where a file switches that safeguard off."""
    _, plan, _ = proven
    for step in (1e-3, 1e-4):
        np.testing.assert_array_equal(CompiledTwin(plan.twin).stepping(step).eq_solref[:, 0], 2.0 * step)


def test_the_users_own_softness_is_judged_in_their_file(proven):
    """Its time constant is 0.02 s, and its deviations are larger than those of the hard replay."""
    _, plan, proof = proven
    assert 'solref=".02 1"' in plan.twin.original
    assert proof.your_file.passed
    own = measured(proof.your_file, "largest_velocity_error").value
    assert own > 10.0 * np.abs(proof.replays["feedback"].error[:, 6:]).max()


@pytest.mark.parametrize("other", ['<joint joint1="right" joint2="left" polycoef="0 1.01"/>', " "])
def test_another_coupling_is_another_machine(proven, other):
    name, plan, _ = proven
    section = planner.parity(plan.problem, text(name, other))
    assert not section.passed
    assert "equalities of joints are others" in section.failures[0].note


def test_the_goal_is_held(proven):
    """By gains of the free coordinates alone: the others' are no motion that gains could make stable."""
    _, plan, _ = proven
    hold = hold_gain(plan.problem)
    reduction = plan.problem.dynamics.mechanism.reduction
    assert not np.any(hold.K[:, reduction.dependent])
    run = replay_in(CompiledTwin(plan.twin), plan, feedback=True)
    assert hold_section(simulate_regulator(run, hold, 2.0)).passed


def test_other_engines_are_not_asked(proven):
    _, plan, _ = proven
    reason = _reason(plan.problem.dynamics, CompiledTwin(plan.twin).model)
    assert "coupled by equality 'mimic'" in reason


# An arm that turns about the vertical pulls its fingers outwards, and the file's equality, a spring, gives.
FINGERS = """<mujoco><worldbody><body><joint name="yaw" axis="0 0 1" damping="1"/>
  <inertial pos=".3 0 0" mass="2" diaginertia=".02 .1 .1"/>
  <body name="one" pos=".5 0 0"><joint name="left" type="slide" axis="1 0 0" range="-.02 .02"/>
    <inertial pos=".05 0 0" mass=".05" diaginertia="1e-4 1e-4 1e-4"/></body>
  <body name="two" pos=".5 0 0"><joint name="right" type="slide" axis="1 0 0" damping="1" range="-.02 .02"/>
    <inertial pos=".05 0 0" mass=".05" diaginertia="1e-4 1e-4 1e-4"/></body></body></worldbody>
  <equality><joint joint1="right" joint2="left" solref="{time} 1"/></equality>
  <actuator><motor joint="yaw"/><position joint="left" kp="400" kv="9"/></actuator></mujoco>"""


def still_fingers(time, more=""):
    text = FINGERS.format(time=time).replace('axis="0 0 1" damping="1"', f'axis="0 0 1" damping="1"{more}')
    mechanism = planner.Mechanism.from_mjcf(text)
    goals = planner.Goal(joints={"yaw": 1.5, "left": 0.0})
    return planner.prove(planner.solve(planner.task(mechanism, mechanism.home, goals, duration=1.0)), rollouts=0)


def test_a_finger_that_hardly_moves_may_give_as_its_equality_does():
    """By a hundredth of its range of 40 mm, more than a finger that the plan does not move may be off elsewhere."""
    proof = still_fingers(0.02)
    assert proof.passed, proof.reason
    off = measured(proof.your_file, "largest_distance_error")
    assert 5e-5 < off.value < off.bound == pytest.approx(4e-4)


def test_an_equality_that_gives_too_much_is_told_with_the_stiffness_that_passes():
    """A spring four times as soft: the finger goes its own way."""
    proof = still_fingers(0.04)
    assert not proof.passed
    found = suggested_fixes(proof.replay.plan, proof)[-1]
    assert (found.code, found.values["rate"]) == ("equality_gives", pytest.approx(25.0))
    assert 'solref="' in found.sentence
    assert still_fingers(found.values["time"]).passed
