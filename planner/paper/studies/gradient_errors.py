"""Errors of the gradient of Eq. 7 by the tolerance of the integrations, in numbers, as a table and as curves."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from planner.paper.studies.records import table
from planner.view.plots.style import dress

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Evaluated = tuple[float, np.ndarray]
"""J and its gradient."""


def errors_at(point: str, exact: Evaluated, values: Sequence[Evaluated]) -> dict[str, Any]:
    """Errors of J and its gradient at a named point: `values` at each tolerance, `exact` at a very tight one."""
    J, gradient = exact
    size = float(np.linalg.norm(gradient))
    return {
        "point": point, "cost": J, "gradient_norm": size,
        "cost_errors": [abs(value - J) / abs(J) for value, _ in values],
        "relative_errors": [float(np.linalg.norm(g - gradient)) / size for _, g in values],
    }  # fmt: skip


def errors_table(points: Sequence[dict[str, Any]], tolerances: Sequence[float]) -> list[str]:
    """Lines of a Markdown table: a row for each point, a column for each tolerance."""
    columns = {f"{tolerance:g}": f"{{relative_errors[{i}]:.1e}}" for i, tolerance in enumerate(tolerances)}
    return table({"at": "{point}", "gradient": "{gradient_norm:.3g}", **columns}, points)


def draw_errors(axes: Axes, title: str, points: Sequence[dict[str, Any]], tolerances: Sequence[float]) -> None:
    """A curve for each point, from loose to tight tolerances."""
    dress(axes, title, "relative error of the gradient", "tolerance of the integration")
    for point in points:
        label = f"{point['point']}: gradient {point['gradient_norm']:.2g}"
        axes.loglog(tolerances, point["relative_errors"], marker="o", ms=4, label=label)
    axes.invert_xaxis()
