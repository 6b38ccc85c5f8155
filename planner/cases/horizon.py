"""Duration and number of stages of a case, checked, and the limits that the cases share."""

from __future__ import annotations

from typing import Any

from planner.base.arguments import count, number
from planner.base.errors import PlannerError
from planner.problem.problem_parts import MAX_STAGES

LARGEST = 1e6  # of sizes, weights and seconds


def stages(duration: Any, horizon: Any, per_second: float = 100.0, least: int = 1) -> tuple[float, int]:
    """The checked duration, s, and N: the horizon, or without one `per_second` a second, but at least `least`."""
    duration = number("duration", duration, greater_than=0.0, maximum=LARGEST)
    if horizon is not None:
        return duration, count("horizon", horizon, maximum=MAX_STAGES)
    if per_second * duration > MAX_STAGES:
        longest = MAX_STAGES / per_second
        raise PlannerError(f"duration is {duration:g} s, expected at most {longest:g} s without a horizon.")
    return duration, max(least, round(per_second * duration))
