"""GoalSpec: a goal of a cost or task, with its error and unit; and how a problem states its tolerances."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from planner.base.arguments import number, short_repr
from planner.base.errors import PlannerError

SOFT = "soft"  # the word for an infinite tolerance in files, which know no infinity


class GoalSpec(NamedTuple):
    """One goal: of a cost's term with a final weight at the end, or of a task at its times.

    A term has `goal_specs(coordinates) -> tuple of GoalSpec`, with the planner.model.coordinates.Coordinate of every
    component of a deviation, and `final_cost(x) -> float`, its cost at the end.
    """

    name: str  # of the coordinate, or of a frame's part: "position of hand"
    unit: str
    error: Callable[[np.ndarray], np.ndarray]  # states (K, nx) -> (K,) distances from the goal; K = T with times
    times: tuple[float, ...] | None = None  # (T,) s; None for the end
    tolerance: float | None = None  # in its unit; None for the problem's


def checked_tolerance(value: Any) -> float | dict[str, float] | None:
    """A problem's tolerance: a number above 0, "soft" or infinity for no check, or a table of these by name.

    Raises:
        PlannerError: It is something else.
    """
    if value is None:
        return None
    if isinstance(value, Mapping):
        return {str(name): _one(f"the tolerance of {short_repr(name)}", one) for name, one in value.items()}
    return _one("tolerance", value)


def stored_tolerance(tolerance: float | Mapping[str, float] | None) -> Any:
    """A checked tolerance as JSON values, which know no infinity."""
    if isinstance(tolerance, Mapping):
        return {name: stored_tolerance(one) for name, one in tolerance.items()}
    return SOFT if tolerance == np.inf else tolerance


def _one(name: str, value: Any) -> float:
    if value == SOFT or (isinstance(value, float) and value == np.inf):
        return float("inf")
    try:
        return number(name, value, greater_than=0.0)
    except PlannerError:
        raise PlannerError(
            f"{name} is {short_repr(value)}, expected a number above 0, 'soft' for a goal that is not judged, or a "
            "table such as {position = 0.02, velocity = 0.1}."
        ) from None
