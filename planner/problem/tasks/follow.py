"""Follow: a reference path of a frame or of joints."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from planner.base.arguments import choice, number, numbers, short_repr
from planner.base.errors import FileError, PlannerError
from planner.base.files import printable
from planner.problem.recording import TIME, read_recording
from planner.problem.tasks.goal import json_value

COORDINATES = ("x", "y", "z")
_OF_A_FILE = ("file", "part", "degrees")


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
        if (self.frame is None) == (self.joints is None):
            raise PlannerError("follow has neither frame nor joints, or both: expected one of the two.")
        if self.frame is not None and not isinstance(self.frame, str):
            raise PlannerError(f"frame of follow is {short_repr(self.frame)}, expected the name of a site or body.")
        if self.joints is not None and (
            not isinstance(self.joints, (list, tuple)) or not all(isinstance(name, str) for name in self.joints)
        ):
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


def follow_of(value: Any, name: str) -> Follow:
    """A Follow from one, or from a table.

    Raises:
        PlannerError: Another type, or a table that is no valid path.
    """
    if isinstance(value, Follow):
        return value
    keys = [one.name for one in fields(Follow)]
    if not isinstance(value, Mapping):
        raise PlannerError(
            f"{name} is {short_repr(value)}, expected a Follow or a table with some of: {', '.join(keys)}."
        )
    given = {choice(f"a key of {name}", key, (*keys, *_OF_A_FILE)): part for key, part in value.items()}
    if "points" not in given:
        raise PlannerError(f'{name} has no points, expected points = [[t, x, y, z], ...] or file = "path.csv".')
    return Follow(**given)


def with_points(table: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """The table with its `file`, a recording relative to a folder, replaced by the points in it.

    A heading t,x,y,z may be left out for a frame; for joints it has their names. `part` and `degrees` are those of
    read_recording().

    Raises:
        FileError: It cannot be read, or is no table of numbers.
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
    heading, rows = read_recording(path, "the path to follow", table.get("part"), degrees)
    joints = table.get("joints")
    rest = {key: value for key, value in table.items() if key not in _OF_A_FILE}
    if table.get("frame") is None and joints is None:
        if not heading or heading[0] != TIME or len(heading) < 2:
            expected = 'expected one, or frame = "..." in [follow]'
            raise FileError(f"{printable(path)} has no heading t,JOINT,..., {expected}.")
        rest["joints"] = list(heading[1:])
    elif heading and table.get("frame") is not None and heading not in ((TIME, *COORDINATES), COORDINATES):
        raise FileError(f"{printable(path)} has another heading than t,x,y,z.")
    elif isinstance(joints, list) and heading[:1] == (TIME,) and all(name in heading for name in joints):
        rows = rows[:, [0, *map(heading.index, joints)]]
    return {**rest, "points": rows.tolist()}
