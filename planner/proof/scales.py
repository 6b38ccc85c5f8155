"""Bounds and scales of the errors of a replay."""

from __future__ import annotations

import numpy as np

from planner.problem.costs.tracking import Quadratic
from planner.problem.plan import Plan
from planner.problem.problem import Problem

STATE_BOUND = 1e-2  # end state, in rad, m, rad/s, m/s: what the general rules ask
COST_BOUND = 1.0  # %


def cost_of_deviation(quadratic: Quadratic) -> float:
    """The cost of every state off by STATE_BOUND: a cost far below that is as good as zero."""
    weights = np.abs(np.diagonal(quadratic.Q, axis1=1, axis2=2))
    return float(0.5 * STATE_BOUND**2 * weights.sum())


def cost_scale(plan: Plan, problem: Problem) -> float:
    """The cost that errors are relative to: the plan's, or that of a deviation where the plan's is about zero."""
    return max(abs(plan.cost), cost_of_deviation(problem.cost.quadratize(plan.xs, plan.us)), np.finfo(float).tiny)
