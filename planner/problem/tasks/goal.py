"""Goal: the pose of a frame, or positions of joints, at a time.

Goal(frame="hand", position=(0.4, 0.1, 0.3), pointing=(0, 0, -1))         at the end, at rest
Goal(frame="hand", position=(0.4, 0.1, 0.6), time=1.0, through=True)      via point at 1 s
Goal(joints={"elbow": 1.0}, time=2.0)
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from planner.base.arguments import array, choice, number, numbers, quaternion, short_repr, unit_vector
from planner.base.errors import PlannerError

AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
PARTS = ("position", "orientation", "pointing", "velocity")
"""Keys of a table of tolerances."""


@dataclass(frozen=True)
class Goal:
    """A goal for a frame, or for joints, at a time.

    Attributes:
        frame: Name of a site or body; None for joints.
        position: (3,) m, in the world.
        orientation: Quaternion (4,), w first, or a table of roll, pitch and yaw in degrees: rotations about the world's
            x, then y, then z.
        pointing: (3,) the direction of the world to which the frame's z axis points, or a table with `to`, that
            direction, and `axis`, "x", "y", "z" or (3,) in the frame. The rotation about it is free.
        joints: Positions by joint, a keyframe's name, or all positions; rad or m.
        time: s from the start; None for the end.
        share: In place of a time, of the duration: 0.5 is half-way, whatever the duration becomes.
        through: Whether it is a via point, passed without stopping; else the machine is at rest there. One without a
            time or a share before the end's goal is passed when it fits best.
        tolerance: Largest error that passes: a number in m and rad, or a table of position, orientation, pointing and
            velocity (at rest, m/s). By default 5 mm, 0.02 rad and 0.05 m/s.

    Raises:
        PlannerError: Neither frame nor joints, or both; a wrong shape; both orientation and pointing.
    """

    frame: str | None = None
    position: Any = None
    orientation: Any = None
    pointing: Any = None
    joints: Any = None
    time: float | None = None
    share: float | None = None
    through: bool = False
    tolerance: Any = None

    def __post_init__(self) -> None:
        if (self.frame is None) == (self.joints is None):
            raise PlannerError("a goal has neither frame nor joints, or both: expected one of the two.")
        if self.frame is not None and not isinstance(self.frame, str):
            raise PlannerError(f"frame of a goal is {short_repr(self.frame)}, expected the name of a site or body.")
        asked = [name for name in PARTS[:3] if getattr(self, name) is not None]
        if self.joints is not None and asked:
            raise PlannerError(f"a goal of joints has {asked[0]}, expected that beside a frame.")
        if self.frame is not None and not asked:
            expected = "expected position, orientation or pointing"
            raise PlannerError(f"the goal of {self.frame!r} asks for nothing, {expected}.")
        if "orientation" in asked and "pointing" in asked:
            raise PlannerError(
                f"the goal of {self.frame!r} has orientation and pointing, expected one of them: a full orientation, "
                "or a direction about which the frame may turn."
            )
        if not isinstance(self.through, bool):
            raise PlannerError(f"through of a goal is {short_repr(self.through)}, expected true or false.")
        if self.time is not None:
            number("time of a goal", self.time, greater_than=0.0)
        if self.share is not None:
            number("share of a goal", self.share, greater_than=0.0, maximum=1.0)
            if self.time is not None:
                raise PlannerError("a goal has a time and a share of the duration, expected one of the two.")
        if self.position is not None:
            array("position of a goal", self.position, (3,))
        _ = self.quaternion, self.direction, self.tolerances({})

    @property
    def undated(self) -> bool:
        """Whether it says neither when it is met nor to be met at rest: a via point, if a goal comes after it."""
        return self.through and self.time is None and self.share is None

    def after(self, duration: float) -> float:
        """When it is met in a motion of a duration (s), s from the start."""
        return duration * (1.0 if self.share is None else self.share) if self.time is None else float(self.time)

    @property
    def quaternion(self) -> np.ndarray | None:
        """(4,) the unit quaternion of the orientation; None for none."""
        return None if self.orientation is None else quaternion("orientation of a goal", self.orientation)

    @property
    def direction(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Unit vectors (3,): an axis of the frame and the direction of the world to which it points; None for none."""
        given = self.pointing
        if given is None:
            return None
        axis: Any = "z"
        if isinstance(given, Mapping):
            for name in given:
                choice("a key of a goal's pointing", name, ("axis", "to"))
            axis, given = given.get("axis", "z"), given.get("to")
        axis = AXES.get(axis, axis) if isinstance(axis, str) else axis
        return tuple(
            unit_vector(name, array(name, value, (3,)), "0, 0, -1")
            for name, value in (("the axis of a goal's pointing", axis), ("pointing of a goal", given))
        )  # pyright: ignore

    def tolerances(self, defaults: Mapping[str, float]) -> dict[str, float]:
        """By PARTS: those of the goal, else `defaults`."""
        given = self.tolerance
        if given is None:
            return dict(defaults)
        if isinstance(given, Mapping):
            own = {choice("a tolerance of a goal", name, PARTS): value for name, value in given.items()}
            return {
                **defaults,
                **{name: number(f"the {name} tolerance", value, greater_than=0.0) for name, value in own.items()},
            }
        return {**defaults, **dict.fromkeys(PARTS[:3], number("tolerance of a goal", given, greater_than=0.0))}

    def to_dict(self) -> dict[str, Any]:
        """As JSON values, without defaults."""
        return {
            one.name: json_value(value)
            for one in fields(self)
            if (value := getattr(self, one.name)) is not None and value is not False
        }


def goal_of(value: Any, name: str) -> Goal:
    """A Goal from one, or from a table; messages call it `name`.

    Raises:
        PlannerError: Another type, or a table that is no valid goal.
    """
    if isinstance(value, Goal):
        return value
    keys = [one.name for one in fields(Goal)]
    if not isinstance(value, Mapping):
        raise PlannerError(
            f"{name} is {short_repr(value)}, expected a Goal or a table with some of: {', '.join(keys)}."
        )
    given = {choice(f"a key of {name}", key, keys): part for key, part in value.items()}
    try:
        return Goal(**given)
    except PlannerError as error:
        raise PlannerError(f"{name}: {error}") from None


def json_value(value: Any) -> Any:
    """A user's value as JSON values."""
    if isinstance(value, Mapping):
        return {str(key): json_value(part) for key, part in value.items()}
    if isinstance(value, (list, tuple, np.ndarray, np.number)):
        return numbers("a number of a goal", value).tolist()
    return value
