"""Warm starts: a plan, shifted or stretched, as a first guess of controls, states and multipliers."""

from dataclasses import replace

import numpy as np
import pytest

import planner
from planner import Limits, PlannerError
from planner.problem.rediscretize import retimed

ARM = """<mujoco><worldbody>
  <body><joint name="a" axis="0 1 0" damping="1"/><geom type="capsule" fromto="0 0 0 0 0 -.4" size=".03"/>
    <body pos="0 0 -.4"><joint name="b" axis="0 1 0" damping="1"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.4" size=".03"/></body></body></worldbody>
  <actuator><motor joint="a"/><motor joint="b"/></actuator></mujoco>"""


def reach(limits=None, duration=1.0, N=50):
    """Two links from hanging to a pose, whose unbounded plan is faster than 4 rad/s."""
    mechanism = planner.Mechanism.from_mjcf(ARM)
    dynamics = planner.RigidBodyDynamics(mechanism, duration / N, "semi-implicit-euler")
    cost = planner.TrackingCost.reach(
        np.array([1.5, -1.0, 0.0, 0.0]), N, final=1e4, running=0.0, effort=0.01, dt=dynamics.dt, nu=2
    )
    return planner.Problem(dynamics, cost, np.zeros(4), limits=limits)


def turning():
    """A plan of a body on a ball joint, whose states have a quaternion."""
    motors = "".join(f'<motor joint="ball" gear="{axis}"/>' for axis in ("1 0 0", "0 1 0", "0 0 1"))
    mechanism = planner.Mechanism.from_mjcf(
        '<mujoco><option gravity="0 0 0"/><worldbody><body><joint name="ball" type="ball"/><geom size=".1"/></body>'
        f"</worldbody><actuator>{motors}</actuator></mujoco>"
    )
    dynamics = planner.RigidBodyDynamics(mechanism, 0.1)
    goal = mechanism.space.integrate(mechanism.home, np.r_[0.0, 0.5, 1.0, np.zeros(3)])
    cost = planner.TrackingCost.reach(
        goal, 10, final=100.0, running=0.0, effort=0.1, dt=0.1, nu=3, space=mechanism.space
    )
    return planner.solve(planner.Problem(dynamics, cost, mechanism.home))


def test_a_motion_at_its_own_knots_is_the_plan_bit_for_bit():
    plan = planner.solve(reach())
    for motion in (plan.motion.at(plan.t), plan.shifted(0.0).at(plan.t), plan.stretched(plan.t[-1]).at(plan.t)):
        np.testing.assert_array_equal(motion.xs, plan.xs)
        np.testing.assert_array_equal(motion.us, plan.us)
        np.testing.assert_array_equal(motion.K, plan.K)


def test_a_shifted_motion_is_what_is_left_of_it_and_rests_then():
    plan = planner.solve(reach())
    later = plan.shifted(0.2).at(plan.t)
    np.testing.assert_allclose(later.xs[:41], plan.xs[10:], atol=1e-12)
    np.testing.assert_array_equal(later.us[:40], plan.us[10:])
    np.testing.assert_array_equal(later.xs[41:, :2], np.tile(plan.xs[-1, :2], (10, 1)))
    assert np.all(later.xs[41:, 2:] == 0.0)
    waits = plan.shifted(-0.2).at(plan.t)
    np.testing.assert_array_equal(waits.xs[:10], np.zeros((10, 4)))
    np.testing.assert_allclose(waits.xs[10:], plan.xs[:41], atol=1e-12)


def test_a_stretched_motion_has_the_same_states_at_the_pace_of_its_duration():
    plan = planner.solve(reach())
    slow = plan.stretched(2.0)
    assert slow.t[-1] == 2.0
    np.testing.assert_array_equal(slow.xs[:, :2], plan.xs[:, :2])
    np.testing.assert_allclose(slow.xs[:, 2:], 0.5 * plan.xs[:, 2:], rtol=1e-15)
    between = slow.at(np.linspace(0.0, 2.0, 101)).xs
    np.testing.assert_allclose(between[1::2], 0.5 * (slow.xs[1:] + slow.xs[:-1]), atol=1e-12)


def test_between_knots_quaternions_stay_of_length_one():
    plan = turning()
    motion = plan.stretched(1.3).at(np.linspace(0.0, 1.3, 38))
    np.testing.assert_allclose(np.linalg.norm(motion.xs[:, :4], axis=1), 1.0, rtol=1e-14)
    np.testing.assert_array_equal(motion.xs[-1, :4], plan.xs[-1, :4])


def test_a_plan_is_its_own_warm_start():
    """With limits it needs its multipliers, too: without them it would take all rounds again."""
    for limits in (None, Limits(velocity=2.0)):
        problem = reach(limits)
        plan = planner.solve(problem)
        again = planner.solve(problem, warm_start=plan)
        assert plan.nit > 1
        assert (again.success, again.nit) == (True, 0)
        np.testing.assert_array_equal(again.us, plan.us)
        assert again.options["warm_start"] == "given"


def test_what_is_left_of_a_motion_and_a_slower_one_converge_at_once():
    problem = reach(Limits(velocity=2.0))
    plan = planner.solve(problem)
    later, slower = replace(problem, x0=plan.xs[1]), reach(Limits(velocity=2.0), 1.05)
    for task, motion in ((later, plan.shifted(plan.dt)), (slower, plan.stretched(1.05))):
        cold, warm = planner.solve(task), planner.solve(task, warm_start=motion)
        assert warm.success
        assert warm.nit < cold.nit  # 8 and 12 beside 13 and 14
        assert task.trajectory_constraints.violation(warm.xs, warm.us).max() <= task.trajectory_constraints.tolerance
        assert warm.cost == pytest.approx(cold.cost, rel=1e-3)


def test_other_stages_are_sampled():
    plan = planner.solve(reach(Limits(velocity=2.0)))
    fine = reach(Limits(velocity=2.0), N=75)
    warm = planner.solve(fine, warm_start=plan)
    assert warm.success
    assert warm.cost == pytest.approx(planner.solve(fine).cost, rel=1e-3)


def test_where_no_gains_follow_states_are_the_guess():
    """The acrobot cannot follow its own motion at another pace: from its controls alone it ends elsewhere."""
    problem = planner.cases.build("acrobot")
    plan = planner.solve(problem)
    warm = planner.solve(retimed(problem, 1.1 * plan.t[-1]), warm_start=plan.stretched(1.1 * plan.t[-1]))
    assert warm.success
    assert warm.cost < plan.cost


def test_bad_warm_starts_are_one_sentence():
    plan = planner.solve(reach())
    with pytest.raises(PlannerError, match="warm_start is 3, expected a Plan"):
        planner.solve(reach(), warm_start=3)
    with pytest.raises(PlannerError, match="warm_start has 4 states and 2 controls, expected 4 and 1"):
        planner.solve(planner.cases.build("acrobot"), warm_start=plan)
    with pytest.raises(PlannerError, match="duration"):
        plan.stretched(0.0)
    with pytest.raises(PlannerError, match="seconds"):
        plan.shifted(np.inf)
