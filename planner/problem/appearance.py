"""Appearance: how a machine is shown. Data only; the renderer knows no machine, a machine knows no renderer."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from planner.problem.pictures import CasePicture

Point = tuple[float, float, float]
Colour = tuple[float, float, float]


@dataclass(frozen=True)
class Readout:
    """A number written into every frame, e.g. the height."""

    label: str  # Written before the number
    index: int  # Which entry of the plan's state x it is
    unit: str  # The unit written behind it


@dataclass(frozen=True)
class View:
    """One of several cameras whose pictures stand side by side."""

    azimuth: float  # Of the camera, degrees (MuJoCo's convention)
    elevation: float = -10.0  # Of the camera, degrees (negative looks down)
    distance: float | None = None  # From the camera to its point; None takes the appearance's
    look_at: Point | None = None  # The point it looks at; None takes the appearance's
    label: str = ""  # Written into the picture, e.g. "front"


@dataclass(frozen=True, eq=False)
class Ghost:
    """A motion shown as the ghost in place of the plan: the one that the machine was asked to imitate."""

    # (K, nx) states of the plan's kind at equal times over its duration, the first at its start and the last at its
    # end. Only positions are seen.
    states: np.ndarray
    label: str  # In the legend
    colour: Colour = (0.05, 0.62, 0.48)  # Red, green, blue, each 0..1
    opacity: float | None = None  # 0..1; None leaves it to the picture: less for a ghost that stands in the machine


@dataclass(frozen=True, eq=False)
class GoalMark:
    """Where a frame is asked to be: a ball, with axes where it has an orientation, or an arrow to a direction."""

    frame: str  # A site or body of the model
    time: float  # s, when it is asked for; fainter from then on
    position: Point | None = None  # In the world; None is where the frame is planned to be then
    orientation: np.ndarray | None = None  # (3, 3) the frame's axes in the world, as columns
    direction: Point | None = None  # Of length 1: to where an axis of the frame is to point
    number: str = ""  # Written beside it: one of several waypoints


@dataclass(frozen=True)
class Appearance:
    """How a film shows a plan and its machine. Lengths are the model's."""

    title: str  # Written in the corner of every frame
    readouts: tuple[Readout, ...] = ()  # Numbers written into every frame
    ghost_offset: Point = (0.0, 0.0, 0.0)  # Where the ghost stands, relative to the simulated machine
    ghost: Ghost | None = None  # A motion that is shown as the ghost; None shows the plan
    # Names of bodies and tendons that move but are no part of the machine, a treadmill's belt for example: the ghost is
    # drawn without them, and no camera tries to see all of them. A body's name stands for all that hangs on it.
    scenery: tuple[str, ...] = ()
    goal_line: tuple[Point, Point] | None = None  # Two end points of a line that marks the goal, or None
    goal_label: str = "goal"  # Written beside that line
    look_at: Point = (0.0, 0.0, 0.0)  # The point the camera looks at
    # (state index, fraction): the camera's point is raised by fraction * x[index].
    height_tracking: tuple[int, float] | None = None
    # Entries of the state that are a place in space, x, y and z: the camera's point moves with it, beside a machine
    # that goes a long way; look_at is then relative to that place. None uses height_tracking.
    accompany: tuple[int, int, int] | None = None
    # From the camera to its point; None looks at the whole motion instead of look_at and height_tracking.
    distance: float | None = None
    azimuth: float = 90.0  # Of the camera, degrees (MuJoCo's convention)
    elevation: float = -10.0  # Of the camera, degrees (negative looks down)
    # Cameras in place of the one: side by side in a film, one below the other in a strip. Of two films beside each
    # other, the second camera's pictures stand below the first's.
    views: tuple[View, ...] = ()
    # Length of a contact force's arrow per unit of force; 0 draws none. There is one for each two shapes that touch,
    # friction included.
    force_scale: float = 0.0
    # From a contact's point to where its arrow begins, so that the machine does not hide it.
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
    goals: tuple[GoalMark, ...] = ()  # What frames are asked for
    paths: tuple[np.ndarray, ...] = ()  # (K, 3) each: lines that frames are to follow

    def seen_from(self, view: View) -> Appearance:
        """The same with this camera alone."""
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
