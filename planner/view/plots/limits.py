"""The limits of a problem in a plot: bounds as dotted lines, and shading in the curve's colour where it is at one."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from planner.problem.plan import Plan

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SHADE = 0.13  # opacity, so that curves at their bounds at the same time can both be told
LABEL = "at its bound"


def limited(plan: Plan) -> bool:
    """Whether a plan's problem has limits that can be drawn."""
    return plan.problem is not None and (plan.problem.bounds is not None or plan.problem.ranges is not None)


def draw_control_bounds(axes: Axes, plan: Plan, index: int, colour: str) -> None:
    """Draw the bounds of one control, and shade the stages in which it is at one."""
    if plan.problem is None or plan.problem.bounds is None:
        return
    bounds = plan.problem.bounds
    lower, upper = (side[:, index] for side in bounds.at(slice(None), plan.xs[:-1]))
    _draw(axes, plan.t, lower, upper, bounds.at_bound(plan.xs, plan.us)[:, index], colour, held=True)


def draw_state_range(axes: Axes, plan: Plan, index: int, colour: str) -> None:
    """Draw the range of one entry of the state, and shade the knots at which it is at an end of it."""
    if plan.problem is None or plan.problem.ranges is None or plan.problem.limits is None:
        return
    ranges, limits = plan.problem.ranges, plan.problem.limits
    always = len(ranges.component) - ranges.at_end
    for h in np.flatnonzero(ranges.component[:always] == plan.space.in_deviation(index)):
        offset = plan.xs[:, index] - ranges.deviations(plan.xs)[:, h]
        lower, upper = ranges.lower[:, h] + offset, ranges.upper[:, h] + offset
        active = ranges.at_bound(plan.xs, limits.tolerance)[:, h]
        _draw(axes, plan.t, lower[1:], upper[1:], active[1:], colour, held=False)


def _draw(
    axes: Axes, t: np.ndarray, lower: np.ndarray, upper: np.ndarray, active: np.ndarray, colour: str, *, held: bool
) -> None:
    """Bounds (N,) of stages, or of the knots at their ends."""
    for side in (lower, upper):
        if np.isfinite(side).any():
            values = np.where(np.isfinite(side), side, np.nan)
            values = np.append(values, values[-1:]) if held else np.append(values[:1], values)
            axes.plot(t, values, color=colour, lw=0.9, ls=":", drawstyle="steps-post" if held else "default",
                      scaley=False, zorder=1.5)  # fmt: skip
    edges = np.flatnonzero(np.diff(np.concatenate([[0], active.astype(int), [0]])))
    for first, end in edges.reshape(-1, 2):
        axes.axvspan(float(t[first]), float(t[end]), color=colour, alpha=SHADE, lw=0, zorder=0)
