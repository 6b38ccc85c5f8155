"""check_derivatives: a wrong entry is named, a right one and a kink are not; limits by the units of coordinates."""

import numpy as np
import pytest
from solves import pendulum, pendulum_jacobian

import planner
from planner import FunctionDynamics, Limits, Mechanism, PlannerError, Problem, RigidBodyDynamics, TrackingCost

COORDINATES = [("angle", "rad"), ("speed", "rad/s")]


def dynamics_with(own):
    return FunctionDynamics(pendulum, nx=2, nu=1, dt=0.02, jacobian=own, coordinates=COORDINATES)


class Quartic:
    """(x0^4 + u^2) / 2 at each stage, with a gradient of the control that is right or lacks a factor."""

    def __init__(self, factor=1.0):
        self.factor = factor

    def value(self, xs, us):
        return float(0.5 * np.sum(xs[:, 0] ** 4) + 0.5 * np.sum(us**2))

    def quadratize(self, xs, us):
        Q, q = np.zeros((len(xs), 2, 2)), np.zeros((len(xs), 2))
        Q[:, 0, 0], q[:, 0] = 6.0 * xs[:, 0] ** 2, 2.0 * xs[:, 0] ** 3
        R = np.tile(np.eye(1), (len(us), 1, 1))
        return planner.costs.Quadratic(Q, q, R, self.factor * us)


def problem_of(own=pendulum_jacobian, factor=1.0):
    return Problem(dynamics_with(own), Quartic(factor), [0.5, 0.0], horizon=20)


def test_right_derivatives_pass():
    check = planner.check_derivatives(problem_of())
    assert check.passed, str(check)
    assert len(check.entries) == 2 * 3 + 2 * 2 + 1  # next states by x and u; the cost by x, x at the end, and u


def test_a_wrong_entry_of_the_dynamics_is_named():
    check = planner.check_derivatives(dynamics_with(lambda x, u: pendulum_jacobian(x, u, gravity=9.0)))
    worst = max(check.entries, key=lambda one: one.error)
    assert (worst.of, worst.by) == ("speed, next", "angle")
    assert not check.passed
    assert "speed, next" in str(check).splitlines()[1]
    assert "WRONG" in str(check)


def test_a_wrong_gradient_of_a_cost_is_named():
    check = planner.check_derivatives(problem_of(factor=2.0))
    wrong = [one for one in check.entries if not one.passed]
    assert [(one.of, one.by) for one in wrong] == [("cost", "u[0]")]
    assert wrong[0].given == pytest.approx(2.0 * wrong[0].differenced, rel=1e-3)  # beside 30^4: rounding
    alone = planner.check_derivatives(Quartic(2.0), xs=np.ones((3, 2)), us=np.ones((2, 1)))
    assert [one.by for one in alone.entries if not one.passed] == ["u[0]"]


def test_a_kink_says_nothing():
    """|u| at 0.3 of a step: differences of two lengths disagree, so no derivative can be called wrong."""

    class Kinked(Quartic):
        def value(self, xs, us):
            return float(np.sum(np.abs(us - 0.3e-4)))

        def quadratize(self, xs, us):
            return super().quadratize(xs, us)._replace(q=np.zeros((len(xs), 2)))

    check = planner.check_derivatives(Kinked(), xs=np.zeros((3, 2)), us=np.zeros((2, 1)))
    assert check.passed
    assert "not smooth" in str(check)


def test_a_machine_with_quaternions_passes():
    mechanism = Mechanism.from_mjcf(
        '<mujoco><worldbody><body><joint name="b" type="ball"/><geom size="0.1" pos="0.1 0 0.2"/></body></worldbody>'
        '<actuator><motor joint="b" gear="1 0 0"/></actuator></mujoco>', contacts="off",
    )  # fmt: skip
    assert planner.check_derivatives(RigidBodyDynamics(mechanism, dt=0.01)).passed


def test_what_has_no_derivatives_is_refused():
    with pytest.raises(PlannerError, match="expected a Problem, dynamics or a cost"):
        planner.check_derivatives(3)
    with pytest.raises(PlannerError, match="does not know its sizes, expected xs and us"):
        planner.check_derivatives(Quartic())


@pytest.mark.parametrize("velocity", [4.0, (-4.0, 4.0), {"speed": 4.0}, {"speed": [-4.0, 4.0]}])
def test_velocities_of_own_dynamics_are_limited_by_their_unit_or_name(velocity):
    """Swung to 2 rad in 0.6 s, a minimum-effort motion is faster than 4 rad/s: the limit acts."""
    dynamics = dynamics_with(None)
    cost = TrackingCost.reach([2.0, 0.0], 30, final=1000.0, effort=0.01, dt=0.02)
    free = planner.solve(Problem(dynamics, cost, [0.0, 0.0]))
    assert np.abs(free.xs[:, 1]).max() > 4.5
    plan = planner.solve(Problem(dynamics, cost, [0.0, 0.0], limits=Limits(velocity=velocity)))
    assert np.abs(plan.xs[:, 1]).max() == pytest.approx(4.0, abs=2e-4)  # twice the limits' tolerance


def test_limits_of_positions_and_refusals_of_own_dynamics():
    dynamics, cost = dynamics_with(None), TrackingCost.reach([0.5, 0.0], 5, final=1.0, effort=1.0, dt=0.02)
    ranges = Problem(dynamics, cost, [0.0, 0.0], limits=Limits(position=(-1.0, 2.0))).ranges
    assert ranges.component.tolist() == [0]
    unnamed = FunctionDynamics(pendulum, nx=2, nu=1, dt=0.02)
    for given, said in (
        (Limits(velocity=4.0), r"no coordinate of the dynamics has the unit of one: write coordinates="),
        (Limits(velocity={"sped": 4.0}), r"the coordinate in the limits' velocity is 'sped', .* Did you mean"),
        (Limits(velocity="model"), r"no mechanism: expected numbers"),
    ):
        machine = dynamics if isinstance(given.velocity, dict) else unnamed
        with pytest.raises(PlannerError, match=said):
            Problem(machine, cost, [0.0, 0.0], limits=given)


def test_one_number_limits_all_that_it_can_only_mean():
    """Semi-implicit Euler takes positions, then as many velocities; `state` is all of both."""
    halves = FunctionDynamics(pendulum, nx=2, nu=1, dt=0.02, integrator="semi-implicit-euler")
    cost = TrackingCost.reach([0.0, 0.0], 5, final=1.0, effort=1.0, dt=0.02)
    for given, components in (
        (Limits(velocity=4.0), [1]),
        (Limits(position=(-1.0, 2.0)), [0]),
        (Limits(state=4.0), [0, 1]),
    ):
        ranges = Problem(halves, cost, [0.0, 0.0], limits=given).ranges
        assert ranges.component.tolist() == components
        assert ranges.upper[-1].tolist() == [2.0 if given.position else 4.0] * len(components)


class Fast(Quartic):
    """100 (|x1| - 4)^2 / 2 where the speed is above 4, with a gradient that is right or lacks a factor."""

    def value(self, xs, us):
        return float(50.0 * np.sum(np.maximum(np.abs(xs[:, 1]) - 4.0, 0.0) ** 2))

    def quadratize(self, xs, us):
        over = np.maximum(np.abs(xs[:, 1]) - 4.0, 0.0)
        Q, q = np.zeros((len(xs), 2, 2)), np.zeros((len(xs), 2))
        Q[:, 1, 1], q[:, 1] = 100.0 * (over > 0.0), self.factor * 100.0 * over * np.sign(xs[:, 1])
        return planner.costs.Quadratic(Q, q, np.zeros((len(us), 1, 1)), np.zeros_like(us))


def test_a_penalty_that_acts_far_from_the_start_and_beside_others_is_checked():
    """It is zero about the start, and small beside the weight of the end."""
    track = TrackingCost.reach([0.0, 0.0], 20, final=1e6, effort=1.0)
    for factor, right in ((1.0, True), (2.0, False)):
        check = planner.check_derivatives(Problem(dynamics_with(pendulum_jacobian), track + Fast(factor), [0.5, 0.0]))
        wrong = {(one.of, one.by) for one in check.entries if not one.passed}
        assert check.passed == right, str(check)
        assert wrong <= {("Fast", "speed"), ("Fast", "speed at the end")}


def test_a_cost_that_is_not_defined_far_from_the_start_is_checked_near_it():
    class Barrier(Quartic):
        def value(self, xs, us):
            with np.errstate(all="ignore"):
                return float(-np.sum(np.log(4.0 - xs[:, 0] ** 2)))

        def quadratize(self, xs, us):
            q = np.zeros((len(xs), 2))
            q[:, 0] = self.factor * 2.0 * xs[:, 0] / (4.0 - xs[:, 0] ** 2)
            Q = np.zeros((len(xs), 2, 2))
            return planner.costs.Quadratic(Q, q, np.zeros((len(us), 1, 1)), np.zeros_like(us))

    for factor, right in ((1.0, True), (2.0, False)):
        problem = Problem(dynamics_with(pendulum_jacobian), Barrier(factor), [0.0, 0.0], horizon=20)
        assert planner.check_derivatives(problem).passed == right
