"""Second-order terms of the dynamics against differences of exact Jacobians, and the solves that use them."""

import itertools

import numpy as np
import pytest
from engines import assert_same_iterations, both_engines
from gradients import second_order_differences
from hypothesis import strategies as st
from solves import hopper, linear, pendulum, pendulum_jacobian, rollout, swing
from trees import CHAINS, actuated, driven, machines, relative_error

import planner
from planner import FunctionDynamics, PlannerError, Problem, TrackingCost
from planner.dynamics import INTEGRATORS, HopperDynamics, RigidBodyDynamics
from planner.solvers import lq

each_integrator = pytest.mark.parametrize("integrator", INTEGRATORS)
# ------------------------------------------------------------------------------------------------ the terms


@machines(20, max_dofs=8, max_bodies=6, plain=True, integrator=st.sampled_from(INTEGRATORS))
def test_second_derivatives_of_trees_are_differences(text, seed, integrator):
    """With springs, dampers, every kind of actuator, activations and prescribed joints; four knots and one."""
    dynamics, xs, us, rng = driven(text, seed, K=5, integrator=integrator, dt=0.1)
    xs, costates = np.vstack([xs, xs[:1]]), rng.normal(size=(6, dynamics.nx))
    T = dynamics.second_order(xs, us, costates)
    assert relative_error(T, second_order_differences(dynamics, xs, us, costates)) < 1e-7
    np.testing.assert_array_equal(T, T.swapaxes(1, 2))


@each_integrator
def test_second_derivatives_of_the_hopper_are_differences(integrator):
    """On the ground, in the air and between; not across the ends of the parabola, where the derivative jumps."""
    dynamics, rng = HopperDynamics(0.05, integrator, smoothing=2.0), np.random.default_rng(0)
    xs, us, costates = (
        rng.normal(size=(201, 3)) * [2.0, 10.0, 2.0],
        rng.normal(size=(200, 1)),
        rng.normal(size=(201, 3)),
    )
    T, theirs = dynamics.second_order(xs, us, costates), second_order_differences(dynamics, xs, us, costates, 1e-6)
    wrong = np.abs(T - theirs).max(axis=(1, 2)) > 1e-7
    assert wrong.sum() <= 2  # knots of 200 where a difference of 1e-6 may trip over a kink
    curved = np.abs(T).max(axis=(1, 2)) > 0.0
    assert 20 < curved.sum() < 200


@pytest.mark.parametrize(("exact", "tolerance"), [(True, 1e-8), (False, 1e-3)])
@pytest.mark.parametrize("integrator", ["euler", "semi-implicit-euler", "rk4", "discrete"])
def test_second_derivatives_of_a_users_own_dynamics_are_near(integrator, exact, tolerance):
    """By differences: the one of the pendulum in closed form where the step is one evaluation."""
    rng = np.random.default_rng(1)
    xs, us, costates = rng.normal(size=(5, 2)), rng.normal(size=(4, 1)), rng.normal(size=(5, 2))
    dynamics = FunctionDynamics(pendulum, 2, 1, 0.1, integrator, pendulum_jacobian if exact else None)
    T = dynamics.second_order(xs, us, costates)
    if integrator == "rk4":
        twin = FunctionDynamics(pendulum, 2, 1, 0.1, integrator, pendulum_jacobian)
        assert relative_error(T, second_order_differences(twin, xs, us, costates)) < tolerance
        return
    weight = {"euler": 0.1, "semi-implicit-euler": 0.1, "discrete": 1.0}[integrator] * costates[1:, 1]
    if integrator == "semi-implicit-euler":
        weight += 0.01 * costates[1:, 0]
    theirs = np.zeros((4, 3, 3))
    theirs[:, 0, 0] = 9.81 * np.sin(xs[:4, 0]) * weight
    assert relative_error(T, theirs) < tolerance


# ------------------------------------------------------------------------------------------------ the sweep


def arm(integrator="rk4", N=12, name="arm"):
    """A small machine, far from the stationary point."""
    rng = np.random.default_rng(2)
    m = planner.Mechanism.from_mjcf(actuated(CHAINS[name], rng))
    dynamics = RigidBodyDynamics(m, 0.03, integrator)
    goal = m.space.integrate(m.home, 0.4 * rng.normal(size=m.space.ndx))
    cost = TrackingCost.reach(goal, N, final=100.0, running=1.0, effort=0.1, dt=0.03, nu=m.nu, space=m.space)
    return Problem(dynamics, cost, m.home)


def tasks():
    cases = {f"arm {integrator}": (lambda i=integrator: arm(i)) for integrator in INTEGRATORS}
    return cases | {f"hopper {name}": (lambda n=name: hopper(n)) for name in ("short", "semi-implicit", "paper 1")}


each_task = pytest.mark.parametrize("make", tasks().values(), ids=tasks())


@each_task
@pytest.mark.parametrize("feedback", [True, False])
def test_both_engines_do_the_same(make, feedback):
    task = make()
    assert assert_same_iterations(both_engines(task), task, [feedback] * 4, exact=True, within=1e-7)


@each_task
def test_the_sweep_is_the_hessian_of_the_cost(make):
    """The curvature of J along the solution dU of the LQ problem.

    At the minimum of the model, regularized by mu, dU' (H + mu) dU = -slope: so H dU may be compared with how the
    gradient of Eq. 19 changes along dU. The sweep of Gauss and Newton has another curvature.
    """
    task = make()
    us = planner.solve(task, max_iterations=3).us
    xs, _ = rollout(task, us)
    A, B = task.dynamics.linearize(xs, us)
    model = task.cost.quadratize(xs, us)
    T = task.dynamics.second_order(xs, us, lq.costates(A, model))
    mu = 0.0
    while (sweep := lq.riccati(A, B, model, mu, second=T)) is None:
        mu = max(1.0, 4.0 * mu)
    _, dus = lq.direction(A, B, sweep)
    h = 1e-6 / np.abs(dus).max()

    def slope(t):
        states, controls = rollout(task, us + t * dus)
        A, B = task.dynamics.linearize(states, controls)
        return float(np.sum(lq.gradient(A, B, task.cost.quadratize(states, controls)) * dus))

    assert slope(0.0) == pytest.approx(sweep.slope, rel=1e-9)
    curvature = (slope(h) - slope(-h)) / (2.0 * h)
    assert curvature == pytest.approx(-sweep.slope - mu * np.sum(dus * dus), rel=1e-5)


def test_linear_dynamics_have_none():
    task = linear(3)
    plain, exact = planner.solve(task), planner.solve(task, hessian="exact")
    assert exact.success
    np.testing.assert_allclose(exact.us, plain.us, rtol=0, atol=1e-8)


# ------------------------------------------------------------------------------------------------ solves


@each_integrator
def test_newton_steps_converge_quadratically(integrator):
    """At the end a step squares the gradient, where Gauss and Newton's divide it by a constant."""
    orders = {}
    for hessian in ("exact", "gauss-newton"):
        plan = planner.solve(
            arm(integrator), hessian=hessian, gradient_tolerance=1e-13, expected_reduction_tolerance=0.0
        )
        norms = np.array([line.gradient_norm for line in plan.history])
        relative = norms / norms[0]
        # between where the model begins to hold and where rounding does
        orders[hessian] = [
            np.log(after) / np.log(before) for before, after in itertools.pairwise(relative) if 1e-7 < before < 5e-3
        ]
    assert len(orders["exact"]) >= 2
    assert min(orders["exact"]) > 1.5
    assert min(orders["gauss-newton"]) < 1.3


@pytest.mark.parametrize("task", [hopper, lambda: arm("rk4"), swing], ids=["hopper", "arm", "pendulum"])
def test_the_same_minimum_in_fewer_or_as_many_iterations(task):
    problem = task()
    plain, exact = planner.solve(problem), planner.solve(problem, hessian="exact")
    assert exact.success
    assert exact.options["hessian"] == "exact"
    assert plain.options["hessian"] == "gauss-newton"
    assert exact.cost == pytest.approx(plain.cost, rel=1e-6)
    xs, us = rollout(problem, exact.us)
    assert exact.cost == pytest.approx(problem.cost.value(xs, us), rel=1e-12)


def test_steps_that_outrun_the_regularization_end_converged():
    """Newton steps reach the last digit of the cost while states are still held: the plain model is asked in time."""
    problem = planner.cases.build("two-link")
    plan = planner.solve(problem, hessian="exact")
    assert any(line.regularization > 0.0 for line in plan.history)
    assert plan.success


def test_the_wolfe_rule_goes_on_in_numpy():
    problem = arm("rk4", N=6)
    plan = planner.solve(problem, hessian="exact", line_search="wolfe")
    assert plan.success
    assert plan.cost == pytest.approx(planner.solve(problem, hessian="exact").cost, rel=1e-6)


def test_an_exact_solve_leaves_nothing_behind():
    """Engines are used again: the next solve is Gauss and Newton's, bit for bit."""
    problem = arm("semi-implicit-euler")
    before = planner.solve(problem)
    planner.solve(problem, hessian="exact")
    after = planner.solve(problem)
    np.testing.assert_array_equal(before.us, after.us)
    assert before.history == after.history


# ------------------------------------------------------------------------------------------------ bad input


def test_exact_hessians_of_unsuited_problems_are_refused():
    with pytest.raises(PlannerError, match=r"hessian is 'newton', expected one of: gauss-newton, exact\."):
        planner.solve(hopper(), hessian="newton")
    with pytest.raises(PlannerError, match=r"hinges and slides .* ball or free joint"):
        planner.solve(arm(name="balls"), hessian="exact")


class Mine:
    """A user's own dynamics without second derivatives, or with wrong ones."""

    nx, nu, dt = 2, 1, 0.1

    def step(self, xs, us, dt=None):
        return xs + self.dt * np.concatenate([xs[:, 1:], us], axis=1)

    def linearize(self, xs, us):
        A, B = np.tile(np.eye(2), (len(us), 1, 1)), np.zeros((len(us), 2, 1))
        A[:, 0, 1] = B[:, 1, 0] = self.dt
        return A, B


class Wrong(Mine):
    def second_order(self, xs, us, costates):
        return np.zeros((len(us), 2, 2))


@pytest.mark.parametrize(
    ("dynamics", "sentence"),
    [(Mine(), "needs second derivatives"), (Wrong(), r"second_order gives .*\(5, 2, 2\), expected \(5, 3, 3\)")],
)
def test_a_users_own_dynamics_are_told(dynamics, sentence):
    problem = Problem(dynamics, TrackingCost.reach([1.0, 0.0], 5, final=10.0, effort=1.0, dt=0.1), np.zeros(2))
    assert planner.solve(problem).success
    with pytest.raises(PlannerError, match=sentence):
        planner.solve(problem, hessian="exact")
