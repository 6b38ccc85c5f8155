"""Convergence of the solver: cost and gradient at each iteration."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from planner.problem.plan import Plan
from planner.view.plots.style import HUES, MINUS, drawable, dress, positive, right_axis, say

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MARKED = 60  # iterations beyond which marks would be a band


def draw_convergence(axes: Axes, plan: Plan) -> None:
    """Cost minus final cost, and gradient norm, at each iteration."""
    dress(axes, "Convergence", "", "iteration")
    axes.locator_params(axis="x", integer=True)
    iterations = np.array([line.iteration for line in plan.history], dtype=float)
    excess = drawable(np.array([line.cost for line in plan.history], dtype=float))
    if excess.size and np.isfinite(excess[-1]):
        excess = excess - excess[-1]
    gradient = np.array([line.gradient_norm for line in plan.history], dtype=float)
    drawn = False
    for axis, label, values, dark, marker in (
        (axes, f"cost {MINUS} final cost", excess, HUES[0][0], "o"),
        (None, "gradient norm", gradient, HUES[1][0], "s"),
    ):
        # A log scale has no zero: the last cost, which is the final one, falls out, and so does rounding.
        shown = np.isfinite(positive(values))
        if not np.any(shown):
            continue
        if axis is None:
            axis = right_axis(axes, "") if drawn else axes
        axis.set_yscale("log")
        mark = marker if len(iterations) < _MARKED else ""
        axis.plot(iterations[shown], values[shown], color=dark, lw=1.2, marker=mark, ms=3.5)
        axis.set_ylabel(label, color=dark, fontsize=8.5)
        axis.tick_params(axis="y", which="both", colors=dark)
        axis.tick_params(axis="y", which="minor", length=1.5)
        drawn = True
    if not drawn:
        say(axes, "no finite iteration")
