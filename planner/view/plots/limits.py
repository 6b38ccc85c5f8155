"""The limits of a problem in a plot: bounds as dotted lines, and shading in the curve's colour where it is at one."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from planner.problem.plan import Plan
from planner.view.plots.time_series import to_the_end

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SHADE = 0.13  # opacity, so that curves at their bounds at the same time can both be told
LABEL = "at its bound"
DISTANT_BOUND_SHARE = 0.25  # of the way from one bound to the other: what comes no nearer to a bound is far from it


def limited(plan: Plan) -> bool:
    """Whether a plan's problem has limits that can be drawn."""
    return plan.problem is not None and (plan.problem.bounds is not None or plan.problem.ranges is not None)


class Sides(NamedTuple):
    """The bounds of one curve, at the times of a plan's knots; those of a control are held over a stage."""

    lower: np.ndarray  # (N+1,), NaN where there is none to draw
    upper: np.ndarray  # (N+1,)
    active: np.ndarray  # (N,) whether the curve is at one of them in a stage


def sides_of(plan: Plan, index: int, *, held: bool) -> Sides | None:
    """Of a control (`held`) or of an entry of the state; None for none.

    A bound that the plan stays far from is left out: in a panel of several curves it would be taken for another's.
    """
    sides = (_of_control if held else _of_state)(plan, index)
    if sides is None:
        return None
    values = to_the_end(plan.us[:, index]) if held else plan.xs[:, index]
    width = sides.upper - sides.lower
    far = [
        np.isfinite(width).all() and np.nanmin(gap) > DISTANT_BOUND_SHARE * np.nanmax(width)
        for gap in (values - sides.lower, sides.upper - values)
    ]
    lower, upper = (
        np.where(np.isfinite(side) & ~left_out, side, np.nan) for side, left_out in zip(sides[:2], far, strict=True)
    )
    return Sides(lower, upper, sides.active)


def draw_bounds(axes: Axes, plan: Plan, index: int, colour: str, *, held: bool) -> None:
    """Draw the bounds of a control (`held`) or of an entry of the state, and shade where the plan is at one."""
    sides = sides_of(plan, index, held=held)
    if sides is None:
        return
    for side in sides[:2]:
        if np.isfinite(side).any():
            axes.plot(plan.t, side, color=colour, lw=0.9, ls=":", drawstyle="steps-post" if held else "default",
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
    """Its range, of which the knots but the first are kept."""
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
