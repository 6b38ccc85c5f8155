"""Paths of points in space, seen from several sides to one scale: where a pelvis goes, for example."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from planner.base.arguments import array, number
from planner.base.errors import PlannerError
from planner.base.files import PathLike
from planner.problem.appearance import View
from planner.problem.pictures import Trace
from planner.view.plots.projection import FRONT, SIDE, TOP, axes_of, projected
from planner.view.plots.style import HUES, INK, SOFT, dress, figure_of, save

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_DASHED = (0, (4, 2))
_HIGH = 3.6  # inches


def plot_paths(
    paths: Sequence[Trace], path: PathLike, *, views: Sequence[View] = (SIDE, FRONT, TOP), scale: float = 1000.0,
    unit: str = "mm", title: str = "",
) -> None:  # fmt: skip
    """Write a picture of paths; a dot is where each begins.

    Args:
        paths: What to draw.
        path: The file to write; its suffix chooses the format (png, pdf, svg).
        views: From where, side by side.
        scale: Units per metre.
        unit: Their name.
        title: Above it all.

    Raises:
        PlannerError: Wrong shapes.
        FileError: `path` cannot be written, or its suffix names no format.
    """
    save(draw_paths(paths, views=views, scale=scale, unit=unit, title=title), path)


def draw_paths(
    paths: Sequence[Trace], *, views: Sequence[View] = (SIDE, FRONT, TOP), scale: float = 1000.0, unit: str = "mm",
    title: str = "",
) -> Figure:  # fmt: skip
    """The figure that plot_paths() writes."""
    scale = number("scale", scale, above=0.0)
    if not paths or not views:
        raise PlannerError("there is nothing to draw, expected at least one path and one view.")
    spaces = [scale * array(f"points of {label!r}", points, ("K", 3)) for label, points, _ in paths]
    figure, _ = figure_of(1)
    figure.clear()
    flat = [[projected(points, view) for points in spaces] for view in views]
    every = [np.concatenate(row) for row in flat]
    reach = 0.55 * max(float(np.ptp(points, axis=0).max()) for points in every) or 0.5
    figure.set_size_inches(_HIGH * len(views), _HIGH + 0.6)
    for i, (view, row, points) in enumerate(zip(views, flat, every, strict=True)):
        axes = figure.add_subplot(1, len(views), i + 1)
        right, up = (_direction(axis) for axis in axes_of(view))
        dress(axes, view.label, f"{up} ({unit})")
        axes.set_xlabel(f"{right} ({unit})")
        middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
        axes.set_xlim(middle[0] - reach, middle[0] + reach)
        axes.set_ylim(middle[1] - reach, middle[1] + reach)
        axes.set_aspect("equal")
        hue = 0
        for (label, _, dashed), line in zip(paths, row, strict=True):
            colour = SOFT if dashed else HUES[hue % len(HUES)][1]
            hue += not dashed
            axes.plot(line[:, 0], line[:, 1], color=colour, lw=1.2 if dashed else 2.0, ls=_DASHED if dashed else "-",
                      label=label)  # fmt: skip
            axes.plot(line[0, 0], line[0, 1], "o", color=colour, ms=4.5)
    if title:
        figure.suptitle(title, fontsize=12, fontweight="bold", color=INK)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False, fontsize=8.5)
    return figure


def _direction(axis: np.ndarray) -> str:
    """What an axis of the paper is in space."""
    i = int(np.argmax(np.abs(axis)))
    if abs(axis[i]) < 1.0 - 1e-9:
        return "across" if abs(axis[2]) < 1e-9 else "up"
    return ("\N{MINUS SIGN}" if axis[i] < 0.0 else "") + "xyz"[i]
