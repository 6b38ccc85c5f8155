"""What a sweep's page shows of its table: maps over two parameters, and neighbours that are in another minimum.

Two neighbours are marked as in different minima where cost or motion changes between them by far more than between the
neighbours before and after them, and by more than a tenth of its whole range over the map.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from planner.sweeps.grid import Grid

MAX_MAPS = 12
MAX_CELLS = 20_000  # of all maps
_OUTLIER_FACTOR = 4.0  # times the larger of the changes beside it
_MIN_CHANGE = 0.1  # of the range over the map


@dataclass
class Map:
    """One map: the tasks over two parameters, the others held.

    Attributes:
        across: Name of the parameter from left to right.
        up: Name of the parameter from bottom to top; "" for a single row.
        held: The values of the other parameters.
        tasks: (rows, columns) numbers of the tasks.
        jumps: Pairs of neighbouring tasks in different minima.
    """

    across: str
    up: str
    held: dict[str, Any]
    tasks: np.ndarray
    jumps: list[tuple[int, int]] = field(default_factory=list)


def maps_of(grid: Grid) -> list[Map]:
    """The maps of a grid over its two parameters with most values, for each of the first values of the others."""
    by_length = sorted(grid.values, key=lambda name: -len(grid.values[name]))
    several = [name for name in by_length if len(grid.values[name]) > 1]
    across = (several or by_length)[0]
    up = several[1] if len(several) > 1 else ""
    axes = list(grid.values)
    numbers = np.arange(len(grid)).reshape(grid.shape)
    others = [name for name in axes if name not in (across, up)]
    maps, cells = [], 0
    for indices in itertools.product(*(range(len(grid.values[name])) for name in others)):
        chosen = dict(zip(others, indices, strict=True))
        part = numbers[tuple(chosen.get(name, slice(None)) for name in axes)]
        rows = part[None] if not up else part if axes.index(up) < axes.index(across) else part.T
        cells += rows.size
        if len(maps) == MAX_MAPS or (maps and cells > MAX_CELLS):
            break
        maps.append(Map(across, up, {name: grid.values[name][index] for name, index in chosen.items()}, rows))
    return maps


def mark_jumps(one: Map, rows: Iterable[dict[str, Any]]) -> None:
    """Find neighbours in different minima; `rows` are those of the map's tasks."""
    features = {row["task"]: _features(row) for row in rows if row["status"] == "CONVERGED"}
    longest = max(map(len, features.values()), default=0)
    values = np.full((*one.tasks.shape, longest), math.nan)
    for place, task in np.ndenumerate(one.tasks):
        found = features.get(int(task), [])
        values[place][: len(found)] = found
    if not values.size or np.isnan(values).all():
        return
    seen = values.reshape(-1, longest)
    seen = seen[~np.isnan(seen).all(axis=1)]
    span = np.nanmax(seen, axis=0) - np.nanmin(seen, axis=0)
    span[~(span > 1e-9 * np.nanmax(np.abs(seen), axis=0))] = math.inf  # what does not change says nothing
    for axis in (0, 1):
        for place in _steps(values / span, axis):
            beside = (place[0] + (axis == 0), place[1] + (axis == 1))
            one.jumps.append((int(one.tasks[place]), int(one.tasks[beside])))


def _features(row: dict[str, Any]) -> list[float]:
    """Cost and motion, as numbers of which neighbours in one minimum have similar ones."""
    cost = row.get("cost")
    logarithm = math.log(cost) if isinstance(cost, float) and cost > 0.0 else math.nan
    return [logarithm, *map(float, row.get("print", ()))]


def _steps(values: np.ndarray, axis: int) -> Iterable[tuple[int, int]]:
    """Places (row, column) after which a value steps along an axis."""
    change = np.abs(np.diff(values, axis=axis))
    if change.shape[axis] < 3:  # nothing to compare with
        return []
    change = np.moveaxis(change, axis, 0)
    usual = np.full_like(change, math.nan)
    usual[1:] = change[:-1]
    usual[:-1] = np.fmax(usual[:-1], change[1:])
    with np.errstate(invalid="ignore"):
        far = (change > _MIN_CHANGE) & (change > _OUTLIER_FACTOR * usual)
    marked = np.moveaxis(np.asarray(far.any(axis=-1)), 0, axis)
    return [(int(i), int(j)) for i, j in np.argwhere(marked)]
