"""First controls from a plan of another discretization, by tracking its states in the new dynamics.

Along an unstable trajectory, the rollout of a plan's controls with another integrator diverges within a second, and SLQ
from there ends in another local minimum, if at all. So the plan is tracked in the new dynamics, u = us + K (x - xs),
with its own gains or with those of a Riccati sweep along its states in the new dynamics. The rollout of lowest cost is
the first guess.
"""

from __future__ import annotations

import math

import numpy as np

from planner.base.arguments import short_repr
from planner.base.errors import PlannerError
from planner.dynamics.protocol import feedback_control, rollout
from planner.model.space import space_of
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.problem.state_bounds import BoundPenalties
from planner.problem.trajectory import Trajectory
from planner.solvers.lqr import tracking_gains

_WEAKEST = 1e-6  # smallest tracking weight of a state, relative to the largest


def warm_start(plan: Plan, problem: Problem) -> np.ndarray:
    """First controls (N, nu): of lowest cost among the problem's own guess, the plan's and those that track the plan.

    Args:
        plan: Plan of the same duration with at most N stages.
        problem: The new problem; its number of stages N is a multiple of the plan's.
    """
    parts = problem.N // plan.N
    us, K = np.repeat(plan.us, parts, axis=0), np.repeat(plan.K, parts, axis=0)
    xs = plan.xs if parts == 1 else plan.between_knots(parts)  # a discrete map has no states between knots
    tries = [feedback_rollout(problem, problem.first_guess), *_ways(problem, xs, us, K)]
    return min(tries, key=lambda one: one[0])[1]


def tracked_warm_start(
    problem: Problem, given: Plan | Trajectory, max_cost_ratio: float
) -> tuple[np.ndarray, np.ndarray | None, BoundPenalties | None]:
    """A first guess from a trajectory of any duration and step, sampled at the problem's knots.

    Args:
        problem: The problem.
        given: The trajectory.
        max_cost_ratio: Tracking fails if the rollout costs more than this multiple of the sampled trajectory.

    Returns:
        Controls (N, nu) of the cheapest tracking rollout, or the trajectory's own where tracking fails; the
        trajectory's states (N+1, nx) where tracking fails, else None; its penalties, or None.

    Raises:
        PlannerError: Neither a Plan nor a Trajectory, or other dimensions of state or control.
    """
    motion = given.motion if isinstance(given, Plan) else given
    if not isinstance(motion, Trajectory):
        raise PlannerError(
            f"warm_start is {short_repr(given)}, expected a Plan, or what plan.shifted(seconds) or "
            "plan.stretched(duration) returns."
        )
    own, nx, nu = problem.dynamics, motion.xs.shape[1], motion.us.shape[1]
    if (nx, nu, motion.space.ndx) != (own.nx, own.nu, space_of(own).ndx):
        raise PlannerError(
            f"warm_start has {nx} states and {nu} controls, expected {own.nx} and {own.nu}: a plan of the same machine."
        )
    there = motion.at(own.dt * np.arange(problem.N + 1))
    penalties = (
        None
        if there.pulls is None or problem.trajectory_constraints is None
        else there.pulls.penalties(problem.trajectory_constraints)
    )
    xs, us, near = there.xs, there.us, max_cost_ratio * problem.cost.value(there.xs, there.us)
    cost, found = min(feedback_rollout(problem, us), feedback_rollout(problem, us, there.K, xs), key=lambda one: one[0])
    retuned = None if cost <= near else _gains(problem, xs, us)
    if retuned is not None:
        cost, found = feedback_rollout(problem, us, retuned, xs)
    return (found, None, penalties) if cost <= near else (us, xs, penalties)


def _ways(problem: Problem, xs: np.ndarray, us: np.ndarray, K: np.ndarray) -> list[tuple[float, np.ndarray]]:
    """Costs and controls of rollouts: us without feedback, and tracking xs with gains K or with an LQR along xs."""
    ways, retuned = [feedback_rollout(problem, us), feedback_rollout(problem, us, K, xs)], _gains(problem, xs, us)
    return ways if retuned is None else [*ways, feedback_rollout(problem, us, retuned, xs)]


def feedback_rollout(
    problem: Problem, us: np.ndarray, K: np.ndarray | None = None, about: np.ndarray | None = None
) -> tuple[float, np.ndarray]:
    """Cost (inf if not finite) and clipped controls (N, nu) of the rollout u = us + K difference(x, about)."""
    control = None if K is None or about is None else feedback_control(problem.dynamics, about, us, K)
    with np.errstate(all="ignore"):  # a rollout may diverge
        xs, us = rollout(problem.dynamics, problem.x0, us, control, bounds=problem.bounds)
        cost = problem.cost.value(xs, us) if np.isfinite(xs[-1]).all() else math.inf
    return (cost if math.isfinite(cost) else math.inf), us


def _gains(problem: Problem, xs: np.ndarray, us: np.ndarray) -> np.ndarray | None:
    """LQR gains (N, nu, ndx) along a trajectory: the cost's weights, plus dt times the final one at every knot."""
    model = problem.cost.quadratize(xs, us)
    Q = model.Q + problem.dynamics.dt * model.Q[-1]
    Q = Q + _WEAKEST * np.abs(Q).max() * np.eye(Q.shape[1])
    A, B = problem.dynamics.linearize(xs, us)
    return tracking_gains(A, B, Q, model.R)
