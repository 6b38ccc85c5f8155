"""The picture of a loop: MuJoCo beside what the controller expected, what it applied, and the pushes it bore."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from planner.model.coordinates import coordinates_of
from planner.problem.pictures import Chart, Charts, CurveData
from planner.view.plots.charts import draw_charts
from planner.view.plots.style import HUES

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from planner.control.judging import LoopVerdict

_SAMPLES = 1500


def draw_loop(verdict: LoopVerdict) -> Figure:
    """States by unit, controls, and where it was sought the map of pushes."""
    run, most = verdict.loop, len(HUES)
    few = np.unique(np.linspace(0, len(run.t) - 1, _SAMPLES).round().astype(int))
    t, coordinates = run.t[few], coordinates_of(run.controller.problem.dynamics)
    zero = run.controller.problem.x0
    seen, expected = (run.plan.space.difference(xs[few], zero) for xs in (run.xs, run.plan_xs))
    charts = []
    for unit in dict.fromkeys(one.unit for one in coordinates):
        rows = [i for i, one in enumerate(coordinates) if one.unit == unit][:most]
        curves = [CurveData(coordinates[i].name.removeprefix("velocity of "), seen[:, i]) for i in rows]
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
