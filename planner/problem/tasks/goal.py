"""Goals as people say them: the pose of a frame, or positions of joints, at a time; and paths to follow.

Goal(frame="hand", position=(0.4, 0.1, 0.3), pointing=(0, 0, -1))         at the end, at rest
Goal(frame="hand", position=(0.4, 0.1, 0.6), time=1.0, through=True)      via point at 1 s
Goal(joints={"elbow": 1.0}, time=2.0)
Follow(frame="hand", points=[[0, 0.4, 0, 0.3], [1, 0.4, 0.1, 0.3]])       straight lines between points in time
"""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from planner.base.arguments import array, choice, did_you_mean, number, numbers, quaternion, short_repr, unit_vector
from planner.base.errors import FileError, PlannerError
from planner.base.files import printable
from planner.problem.recording import TIME, Recording, missing_position, other_columns, position_columns, read_recording

AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
PARTS = ("position", "orientation", "pointing", "velocity")
"""Keys of a table of tolerances."""
COORDINATES = ("x", "y", "z")
_OF_A_FILE = ("file", "part", "degrees")


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
        _check_subject("a goal", self.frame, self.joints)
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
        if self.joints is not None and not isinstance(self.joints, (str, Mapping)) and not _are_numbers(self.joints):
            expected = 'expected a table, {"elbow": 1.0}, the name of a keyframe, or all positions'
            raise PlannerError(f"joints of a goal is {short_repr(self.joints)}, {expected}.")
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
    given = _table_of(Goal, value, name)
    try:
        return Goal(**given)
    except PlannerError as error:
        raise PlannerError(f"{name}: {error}") from None


def _are_numbers(value: Any) -> bool:
    try:
        numbers("positions", value)
    except PlannerError:
        return False
    return True


def _check_subject(what: str, frame: Any, joints: Any) -> None:
    """Refuse a goal or path unless it is of a frame or of joints."""
    if (frame is None) == (joints is None):
        raise PlannerError(f"{what} has neither frame nor joints, or both: expected one of the two.")
    if frame is not None and not isinstance(frame, str):
        raise PlannerError(f"frame of {what} is {short_repr(frame)}, expected the name of a site or body.")


def _table_of(kind: type[Goal | Follow], value: Any, name: str, more: tuple[str, ...] = ()) -> dict[str, Any]:
    """The arguments of a Goal or Follow in a table; `more` keys are known too."""
    keys = [one.name for one in fields(kind)]
    if not isinstance(value, Mapping):
        expected = f"expected a {kind.__name__} or a table with some of: {', '.join(keys)}"
        raise PlannerError(f"{name} is {short_repr(value)}, {expected}.")
    return {choice(f"a key of {name}", key, (*keys, *more)): part for key, part in value.items()}


def json_value(value: Any) -> Any:
    """A user's value as JSON values."""
    if isinstance(value, Mapping):
        return {str(key): json_value(part) for key, part in value.items()}
    if isinstance(value, (list, tuple, np.ndarray, np.number)):
        return numbers("a number of a goal", value).tolist()
    return value


@dataclass(frozen=True)
class Follow:
    """A path to follow: straight lines between points, each at its time.

    Attributes:
        frame: Name of a site or body, whose points are positions in the world; None for joints.
        joints: Names of the joints whose positions the points are; None for a frame.
        points: (M, 1 + n) rows of t, s, and x, y, z in m or the joints' positions in rad or m; or (M, n) without
            times, for points at equal times from the start to the end.
        tolerance: Max allowed distance from the path, m or rad; by default 10 mm or 0.04 rad.

    Raises:
        PlannerError: Neither frame nor joints, or both; a wrong shape; times that do not rise.
    """

    points: Any
    frame: str | None = None
    joints: Any = None
    tolerance: float | None = None

    def __post_init__(self) -> None:
        _check_subject("follow", self.frame, self.joints)
        if self.joints is not None and not _are_names(self.joints):
            raise PlannerError(f"joints of follow is {short_repr(self.joints)}, expected a list of names of joints.")
        if self.tolerance is not None:
            number("tolerance of follow", self.tolerance, greater_than=0.0)
        given = numbers("points of follow", self.points)
        n = self.width
        if given.ndim != 2 or len(given) < 2 or given.shape[1] not in (n, n + 1):
            raise PlannerError(
                f"points of follow have shape {given.shape}, expected at least 2 rows of t and {self.words}, or of "
                f"{self.words} alone."
            )
        if not np.isfinite(given).all():
            raise PlannerError("points of follow are not all finite, expected numbers.")
        if given.shape[1] == n + 1 and not np.all(np.diff(given[:, 0]) > 0.0):
            row = int(np.argmax(np.diff(given[:, 0]) <= 0.0)) + 2
            raise PlannerError(
                f"the time in row {row} of follow's points is not after the one before, expected times that rise."
            )

    @property
    def width(self) -> int:
        """Numbers of a point, without its time."""
        return 3 if self.joints is None else len(self.joints)

    @property
    def words(self) -> str:
        """Names of a point's numbers, in messages."""
        return ", ".join(COORDINATES if self.joints is None else self.joints)

    @property
    def what(self) -> str:
        """Name of the frame or joints, in messages."""
        return self.frame or " and ".join(self.joints)

    def times(self, duration: float) -> np.ndarray:
        """(M,) s, of the points."""
        points = np.asarray(self.points, dtype=float)
        return points[:, 0] if points.shape[1] > self.width else np.linspace(0.0, duration, len(points))

    def at(self, t: np.ndarray, duration: float) -> np.ndarray:
        """The path (K, n) at times t (K,)."""
        points = np.asarray(self.points, dtype=float)[:, -self.width :]
        return np.stack([np.interp(t, self.times(duration), column) for column in points.T], axis=1)

    def to_dict(self) -> dict[str, Any]:
        """As JSON values, without defaults."""
        return {one.name: _json_value(value) for one in fields(self) if (value := getattr(self, one.name)) is not None}


def _json_value(value: Any) -> Any:
    """A value as JSON values; lists of names stay."""
    return (
        list(value) if isinstance(value, (list, tuple)) and value and isinstance(value[0], str) else json_value(value)
    )


def _are_names(value: Any) -> bool:
    return isinstance(value, (list, tuple)) and all(isinstance(name, str) for name in value)


def follow_of(value: Any, name: str) -> Follow:
    """A Follow from one, or from a table.

    Raises:
        PlannerError: Another type, or a table that is no valid path.
    """
    if isinstance(value, Follow):
        return value
    given = _table_of(Follow, value, name, _OF_A_FILE)
    if "points" not in given:
        raise PlannerError(f'{name} has no points, expected points = [[t, x, y, z], ...] or file = "path.csv".')
    return Follow(**given)


def with_points(
    table: Mapping[str, Any], folder: Path, joints: Collection[str], actuators: Collection[str] = ()
) -> dict[str, Any]:
    """The table with its `file`, a recording relative to a folder, replaced by the points in it.

    A heading t,x,y,z may be left out for a frame; for joints it has their names, of the machine's `joints` and not its
    `actuators`. `part` and `degrees` are those of read_recording().

    Raises:
        FileError: It cannot be read, is no table of numbers, or has no positions of the joints.
        PlannerError: It has a file and points.
    """
    if "file" not in table:
        return dict(table)
    if "points" in table:
        raise PlannerError("follow has a file and points, expected one of the two.")
    if not isinstance(table["file"], str):
        raise PlannerError(f"file of follow is {short_repr(table['file'])}, expected the name of a file.")
    path = folder / table["file"]
    if not isinstance(degrees := table.get("degrees", False), bool):
        raise PlannerError(f"degrees of follow is {short_repr(degrees)}, expected true or false.")
    recording = read_recording(path, "the path to follow", table.get("part"), degrees)
    heading, rows, named = recording.heading, recording.table, table.get("joints")
    rest = {key: value for key, value in table.items() if key not in _OF_A_FILE}
    if table.get("frame") is not None:
        if heading and heading not in ((TIME, *COORDINATES), COORDINATES):
            raise FileError(
                f"{printable(path)} has another heading than t,x,y,z, expected it for a frame, or joints = [...] in "
                "[follow] in place of frame."
            )
    elif named is None:
        if len(heading) < 2 or heading[0] != TIME:
            expected = 'expected one, or frame = "..." in [follow]'
            raise FileError(f"{printable(path)} has no heading t,JOINT,..., {expected}.")
        rest["joints"] = _recorded_joints(recording, path, joints, actuators)
    named = rest.get("joints")
    if heading and isinstance(named, (list, tuple)) and _are_names(named):
        found = position_columns(recording, joints, actuators)
        for joint in named:
            if choice("a joint of follow", joint, joints) not in found:
                expected = missing_position(recording, joint, actuators)
                if not found:
                    expected += "; without a heading columns are taken in the order of joints"
                raise FileError(f"{printable(path)} has no positions of the joint {joint!r}, {expected}.")
        rows = rows[:, [*([0] if heading[0] == TIME else []), *(found[joint] for joint in named)]]
    return {**rest, "points": rows.tolist()}


def recorded_duration(table: Mapping[str, Any], folder: Path) -> float | None:
    """The last time in the recording that a path's table names, relative to a folder, s; None without times.

    Raises:
        FileError: It cannot be read, or is no table of numbers.
    """
    if not isinstance(table.get("file"), str):
        return None
    recording = read_recording(folder / table["file"], "the path to follow", table.get("part"))
    timed = recording.heading[0] == TIME if recording.heading else recording.table.shape[1] == 1 + len(COORDINATES)
    timed &= bool(recording.heading) or table.get("frame") is not None  # rows of joints: who knows which
    return float(recording.table[-1, 0]) if timed and len(recording.table) else None


def _recorded_joints(
    recording: Recording, path: Path, joints: Collection[str], actuators: Collection[str]
) -> list[str]:
    """The joints whose positions a recording has, unless it has columns of something unknown."""
    found = list(position_columns(recording, joints, actuators))
    if other := other_columns(recording, joints, actuators):
        advice = f": name those to follow, joints = {json.dumps(found, ensure_ascii=False)}" if found else ""
        raise FileError(
            f"{printable(path)} has the column {short_repr(other[0])}, expected joints of the model "
            f"({', '.join(joints)}){advice}.{did_you_mean(other[0], joints) if not found else ''}"
        )
    if not found:
        joint = next((name for name in recording.heading if name in joints), next(iter(joints), "JOINT"))
        raise FileError(f"{printable(path)} has no positions, {missing_position(recording, joint, actuators)}.")
    return found
