"""Charts of curves over time, e.g. joint angles or foot forces, with bands of normal values behind them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from planner.base.arguments import array
from planner.base.errors import PlannerError
from planner.problem.pictures import Band, Charts
from planner.view.plots.style import DASHED, HUES, INK, SOFT, drawable, dress, legend_below, panels_of, title_above

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_BAND = "#c6d2de"
_SPAN = "#ece7dc"
_MAX_CURVES = len(HUES)  # curves in one chart that can be told apart


def draw_charts(picture: Charts) -> Figure:
    """A figure of charts, two in a row; PlannerError for shapes that do not fit and for too many curves in a chart."""
    charts, t = picture.charts, array("t", picture.t, ("K",))
    if not charts or len(t) < 2:
        raise PlannerError(
            f"there are {len(charts)} charts over {len(t)} times, expected one or more over two or more."
        )
    labels = dict.fromkeys(curve.label for chart in charts for curve in chart.curves if not curve.of)
    hues = {label: HUES[i % _MAX_CURVES][1] for i, label in enumerate(labels)}
    figure, panels = panels_of(len(charts))
    for chart, axes in zip(charts, panels, strict=True):
        dress(axes, chart.title, chart.ylabel, picture.xlabel)
        for start, end in chart.spans:
            axes.axvspan(start, end, color=_SPAN, lw=0, zorder=0)
        if chart.band is not None:
            _draw_band(axes, t, chart.band, chart.title)
        own_hue = sum(not curve.of for curve in chart.curves)
        if own_hue > _MAX_CURVES:
            raise PlannerError(f"chart {chart.title!r} has {own_hue} curves, expected at most {_MAX_CURVES}.")
        for curve in chart.curves:
            own = t if curve.t is None else array(f"t of {curve.label!r}", curve.t, ("K",))
            values = array(f"values of {curve.label!r}", curve.values, (len(own),), any_value=True)
            axes.plot(
                own, drawable(values), color=hues.get(curve.of or curve.label, INK), lw=1.2 if curve.dashed else 1.8,
                ls=DASHED if curve.dashed else "-", label=curve.label, zorder=3,
            )  # fmt: skip
        axes.set_xlim(float(t[0]), float(t[-1]))
    title_above(figure, picture.title)
    _legend(figure, picture)
    return figure


def _draw_band(axes: Axes, t: np.ndarray, band: Band, title: str) -> None:
    mean = array(f"band of {title!r}", band.mean, (len(t),))
    spread = array(f"spread of {title!r}", np.full(len(t), band.spread) if np.ndim(band.spread) == 0 else band.spread,
                   (len(t),))  # fmt: skip
    axes.fill_between(t, mean - spread, mean + spread, color=_BAND, lw=0, alpha=0.75, zorder=1)
    axes.plot(t, mean, color=SOFT, lw=1.2, ls=DASHED, zorder=2, label=band.label)


def _legend(figure: Figure, picture: Charts) -> None:
    """Draw one legend for all charts: each label once, the band and the shade."""
    from matplotlib.patches import Patch

    handles = {}
    for axes in figure.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    if picture.span_label and any(chart.spans for chart in picture.charts):
        handles[picture.span_label] = Patch(facecolor=_SPAN, edgecolor="#cfc8b8", lw=0.5, label=picture.span_label)
    if handles:
        legend_below(figure, list(handles.values()), columns=6)
