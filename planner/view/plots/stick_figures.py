"""Stick figures over a motion, from several sides: the plan solid, its reference dashed, as in Fig. 5.

The poses of one row stand apart, further than they are in space; all views of a pose stand below each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from planner.base.arguments import array, count, number
from planner.base.errors import PlannerError
from planner.problem.appearance import View
from planner.problem.pictures import PoseSequence, Stick, StickFigures
from planner.view.plots.projection import FRONT, SIDE, axes_of, projected
from planner.view.plots.style import HUES, INK, SOFT, blank, legend_below, title_above

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_DASHED = (0, (3.5, 1.8))
_APART = 1.06  # of the width of the widest pose
_WIDE, _HEAD = 13.0, 0.6  # inches
_EMPTY = 0.08  # of the height, above and below


def draw_stick_figures(picture: StickFigures, views: Sequence[View] = (SIDE, FRONT)) -> Figure:
    """A figure of poses at equal times, a row for each view; PlannerError where points do not fit the sticks."""
    motions, sticks, poses = picture.motions, picture.sticks, count("poses", len(picture.times), minimum=2)
    shown = [_poses(motion, sticks, poses) for motion in motions]
    if not shown or not sticks or not views:
        raise PlannerError("there is nothing to draw, expected at least one motion, one stick and one view.")
    floor = None if picture.ground is None else number("ground", picture.ground)
    flat = [[projected(points, view) for points in shown] for view in views]
    # Each solid pose stands in the middle of its column; the dashed one keeps its distance from it.
    middles = [0.5 * (row[0][..., 0].min(axis=1) + row[0][..., 0].max(axis=1)) for row in flat]
    reach = max(
        float(np.abs(points[..., 0] - middle[:, None]).max())
        for row, middle in zip(flat, middles, strict=True) for points in row
    )  # fmt: skip
    apart = 2.0 * _APART * max(reach, 1e-9)
    figure, axes = _figure(flat, apart, poses, bool(picture.title))
    for view, row, middle, on in zip(views, flat, middles, axes, strict=True):
        for motion, points in zip(motions, row, strict=True):
            shifted = points.copy()
            shifted[..., 0] += (apart * np.arange(poses) - middle)[:, None]
            _draw(on, shifted, sticks, motion.dashed)
        if floor is not None and abs(axes_of(view)[1][2]) > 0.5:
            on.axhline(floor * axes_of(view)[1][2], color=SOFT, lw=0.8, zorder=0)
        on.set_title(view.label, fontsize=9.5, loc="left", color=INK)
        on.set_xlim(-0.5 * apart, (poses - 0.5) * apart)
    for k, words in enumerate(picture.times):
        axes[-1].text(apart * k, -0.02, words, ha="center", va="top", fontsize=8.5, color=INK,
                      transform=axes[-1].get_xaxis_transform())  # fmt: skip
    title_above(figure, picture.title)
    _legend(figure, motions, sticks)
    return figure


def _poses(motion: PoseSequence, sticks: Sequence[Stick], poses: int) -> np.ndarray:
    """The motion's points (poses, P, 3) at equal times, linearly between its samples."""
    points = array(f"points of {motion.label!r}", motion.points, ("K", "P", 3))
    last = max((max(stick.points, default=-1) for stick in sticks), default=-1)
    if last >= points.shape[1] or any(i < 0 for stick in sticks for i in stick.points):
        raise PlannerError(
            f"the sticks join points up to {last} of {motion.label!r}, expected 0 to {points.shape[1] - 1}."
        )
    if len(points) == 0:
        raise PlannerError(f"{motion.label!r} has no samples, expected one or more.")
    at, samples = np.linspace(0.0, 1.0, poses), np.linspace(0.0, 1.0, len(points))
    flat = points.reshape(len(points), -1)
    return np.stack([np.interp(at, samples, column) for column in flat.T], axis=-1).reshape(poses, -1, 3)


def _figure(flat: list[list[np.ndarray]], apart: float, poses: int, titled: bool) -> tuple[Figure, list[Axes]]:
    """A figure of rows to one scale, each as high as its poses."""
    spans = []
    for row in flat:
        heights = np.concatenate([points[..., 1].ravel() for points in row])
        room = _EMPTY * max(float(np.ptp(heights)), apart * 0.1)
        spans.append((float(heights.min()) - room, float(heights.max()) + room))
    scale = _WIDE / (poses * apart)  # inches per metre
    high = [scale * (top - bottom) for bottom, top in spans]
    figure = blank(_WIDE, sum(high) + _HEAD + 0.3 * len(high) + (0.3 if titled else 0.0))
    grid = figure.add_gridspec(len(flat), 1, height_ratios=high)
    axes = [figure.add_subplot(grid[i, 0]) for i in range(len(flat))]
    for on, span in zip(axes, spans, strict=True):
        on.set_ylim(*span)
        on.set_aspect("equal")
        on.axis("off")
    return figure, axes


def _draw(axes: Axes, points: np.ndarray, sticks: Sequence[Stick], dashed: bool) -> None:
    for pose in points:
        for stick in sticks:
            line = pose[list(stick.points)]
            axes.plot(
                line[:, 0], line[:, 1], color=_colour(stick, dashed), lw=1.0 if dashed else 2.2,
                ls=_DASHED if dashed else "-", solid_capstyle="round", solid_joinstyle="round",
                zorder=2 if dashed else 3,
            )  # fmt: skip


def _colour(stick: Stick, dashed: bool) -> str:
    if stick.hue is None:
        return SOFT if dashed else INK
    return HUES[stick.hue % len(HUES)][1]


def _legend(figure: Figure, motions: Sequence[PoseSequence], sticks: Sequence[Stick]) -> None:
    from matplotlib.lines import Line2D

    handles = [
        Line2D([], [], color=INK, lw=1.0 if motion.dashed else 2.2, ls=_DASHED if motion.dashed else "-",
               label=motion.label) for motion in motions
    ]  # fmt: skip
    handles += [Line2D([], [], color=_colour(stick, False), lw=2.0, label=stick.label) for stick in sticks
                if stick.label]  # fmt: skip
    legend_below(figure, handles)
