"""Curves of a plan and its replays over time, as plain arrays and as lines; goals and constraints beside their bounds.

plots.png and the interactive curves of the page are made of these.

In a panel of goals or constraints a bound that most curves share is a red line, with the outside shaded; a bound of one
curve is dotted, in its hue. A bound at one time only is a triangle whose tip is the bound, or a ring where a value is
to be met. Values over decades have a log scale; with negative values (a penetration is a negative clearance) it is
linear about zero, so that they are visible.
"""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import cycle
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from planner.model.coordinates import Coordinate, coordinates_of
from planner.problem.appearance import BoundedPanel, Panel
from planner.problem.default_appearance import appearance_of, small_multiples, task_panels
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.proof.replays.replaying import Replay
from planner.view.plots.style import DASHED, HUES, INK, RED, drawable, dress, positive

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from planner.proof import Proof


@dataclass(frozen=True)
class TimeSeries:
    """One quantity over time: (t, values) of the plan and of each replay."""

    label: str
    plan: tuple[np.ndarray, np.ndarray]
    replays: tuple[tuple[np.ndarray, np.ndarray], ...]
    stepwise: bool  # constant over a stage: drawn as steps
    index: int  # of the state or control


def replays_of(result: Proof | Replay | None) -> list[Replay]:
    """The replays to draw, the widest line first."""
    if result is None:
        return []
    runs = [result] if isinstance(result, Replay) else result.replays.values()
    return sorted(runs, key=lambda replay: replay.feedback)


def tasks_of(plan: Plan, replays: list[Replay]) -> list[BoundedPanel]:
    """Goals and constraints over time, at the knots; none for a problem without."""
    if not isinstance(plan.problem, Problem):
        return []
    motions = [(plan.xs, plan.us)]
    for replay in replays:
        us = replay.stage_controls if replay.ctrl.shape[1] == plan.us.shape[1] else plan.us
        motions.append((replay.xs[:: replay.substeps], us))
    return task_panels(plan.problem, plan.t, motions)


def panels_of(plan: Plan) -> tuple[Panel, ...]:
    """The panels that the plan's appearance lists; for a plan without any, its states by unit and its controls."""
    if own := appearance_of(plan.problem).plots:
        return own
    nx, nu = plan.xs.shape[1], plan.us.shape[1]
    known = coordinates_of(plan.problem.dynamics) if plan.problem is not None else ()
    states = known if len(known) == nx else tuple(Coordinate(f"x[{index}]", "") for index in range(nx))
    panels = []
    for unit in dict.fromkeys(one.unit for one in states):
        of_unit = [(index, one.name) for index, one in enumerate(states) if one.unit == unit]
        for title, curves in small_multiples(f"States, {unit}" if unit else "States", of_unit):
            panels.append(Panel(title, unit or "x", states=curves))
    inputs = small_multiples("Controls", [(index, f"u[{index}]") for index in range(nu)])
    return (*panels, *(Panel(title, "u", controls=curves) for title, curves in inputs))


def curves_of(panel: Panel, plan: Plan, replays: list[Replay]) -> list[TimeSeries]:
    """The curves of a panel: states first."""
    curves = []
    for index, label in panel.states:
        planned = (replays[0].t, replays[0].plan_xs[:, index]) if replays else (plan.t, plan.xs[:, index])
        simulated = tuple((replay.t, replay.xs[:, index]) for replay in replays)
        curves.append(TimeSeries(label, planned, simulated, stepwise=False, index=index))
    for index, label in panel.controls:
        simulated = tuple((replay.t, to_the_end(replay.ctrl[:, index])) for replay in replays)
        curves.append(TimeSeries(label, (plan.t, to_the_end(plan.us[:, index])), simulated, stepwise=True, index=index))
    return curves


def to_the_end(us: np.ndarray) -> np.ndarray:
    """Controls (N,) with the last one repeated, so that its stage is drawn too: (N+1,)."""
    return np.append(us, us[-1:])


def unit_of(ylabel: str) -> str:
    """The unit in the label of an axis, "height, in" or "rate (rad/s)"; "" where there is none."""
    found = re.search(r"[(\[,]\s*([^()\[\],]+?)\s*[)\]]?$", ylabel)
    return found[1] if found else ""


BESIDE = 3  # more curves than this are named beside the panel, not in it
ASTRAY = 1.5  # by how much a diverging replay may widen an axis, in ranges of the other curves
_LONGEST = 22  # characters of a line of a name beside a panel


def line_of(replay: Replay, hue: tuple[str, str, str]) -> dict[str, Any]:
    """Style of a replay's line."""
    return {"color": hue[1], "lw": 2.2, "zorder": 2} if replay.feedback else {"color": hue[2], "lw": 4.0, "zorder": 1.9}


def range_of(values: Sequence[np.ndarray]) -> tuple[float, float]:
    """Least and largest value that can be drawn; (0, 0) if there is none."""
    visible = np.concatenate([drawable(part).ravel() for part in values] or [np.empty(0)])
    visible = visible[np.isfinite(visible)]
    return (float(visible.min()), float(visible.max())) if visible.size else (0.0, 0.0)


def view_limits(certain: Sequence[np.ndarray], replayed: Sequence[np.ndarray], padding: float) -> tuple[float, float]:
    """Limits of an axis: all `certain` values (plan, bounds), and of those replayed what is not far outside.

    `padding` is the free part of the height at either end.
    """
    (low, high), (lowest, highest) = range_of(certain), range_of([*certain, *replayed])
    reach = ASTRAY * ((high - low) or math.inf)
    low, high = max(lowest, low - reach), min(highest, high + reach)
    if not high > low:
        low, high = low - 1.0, high + 1.0
    return low - padding * (high - low), high + padding * (high - low)


def until_astray(values: np.ndarray, limits: tuple[float, float]) -> np.ndarray:
    """The values until they first leave the view: later ones of a diverging replay would hide the others."""
    visible = drawable(values)
    outside = np.flatnonzero((visible < limits[0]) | (visible > limits[1]))
    if len(outside):
        visible[outside[0] + 1 :] = np.nan
    return visible


def name_curves(axes: Axes, labels: Sequence[str], beside: float, *, most: int = BESIDE) -> None:
    """Draw a legend by colour: each curve's plan and replay share a hue. More than `most` names are put at `beside`."""
    from matplotlib.lines import Line2D

    handles = [Line2D([], [], color=dark, lw=2.0) for (dark, _, _), _ in zip(cycle(HUES), labels, strict=False)]
    style: dict[str, Any] = {"framealpha": 0.85, "edgecolor": "none", "borderpad": 0.3, "handlelength": 1.4}
    if len(labels) > most:
        names = [textwrap.fill(label, _LONGEST) for label in labels]
        legend = axes.legend(handles, names, fontsize=7, loc="center left", bbox_to_anchor=(beside, 0.5), **style)
    else:
        legend = axes.legend(handles, labels, fontsize=8, loc="upper left", ncols=len(labels), **style)
    legend.set_zorder(5)


SHADE = 0.13  # opacity of the shade at a bound; shades of two curves overlap visibly
LABEL = "at its bound"
DISTANT_BOUND_SHARE = 0.25  # of the range between the bounds: a bound that is never nearer is not drawn


def limited(plan: Plan) -> bool:
    """Whether a plan's problem has limits that can be drawn."""
    return plan.problem is not None and (plan.problem.bounds is not None or plan.problem.ranges is not None)


class Sides(NamedTuple):
    """The bounds of one curve at a plan's knots; those of a control are constant over a stage."""

    lower: np.ndarray  # (N+1,), NaN where there is none to draw
    upper: np.ndarray  # (N+1,)
    active: np.ndarray  # (N,) whether the curve is at one of them in a stage


def sides_of(plan: Plan, index: int, *, stepwise: bool) -> Sides | None:
    """Bounds of a control (`stepwise`: constant over a stage) or of an entry of the state; None without bounds.

    A bound that the plan never approaches is left out: in a panel of several curves it would be taken for another's.
    """
    sides = (_of_control if stepwise else _of_state)(plan, index)
    if sides is None:
        return None
    values = to_the_end(plan.us[:, index]) if stepwise else plan.xs[:, index]
    width = sides.upper - sides.lower
    distant = [
        np.isfinite(width).all() and np.nanmin(clearance) > DISTANT_BOUND_SHARE * np.nanmax(width)
        for clearance in (values - sides.lower, sides.upper - values)
    ]
    lower, upper = (
        np.where(np.isfinite(side) & ~hidden, side, np.nan) for side, hidden in zip(sides[:2], distant, strict=True)
    )
    return Sides(lower, upper, sides.active)


def draw_bounds(axes: Axes, plan: Plan, index: int, colour: str, *, stepwise: bool) -> None:
    """Draw the bounds of a control (`stepwise`) or of an entry of the state, and shade where the plan is at one."""
    sides = sides_of(plan, index, stepwise=stepwise)
    if sides is None:
        return
    for side in sides[:2]:
        if np.isfinite(side).any():
            axes.plot(plan.t, side, color=colour, lw=0.9, ls=":", drawstyle="steps-post" if stepwise else "default",
                      scaley=False, zorder=1.5)  # fmt: skip
    edges = np.flatnonzero(np.diff(np.concatenate([[0], sides.active.astype(int), [0]])))
    for first, end in edges.reshape(-1, 2):
        axes.axvspan(float(plan.t[first]), float(plan.t[end]), color=colour, alpha=SHADE, lw=0, zorder=0)


def _of_control(plan: Plan, index: int) -> Sides | None:
    if plan.problem is None or plan.problem.bounds is None:
        return None
    bounds = plan.problem.bounds
    lower, upper = (to_the_end(side[:, index]) for side in bounds.at(slice(None), plan.xs[:-1]))
    return Sides(lower, upper, bounds.at_bound(plan.xs, plan.us)[:, index])


def _of_state(plan: Plan, index: int) -> Sides | None:
    """The range of a state; the plan's first state is not limited by it."""
    if plan.problem is None or plan.problem.ranges is None or plan.problem.limits is None:
        return None
    ranges, limits = plan.problem.ranges, plan.problem.limits
    always = len(ranges.component) - ranges.at_end
    own = np.flatnonzero(ranges.component[:always] == plan.space.in_deviation(index))
    if not len(own):
        return None
    h = own[0]
    offset = plan.xs[:, index] - ranges.deviations(plan.xs)[:, h]
    lower, upper = (side[:, h] + offset for side in (ranges.lower, ranges.upper))
    lower[0], upper[0] = lower[1], upper[1]
    return Sides(lower, upper, ranges.at_bound(plan.xs, limits.tolerance)[1:, h])


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
