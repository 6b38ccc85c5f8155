"""The goal of a problem.toml must be away from its start."""

from __future__ import annotations

import numpy as np

from planner.base.errors import PlannerError
from planner.model.space import space_of
from planner.problem.costs.tracking import tracking_of
from planner.problem.goals import ROUNDING, goals_of
from planner.problem.problem import Problem


def check_departure(problem: Problem) -> None:
    """Refuse a problem that doing nothing solves, unless start and goal are equal: then to stay is the task."""
    cost, x0 = tracking_of(problem.cost), problem.x0
    assert cost is not None  # a problem file has one
    way = np.abs(space_of(problem.dynamics).difference(x0, cost.x_ref[-1]))
    goals = [goal for goal in goals_of(problem) if np.isfinite(goal.tolerance)]
    if not goals or not np.any(way > ROUNDING):
        return
    ways = {goal.name: float(goal.missed(x0[None])[0]) for goal in goals}
    largest = max(goals, key=lambda goal: ways[goal.name])
    if ways[largest.name] > 0.0 and all(ways[goal.name] <= goal.tolerance for goal in goals):
        raise PlannerError(
            f"the start is already within the tolerance {largest.tolerance:g} {largest.unit} of the goal (largest "
            f"difference {ways[largest.name]:.3g} at {largest.name}), expected a smaller one, e.g. "
            f"tolerance = {0.1 * ways[largest.name]:.1g}: a plan that does nothing would pass."
        )
    if ways[largest.name] == 0.0 and not np.any(np.abs(cost.Q).max(axis=(0, 1))[way > 0.0]):
        raise PlannerError("no weight is above 0 where start and goal differ, expected one: nothing would move.")
