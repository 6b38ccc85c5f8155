"""Paths of points in space, e.g. of a pelvis, seen from several sides to one scale."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from planner.base.arguments import array
from planner.base.errors import PlannerError
from planner.problem.appearance import View
from planner.problem.pictures import Paths
from planner.view.plots.projection import FRONT, SIDE, TOP, axes_of, projected
from planner.view.plots.style import DASHED, HUES, SOFT, blank, dress, legend_below, title_above

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_HIGH = 3.6  # inches


def draw_paths(picture: Paths, views: Sequence[View] = (SIDE, FRONT, TOP)) -> Figure:
    """A figure of paths, mm, from each view; a dot marks the start of each. PlannerError for wrong shapes."""
    traces = picture.traces
    if not traces or not views:
        raise PlannerError("there is nothing to draw, expected at least one path and one view.")
    spaces = [1000.0 * array(f"points of {label!r}", points, ("K", 3)) for label, points, _ in traces]
    flat = [[projected(points, view) for points in spaces] for view in views]
    every = [np.concatenate(row) for row in flat]
    reach = 0.55 * max(float(np.ptp(points, axis=0).max()) for points in every) or 0.5
    figure = blank(_HIGH * len(views), _HIGH + 0.6)
    for i, (view, row, points) in enumerate(zip(views, flat, every, strict=True)):
        axes = figure.add_subplot(1, len(views), i + 1)
        right, up = (_direction(axis) for axis in axes_of(view))
        dress(axes, view.label, f"{up}, mm", f"{right}, mm")
        middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
        axes.set_xlim(middle[0] - reach, middle[0] + reach)
        axes.set_ylim(middle[1] - reach, middle[1] + reach)
        axes.set_aspect("equal")
        hue = 0
        for (label, _, dashed), line in zip(traces, row, strict=True):
            colour = SOFT if dashed else HUES[hue % len(HUES)][1]
            hue += not dashed
            axes.plot(line[:, 0], line[:, 1], color=colour, lw=1.2 if dashed else 2.0, ls=DASHED if dashed else "-",
                      label=label)  # fmt: skip
            axes.plot(line[0, 0], line[0, 1], "o", color=colour, ms=4.5)
    title_above(figure, picture.title)
    legend_below(figure, figure.axes[0].get_legend_handles_labels()[0])
    return figure


def _direction(axis: np.ndarray) -> str:
    """The direction in space of an axis of the figure."""
    i = int(np.argmax(np.abs(axis)))
    if abs(axis[i]) < 1.0 - 1e-9:
        return "across" if abs(axis[2]) < 1e-9 else "up"
    return ("\N{MINUS SIGN}" if axis[i] < 0.0 else "") + "xyz"[i]
