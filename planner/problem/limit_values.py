"""How a limit may be written: a pair, a number, None, infinity or a word; and as arrays, or as JSON values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from planner.base.arguments import array, choice, number, numbers, short_repr
from planner.base.errors import PlannerError
from planner.dynamics import Dynamics
from planner.model.coordinates import coordinates_of
from planner.model.mechanism import Mechanism

OFF = "off"
Pair = tuple[float, float]


def with_names(mechanism: Mechanism | None, what: str) -> Mechanism:
    """The machine whose names a limit has; refuses dynamics without one."""
    if mechanism is None:
        raise PlannerError(f"the limits' {what} has names, but the dynamics have no mechanism: expected numbers.")
    return mechanism


def table_of(name: str, value: Any) -> Mapping[Any, Any]:
    """A limit that must be a table."""
    if not isinstance(value, Mapping):
        raise PlannerError(f"the limits' {name} is {short_repr(value)}, expected a table of (lower, upper).")
    return value


def component_of(name: str, value: Any, ndx: int) -> int:
    """The index of a component of the deviation, 0 to ndx - 1."""
    value = int(value) if isinstance(value, str) and value.isdigit() else value  # a key of JSON
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or not 0 <= value < ndx:
        raise PlannerError(f"the limits' {name} has {short_repr(value)}, expected an index of 0 to {ndx - 1}.")
    return int(value)


def is_word(value: Any, word: str) -> bool:
    """Whether a limit is this word; an array never is."""
    return isinstance(value, str) and value == word


def pair_of(name: str, value: Any) -> Pair:
    """(lower, upper) from a pair, from a number b for -b to b, or "off" for none."""
    if is_word(value, OFF):
        return -np.inf, np.inf
    if isinstance(value, (Sequence, np.ndarray)) and not isinstance(value, str):
        if len(value) != 2:
            raise PlannerError(f"{name} is {short_repr(value)}, expected (lower, upper).")
        sides = sides_of(name, value)
        if any(side.ndim for side in sides):
            raise PlannerError(f"{name} is {short_repr(value)}, expected (lower, upper).")
        low, high = map(float, sides)
    else:
        high = number(name, value, greater_than=0.0)
        low = -high
    if not low <= high or low == np.inf or high == -np.inf:
        raise PlannerError(f"{name} is {short_repr(value)}, expected a lower bound below the upper.")
    return low, high


def json_value(value: Any) -> Any:
    """A limit as JSON values: infinity is None. NaN stays what it is, to be refused."""
    if isinstance(value, Mapping):
        return {str(key): json_value(part) for key, part in value.items()}
    if isinstance(value, np.ndarray):
        return json_value(value.tolist())
    if isinstance(value, (list, tuple)):
        return [json_value(part) for part in value]
    value = value.item() if isinstance(value, np.number) else value
    if isinstance(value, float) and np.isinf(value):  # an int may be larger than any float
        return None
    return value


def sides_of(name: str, pair: Any) -> list[np.ndarray]:
    """Lower and upper bounds with infinity in the place of None; NaN is refused."""
    sides = [numbers(name, _filled(part, none)) for part, none in zip(pair, (-np.inf, np.inf), strict=True)]
    if any(np.isnan(side).any() for side in sides):
        raise PlannerError(f"{name} has a bound that is not a number, expected numbers or None.")
    return sides


def _filled(value: Any, none: float) -> Any:
    if value is None:
        return none
    return [_filled(part, none) for part in value] if isinstance(value, (list, tuple)) else value


def spread(bound: np.ndarray, N: int, nu: int) -> np.ndarray:
    """Bounds (N, nu) from a number, (nu,) or (N, nu)."""
    if bound.ndim == 1:
        bound = array("the limits' control", bound, (nu,), any_value=True)
    if bound.ndim <= 1:
        bound = np.broadcast_to(bound, (N, nu))
    return array("the limits' control", bound, (N, nu), any_value=True)


def pairs_of_coordinates(what: str, value: Any, dynamics: Dynamics) -> dict[int, Pair]:
    """Limits by component, of dynamics whose coordinates have names and units instead of joints."""
    coordinates = coordinates_of(dynamics)
    if isinstance(value, str):
        with_names(None, what)
    if isinstance(value, Mapping):
        places = {one.name: i for i, one in enumerate(coordinates)}
        return {
            places[choice(f"the coordinate in the limits' {what}", name, places)]: pair_of(
                f"the {what} range of {name!r}", part
            )
            for name, part in value.items()
        }
    pair = pair_of(f"the limits' {what}", value)
    halves = getattr(dynamics, "integrator", None) == "semi-implicit-euler"  # positions, then as many velocities
    last = [2 * i >= len(coordinates) if halves else None for i in range(len(coordinates))]
    rates = [one.is_rate if one.unit else known for one, known in zip(coordinates, last, strict=True)]
    found = {i: pair for i, rate in enumerate(rates) if rate is (what == "velocity")}
    if not found:
        raise PlannerError(
            f"the limits' {what} is {short_repr(value)}, but no coordinate of the dynamics has the unit of one: write "
            'coordinates=[("angle", "rad"), ("speed", "rad/s"), ...] of the dynamics, or limits by the index of the '
            "state, state={1: (-4, 4)}, or of all of it, state=4."
        )
    return found
