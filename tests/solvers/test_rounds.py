"""Rounds of the augmented Lagrangian: early ones are not solved to the end, and it stops once they are in vain."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from planner import Constraint, FunctionDynamics, Limits, Problem, Status, TrackingCost, load_problem, solve
from planner.cases import two_link
from planner.problem.constraints import trajectory_constraints
from planner.problem.constraints.trajectory_constraints import BoundPenalties
from planner.solvers import augmented_lagrangian, slq
from planner.solvers.engine import acquire_engine
from planner.solvers.options import SolverOptions
from planner.solvers.step_control import Regularization

N, DT = 15, 0.1


def point(*constraints):
    """A point mass in the plane from rest at (0, 0) to rest at (1, 1), nearly."""
    dynamics = FunctionDynamics(lambda x, u: np.concatenate([x[..., 2:], u], axis=-1), 4, 2, DT, "rk4")
    cost = TrackingCost.reach([1.0, 1.0, 0.0, 0.0], N, final=[50.0, 50.0, 5.0, 5.0], effort=[0.1, 0.1], dt=DT)
    return Problem(dynamics, cost, np.zeros(4), constraints=constraints)


def test_early_rounds_left_early_lead_to_the_same_plan_sooner():
    post = Constraint(lambda xs: np.hypot(xs[:, 0] - 0.5, xs[:, 1] - 0.4), lower=0.3, name="post", unit="m")
    problem = point(post)
    plan = solve(problem)
    exact = solve(problem, SolverOptions(inner_accuracy=1e-9, first_round_tolerance=0.0))  # every round to its minimum
    assert plan.status is exact.status is Status.CONVERGED
    assert plan.nit <= 0.7 * exact.nit
    np.testing.assert_allclose(plan.cost, exact.cost, rtol=1e-3)


@pytest.mark.parametrize("errors", [[1.0, 0.9, 0.8], [1.0, 0.1, 0.01], [1.0, 0.1, 0.2]])
def test_it_ends_after_rounds_that_come_no_nearer(errors):
    problem = point(Constraint(lambda xs: xs[:, :2], equal=[1.0, 1.0], when="end", name="there"))
    plan, solved = solve(problem), []

    def minimize(us, hinges, max_iterations, first_line, loose):
        error = errors[min(len(solved), len(errors) - 1)]
        solved.append(error)
        xs = plan.xs.copy()
        xs[-1, :2] = 1.0 + error
        return dataclasses.replace(plan, xs=xs, history=plan.history[:1])

    ended = augmented_lagrangian.augmented_lagrangian(
        problem.trajectory_constraints, problem.trajectory_constraints.tolerance, minimize, plan.us, 1000
    )
    assert ended.status is Status.OUTSIDE_LIMITS
    nearest = int(np.argmin(errors)) if errors[1] < SolverOptions.stall_ratio * errors[0] else 0
    assert len(solved) == nearest + 1 + SolverOptions.max_stalled_rounds


def test_a_weight_that_a_kink_set_to_zero_comes_back_at_once():
    engine = SimpleNamespace(largest_control_weight=1.0)
    regularization = Regularization(engine, exact=False)
    for _ in range(5):
        regularization.increase()
    before = regularization.mu
    assert before == pytest.approx(1e-6 * 10.0**4)
    regularization.decrease(0.5, nonsmooth=True)
    assert regularization.unregularized
    regularization.increase()
    assert regularization.mu == before
    regularization.increase()
    assert regularization.mu == pytest.approx(10.0 * before)


def test_a_narrow_cone_costs_few_iterations():
    problem = load_problem(Path(__file__).parents[2] / "examples" / "tasks" / "reach_upright_cup.toml")
    plan = solve(problem)
    assert plan.status is Status.CONVERGED
    assert plan.nit <= 18  # 9; without the tilt's own curvature steps along the cone are short, and it takes 52


def slower(free, share):
    """The problem of a plan of the two-link arm, with a share of its largest speeds."""
    most = share * np.abs(free.xs[:, 2:]).max(axis=0)
    names = free.problem.dynamics.mechanism.joint_names
    return dataclasses.replace(free.problem, limits=Limits(velocity=dict(zip(names, most, strict=True))))


def test_bounds_are_tightened_with_their_multipliers(monkeypatch):
    """A plan is no minimum with bounds that were just tightened: the slopes of its penalties are no multipliers.

    Taken as such, they led 0.6 of the speeds to 50 iterations instead of 31.
    """
    shifts, solved, after = list[Any](), list[Any](), list[Any]()
    constraints_class, minimize = trajectory_constraints.TrajectoryConstraints, slq._inner_solve
    tighten = constraints_class.tightened

    def tightened(self, more, less):
        shifts.append((len(solved), more, less))
        return tighten(self, more, less)

    def recorded(*given):
        solved.append(given[5])
        return minimize(*given)

    monkeypatch.setattr(constraints_class, "tightened", tightened)
    monkeypatch.setattr(slq, "_inner_solve", recorded)
    plan = solve(slower(solve(two_link(horizon=100)), 0.6))
    assert plan.status is Status.CONVERGED
    for k, more, less in shifts:
        before, now = solved[k - 1], solved[k]
        if before is None or not before.weight.any():
            continue  # the first round has no multipliers
        after.append(now)
        np.testing.assert_array_equal(now.lower, before.lower + more)
        np.testing.assert_array_equal(now.upper, before.upper - less)
        np.testing.assert_array_equal(now.weight, before.weight)
    assert after


def test_speeds_that_a_free_plan_exceeds_take_less_than_twice_its_iterations():
    free = solve(two_link(horizon=100))
    for share in (0.9, 0.8, 0.7):
        plan = solve(slower(free, share))
        assert plan.status is Status.CONVERGED
        assert plan.nit <= 2 * free.nit  # 39, 26 and 32 beside 20; 48 and 42 where each round had a last line


@pytest.mark.slow
def test_short_steps_far_from_the_end_of_a_round_are_regularized():
    """A hand in free flight, whose full steps promise much and are wrong beyond a thousandth of it.

    801 iterations while what such a short step promises counted as the end of a round.
    """
    problem = load_problem(Path(__file__).parents[2] / "benchmarks" / "moving" / "satellite-grasp.toml")
    us = 0.3 * np.random.default_rng(0).normal(size=problem.first_guess.shape)  # its own guess takes whole steps
    plan = solve(dataclasses.replace(problem, us=us))
    assert plan.success
    assert plan.nit < 400
    assert max(line.regularization for line in plan.history[:12]) > 0.0


TASKS = Path(__file__).parents[2] / "examples" / "tasks"


def test_ways_around_obstacles_begin_with_softer_penalties():
    """39 iterations with stiff ones and Hessians of Gauss and Newton, 18 with softer ones and curvature."""
    assert solve(load_problem(TASKS / "around_a_post.toml")).nit <= 28


@pytest.mark.parametrize("most", [3, 5, 7, 9])
def test_a_limit_that_ends_a_soft_round_is_said(most):
    """A solve with soft penalties converges to another problem's plan: with 7 iterations it did."""
    plan = solve(load_problem(TASKS / "around_a_post.toml"), SolverOptions(max_iterations=most))
    assert plan.status is Status.MAX_ITERATIONS


def test_a_sweep_that_curvature_makes_indefinite_is_done_without():
    problem = load_problem(TASKS / "around_a_post.toml")
    constraints: Any = problem.trajectory_constraints
    penalties = constraints.initial_penalties()
    penalties.lower[:, constraints.split :] += 0.2 * constraints.rows.scale  # 0.2 m: multipliers are large
    engine: Any = acquire_engine(problem)
    other: Any = acquire_engine(problem)
    other.residuals.bends = other.residuals.bends[:0]  # Gauss and Newton alone
    for one in (engine, other):
        one.set_penalties(penalties)
        one.start_from_controls(problem.x0, problem.first_guess)
    direction = engine.compute_direction(0.0, True)
    assert np.abs(engine.residuals.bends).max() > 0.0
    assert direction.definite
    assert not engine.curved
    # The search for the active set is made here, too, though one with the curvature has failed.
    np.testing.assert_allclose(direction, other.compute_direction(0.0, True), rtol=1e-9)


def test_bounds_without_weights_get_them_once_they_are_violated():
    """As where the first round has weights of clearances alone, and keeps within the ranges."""
    post = Constraint(lambda xs: np.hypot(xs[:, 0] - 0.5, xs[:, 1] - 0.4), lower=0.3, name="post", unit="m")
    free = solve(point(post))

    def soft(problem):
        """Penalties of the post alone, which let the motion through a part of it."""
        constraints = problem.trajectory_constraints
        weight = np.zeros((N + 1, constraints.size))
        weight[:, 0] = 10.0
        return BoundPenalties(constraints.lower.copy(), constraints.upper.copy(), weight)

    def aside(plan):
        return np.max(plan.xs[:, 1] - plan.xs[:, 0])

    first = slq._inner_solve(point(post), SolverOptions(), None, None, free.us, soft(point(post)), 100, 0)
    assert aside(first) < aside(free) - 0.02
    between = 0.2 * aside(first) + 0.8 * aside(free)
    problem = point(post, Constraint(lambda xs: xs[:, 1] - xs[:, 0], upper=between, name="aside", unit="m"))
    constraints = problem.trajectory_constraints
    plan = slq._solve_from_guess(problem, SolverOptions(), None, soft(problem), free.us, 1000, None)
    assert plan.status is Status.CONVERGED
    assert constraints.violation(plan.xs, plan.us).max() <= constraints.tolerance
