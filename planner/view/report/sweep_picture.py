"""A map of a sweep as SVG: a cell a task, values along both axes, lines between neighbours in different minima."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from typing import Any

import numpy as np

from planner.sweeps.grid import Grid
from planner.view.report.sweep_maps import Map
from planner.view.report.tables import number

NOTHING = "#c9ced3"  # the colour of a task without a value
WIDE = 24  # columns: a map with more takes the whole width of the page
_WIDTH, _NARROW = 1000.0, 420.0  # of a map, in its own units
_LEFT, _LINE, _LETTER = 12.0, 20.0, 8.0  # margin, height of a line of text, width of a letter
_TALLEST, _LEAST, _MOST = 420.0, 3.0, 34.0  # of all rows; of a cell
_TICKS_UP, _APART = 12, 60.0  # most values beside a map, and how far apart those below it are
# Viridis (van der Walt and Smith, 2015), which reads in grey and by the colour-blind.
_STOPS = np.array([[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]], dtype=float)

CSS = """
svg { width: 100%; height: auto; display: block; } svg rect[data-t] { cursor: pointer; }
svg rect[data-t]:hover { opacity: .65; } .three { display: grid; gap: 1rem 1.5rem; }
.few { grid-template-columns: repeat(auto-fit, minmax(17rem, 1fr)); } .few figcaption { min-height: 3em; }
.jump { stroke: #e2007a; stroke-width: 4; } .under { stroke: #fff; stroke-width: 7; }
svg text { font: 13px system-ui, sans-serif; fill: var(--soft); }
.bar { display: inline-block; width: 7rem; height: .8rem; vertical-align: -.1rem; margin: 0 .4rem; }
"""


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
    tall = min(max(min(wide, _MOST), _MOST / 2.0), max(_TALLEST / rows, _LEAST))
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
    for j in _some(columns, int(min((width - left) / _APART, columns))):
        lines.append(_text(left + (j + 0.5) * wide, below + _LINE - 4.0, word(grid.values[one.across][j]), "middle"))
    axes = f"{one.across} to the right{f', {one.up} upwards' if one.up else ''}"
    lines.append(_text(left, below + 2.0 * _LINE - 4.0, axes, "start"))
    return (
        f"<figure><figcaption><b>{escape(title)}</b>: {legend}</figcaption>"
        f'<svg viewBox="0 0 {width:.0f} {below + 2.0 * _LINE:.0f}" role="img" aria-label="{escape(title)}">'
        f"{''.join(lines)}</svg></figure>"
    )


def colour(part: float) -> str:
    """The colour of a value, 0 for the least and 1 for the largest."""
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
    """At most so many of 0 ... count - 1, evenly apart from the first on."""
    return list(range(0, count, -(-count // max(most, 1))))


def _text(x: float, y: float, text: str, anchor: str) -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(text)}</text>'
