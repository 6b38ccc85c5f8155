"""Panels of goals and constraints over time, beside their bounds.

A bound that most curves share is a red line, with the outside shaded; a bound of one curve is dotted, in its hue. A
bound at one time only is a triangle whose tip is the bound, or a ring where a value is to be met.

Values over decades have a log scale; with negative values (a penetration is a negative clearance) it is linear about
zero, so that they are visible.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle
from typing import TYPE_CHECKING

import numpy as np

from planner.problem.appearance import BoundedPanel
from planner.proof.replays.replaying import Replay
from planner.view.plots.style import DASHED, HUES, INK, RED, drawable, dress, positive
from planner.view.plots.time_series import line_of, name_curves, range_of, until_astray, view_limits

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_OUTSIDE = 0.07  # opacity of the shade outside a bound
_DECADES = 30.0  # largest over smallest value, from which the scale is logarithmic
_BELOW = 30.0  # the smallest bound over the smallest value that a log scale shows
_PADDING = 0.06
SHARED, OWN = "_shared bound", "_own bound"  # labels of lines, for a legend below all panels
_UP, _DOWN = 6, 7  # matplotlib's triangles whose tips are at the point


def draw_bounded(axes: Axes, panel: BoundedPanel, replays: Sequence[Replay]) -> None:
    """Draw a panel; `replays` belong to the values after the plan's in it, in the same order."""
    dress(axes, panel.title, panel.ylabel, "time, s")
    single = _single(panel)
    note = "tolerance" if panel.decades and not np.isfinite(panel.lower).any() else "bound"
    if single[0].any() or single[1].any():
        axes.set_ylabel(f"{panel.ylabel}   ({'ring: to be met' if _met(panel).any() else f'tip: {note}'})")
    log = _keep_in_view(axes, panel)
    for column, (name, hue) in enumerate(zip(panel.names, cycle(HUES), strict=False)):
        for replay, values in zip(replays, panel.motions[1:], strict=True):
            curve = positive(values[:, column]) if log else drawable(values[:, column])
            if not log:
                curve = until_astray(curve, axes.get_ylim())
            axes.plot(panel.t, curve, **line_of(replay, hue), solid_capstyle="round", scaley=False)
        planned = panel.motions[0][:, column]
        axes.plot(panel.t, positive(planned) if log else drawable(planned), color=hue[0], lw=1.2, ls=DASHED, label=name,
                  zorder=3, scaley=False)  # fmt: skip
    _draw_bounds(axes, panel, single)
    if len(panel.names) > 1:
        name_curves(axes, panel.names, 1.0, most=0)


def _draw_bounds(axes: Axes, panel: BoundedPanel, single: tuple[np.ndarray, np.ndarray]) -> None:
    met = _met(panel)
    for side, alone, marker, edge in (
        (panel.lower, single[0], _UP, axes.get_ylim()[0]), (panel.upper, single[1], _DOWN, axes.get_ylim()[1])
    ):  # fmt: skip
        along = np.where(np.isfinite(side) & ~alone, side, np.nan)
        close = np.all(np.isclose(along[:, :, None], along[:, None, :], rtol=1e-6, equal_nan=True), axis=0)
        shared: np.ndarray = close[int(np.argmax(close.sum(axis=1)))]  # the curves with the most frequent bound
        together = 2 * int(shared.sum()) > len(shared) or len(shared) == 1
        line = along[:, int(np.argmax(shared))]
        if together and np.isfinite(line).any():
            axes.plot(panel.t, line, color=RED, lw=1.0, scaley=False, zorder=2.5, label=SHARED)
            if not met.any():
                axes.fill_between(panel.t, line, edge, color=RED, alpha=_OUTSIDE, lw=0, zorder=0)
        for column, hue in zip(range(side.shape[1]), cycle(HUES), strict=False):
            if not (together and shared[column]) and np.isfinite(along[:, column]).any():
                axes.plot(panel.t, along[:, column], color=hue[0], lw=1.1, ls=":", scaley=False, zorder=2.5, label=OWN)
            for marked, style in (
                (alone[:, column] & ~met[:, column], {"marker": marker, "color": hue[0], "mec": "white", "mew": 0.6}),
                (alone[:, column] & met[:, column], {"marker": "o", "color": "none", "mec": hue[0], "mew": 1.4}),
            ):
                if marked.any():
                    on_top = {"ms": 7.0, "zorder": 5, "clip_on": False, "in_layout": False, "scaley": False}
                    axes.plot(panel.t[marked], side[marked, column], ls="", **style, **on_top)


def _met(panel: BoundedPanel) -> np.ndarray:
    """Mask (K, R) of equal bounds: a value to be met."""
    return np.isfinite(panel.lower) & (panel.lower == panel.upper)


def _single(panel: BoundedPanel) -> tuple[np.ndarray, np.ndarray]:
    """Masks (K, R) of lower and upper bounds that hold at one time only."""
    found = []
    for side in (panel.lower, panel.upper):
        finite = np.pad(np.isfinite(side), ((1, 1), (0, 0)))
        found.append(finite[1:-1] & ~finite[:-2] & ~finite[2:])
    return found[0], found[1]


def _keep_in_view(axes: Axes, panel: BoundedPanel) -> bool:
    """Set the limits of the axis and return whether its scale is logarithmic."""
    bounds = [side[np.isfinite(side)] for side in (panel.lower, panel.upper)]
    _, high = range_of([panel.motions[0], *bounds])
    if panel.decades and high > 0.0:
        levels = positive(np.concatenate([panel.motions[0].ravel(), *bounds]))
        smallest, edge = float(np.nanmin(levels)), min(float(one.min()) for one in bounds if len(one))
        smallest = max(smallest, edge / _BELOW) if edge > 0.0 else smallest
        lowest, _ = range_of(panel.motions)
        if high > _DECADES * smallest and lowest < 0.0:
            _show_negative(axes, lowest, high, edge)
            return False
        if high > _DECADES * smallest:
            axes.set_yscale("log")
            axes.set_ylim(smallest / 1.5, 1.5 * high)
            return True
    axes.set_ylim(view_limits([panel.motions[0], *bounds], panel.motions, _PADDING))
    return False


def _show_negative(axes: Axes, lowest: float, high: float, edge: float) -> None:
    """A scale that is linear from -edge to edge, the smallest bound, and logarithmic outside; with a line at zero."""
    linear = edge if edge > 0.0 else high / _DECADES
    axes.set_yscale("symlog", linthresh=linear)
    axes.set_ylim(max(1.5 * lowest - 0.2 * linear, -1.5 * high), 1.5 * high)
    axes.axhline(0.0, color=INK, lw=0.6, zorder=1)
