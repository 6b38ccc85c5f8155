"""remaining_decrease(): what more steps of SLQ gain, tried.

At kinks of contact the LQ model keeps promising a decrease that no step achieves: a solve ends there by what it gains
(actual_reduction_tolerance of planner.solve), and so does a proof.
"""

from __future__ import annotations

import numpy as np

from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.solvers import lq

STEPS = 10
_HALVINGS = 12  # step lengths 1, 1/2, ... that are tried


@np.errstate(all="ignore")  # a long step may run away: then it gains nothing
def remaining_decrease(plan: Plan, problem: Problem) -> float:
    """The decrease of a plan's cost in at most STEPS steps, each the best of several lengths; 0 where none is lower."""
    xs, us = plan.xs, plan.us
    first = cost = _cost(plan, problem, xs, us)
    for _ in range(STEPS):
        A, B = problem.dynamics.linearize(xs, us)
        quadratic = problem.cost.quadratize(xs, us)
        if plan.bound_penalties is not None and problem.trajectory_constraints is not None:
            quadratic = problem.trajectory_constraints.with_penalties(plan.bound_penalties, quadratic, xs, us, A, B)
        moves = None if problem.bounds is None else problem.bounds.step_bounds(xs, us)
        sweep = lq.riccati(A, B, quadratic, bounds=moves)
        if sweep is None:
            break
        tried = _rolled(plan, problem, xs, us, sweep)
        costs = np.array([_cost(plan, problem, *one) for one in zip(*tried, strict=True)])
        best = int(np.argmin(np.where(np.isfinite(costs), costs, np.inf)))
        if not costs[best] < cost:
            break
        xs, us, cost = tried[0][best], tried[1][best], float(costs[best])
    return first - cost


def _rolled(
    plan: Plan, problem: Problem, xs: np.ndarray, us: np.ndarray, sweep: lq.Sweep
) -> tuple[np.ndarray, np.ndarray]:
    """States (S, N+1, nx) and controls (S, N, nu) along a sweep's direction, with its gains, of each step length."""
    lengths = 0.5 ** np.arange(_HALVINGS + 1)
    states = np.empty((len(lengths), *xs.shape))
    controls = np.empty((len(lengths), *us.shape))
    states[:, 0] = problem.x0
    for n in range(len(us)):
        dx = plan.space.difference(states[:, n], np.broadcast_to(xs[n], states[:, n].shape))
        wanted = us[n] + lengths[:, None] * sweep.k[n] + dx @ sweep.K[n].T
        controls[:, n] = plan.within_bounds(n, wanted, states[:, n])
        states[:, n + 1] = problem.dynamics.step(states[:, n], controls[:, n])
    return states, controls


def _cost(plan: Plan, problem: Problem, xs: np.ndarray, us: np.ndarray) -> float:
    """With what ranges of states added in the last round."""
    if not np.isfinite(xs).all():
        return np.inf
    cost = float(problem.cost.value(xs, us))
    if plan.bound_penalties is not None and problem.trajectory_constraints is not None:
        cost += problem.trajectory_constraints.value(plan.bound_penalties, xs, us)
    return cost
