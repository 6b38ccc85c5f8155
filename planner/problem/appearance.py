"""Appearance: cameras, colours and plots of a machine, and further pictures of a built-in problem.

Data only, independent of the renderer; planner.view.plots draws the pictures.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

Point = tuple[float, float, float]
Colour = tuple[float, float, float]


@dataclass(frozen=True)
class Stick:
    """Points joined by a line: a leg, for example."""

    points: tuple[int, ...]  # Indices of the points, in order
    label: str = ""  # For the legend; "" for none
    hue: int | None = None  # Index in the hues of all plots; None for ink


@dataclass(frozen=True, eq=False)
class PoseSequence:
    """A motion of points."""

    label: str  # For the legend
    points: np.ndarray  # (K, P, 3) m, at equal times; see view.plots.case_pictures
    dashed: bool = False  # Drawn thin and dashed: a reference of the others


class Trace(NamedTuple):
    """Path of a point."""

    label: str  # For the legend
    points: np.ndarray  # (K, 3) m
    dashed: bool = False  # Drawn dashed and grey: a reference of the others


class CurveData(NamedTuple):
    """One quantity over time."""

    label: str  # For the legend; the same label in another chart has the same colour there
    values: np.ndarray  # (K,) at the times of all charts, or at t; gaps where they are not finite
    # Drawn dashed, e.g. the plan against its replay, in the colour of the solid curve with label `of` in the chart.
    dashed: bool = False
    of: str = ""  # See dashed
    t: np.ndarray | None = None  # (K,) own times; None for those of all charts


class Band(NamedTuple):
    """The normal range of a quantity in people: a mean, drawn dashed, and the spread about it."""

    label: str  # For the legend
    mean: np.ndarray  # (K,)
    spread: np.ndarray | float  # (K,) or a number, to both sides: a standard deviation, for example


@dataclass(frozen=True, eq=False)
class Chart:
    """One panel."""

    title: str  # Above it
    ylabel: str  # With the unit
    curves: Sequence[CurveData] = ()  # The lines of the panel
    band: Band | None = None  # Behind them, or None
    # (start, end) of times that are shaded: stance, for example.
    spans: Sequence[tuple[float, float]] = field(default=())


@dataclass(frozen=True, eq=False)
class StickFigures:
    """A picture of poses, see view.plots.case_pictures."""

    caption: str  # Under it, on a page
    motions: Sequence[PoseSequence]  # Over the same time
    sticks: Sequence[Stick]  # Lines that join the points
    times: tuple[str, ...]  # One for each pose, written under it
    ground: float | None = None  # m, height of a line under the feet; None for none
    title: str = ""  # Above it all


@dataclass(frozen=True, eq=False)
class Charts:
    """Panels, see view.plots.case_pictures."""

    caption: str  # Under them, on a page
    t: np.ndarray  # (K,) of all curves without times of their own
    charts: Sequence[Chart]  # The panels
    xlabel: str = "time, s"  # Of t
    title: str = ""  # Above them all
    span_label: str = ""  # Name of the shaded times


@dataclass(frozen=True, eq=False)
class Paths:
    """Paths in space from the side, from the front and from above, see view.plots.case_pictures."""

    caption: str  # Under them, on a page
    traces: Sequence[Trace]  # The paths
    title: str = ""  # Above it all


@dataclass(frozen=True, eq=False)
class BoundedPanel:
    """Quantities over time with their bounds: one panel of plots.png, see view.plots.time_series."""

    title: str  # Above it
    ylabel: str  # With the unit
    t: np.ndarray  # (K,) s
    names: tuple[str, ...]  # (R,) of the quantities
    motions: tuple[np.ndarray, ...]  # (K, R) each: of the plan, then of its replays; gaps where they are not finite
    lower: np.ndarray  # (K, R), not finite where there is none
    upper: np.ndarray  # (K, R), the same
    decades: bool = False  # Whether to use a log scale if values span decades


CasePicture = StickFigures | Charts | Paths


@dataclass(frozen=True)
class Readout:
    """A number written into every frame, e.g. the height."""

    label: str  # Written before the number
    index: int  # Of the entry of the plan's state x
    unit: str  # Written after the number


@dataclass(frozen=True)
class View:
    """One of several cameras with pictures side by side."""

    azimuth: float  # Of the camera, degrees (MuJoCo's convention)
    elevation: float = -10.0  # Of the camera, degrees (negative looks down)
    distance: float | None = None  # From the camera to its point; None takes the appearance's
    look_at: Point | None = None  # The point it looks at; None takes the appearance's
    label: str = ""  # Written into the picture, e.g. "front"


@dataclass(frozen=True, eq=False)
class Ghost:
    """A reference trajectory shown as the ghost in place of the plan."""

    # (K, nx) states in the plan's state space at equal times, from its start to its end. Only positions are shown.
    states: np.ndarray
    label: str  # In the legend
    colour: Colour = (0.05, 0.62, 0.48)  # Red, green, blue, each 0..1
    opacity: float | None = None  # 0..1; None for the picture's default: less for a ghost that overlaps the machine


@dataclass(frozen=True, eq=False)
class GoalMark:
    """Mark of a frame's goal: a ball, with axes for an orientation, or an arrow for a direction."""

    frame: str  # A site or body of the model
    time: float  # s, of the goal; fainter afterwards
    position: Point | None = None  # In the world; None for the frame's planned position at that time
    orientation: np.ndarray | None = None  # (3, 3) the frame's axes in the world, as columns
    direction: Point | None = None  # Unit vector in the world, target direction of an axis of the frame
    number: str = ""  # Label of one of several waypoints


@dataclass(frozen=True)
class Appearance:
    """Presentation of a plan and its machine in films and plots. Lengths are in the model's unit."""

    title: str  # Written in the corner of every frame
    readouts: tuple[Readout, ...] = ()  # Numbers written into every frame
    ghost_offset: Point = (0.0, 0.0, 0.0)  # Position of the ghost relative to the simulated machine
    ghost: Ghost | None = None  # Trajectory that is shown as the ghost; None for the plan
    # Names of bodies and tendons that move but are no part of the machine, a treadmill's belt for example: the ghost is
    # drawn without them, and cameras do not frame them. A body's name includes its descendants.
    scenery: tuple[str, ...] = ()
    goal_line: tuple[Point, Point] | None = None  # Two end points of a line that marks the goal, or None
    goal_label: str = "goal"  # Label of that line
    look_at: Point = (0.0, 0.0, 0.0)  # The point the camera looks at
    # Indices of the state's entries x, y and z of a position that the camera's point follows, for a machine that
    # travels; look_at is then relative to that position.
    accompany: tuple[int, int, int] | None = None
    # From the camera to its point; None looks at the whole motion instead of look_at.
    distance: float | None = None
    azimuth: float = 90.0  # Of the camera, degrees (MuJoCo's convention)
    elevation: float = -10.0  # Of the camera, degrees (negative looks down)
    may_turn: bool = False  # Whether the camera turns where something at rest hides the motion
    # Several cameras in place of one: side by side in a film, stacked in a strip. In a comparison of two films, the
    # second camera's pictures are below the first's.
    views: tuple[View, ...] = ()
    # Length of a contact force's arrow per unit of force, friction included; 0 draws none. One arrow for each pair of
    # shapes in contact.
    force_scale: float = 0.0
    # Offset of the arrow's origin from the contact point, so that the machine does not hide it.
    force_offset: Point = (0.0, 0.0, 0.0)
    force_unit: str = ""  # Of the contact force, for plots
    length_unit: str = "m"  # Of the model's lengths
    speed: float = 1.0  # Playback speed; 0.25 is four times slow motion
    plots: tuple[Panel, ...] = field(default=())  # Panels of the report
    # (Plan, the judged planner.Replay or None) -> more pictures of the case, at most one of a kind.
    pictures: Callable[[Any, Any], Sequence[CasePicture]] | None = None
    # A site or body of the model, or several, whose paths are drawn behind them: the tip of an arm. "" draws none.
    trail: str | tuple[str, ...] = ""
    frames: tuple[str, ...] = ()  # Sites and bodies whose axes are drawn
    goals: tuple[GoalMark, ...] = ()  # Goals of frames
    paths: tuple[np.ndarray, ...] = ()  # (K, 3) each: reference paths of frames

    def seen_from(self, view: View) -> Appearance:
        """The appearance with `view` as the only camera."""
        return replace(
            self, azimuth=view.azimuth, elevation=view.elevation, views=(view,),
            distance=self.distance if view.distance is None else view.distance,
            look_at=self.look_at if view.look_at is None else view.look_at,
        )  # fmt: skip


@dataclass(frozen=True)
class Panel:
    """One plot of the report: some states or controls over time, plan against replay."""

    title: str  # Of the panel
    ylabel: str  # With the unit
    states: tuple[tuple[int, str], ...] = ()  # (index, label) of entries of x drawn in it
    controls: tuple[tuple[int, str], ...] = ()  # (index, label) of entries of u drawn in it
    difference: bool = False  # Also draw replay minus plan of the first state, on a second axis
