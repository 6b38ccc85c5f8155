"""The pictures of a case: motions in space from several sides, and charts over time; a control loop is drawn by these.

Motions are stick figures (as in Fig. 5), whose poses are spread out further than they are in space, all views of a pose
below each other; or paths of points. Charts have bands of normal values.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from planner.base.arguments import array, count, number
from planner.base.errors import PlannerError
from planner.dynamics.kinematics import frame_pose
from planner.model.coordinates import coordinates_of
from planner.model.mechanism import Frame, Mechanism
from planner.problem.appearance import (
    Band,
    CasePicture,
    Chart,
    Charts,
    CurveData,
    Paths,
    PoseSequence,
    Stick,
    StickFigures,
    View,
)
from planner.problem.default_appearance import appearance_of
from planner.view.plots.style import (
    DASHED,
    HUES,
    INK,
    SOFT,
    blank,
    drawable,
    dress,
    legend_below,
    panels_of,
    title_above,
)
from planner.view.render.camera import directions

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from planner.control.judging import LoopVerdict
    from planner.problem.plan import Plan
    from planner.proof.replays.replaying import Replay

# Views of a machine that walks along x, with y to its left.
SIDE, FRONT, TOP = View(90.0, 0.0, label="side"), View(180.0, 0.0, label="front"), View(90.0, -90.0, label="top")


def projected(points: np.ndarray, view: View) -> np.ndarray:
    """Points (..., 3) as seen from a view: to the right and up, (..., 2)."""
    return np.asarray(points) @ np.stack(axes_of(view)).T


def axes_of(view: View) -> tuple[np.ndarray, np.ndarray]:
    """The directions (3,) of space that are right and up in a view."""
    return directions(view.azimuth, view.elevation)[1:]


def frame_points(mechanism: Mechanism, q: Any, frames: tuple[str | Frame, ...]) -> np.ndarray:
    """Positions (K, P, 3), m, of P frames, sites or bodies, at joint positions (K, nq) or states (K, nx)."""
    q = array("q", np.asarray(q)[..., : mechanism.nq], ("K", mechanism.nq))
    return np.stack([frame_pose(mechanism, q, frame)[:, :3, 3] for frame in frames], axis=1)


_STICK_DASHED = (0, (3.5, 1.8))
_SPACING = 1.06  # distance of poses over the width of the widest
_WIDE, _HEAD = 13.0, 0.6  # inches
_EMPTY = 0.08  # of the height, above and below


def draw_stick_figures(picture: StickFigures, views: Sequence[View] = (SIDE, FRONT)) -> Figure:
    """A figure of poses at equal times, a row for each view; PlannerError where points do not fit the sticks."""
    motions, sticks, poses = picture.motions, picture.sticks, count("poses", len(picture.times), minimum=2)
    pose_points = [_poses(motion, sticks, poses) for motion in motions]
    if not pose_points or not sticks or not views:
        raise PlannerError("there is nothing to draw, expected at least one motion, one stick and one view.")
    floor = None if picture.ground is None else number("ground", picture.ground)
    flat = [[projected(points, view) for points in pose_points] for view in views]
    # Each solid pose is in the middle of its column; the dashed one is displaced with it.
    middles = [0.5 * (row[0][..., 0].min(axis=1) + row[0][..., 0].max(axis=1)) for row in flat]
    reach = max(
        float(np.abs(points[..., 0] - middle[:, None]).max())
        for row, middle in zip(flat, middles, strict=True) for points in row
    )  # fmt: skip
    spacing = 2.0 * _SPACING * max(reach, 1e-9)
    figure, axes = _figure(flat, spacing, poses, bool(picture.title))
    for view, row, middle, on in zip(views, flat, middles, axes, strict=True):
        for motion, points in zip(motions, row, strict=True):
            shifted = points.copy()
            shifted[..., 0] += (spacing * np.arange(poses) - middle)[:, None]
            _draw_sticks(on, shifted, sticks, motion.dashed)
        if floor is not None and abs(axes_of(view)[1][2]) > 0.5:
            on.axhline(floor * axes_of(view)[1][2], color=SOFT, lw=0.8, zorder=0)
        on.set_title(view.label, fontsize=9.5, loc="left", color=INK)
        on.set_xlim(-0.5 * spacing, (poses - 0.5) * spacing)
    for k, words in enumerate(picture.times):
        axes[-1].text(spacing * k, -0.02, words, ha="center", va="top", fontsize=8.5, color=INK,
                      transform=axes[-1].get_xaxis_transform())  # fmt: skip
    title_above(figure, picture.title)
    _stick_legend(figure, motions, sticks)
    return figure


def _poses(motion: PoseSequence, sticks: Sequence[Stick], poses: int) -> np.ndarray:
    """The motion's points (poses, P, 3) at equal times, linearly between its samples."""
    points = array(f"points of {motion.label!r}", motion.points, ("K", "P", 3))
    last = max((max(stick.points, default=-1) for stick in sticks), default=-1)
    if last >= points.shape[1] or any(i < 0 for stick in sticks for i in stick.points):
        raise PlannerError(
            f"the sticks join points up to {last} of {motion.label!r}, expected 0 to {points.shape[1] - 1}."
        )
    if len(points) == 0:
        raise PlannerError(f"{motion.label!r} has no samples, expected one or more.")
    at, samples = np.linspace(0.0, 1.0, poses), np.linspace(0.0, 1.0, len(points))
    flat = points.reshape(len(points), -1)
    return np.stack([np.interp(at, samples, column) for column in flat.T], axis=-1).reshape(poses, -1, 3)


def _figure(flat: list[list[np.ndarray]], spacing: float, poses: int, titled: bool) -> tuple[Figure, list[Axes]]:
    """A figure of rows to one scale, each as high as its poses."""
    spans = []
    for row in flat:
        heights = np.concatenate([points[..., 1].ravel() for points in row])
        room = _EMPTY * max(float(np.ptp(heights)), spacing * 0.1)
        spans.append((float(heights.min()) - room, float(heights.max()) + room))
    scale = _WIDE / (poses * spacing)  # inches per metre
    high = [scale * (top - bottom) for bottom, top in spans]
    figure = blank(_WIDE, sum(high) + _HEAD + 0.3 * len(high) + (0.3 if titled else 0.0))
    grid = figure.add_gridspec(len(flat), 1, height_ratios=high)
    axes = [figure.add_subplot(grid[i, 0]) for i in range(len(flat))]
    for on, span in zip(axes, spans, strict=True):
        on.set_ylim(*span)
        on.set_aspect("equal")
        on.axis("off")
    return figure, axes


def _draw_sticks(axes: Axes, points: np.ndarray, sticks: Sequence[Stick], dashed: bool) -> None:
    for pose in points:
        for stick in sticks:
            line = pose[list(stick.points)]
            axes.plot(
                line[:, 0], line[:, 1], color=_stick_colour(stick, dashed), lw=1.0 if dashed else 2.2,
                ls=_STICK_DASHED if dashed else "-", solid_capstyle="round", solid_joinstyle="round",
                zorder=2 if dashed else 3,
            )  # fmt: skip


def _stick_colour(stick: Stick, dashed: bool) -> str:
    if stick.hue is None:
        return SOFT if dashed else INK
    return HUES[stick.hue % len(HUES)][1]


def _stick_legend(figure: Figure, motions: Sequence[PoseSequence], sticks: Sequence[Stick]) -> None:
    from matplotlib.lines import Line2D

    handles = [
        Line2D([], [], color=INK, lw=1.0 if motion.dashed else 2.2, ls=_STICK_DASHED if motion.dashed else "-",
               label=motion.label) for motion in motions
    ]  # fmt: skip
    handles += [Line2D([], [], color=_stick_colour(stick, False), lw=2.0, label=stick.label) for stick in sticks
                if stick.label]  # fmt: skip
    legend_below(figure, handles)


_HIGH = 3.6  # inches


def draw_paths(picture: Paths, views: Sequence[View] = (SIDE, FRONT, TOP)) -> Figure:
    """A figure of paths, mm, from each view; a dot marks the start of each. PlannerError for wrong shapes."""
    traces = picture.traces
    if not traces or not views:
        raise PlannerError("there is nothing to draw, expected at least one path and one view.")
    spaces = [1000.0 * array(f"points of {label!r}", points, ("K", 3)) for label, points, _ in traces]
    flat = [[projected(points, view) for points in spaces] for view in views]
    every = [np.concatenate(row) for row in flat]
    reach = 0.55 * max(float(np.ptp(points, axis=0).max()) for points in every) or 0.5
    figure = blank(_HIGH * len(views), _HIGH + 0.6)
    for i, (view, row, points) in enumerate(zip(views, flat, every, strict=True)):
        axes = figure.add_subplot(1, len(views), i + 1)
        right, up = (_direction(axis) for axis in axes_of(view))
        dress(axes, view.label, f"{up}, mm", f"{right}, mm")
        middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
        axes.set_xlim(middle[0] - reach, middle[0] + reach)
        axes.set_ylim(middle[1] - reach, middle[1] + reach)
        axes.set_aspect("equal")
        hue = 0
        for (label, _, dashed), line in zip(traces, row, strict=True):
            colour = SOFT if dashed else HUES[hue % len(HUES)][1]
            hue += not dashed
            axes.plot(line[:, 0], line[:, 1], color=colour, lw=1.2 if dashed else 2.0, ls=DASHED if dashed else "-",
                      label=label)  # fmt: skip
            axes.plot(line[0, 0], line[0, 1], "o", color=colour, ms=4.5)
    title_above(figure, picture.title)
    legend_below(figure, figure.axes[0].get_legend_handles_labels()[0])
    return figure


def _direction(axis: np.ndarray) -> str:
    """The direction in space of an axis of the figure."""
    i = int(np.argmax(np.abs(axis)))
    if abs(axis[i]) < 1.0 - 1e-9:
        return "across" if abs(axis[2]) < 1e-9 else "up"
    return ("\N{MINUS SIGN}" if axis[i] < 0.0 else "") + "xyz"[i]


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
    pushed = [(push["time"], push["time"] + push["duration"]) for push in run.errors["pushes"]]
    charts = []
    for unit in dict.fromkeys(one.unit for one in coordinates):
        rows = [i for i, one in enumerate(coordinates) if one.unit == unit][:most]
        curves = [CurveData(coordinates[i].name.removeprefix("velocity of "), simulated[:, i]) for i in rows]
        curves += [CurveData("expected", expected[:, i], dashed=True, of=curves[k].label) for k, i in enumerate(rows)]
        title = "Speeds" if unit.endswith("/s") else "Positions"
        charts.append(Chart(f"{title}, from the start", unit or "state", curves, spans=pushed))
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
