"""Rounds of the augmented Lagrangian: early ones are not solved to the end, and it stops once they are in vain."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from planner import Constraint, FunctionDynamics, Limits, Problem, Status, TrackingCost, load_problem, solve
from planner.cases import two_link
from planner.solvers import augmented_lagrangian
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


def test_speeds_that_a_free_plan_exceeds_take_less_than_twice_its_iterations():
    free = solve(two_link(horizon=100))
    for share in (0.9, 0.8, 0.7):
        most = share * np.abs(free.xs[:, 2:]).max(axis=0)
        names = free.problem.dynamics.mechanism.joint_names
        held = dataclasses.replace(free.problem, limits=Limits(velocity=dict(zip(names, most, strict=True))))
        plan = solve(held)
        assert plan.status is Status.CONVERGED
        assert plan.nit <= 2 * free.nit  # 33, 24 and more beside 25; 48 and 42 where each round had a last line


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
