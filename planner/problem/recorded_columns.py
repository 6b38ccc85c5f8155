"""Which columns of a recording are positions of joints, and which are controls: joints and actuators may share names.

`position of elbow` is of the joint. `elbow` is of the joint, too, unless it may be the actuator's: the file has other
columns `position of ...`, as an exported plan has, or the column's unit is no position's. With a position's unit it is
the joint's, unless the actuator has the same.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

from planner.problem.recording import POSITION, TIME, Recording

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
