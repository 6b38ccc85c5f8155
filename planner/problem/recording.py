"""A recorded motion as a table of times and named columns, and which of these are positions of joints, which controls.

Read from a CSV file, a ROS bag or a LeRobot data set.

The ending of a path chooses the reader. Messages have no word of a file's content but names of topics and episodes.

`position of elbow` is of the joint. `elbow` is of the joint, too, unless it may be the actuator's: the file has other
columns `position of ...`, as an exported plan has, or the column's unit is no position's. With a position's unit it is
the joint's, unless the actuator has the same.
"""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Collection, Iterable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from planner.base.errors import FileError, PlannerError
from planner.base.files import check_confined, printable, read_input, read_text

MAX_ROWS = 100_000
TIME = "time"
STEPS_PER_ROW = "steps_per_row"  # among the options of a plan of a recording
POSITION = "position of "  # before a joint's name where an actuator is called the same
_UNITS = {
    **{name: (name, 1.0) for name in ("s", "rad", "m", "rad/s", "m/s", "N", "N m")},
    "ms": ("s", 1e-3), "deg": ("rad", np.pi / 180.0), "°": ("rad", np.pi / 180.0), "deg/s": ("rad/s", np.pi / 180.0),
    "cm": ("m", 1e-2), "mm": ("m", 1e-3), "mm/s": ("m/s", 1e-3), "Nm": ("N m", 1.0),
}  # fmt: skip
"""Units that may stand behind a name in a heading, and what they are in ours; others are a part of the name."""
_UNIT = re.compile(rf" ?\[({'|'.join(_UNITS)})\]$")
_TIMES = ("t", TIME)  # headings of the column of times
_JOINT_STATE = "sensor_msgs/msg/JointState"
_STATE, _EPISODE, _TIMESTAMP = "observation.state", "episode_index", "timestamp"  # LeRobot's columns
_METADATA = "metadata.yaml"  # of a bag of ROS 2
_POSITION = ".pos"  # LeRobot's ending of a motor's position


class Recording(NamedTuple):
    """Rows of numbers with a heading."""

    heading: tuple[str, ...]  # of all columns, that of times being TIME; empty for a CSV without
    table: np.ndarray  # (M, n); times in s, from the first row on where they are of a bag or data set
    units: tuple[str, ...] = ()  # of the columns, as far as a heading says them; else "", or () for none

    def unit(self, column: int) -> str:
        """The unit of a column; "" where it is not said."""
        return self.units[column] if self.units else ""


def read_recording(path: Path, what: str, part: Any = None, degrees: bool = False) -> Recording:
    """Read a file, or the folder of a bag; messages call it `what`.

    Args:
        path: `.csv`; `.bag`, `.mcap`, `.db3` or a folder: a ROS bag; `.parquet`: of a LeRobot data set.
        what: E.g. "the path to follow".
        part: Topic of a bag, or number of an episode; None where there is one alone.
        degrees: Whether all columns but the time, and those whose headings have a unit, are degrees, to be read as rad.

    Raises:
        FileError: It cannot be read, or is no table of numbers.
        PlannerError: The package that reads it is not installed.
    """
    if path.suffix.lower() == ".parquet":
        found = _read_episode(path, what, part)
    elif path.is_dir() or path.suffix.lower() in (".bag", ".mcap", ".db3"):
        found = _read_bag(path, what, part)
    elif part is not None:
        raise FileError(f"{what} {printable(path)} has no parts, expected part for a ROS bag or a data set alone.")
    else:
        found = _read_csv(path, what)
    if len(found.table) > MAX_ROWS:
        raise FileError(f"{what} {printable(path)} has {len(found.table)} rows, expected at most {MAX_ROWS}.")
    if degrees and not found.heading:
        raise FileError(f"{what} {printable(path)} has no heading t,JOINT,..., expected one to know what is degrees.")
    if degrees:
        unitless = [name != TIME and not found.unit(column) for column, name in enumerate(found.heading)]
        found.table[:, unitless] *= np.pi / 180.0
    return found


def _read_csv(path: Path, what: str) -> Recording:
    reader = csv.reader(io.StringIO(read_text(path, what)))
    try:
        lines = [(reader.line_num, row) for row in reader if any(map(str.strip, row))]
    except csv.Error as error:
        raise FileError(f"{what} {printable(path)} is no CSV: {error}.") from None
    top_row = [cell.strip() for cell in lines[0][1]] if lines else []
    for separator, name in ((";", "semicolons"), ("\t", "tabs")):
        if any(separator in cell for cell in top_row):
            raise FileError(
                f"{what} {printable(path)} has {name} between its columns, expected commas: write commas there, and "
                "points in numbers."
            )
    heading = top_row if not np.isfinite([*map(_number, top_row)]).all() else []
    names, units, factors = zip(*map(_name_and_unit, heading), strict=True) if heading else ((), (), ())
    if names and names[0].lower() in _TIMES:
        names = (TIME, *names[1:])
    rows = [(line, [*map(_number, row)]) for line, row in lines[bool(heading) :]]
    width = len(names or (rows[-1][1] if rows else ()))
    for line, row in rows:
        if len(row) != width:
            raise FileError(
                f"row {line} of {printable(path)} has {len(row)} columns, expected {width} as in "
                f"{'the heading' if names else 'the last row'}: complete the row or delete it."
            )
        if not np.isfinite(row).all():
            column = int(np.argmin(np.isfinite(row))) + 1
            raise FileError(
                f"row {line} of {printable(path)} has no finite number in column {column}, expected rows of numbers "
                "with commas between them, below a heading such as t,shoulder,elbow: correct the row or delete it."
            )
    table = np.reshape(np.array([row for _, row in rows], dtype=float), (len(rows), width))
    return Recording(names, table * factors if names else table, units)


def _name_and_unit(cell: str) -> tuple[str, str, float]:
    """A heading's name, its unit in ours, and the factor to it."""
    if (found := _UNIT.search(cell)) is None:
        return cell, "", 1.0
    return cell[: found.start()], *_UNITS[found[1]]


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return np.nan


def _read_bag(path: Path, what: str, part: Any) -> Recording:
    """The positions of a topic of joint states, of ROS 1 or 2."""
    reading, types = _optional("rosbags.highlevel", "ros"), _optional("rosbags.typesys", "ros")
    folder = path if path.is_dir() or path.suffix.lower() == ".bag" else path.parent
    for file in (folder, *(folder.iterdir() if folder.is_dir() else ())):
        check_confined(file, what)
    if not path.exists():
        read_input(path, what)  # which says why it is not there
    stamps, rows, names = [], [], None
    try:
        with reading.AnyReader([folder], default_typestore=types.get_typestore(types.Stores.LATEST)) as bag:
            found = [one for one in bag.connections if one.msgtype == _JOINT_STATE and one.msgcount]
            topic = _chosen(path, what, part, dict.fromkeys(one.topic for one in found), f"topics of {_JOINT_STATE}")
            for one, _, raw in bag.messages([one for one in found if one.topic == topic]):
                message = bag.deserialize(raw, one.msgtype)
                names = sorted(message.name) if names is None else names
                if sorted(message.name) != names or len(message.position) != len(names):
                    raise FileError(f"messages of {topic} in {printable(path)} have positions of different joints.")
                stamps.append((message.header.stamp.sec, message.header.stamp.nanosec))
                rows.append([position for _, position in sorted(zip(message.name, message.position, strict=True))])
    except PlannerError:
        raise
    except Exception:  # rosbags' own, and those of broken files
        expected = "a .bag of ROS 1" if path.suffix.lower() == ".bag" else "the folder that `ros2 bag record` wrote"
        if folder.is_dir() and not (folder / _METADATA).is_file():
            expected += f", with its {_METADATA} beside the data (`ros2 bag reindex` writes one)"
        raise FileError(f"{what} {printable(path)} is no ROS bag that can be read, expected {expected}.") from None
    ticks = np.array(stamps, dtype=np.int64) - stamps[0]  # whole numbers: seconds since 1970 leave floats 0.2 us
    return _timed(names or [], ticks @ [1.0, 1e-9], np.array(rows), path, what)


def _read_episode(path: Path, what: str, part: Any) -> Recording:
    """The states of an episode of a LeRobot data set; its meta/info.json has their names."""
    parquet, content = _optional("pyarrow.parquet", "lerobot"), read_input(path, what)
    expected = f"expected a data file of a LeRobot data set, with the columns {_STATE}, {_EPISODE} and {_TIMESTAMP}"
    try:
        table = parquet.read_table(io.BytesIO(content))
    except (ValueError, KeyError, OSError):  # PyArrow's own are some of these
        raise FileError(f"{what} {printable(path)} is no Parquet file that can be read, {expected}.") from None
    names = (_STATE, _EPISODE, _TIMESTAMP)
    if missing := [name for name in names if table.column_names.count(name) != 1]:
        raise FileError(f"{what} {printable(path)} has no column {missing[0]}, {expected}.")
    columns = {name: table[name].to_pylist() for name in names}
    episode = _chosen(path, what, part, dict.fromkeys(columns[_EPISODE]), "episodes")
    chosen = np.array(columns[_EPISODE]) == episode
    state, t = np.array(columns[_STATE], dtype=float)[chosen], np.array(columns[_TIMESTAMP], dtype=float)[chosen]
    info = next((file for one in path.absolute().parents if (file := one / "meta" / "info.json").is_file()), None)
    if info is None:
        raise FileError(f"{what} {printable(path)} has no meta/info.json in a folder above it, expected the data set.")
    facts = read_text(info, "the data set")
    try:
        names = json.loads(facts)["features"][_STATE]["names"]
        names = next(iter(names.values())) if isinstance(names, dict) else names
        names = [name.removesuffix(_POSITION) for name in names]
    except (ValueError, KeyError, TypeError, AttributeError, StopIteration):
        raise FileError(f"{printable(info)} has no names of {_STATE}, expected a list of them.") from None
    return _timed(names, t - t[0], state, path, what)


def _chosen(path: Path, what: str, part: Any, parts: Iterable[Any], kind: str) -> Any:
    """The part that is asked for, or the only one."""
    known = {str(one): one for one in parts}
    if part is None and len(known) == 1:
        return next(iter(known.values()))
    if str(part) not in known:
        listed = f"{', '.join([*known][:20])}" if known else "none"
        raise FileError(f"{what} {printable(path)} has the {kind} {listed}, expected part to be one of them.")
    return known[str(part)]


def _timed(names: list[str], t: np.ndarray, values: np.ndarray, path: Path, what: str) -> Recording:
    if values.shape != (len(t), len(names)) or not (np.isfinite(values).all() and np.isfinite(t).all()):
        raise FileError(f"{what} {printable(path)} has other things than {len(names)} finite numbers in each row.")
    return Recording((TIME, *names), np.column_stack([t, values]))


def _optional(module: str, extra: str) -> Any:
    try:
        return import_module(module)
    except ImportError:
        package = module.partition(".")[0]
        raise PlannerError(
            f"{package} is not installed, expected it for this file: pip install slq-planner[{extra}]."
        ) from None


VELOCITY = "velocity of "
_OF_POSITIONS = ("rad", "m")
_OF_EXPORTS = (POSITION, VELOCITY, "activation of ", "acceleration of ", "stands: ")


def position_columns(recording: Recording, joints: Collection[str], actuators: Collection[str]) -> dict[str, int]:
    """The column of each joint that the recording has positions of, in the file's order."""
    heading, found = recording.heading, {}
    told_apart = any(name.startswith(POSITION) for name in heading)
    for joint in joints:
        if POSITION + joint in heading:
            found[joint] = heading.index(POSITION + joint)
        elif joint in heading and not (told_apart and joint in actuators):
            column = heading.index(joint)
            if recording.unit(column) in ("", *_OF_POSITIONS):
                found[joint] = column
    return dict(sorted(found.items(), key=lambda one: one[1]))


def control_columns(recording: Recording, joints: Collection[str], units: Mapping[str, str]) -> dict[str, int]:
    """The column of each actuator that the recording has controls of; `units` by actuator, "" where unknown."""
    found = {}
    for column, name in enumerate(recording.heading):
        if name not in units:
            continue
        unit, own = recording.unit(column), units[name]
        if unit in ("", own) or not (own or (name in joints and unit in _OF_POSITIONS)):
            found[name] = column
    return found


def other_columns(recording: Recording, joints: Collection[str], actuators: Collection[str]) -> list[str]:
    """Headings that are of no joint or actuator, nor of an exported plan."""
    known = {TIME, *joints, *actuators}
    return [name for name in recording.heading if name not in known and not name.startswith(_OF_EXPORTS)]


def missing_position(recording: Recording, joint: str, actuators: Collection[str]) -> str:
    """What a recording without positions of a joint is to have, for a message."""
    unprefixed = "" if joint in actuators or joint in recording.heading else f"{joint!r} or "
    wanted = f"expected a column {unprefixed}{POSITION + joint!r} (rad or m)"
    if joint in recording.heading:
        whose = "an actuator has this name" if joint in actuators else "its unit is that of no position"
        return f"{wanted}: {joint!r} may be a control, since {whose}"
    return wanted
