"""Curves of the page: SVG that can be read as it is, and numbers from which a script shows values and moves the film.

Every chart has one unit. A curve keeps the extremes of each piece of time: the page stays small and no peak is lost.

A script shows values where the pointer hovers and moves the film to a click; without scripts the curves are pictures.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape
from itertools import cycle
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from planner.problem.default_appearance import appearance_of
from planner.view.plots.style import HUES, MINUS, MODE_WORDS, RED, drawable
from planner.view.plots.time_series import (
    curves_of,
    panels_of,
    replays_of,
    sides_of,
    tasks_of,
    unit_of,
    until_astray,
    view_limits,
)
from planner.view.report.markup import json_block

if TYPE_CHECKING:
    from planner.problem.plan import Plan
    from planner.proof import Proof
    from planner.proof.replays.replaying import Replay

WIDTH, HEIGHT = 470, 230  # of a chart, in its own units
LEFT, RIGHT, TOP, BOTTOM = 56, 10, 10, 36  # around the curves
_PIECES = 120  # of time; two samples of a curve are drawn of each
_DIGITS = 5
_PADDING = 0.06
_TICKS = 5


class Line(NamedTuple):
    """A curve of a chart."""

    label: str
    kind: str  # "plan", "gains", "open" or "bound"
    t: np.ndarray  # (K,) s
    values: np.ndarray  # (K,)
    colour: str
    stepwise: bool  # constant over a stage


class InteractiveChart(NamedTuple):
    """Curves with one unit."""

    title: str
    ylabel: str
    lines: tuple[Line, ...]


def interactive(plan: Plan, proof: Proof | None) -> str:
    """The charts of a plan and its replays as HTML with one data block; "" where there are none."""
    replays = replays_of(proof)
    charts = [chart for chart in _charts(plan, replays) if any(len(line.t) for line in chart.lines)]
    if not charts:
        return ""
    start, end = float(plan.t[0]), float(plan.t[-1])
    drawn = [_figure(i, chart, start, end) for i, chart in enumerate(charts)]
    data = {
        "start": start, "end": end, "speed": appearance_of(plan.problem).speed,
        "box": [LEFT, TOP, WIDTH - LEFT - RIGHT, HEIGHT - TOP - BOTTOM], "width": WIDTH,
        "charts": [[_numbers(line) for line in chart.lines if line.kind != "bound"] for chart in charts],
        "units": [unit_of(chart.ylabel) or chart.ylabel for chart in charts],
    }  # fmt: skip
    keys = ['<span class="key plan"></span> plan']
    words = {False: ("open", MODE_WORDS["open-loop"]), True: ("gains", MODE_WORDS["feedback"])}
    for kind, mode in (words[replay.feedback] for replay in replays):
        keys.append(f'<span class="key {kind}"></span> MuJoCo, {mode}')
    if any(line.kind == "bound" for chart in charts for line in chart.lines):
        keys.append('<span class="key bound"></span> bound')
    block = json_block(data)
    return (
        f'<p class="keys">{" &nbsp; ".join(keys)}</p>\n<div class="charts">\n'
        + "\n".join(drawn)
        + f'\n</div>\n<script type="application/json" id="curves">{block}</script>'
    )


def _charts(plan: Plan, replays: Sequence[Replay]) -> list[InteractiveChart]:
    kinds = ["gains" if replay.feedback else "open" for replay in replays]
    charts = []
    for task in tasks_of(plan, list(replays)):
        lines = []
        for k, (name, hue) in enumerate(zip(task.names, cycle(HUES), strict=False)):
            motions = zip(["plan", *kinds], task.motions, strict=False)
            lines += [Line(name, kind, task.t, motion[:, k], _colour(kind, hue), False) for kind, motion in motions]
            for side in (task.lower, task.upper):
                if np.isfinite(side[:, k]).any():
                    lines.append(Line(name, "bound", task.t, side[:, k], RED, False))
        charts.append(InteractiveChart(task.title, task.ylabel, tuple(lines)))
    for panel in panels_of(plan):
        curves = curves_of(panel, plan, list(replays))
        mixed = bool(panel.states and panel.controls)
        for stepwise in (False, True):
            lines = []
            for curve, hue in zip([one for one in curves if one.stepwise == stepwise], cycle(HUES), strict=False):
                name = curve.label.removesuffix(f", {unit_of(curve.label)}")  # the axis tells it
                for kind, (t, values) in zip(["plan", *kinds], (curve.plan, *curve.replays), strict=False):
                    lines.append(Line(name, kind, t, values, _colour(kind, hue), stepwise))
                sides = sides_of(plan, curve.index, stepwise=stepwise)
                for side in () if sides is None else sides[:2]:
                    if np.isfinite(side).any():
                        lines.append(Line(name, "bound", plan.t, side, hue[0], stepwise))
            ylabel = ", ".join(label for _, label in panel.controls) if mixed and stepwise else panel.ylabel
            if lines:
                charts.append(InteractiveChart(panel.title, ylabel, tuple(lines)))
    return charts


def _colour(kind: str, hue: tuple[str, str, str]) -> str:
    return hue[("plan", "gains", "open").index(kind)]


def thinned(t: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Indices of the samples (K,) to draw: the ends, and the smallest and the largest of each piece of time."""
    finite = np.flatnonzero(np.isfinite(values))
    if len(finite) <= 2 * _PIECES:
        return finite
    chosen = {int(finite[0]), int(finite[-1])}
    for piece in np.array_split(finite, _PIECES):
        chosen |= {int(piece[np.argmin(values[piece])]), int(piece[np.argmax(values[piece])])}
    return np.array(sorted(chosen))


def _numbers(line: Line) -> dict[str, Any]:
    few = thinned(line.t, drawable(line.values))
    return {
        "label": line.label, "kind": line.kind, "stepwise": line.stepwise,
        "t": [_short(value) for value in line.t[few]], "y": [_short(value) for value in line.values[few]],
    }  # fmt: skip


def _short(value: float) -> float:
    return float(f"{value:.{_DIGITS}g}")


def _figure(number: int, chart: InteractiveChart, start: float, end: float) -> str:
    certain = [line.values for line in chart.lines if line.kind in ("plan", "bound")]
    low, high = view_limits(certain, [line.values for line in chart.lines], _PADDING)
    across, up = WIDTH - LEFT - RIGHT, HEIGHT - TOP - BOTTOM

    def x(t: float) -> float:
        return LEFT + across * (t - start) / ((end - start) or 1.0)

    def y(value: float) -> float:
        return TOP + up * (high - value) / (high - low)

    parts = []
    for tick in _ticks(low, high):
        parts.append(f'<line class="grid" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y(tick):.1f}" y2="{y(tick):.1f}"/>')
        parts.append(f'<text x="{LEFT - 6}" y="{y(tick) + 3.5:.1f}" text-anchor="end">{_words(tick)}</text>')
    for tick in _ticks(start, end):
        parts.append(f'<line class="grid" x1="{x(tick):.1f}" x2="{x(tick):.1f}" y1="{TOP}" y2="{TOP + up}"/>')
        parts.append(f'<text x="{x(tick):.1f}" y="{HEIGHT - 20}" text-anchor="middle">{_words(tick)}</text>')
    parts.append(f'<text x="{LEFT + across / 2}" y="{HEIGHT - 5}" text-anchor="middle">time, s</text>')
    middle = TOP + up / 2
    turned = f'text-anchor="middle" transform="rotate(-90 12 {middle})"'
    parts.append(f'<text x="12" y="{middle}" {turned}>{escape(chart.ylabel)}</text>')
    order = {"open": 0, "gains": 1, "bound": 2, "plan": 3}
    for line in sorted(chart.lines, key=lambda one: order[one.kind]):
        visible = until_astray(line.values, (low, high)) if line.kind in ("open", "gains") else drawable(line.values)
        few = thinned(line.t, visible)
        if len(few):
            points = _path([x(t) for t in line.t[few]], [y(value) for value in visible[few]], line.stepwise)
            parts.append(f'<polyline class="{line.kind}" stroke="{line.colour}" points="{points}"/>')
    parts.append(f'<line class="cursor" x1="{LEFT}" x2="{LEFT}" y1="{TOP}" y2="{TOP + up}"/>')
    names = [
        f'<span style="color:{line.colour}">{escape(line.label)}</span>' for line in chart.lines if line.kind == "plan"
    ]
    body, label = "\n".join(parts), escape(f"{chart.title} over time, {chart.ylabel}")
    return (
        f'<figure class="chart"><figcaption><b>{escape(chart.title)}</b> {" ".join(names)}</figcaption>\n'
        f'<svg data-chart="{number}" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{label}">\n'
        f"{body}\n</svg>\n<output></output></figure>"
    )


def _path(xs: Sequence[float], ys: Sequence[float], stepwise: bool) -> str:
    points = []
    for i, (x, y) in enumerate(zip(xs, ys, strict=True)):
        if stepwise and i:
            points.append(f"{x:.1f},{ys[i - 1]:.1f}")
        points.append(f"{x:.1f},{y:.1f}")
    return " ".join(points)


def _ticks(low: float, high: float) -> list[float]:
    """Round numbers between two limits."""
    rough = (high - low) / _TICKS
    if not rough > 0.0:
        return [low]
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(k * power for k in (1.0, 2.0, 5.0, 10.0) if k * power >= rough)
    return [step * k for k in range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)]


def _words(value: float) -> str:
    return f"{value:.4g}".replace("-", MINUS)
