"""What errors of a replay are measured against."""

from __future__ import annotations

import numpy as np

from planner.problem.costs.tracking import Quadratic
from planner.problem.plan import Plan
from planner.problem.problem import Problem

STATE_BOUND = 1e-2  # end state, in rad, m, rad/s, m/s: what the general rules ask
COST_BOUND = 1.0  # %


def cost_of_deviation(quadratic: Quadratic) -> float:
    """What every state off by STATE_BOUND would cost: a cost far below that is as good as zero."""
    weights = np.abs(np.diagonal(quadratic.Q, axis1=1, axis2=2))
    return float(0.5 * STATE_BOUND**2 * weights.sum())


def cost_scale(plan: Plan, problem: Problem) -> float:
    """What an error of the cost is a part of: the plan's cost, or where that is about zero, a deviation's."""
    return max(abs(plan.cost), cost_of_deviation(problem.cost.quadratize(plan.xs, plan.us)), np.finfo(float).tiny)
