"""Plots of measurements over time: charts with bands of normal values, a control loop, and the pictures of a case."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from planner.base.arguments import array
from planner.base.errors import PlannerError
from planner.model.coordinates import coordinates_of
from planner.problem.appearance import Band, CasePicture, Chart, Charts, CurveData, Paths, StickFigures
from planner.problem.default_appearance import appearance_of
from planner.view.plots.stick_figures import draw_paths, draw_stick_figures
from planner.view.plots.style import DASHED, HUES, INK, SOFT, drawable, dress, legend_below, panels_of, title_above

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from planner.control.judging import LoopVerdict
    from planner.problem.plan import Plan
    from planner.proof.replays.replaying import Replay

_BAND = "#c6d2de"
_SPAN = "#ece7dc"
_MAX_CURVES = len(HUES)  # curves in one chart; each has a hue of its own


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


_SAMPLES = 1500


def draw_loop(verdict: LoopVerdict) -> Figure:
    """States by unit, controls, and the map of pushes where there is one."""
    run, most = verdict.loop, len(HUES)
    few = np.unique(np.linspace(0, len(run.t) - 1, _SAMPLES).round().astype(int))
    t, coordinates = run.t[few], coordinates_of(run.controller.problem.dynamics)
    zero = run.controller.problem.x0
    simulated, expected = (run.plan.space.difference(xs[few], zero) for xs in (run.xs, run.plan_xs))
    charts = []
    for unit in dict.fromkeys(one.unit for one in coordinates):
        rows = [i for i, one in enumerate(coordinates) if one.unit == unit][:most]
        curves = [CurveData(coordinates[i].name.removeprefix("velocity of "), simulated[:, i]) for i in rows]
        curves += [CurveData("expected", expected[:, i], dashed=True, of=curves[k].label) for k, i in enumerate(rows)]
        title = "Speeds" if unit.endswith("/s") else "Positions"
        charts.append(Chart(f"{title}, from the start", unit or "state", curves, spans=_pushes(verdict)))
    us = run.ctrl[np.minimum(few, len(run.ctrl) - 1)]
    charts.append(Chart("Controls", "control", [CurveData(f"u{a}", us[:, a]) for a in range(min(us.shape[1], most))]))
    if verdict.robustness_maps:
        words = {"loop": "the loop", "gains": "its plan with the gains alone"}
        curves = [
            CurveData(words[who], values, dashed=who != "loop", t=verdict.times)
            for who, values in verdict.robustness_maps.items()
        ]
        charts.append(Chart("Largest push that is survived, by the time at which it begins", "N", curves))
    return draw_charts(Charts("", t, charts, title=verdict.headline, span_label="pushed"))


def _pushes(verdict: LoopVerdict) -> list[tuple[float, float]]:
    return [(push["time"], push["time"] + push["duration"]) for push in verdict.loop.errors["pushes"]]


CASE_PICTURES = {StickFigures: "poses.png", Charts: "measures.png", Paths: "paths.png"}
"""The file of each kind of picture; a case has at most one of a kind."""


def case_pictures(plan: Plan, replay: Replay | None) -> dict[str, CasePicture]:
    """File name -> picture, of a plan and its judged replay; empty for a case without own pictures."""
    pictures = appearance_of(plan.problem).pictures
    return {} if pictures is None else {CASE_PICTURES[type(one)]: one for one in pictures(plan, replay)}


def draw_case_picture(picture: CasePicture) -> Figure:
    """The figure of a case's picture."""
    if isinstance(picture, Charts):
        return draw_charts(picture)
    return draw_paths(picture) if isinstance(picture, Paths) else draw_stick_figures(picture)
