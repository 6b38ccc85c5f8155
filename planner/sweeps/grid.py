"""Grid: all combinations of some values of some parameters, numbered, the last parameter fastest.

    height=1:60:60       60 values from 1 to 60, evenly apart
    duration=0.8,1,2     these values

Numbers are read as numbers, true and false as such, all else as words. A grid holds the values, never the combinations.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from planner.base.arguments import did_you_mean, short_repr
from planner.base.errors import PlannerError

MAX_POINTS = 10_000_000
MAX_VALUES = 1_000_000  # of one parameter

Value = bool | int | float | str


@dataclass(frozen=True)
class Grid:
    """All combinations of values of parameters.

    Attributes:
        values: The values of each parameter by name, in order; plain numbers, booleans or words.
    """

    values: dict[str, tuple[Value, ...]]

    def __len__(self) -> int:
        return math.prod(map(len, self.values.values()))

    @property
    def shape(self) -> tuple[int, ...]:
        """How many values each parameter has."""
        return tuple(map(len, self.values.values()))

    def point(self, task: int) -> dict[str, Value]:
        """The parameters of a task."""
        return {
            name: values[index]
            for (name, values), index in zip(self.values.items(), np.unravel_index(task, self.shape), strict=True)
        }

    def chains(self, along: str) -> Iterator[list[int]]:
        """Tasks that differ in one parameter alone, in the order of its values."""
        axis = list(self.values).index(along)
        stride = math.prod(self.shape[axis + 1 :])
        count = self.shape[axis]
        for first in range(len(self)):
            if first // stride % count == 0:
                yield [first + k * stride for k in range(count)]


def grid_of(given: Mapping[str, Any] | Sequence[str] | Grid) -> Grid:
    """The grid of {"height": [1, 2]} or of ["height=1:60:60", "duration=0.8,1"].

    Raises:
        PlannerError: No parameter, one twice, no values, one value twice, or too many of them.
    """
    if isinstance(given, Grid):
        return given
    if isinstance(given, Mapping):
        rows = {str(name): _listed(str(name), values) for name, values in given.items()}
    elif isinstance(given, Sequence) and not isinstance(given, (str, bytes)):
        rows = {}
        for text in given:
            name, values = _parsed(text)
            if name in rows:
                raise PlannerError(f"{name} is given twice in the grid, expected each parameter once.")
            rows[name] = values
    else:
        raise PlannerError(f"grid is {short_repr(given)}, expected a table of values by parameter.")
    if not rows:
        raise PlannerError("the grid is empty, expected at least one parameter with its values.")
    for name, values in rows.items():
        twice = [value for i, value in enumerate(values) if value in values[:i]] if len(values) < 1000 else []
        if twice:
            raise PlannerError(f"{name} has the value {short_repr(twice[0])} twice, expected each value once.")
    grid = Grid(rows)
    if len(grid) > MAX_POINTS:
        raise PlannerError(f"the grid has {len(grid)} points, expected at most {MAX_POINTS}.")
    return grid


def check_names(grid: Grid, known: Sequence[str], what: str) -> None:
    """Refuse a parameter that is none of the known ones.

    Raises:
        PlannerError: The sentence has the names that exist.
    """
    for name in grid.values:
        if name not in known:
            hint = did_you_mean(name, known)
            raise PlannerError(f"{what} has no parameter {name!r}, expected some of: {', '.join(known)}.{hint}")


def _parsed(text: Any) -> tuple[str, tuple[Value, ...]]:
    name, equals, values = str(text).partition("=")
    name, values = name.strip(), values.strip()
    if not equals or not name or not values:
        raise PlannerError(
            f"{short_repr(text)} is no part of a grid, expected NAME=START:STOP:COUNT or NAME=VALUE,VALUE, "
            "e.g. height=1:60:60."
        )
    if ":" in values:
        return name, _evenly(name, values)
    words = [word.strip() for word in values.split(",")]
    if not all(words):
        raise PlannerError(f"{name} has an empty value in {short_repr(values)}, expected VALUE,VALUE.")
    return name, _listed(name, [_value(word) for word in words])


def _evenly(name: str, text: str) -> tuple[Value, ...]:
    """Values of START:STOP:COUNT; whole numbers stay whole where all of them are."""
    try:
        start, stop, count = (_value(word) for word in text.split(":"))
        whole = isinstance(start, int) and isinstance(stop, int)
        first, last = float(start), float(stop)
        if not isinstance(count, int) or isinstance(count, bool) or not 1 <= count <= MAX_VALUES:
            raise ValueError(text)
        if not (math.isfinite(first) and math.isfinite(last)) or (count == 1 and first != last):
            raise ValueError(text)
    except (TypeError, ValueError):
        raise PlannerError(
            f"{name} is {short_repr(text)}, expected START:STOP:COUNT of two numbers and a count, e.g. 1:60:60."
        ) from None
    values = [float(value) for value in np.linspace(first, last, count)]
    if whole and all(value.is_integer() for value in values):
        return _listed(name, [int(value) for value in values])
    return _listed(name, values)


def _value(word: str) -> Value:
    word = word.strip()
    if word in ("true", "false"):
        return word == "true"
    for kind in (int, float):
        try:
            return kind(word)
        except ValueError:
            continue
    return word


def _listed(name: str, given: Any) -> tuple[Value, ...]:
    """Plain values of a list, an array or a range."""
    if isinstance(given, (str, bytes)) or not hasattr(given, "__iter__"):
        raise PlannerError(f"the values of {name} are {short_repr(given)}, expected a list of them.")
    values = tuple(value.item() if isinstance(value, np.generic) else value for value in given)
    if not values or len(values) > MAX_VALUES:
        raise PlannerError(f"{name} has {len(values)} values, expected 1 to {MAX_VALUES}.")
    for value in values:
        if not isinstance(value, (bool, int, float, str)):
            raise PlannerError(f"{name} has the value {short_repr(value)}, expected numbers, words, True or False.")
        if isinstance(value, float) and not math.isfinite(value):
            raise PlannerError(f"{name} has the value {value}, expected finite numbers.")
    return values
