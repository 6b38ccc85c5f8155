"""Stage: how a machine is shown. Data only; the renderer knows no machine, a machine knows no renderer."""

from __future__ import annotations

from dataclasses import dataclass, field

Point = tuple[float, float, float]


@dataclass(frozen=True)
class Readout:
    """A number written into every frame, e.g. the height.

    Attributes:
        label: What is written before the number.
        index: Which entry of the plan's state x it is.
        unit: The unit written behind it.
    """

    label: str
    index: int
    unit: str


@dataclass(frozen=True)
class Stage:
    """What a film of a plan shows beside the machine itself. Lengths are the model's.

    Attributes:
        title: Written in the corner of every frame.
        readouts: Numbers written into every frame.
        ghost_offset: Where the ghost of the plan stands, relative to the simulated machine.
        goal_line: Two end points of a line that marks the goal, or None.
        goal_label: Written beside that line.
        look_at: The point the camera looks at.
        follow: What the camera's point moves with: (state index, fraction) raises it by fraction * x[index].
        accompany: Entries of the state that are a place in space, x, y and z: the camera's point moves with it, beside
            a machine that goes a long way; look_at is then relative to that place. None uses follow.
        distance: From the camera to its point; None looks at the whole motion instead of look_at and follow.
        azimuth: Of the camera, degrees (MuJoCo's convention).
        elevation: Of the camera, degrees (negative looks down).
        force_scale: Length of the contact force arrow per unit of force; 0 draws none.
        force_offset: From the contact point to where the arrow begins, so that the machine does not hide it.
        force_unit: Of the contact force, for plots.
        speed: Playback speed; 0.25 is four times slow motion.
        plots: Panels of the report.
        trail: A site of the model, whose path is drawn behind it: the tip of an arm. "" draws none.
    """

    title: str
    readouts: tuple[Readout, ...] = ()
    ghost_offset: Point = (0.0, 0.0, 0.0)
    goal_line: tuple[Point, Point] | None = None
    goal_label: str = "goal"
    look_at: Point = (0.0, 0.0, 0.0)
    follow: tuple[int, float] | None = None
    accompany: tuple[int, int, int] | None = None
    distance: float | None = None
    azimuth: float = 90.0
    elevation: float = -10.0
    force_scale: float = 0.0
    force_offset: Point = (0.0, 0.0, 0.0)
    force_unit: str = ""
    speed: float = 1.0
    plots: tuple[Panel, ...] = field(default=())
    trail: str = ""


@dataclass(frozen=True)
class Panel:
    """One plot of the report: some states or controls over time, plan against replay.

    Attributes:
        title: Of the panel.
        ylabel: With the unit.
        states: (index, label) of entries of x drawn in it.
        controls: (index, label) of entries of u drawn in it.
        difference: Also draw replay minus plan of the first state, on a second axis.
    """

    title: str
    ylabel: str
    states: tuple[tuple[int, str], ...] = ()
    controls: tuple[tuple[int, str], ...] = ()
    difference: bool = False
