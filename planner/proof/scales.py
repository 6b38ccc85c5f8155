"""Bounds and scales of the errors of a replay, and how far a motion is outside of its problem's limits."""

from __future__ import annotations

import numpy as np

from planner.base.measured import Measured
from planner.problem.costs.terms import Quadratic
from planner.problem.plan import Plan
from planner.problem.problem import Problem

KINDS = {"final": "exact_goal", "position": "position_range", "velocity": "velocity_range", "component": "state_range"}
STATE_BOUND = 1e-2  # end state, in rad, m, rad/s, m/s: what the general rules ask
COST_BOUND = 1.0  # %


def cost_of_deviation(quadratic: Quadratic) -> float:
    """The cost of every state off by STATE_BOUND: a cost far below that is as good as zero."""
    weights = np.abs(np.diagonal(quadratic.Q, axis1=1, axis2=2))
    return float(0.5 * STATE_BOUND**2 * weights.sum())


def cost_scale(plan: Plan, problem: Problem) -> float:
    """The cost that errors are relative to: the plan's, or that of a deviation where the plan's is about zero."""
    return max(abs(plan.cost), cost_of_deviation(problem.cost.quadratize(plan.xs, plan.us)), np.finfo(float).tiny)


def limit_violations(
    problem: Problem, xs: np.ndarray, us: np.ndarray | None, whose: str, judged: bool = True
) -> list[Measured]:
    """The largest violation of each kind of limit; nothing where there are none.

    Of states (N+1, nx) at the knots and, where they are asked about, controls (N, nu); notes say `whose` they are.
    What is not judged is shown without bounds.
    """
    measured = []
    if problem.bounds is not None and us is not None:
        lower, upper = problem.bounds
        outside = float(np.maximum(lower - us, us - upper).max())
        active = int(np.sum((us <= lower) | (us >= upper)))
        note = f"largest, {whose}; {active} of {us.size} controls at a bound"
        measured.append(Measured("control_violation", max(outside, 0.0), "", 0.0 if judged else None, note))
    if problem.ranges is not None and problem.limits is not None:
        beyond, tolerance = problem.ranges.beyond(xs), problem.limits.tolerance
        kinds = [name.split()[0] for name in problem.ranges.names]
        for kind, word in KINDS.items():
            which = [h for h, own in enumerate(kinds) if own == kind]
            if which:
                finite = np.isfinite(beyond).all()
                worst = which[int(beyond[:, which].max(axis=0).argmax())] if finite else which[0]
                note = f"largest at the knots, {whose}: {problem.ranges.names[worst]}"
                value = float(beyond[:, which].max())
                measured.append(Measured(f"{word}_violation", value, "", tolerance if judged else None, note))
    return measured
