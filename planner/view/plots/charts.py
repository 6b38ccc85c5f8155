"""Charts of curves over time, with bands of what is normal behind them: joint angles, foot forces, a robot's wrench."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from planner.base.arguments import array
from planner.base.errors import PlannerError
from planner.base.files import PathLike
from planner.problem.pictures import Band, Chart
from planner.view.plots.style import HUES, INK, SOFT, drawable, dress, figure_of, save

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_DASHED = (0, (4, 2))
_BAND = "#c6d2de"
_SPAN = "#ece7dc"
_MOST = len(HUES)  # curves in one chart that can be told apart


def plot_charts(
    t: np.ndarray, charts: Sequence[Chart], path: PathLike, *, xlabel: str = "time (s)", title: str = "",
    span_label: str = "",
) -> None:  # fmt: skip
    """Write a figure of charts, two in a row.

    Args:
        t: (K,) s, or percent of a cycle, of all curves without times of their own.
        charts: The panels.
        path: The file to write; its suffix chooses the format (png, pdf, svg).
        xlabel: Of t.
        title: Above it all.
        span_label: What shaded times are, for the legend.

    Raises:
        PlannerError: Shapes that do not fit, or more curves in a chart than can be told apart.
        FileError: `path` cannot be written, or its suffix names no format.
    """
    save(draw_charts(t, charts, xlabel=xlabel, title=title, span_label=span_label), path)


def draw_charts(
    t: np.ndarray, charts: Sequence[Chart], *, xlabel: str = "time (s)", title: str = "", span_label: str = ""
) -> Figure:
    """The figure that plot_charts() writes."""
    t = array("t", t, ("K",))
    if not charts or len(t) < 2:
        raise PlannerError(
            f"there are {len(charts)} charts over {len(t)} times, expected one or more over two or more."
        )
    labels = dict.fromkeys(curve.label for chart in charts for curve in chart.curves if not curve.of)
    hues = {label: HUES[i % _MOST][1] for i, label in enumerate(labels)}
    figure, cells = figure_of(len(charts))
    for chart, cell in zip(charts, cells, strict=True):
        axes = figure.add_subplot(cell)
        dress(axes, chart.title, chart.ylabel)
        for start, end in chart.spans:
            axes.axvspan(start, end, color=_SPAN, lw=0, zorder=0)
        if chart.band is not None:
            _draw_band(axes, t, chart.band, chart.title)
        own_hue = sum(not curve.of for curve in chart.curves)
        if own_hue > _MOST:
            raise PlannerError(f"chart {chart.title!r} has {own_hue} curves, expected at most {_MOST}.")
        for curve in chart.curves:
            own = t if curve.t is None else array(f"t of {curve.label!r}", curve.t, ("K",))
            values = array(f"values of {curve.label!r}", curve.values, (len(own),), any_value=True)
            axes.plot(
                own, drawable(values), color=hues.get(curve.of or curve.label, INK), lw=1.2 if curve.dashed else 1.8,
                ls=_DASHED if curve.dashed else "-", label=curve.label, zorder=3,
            )  # fmt: skip
        axes.set_xlim(float(t[0]), float(t[-1]))
        axes.set_xlabel(xlabel)
    if title:
        figure.suptitle(title, fontsize=12, fontweight="bold", color=INK)
    _legend(figure, charts, span_label)
    return figure


def _draw_band(axes: Axes, t: np.ndarray, band: Band, title: str) -> None:
    mean = array(f"band of {title!r}", band.mean, (len(t),))
    spread = array(f"spread of {title!r}", np.full(len(t), band.spread) if np.ndim(band.spread) == 0 else band.spread,
                   (len(t),))  # fmt: skip
    axes.fill_between(t, mean - spread, mean + spread, color=_BAND, lw=0, alpha=0.75, zorder=1)
    axes.plot(t, mean, color=SOFT, lw=1.2, ls=_DASHED, zorder=2, label=band.label)


def _legend(figure: Figure, charts: Sequence[Chart], span_label: str) -> None:
    """One for all charts: each label once, and the band and the shade."""
    from matplotlib.patches import Patch

    handles = {}
    for axes in figure.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    if span_label and any(chart.spans for chart in charts):
        handles[span_label] = Patch(facecolor=_SPAN, edgecolor="#cfc8b8", lw=0.5)
    if handles:
        columns = min(len(handles), 6)
        figure.legend(
            list(handles.values()),
            list(handles),
            loc="outside lower center",
            ncols=columns,
            frameon=False,
            fontsize=8.5,
        )
