"""The goal of a problem.toml: the start must be away from it, and the proof checks that the motion arrives there."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from planner.base.errors import PlannerError
from planner.base.measured import Measured, Section
from planner.problem.costs.tracking import TrackingCost

if TYPE_CHECKING:
    from planner.proof.replaying import Replay


def _weighted(cost: TrackingCost) -> np.ndarray:
    """Which components of the deviation have a final weight: (ndx,)."""
    return np.abs(cost.Q[-1]).max(axis=0) > 0.0


def check_departure(x0: np.ndarray, cost: TrackingCost, tolerance: float) -> None:
    """Refuse a problem that doing nothing solves, unless start and goal are equal: then to stay is the task."""
    way, judged = np.abs(cost.space.difference(x0, cost.x_ref[-1])), _weighted(cost)
    if not np.any(way) or not np.any(judged):
        return
    largest = way[judged].max()
    if 0.0 < largest <= tolerance:
        raise PlannerError(
            f"the start is already within tolerance {tolerance:g} of the goal (largest difference {largest:.3g} where "
            f"final weights are above 0), expected a smaller tolerance: a plan that does nothing would pass."
        )
    if largest == 0.0 and not np.any(np.abs(cost.Q).max(axis=(0, 1))[way > 0.0]):
        raise PlannerError("no weight is above 0 where start and goal differ, expected one: nothing would move.")


def judge_arrival(replay: Replay, cost: TrackingCost, tolerance: float) -> Section:
    """Check that the plan and MuJoCo's replay end at the goal in every component with a final weight."""
    judged = _weighted(cost)
    if not np.any(judged):
        return Section("goal", not_applicable="nothing is asked of the goal because no final weight is above 0")
    note = "largest component with a final weight: rad, m, rad/s, m/s; weights that are small beside the effort miss"
    ends = {"planned_goal_error": replay.plan.xs[-1], "replayed_goal_error": replay.xs[-1]}
    measured = tuple(
        Measured(name, float(np.abs(cost.space.difference(x, cost.x_ref[-1]))[judged].max()), "", tolerance, note)
        for name, x in ends.items()
    )
    return Section("goal", measured)
