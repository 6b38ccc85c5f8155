"""Holding a goal: the regulator solves its Riccati equation, and MuJoCo stays up with it after arriving."""

from dataclasses import replace

import numpy as np
import pytest

import planner
from planner.proof.error_scales import path_error_bounds
from planner.proof.goal_regulator import GoalRegulator, hold_gain, hold_section, simulate_regulator

BALL = """
<mujoco model="trunk">
  <compiler angle="radian"/>
  <option gravity="0 0 -9.81"/>
  <worldbody>
    <body>
      <joint name="hip" type="ball"/>
      <inertial pos="0.1 0 0.4" mass="2" diaginertia="0.05 0.06 0.04"/>
    </body>
  </worldbody>
  <actuator>
    <motor joint="hip" gear="1 0 0"/><motor joint="hip" gear="0 1 0"/><motor joint="hip" gear="0 0 1"/>
  </actuator>
</mujoco>
"""
UPRIGHT = [0.5 * np.pi, 0.0, 0.0, 0.0]


@pytest.fixture(scope="module")
def arrived():
    return planner.replay(planner.solve(planner.cases.acrobot()), feedback=True)


def figure(section, name):
    return next(figure for figure in section.measured if figure.name == name)


def linear(A, B, goal, dt=0.1, nu=1):
    """x+ = x + dt (A x + B u), by Euler, to a goal."""
    A, B = np.array(A, dtype=float), np.array(B, dtype=float)
    dynamics = planner.FunctionDynamics(lambda x, u: x @ A.T + u @ B.T, len(A), nu, dt, "euler")
    cost = planner.TrackingCost.reach(goal, 10, final=10.0, effort=1.0, running=0.5, dt=dt, nu=nu)
    return planner.Problem(dynamics, cost, x0=np.zeros(len(A)))


def test_the_acrobot_stays_up_for_ten_seconds(arrived):
    regulator = hold_gain(arrived.plan.problem)
    held = simulate_regulator(arrived, regulator, 10.0)
    section = hold_section(held)
    assert section.passed, section.failures
    np.testing.assert_array_equal(held.xs[0], arrived.xs[-1])
    assert held.t[0] == arrived.t[-1]
    assert held.t[-1] - held.t[0] == pytest.approx(10.0)
    assert np.diff(held.t) == pytest.approx(arrived.timestep)
    np.testing.assert_allclose(regulator.x_goal, UPRIGHT)
    np.testing.assert_allclose(regulator.u_goal, 0.0, atol=1e-12)
    np.testing.assert_array_equal(held.hold.K, regulator.K)
    np.testing.assert_allclose(held.deviation[-1], held.xs[-1] - UPRIGHT)
    last, bounds = held.deviation[held.t >= held.t[-1] - 1.0], path_error_bounds(arrived.plan)
    for word, unit, which in (("angle", "rad", slice(2)), ("angular_velocity", "rad/s", slice(2, 4))):
        one, largest = (figure(section, f"{part}_{word}_deviation") for part in ("held", "largest_held"))
        assert (one.unit, largest.bound) == (unit, None)
        assert one.value / one.bound == pytest.approx(np.max(np.abs(last[:, which]) / bounds[which]))
        assert largest.value in np.abs(held.deviation[:, which]).max(axis=0)
    assert figure(section, "held_angle_deviation").note.startswith(("of shoulder", "of elbow"))


def test_without_gains_it_falls(arrived):
    """The bound can be missed, and the goal does not hold itself."""
    regulator = hold_gain(arrived.plan.problem)
    section = hold_section(simulate_regulator(arrived, replace(regulator, K=0.0 * regulator.K), 3.0))
    assert [bad.name for bad in section.failures] == ["held_angle_deviation", "held_angular_velocity_deviation"]
    assert figure(section, "held_angle_deviation").value > 1.0  # rad


def test_a_runaway_fails(arrived):
    regulator = hold_gain(arrived.plan.problem)
    away = simulate_regulator(arrived, replace(regulator, K=-1e6 * regulator.K), 1.0)
    assert not hold_section(away).passed
    assert figure(hold_section(away), "held_angle_deviation").value == np.inf
    nowhere = replace(arrived, qpos=np.full_like(arrived.qpos, np.nan))
    assert figure(hold_section(simulate_regulator(nowhere, regulator, 1.0)), "held_angle_deviation").value == np.inf


def test_the_gains_are_the_limit_of_the_riccati_recursion():
    """A goal off the origin of an unstable plant, which takes a control to keep."""
    problem = linear([[0.0, 1.0], [3.0, 0.0]], [[0.0], [1.0]], goal=[0.5, 0.0])
    regulator = hold_gain(problem)
    np.testing.assert_allclose(regulator.u_goal, [-1.5], atol=1e-9)
    np.testing.assert_allclose(regulator.control(np.array([0.5, 0.0])), [-1.5], atol=1e-9)
    A, B = (M[0] for M in problem.dynamics.linearize(np.zeros((2, 2)), np.zeros((1, 1))))
    Q, R = (0.1 * 10.0 + 0.1 * 0.5) * np.eye(2), 0.1 * np.eye(1)  # the final weight per second, and that of a stage
    P = Q
    for _ in range(2000):
        K = -np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
        P = Q + A.T @ P @ (A + B @ K)
    np.testing.assert_allclose(regulator.K, K, rtol=1e-4)  # 1e-6 of the weight are added, for what costs nothing


def test_joints_that_cost_nothing_at_the_end_may_move_to_stand_still():
    """A mass on a spring whose rest position is free: the goal asks for the mass only."""

    def rates(x, u):
        return np.stack([x[..., 1], 9.0 * (x[..., 2] - x[..., 0]) - 4.5, u[..., 0]], axis=-1)

    dynamics = planner.FunctionDynamics(rates, 3, 1, 0.02)
    Q = np.zeros((6, 3, 3))
    Q[-1] = np.diag([50.0, 1.0, 0.0])
    cost = planner.TrackingCost(Q, np.full((5, 1, 1), 0.02), np.array([2.0, 0.0, 0.0]))
    regulator = hold_gain(planner.Problem(dynamics, cost, x0=np.zeros(3)))
    np.testing.assert_allclose(regulator.x_goal, [2.0, 0.0, 2.5], atol=1e-9)


def test_an_orientation_is_held_on_the_group():
    mechanism = planner.Mechanism.from_mjcf(BALL)
    dynamics = planner.RigidBodyDynamics(mechanism, 0.01)
    half = 0.5 * 0.7
    goal = np.array([np.cos(half), 0.0, np.sin(half), 0.0, 0.0, 0.0, 0.0])
    cost = planner.TrackingCost.joints(dynamics, goal, 100, final_position=300.0, final_velocity=30.0, effort=0.01)
    plan = planner.solve(planner.Problem(dynamics, cost, x0=mechanism.home))
    regulator = hold_gain(plan.problem)
    assert regulator.K.shape == (3, 6)
    assert np.abs(regulator.u_goal).max() > 1.0  # gravity
    held = simulate_regulator(planner.replay(plan, feedback=True), regulator, 3.0)
    section = hold_section(held)
    assert section.passed, section.failures
    assert held.deviation.shape[1] == 6


def falling():
    """A trunk that no motor holds beside the upright."""
    mechanism = planner.Mechanism.from_mjcf(BALL.replace('gear="0 1 0"', 'gear="0 0 1"'))
    dynamics, goal = planner.RigidBodyDynamics(mechanism, 0.01), np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    cost = planner.TrackingCost.joints(dynamics, goal, 10, final_position=300.0, final_velocity=30.0, effort=0.01)
    return planner.Problem(dynamics, cost, x0=mechanism.home)


def no_goal():
    cost = planner.TrackingCost(np.zeros((301, 4, 4)), np.ones((300, 1, 1)))
    return replace(planner.cases.acrobot(), cost=cost)


@pytest.mark.parametrize(
    ("problem", "fragment"),
    [
        (planner.cases.hopper(), "no equilibrium"),  # in the air
        (linear([[0, 1], [0, 0]], [[0], [1]], goal=[0.5, 2.0]), r"x\[0\] changes by 2 per"),
        (falling(), "velocity of hip rotation about y changes by .* rad/s per second"),
        (linear([[0, 0], [0, 1]], [[1], [0]], goal=[0.5, 0.0]), "cannot be held"),
        (no_goal(), "0 terms"),
    ],
    ids=["in the air", "moving", "falling", "not stabilizable", "no goal"],
)
def test_goals_that_cannot_be_held_are_refused(problem, fragment):
    with pytest.raises(planner.PlannerError, match=fragment) as caught:
        hold_gain(problem)
    assert "\n" not in str(caught.value)


def test_wrong_times_to_hold_are_refused(arrived):
    with pytest.raises(planner.PlannerError, match="seconds is -1"):
        simulate_regulator(arrived, hold_gain(arrived.plan.problem), -1.0)
    with pytest.raises(planner.PlannerError, match="expected 1 to 5000000"):
        simulate_regulator(arrived, hold_gain(arrived.plan.problem), 1e9)
    other = GoalRegulator(np.zeros(4), np.zeros(2), np.zeros((2, 4)), arrived.plan.space)
    with pytest.raises(planner.PlannerError, match="the gains have shape"):
        simulate_regulator(arrived, other)
