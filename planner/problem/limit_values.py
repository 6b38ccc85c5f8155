"""How a limit may be written: a pair, a number, None, infinity or a word; and as arrays, or as JSON values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from planner.base.arguments import array, number, numbers, short_repr
from planner.base.errors import PlannerError
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
