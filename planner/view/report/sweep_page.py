"""index.html of a sweep: maps of success, cost and iterations, what a click on a task shows; needs no other file.

A map is over two parameters. Two neighbours are marked as in different minima where cost or motion changes between them
by far more than between the neighbours before and after them, and by more than a tenth of its whole range over the map.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from planner.base.data_files import finite
from planner.problem.plan import Status
from planner.sweeps.grid import Grid
from planner.sweeps.sweeping import CSV, PARQUET, Sweep
from planner.view.report.markup import json_block, number, write_page

MAX_MAPS = 12
_CONVERGED = {one.name for one in Status if one.converged}  # a task's status may be none of a plan
MAX_CELLS = 20_000  # of all maps
_OUTLIER_FACTOR = 4.0  # times the larger of the changes beside it
_MIN_CHANGE = 0.1  # of the range over the map


@dataclass
class Map:
    """One map: the tasks over two parameters, the others constant.

    Attributes:
        across: Name of the parameter from left to right.
        up: Name of the parameter from bottom to top; "" for a single row.
        constant: The values of the other parameters.
        tasks: (rows, columns) numbers of the tasks.
        jumps: Pairs of neighbouring tasks in different minima.
    """

    across: str
    up: str
    constant: dict[str, Any]
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
    features = {row["task"]: _features(row) for row in rows if row["status"] in _CONVERGED}
    longest = max(map(len, features.values()), default=0)
    values = np.full((*one.tasks.shape, longest), math.nan)
    for place, task in np.ndenumerate(one.tasks):
        found = features.get(int(task), [])
        values[place][: len(found)] = found
    if not values.size or np.isnan(values).all():
        return
    known = values.reshape(-1, longest)
    known = known[~np.isnan(known).all(axis=1)]
    span = np.nanmax(known, axis=0) - np.nanmin(known, axis=0)
    span[~(span > 1e-9 * np.nanmax(np.abs(known), axis=0))] = math.inf  # ignore constant features
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
        jumps = (change > _MIN_CHANGE) & (change > _OUTLIER_FACTOR * usual)
    marked = np.moveaxis(np.asarray(jumps.any(axis=-1)), 0, axis)
    return [(int(i), int(j)) for i, j in np.argwhere(marked)]


NOTHING = "#c9ced3"  # the colour of a task without a value
WIDE = 24  # columns: a map with more takes the whole width of the page
_WIDTH, _NARROW = 1000.0, 420.0  # of a map, in its own units
_LEFT, _LINE, _LETTER = 12.0, 20.0, 8.0  # margin, height of a line of text, width of a letter
_MAX_HEIGHT, _MIN_CELL, _MAX_CELL = 420.0, 3.0, 34.0  # of all rows; of a cell
_TICKS_UP, _TICK_SPACING = 12, 60.0  # most values beside a map, and the distance of those below it
# Viridis (van der Walt and Smith, 2015), which reads in grey and by the colour-blind.
_STOPS = np.array([[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]], dtype=float)


def picture(title: str, legend: str, one: Map, grid: Grid, colours: Mapping[int, str]) -> str:
    """A figure of one map.

    Args:
        title: What it shows.
        legend: What its colours mean, as HTML.
        one: The map.
        grid: Of the sweep.
        colours: By task.
    """
    rows, columns = one.tasks.shape
    ups = [word(value) for value in grid.values[one.up]] if one.up else []
    left = _LEFT + _LETTER * max(map(len, ups), default=0) if ups else 0.0
    width = _WIDTH if columns > WIDE else _NARROW
    wide = (width - left) / columns
    tall = min(max(min(wide, _MAX_CELL), _MAX_CELL / 2.0), max(_MAX_HEIGHT / rows, _MIN_CELL))
    below, lines = tall * rows, list[str]()
    places = {int(task): (left + j * wide, below - (i + 1) * tall) for (i, j), task in np.ndenumerate(one.tasks)}
    for task, (x, y) in places.items():
        label = ", ".join(f"{name} {word(value)}" for name, value in grid.point(task).items())
        lines.append(
            f'<rect x="{x:.2f}" y="{y:.2f}" width="{wide:.2f}" height="{tall:.2f}" data-t="{task}" '
            f'fill="{colours.get(task, NOTHING)}"><title>{escape(label)}</title></rect>'
        )
    ends = []
    for (xa, ya), (xb, yb) in ((places[a], places[b]) for a, b in one.jumps):
        ends.append((xb, yb, xb, yb + tall) if ya == yb else (xa, ya, xa + wide, ya))
    for kind in ("under", "jump"):
        lines += [
            '<line class="{}" x1="{:.2f}" y1="{:.2f}" x2="{:.2f}" y2="{:.2f}"/>'.format(kind, *end) for end in ends
        ]
    for i in _some(rows, _TICKS_UP) if ups else ():
        lines.append(_text(left - 6.0, below - (i + 0.5) * tall + 4.0, ups[i], "end"))
    for j in _some(columns, int(min((width - left) / _TICK_SPACING, columns))):
        lines.append(_text(left + (j + 0.5) * wide, below + _LINE - 4.0, word(grid.values[one.across][j]), "middle"))
    axes = f"{one.across} to the right{f', {one.up} upwards' if one.up else ''}"
    lines.append(_text(left, below + 2.0 * _LINE - 4.0, axes, "start"))
    return (
        f"<figure><figcaption><b>{escape(title)}</b>: {legend}</figcaption>"
        f'<svg viewBox="0 0 {width:.0f} {below + 2.0 * _LINE:.0f}" role="img" aria-label="{escape(title)}">'
        f"{''.join(lines)}</svg></figure>"
    )


def colour(part: float) -> str:
    """The colour of a value: 0 the smallest, 1 the largest."""
    at = np.clip(part, 0.0, 1.0) * (len(_STOPS) - 1)
    mixed = [np.interp(at, range(len(_STOPS)), _STOPS[:, channel]) for channel in range(3)]
    return "#" + "".join(f"{round(float(one)):02x}" for one in mixed)


def bar(low: str, high: str) -> str:
    """A scale of colours between two words, as HTML."""
    stops = ", ".join(colour(part) for part in np.linspace(0.0, 1.0, len(_STOPS)))
    strip = f'<span class="bar" style="background: linear-gradient(to right, {stops})"></span>'
    return f"{escape(low)}{strip}{escape(high)}"


def word(value: Any) -> str:
    """A value of a parameter."""
    return number(value) if isinstance(value, float) else str(value)


def _some(count: int, most: int) -> list[int]:
    """At most so many of 0 ... count - 1, evenly spaced from the first on."""
    return list(range(0, count, -(-count // max(most, 1))))


def _text(x: float, y: float, text: str, anchor: str) -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(text)}</text>'


NAME = "index.html"
LEGEND = "green: proven, light green: converged and not proven, red: FAIL or not converged"
_GOOD, _UNPROVEN, _BAD = "#2a9d5c", "#8fbf5f", "#d1495b"
_SHOWN = 14  # columns of the row that a click shows, beside the parameters


def write_sweep_page(sweep: Sweep) -> Path:
    """Write the page into the sweep's folder.

    Raises:
        FileError: It cannot be written.
    """
    maps = maps_of(sweep.grid)
    drawn = {int(task) for one in maps for task in one.tasks.flat}
    rows = {row["task"]: row for row in sweep.rows() if row["task"] in drawn}
    for one in maps:
        mark_jumps(one, (rows[task] for task in map(int, one.tasks.flat) if task in rows))
    return write_page(
        sweep.folder / NAME, "sweep.html", title=f"Sweep over {', '.join(sweep.grid.values)}",
        counts={"Tasks": f"{sweep.finished} of {len(sweep.grid)}", **sweep.statuses},
        tables=[name for name in (CSV, PARQUET) if (sweep.folder / name).exists()],
        maps=[_shown(one, sweep, rows) for one in maps], left=len(sweep.grid) - len(drawn),
        rows=json_block(finite({task: _detail(row, sweep) for task, row in rows.items()})),
    )  # fmt: skip


def _shown(one: Map, sweep: Sweep, rows: dict[int, dict[str, Any]]) -> dict[str, Any]:
    """What the page shows of a map."""
    pictures = [
        picture("Success", LEGEND, one, sweep.grid, {t: _success(row) for t, row in rows.items()}),
        _scale("Cost", "cost", one, sweep, rows),
        _scale("Iterations", "iterations", one, sweep, rows),
    ]
    return {
        "constant": ", ".join(f"{name} = {word(value)}" for name, value in one.constant.items()),
        "pictures": list(map(Markup, pictures)), "jumps": len(one.jumps), "few": one.tasks.shape[1] <= WIDE,
    }  # fmt: skip


def _success(row: dict[str, Any]) -> str:
    if row.get("verdict"):
        return _GOOD if row["verdict"] == "PASS" else _BAD
    return _UNPROVEN if row["status"] == "CONVERGED" else _BAD


def _scale(title: str, name: str, one: Map, sweep: Sweep, rows: dict[int, dict[str, Any]]) -> str:
    """A map of a number, on a logarithmic scale where it spans more than a factor of ten."""
    found = {
        int(task): float(rows[int(task)][name])
        for task in one.tasks.flat
        if int(task) in rows and rows[int(task)]["status"] in _CONVERGED and math.isfinite(rows[int(task)][name])
    }
    if not found:
        return picture(title, "no task converged", one, sweep.grid, {})
    low, high = min(found.values()), max(found.values())
    scaled = math.log if low > 0.0 and high > 10.0 * low else float
    first, last = scaled(low), scaled(high)
    colours = {
        task: colour((scaled(value) - first) / (last - first) if last > first else 0.0) for task, value in found.items()
    }
    how = ", logarithmic" if scaled is math.log else ""
    return picture(title, bar(number(low), number(high)) + how, one, sweep.grid, colours)


def _detail(row: dict[str, Any], sweep: Sweep) -> dict[str, Any]:
    """The part of a row that a click shows."""
    first = [name for name in row if name not in ("task", "print", "start", "guess")][: len(sweep.grid.values) + _SHOWN]
    names = dict.fromkeys([*first, *(name for name in ("reason", "plan") if row.get(name))])
    return {name: row[name] for name in names}
