"""A plan as ROS 2's trajectory_msgs/JointTrajectory, as YAML or JSON; no ROS is needed.

The message has joints of one coordinate: hinges (rad) and slides (m). Free and ball joints are omitted. Accelerations
and efforts are empty, as the message allows: a plan's accelerations are discontinuous between stages, and its controls
are those of actuators, not of joints.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from planner.base.errors import FileError, PlannerError
from planner.base.files import PathLike, as_path, printable, write_atomically
from planner.model.capabilities import capabilities_of
from planner.model.mechanism import SCREW, Mechanism
from planner.problem.export.sampled import ExportedMotion, sampled

SUFFIXES = (".yaml", ".yml", ".json")


def joint_trajectory(plan: ExportedMotion, path: PathLike | None = None, rate: float | None = None) -> dict[str, Any]:
    """The message as a dictionary, also written to a file where a path is given.

    Args:
        plan: The plan.
        path: The file, ending in .yaml, .yml or .json; None for none.
        rate: Points a second; None for the plan's knots.

    Raises:
        PlannerError: The plan's machine has no hinge or slide, the rate is wrong, or the plan is not finite.
        FileError: The path has another ending, or the file cannot be written.
    """
    if path is not None and as_path(path).suffix not in SUFFIXES:
        raise FileError(f"cannot write a joint trajectory to {printable(path)}: expected a name in {_list(SUFFIXES)}.")
    names, positions, velocities = _single_joints(plan)
    samples = sampled(plan, rate)
    points = [
        {
            "positions": x[positions].tolist(), "velocities": x[velocities].tolist(), "accelerations": [],
            "effort": [], "time_from_start": _duration(t),
        }
        for t, x in zip(samples.t, samples.xs, strict=True)
    ]  # fmt: skip
    header = {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}
    message = {"header": header, "joint_names": names, "points": points}
    if path is not None:
        as_json = Path(path).suffix == ".json"
        text = json.dumps(message, indent=1, allow_nan=False) if as_json else "\n".join(_yaml(message))
        with write_atomically(path) as unfinished:
            unfinished.write_text(f"{text}\n", encoding="utf-8")
    return message


def left_out(plan: ExportedMotion) -> tuple[str, ...]:
    """Names of the joints that the message omits: free and ball joints."""
    mechanism = _mechanism(plan)
    every = zip(mechanism.joint_names, mechanism.joint_links, strict=True)
    return tuple(name or f"joint {j}" for j, (name, links) in enumerate(every) if not _single(mechanism, links))


def _single_joints(plan: ExportedMotion) -> tuple[list[str], np.ndarray, np.ndarray]:
    """Names of hinges and slides, and the indices of their positions and velocities in a state."""
    mechanism, names, dofs = _mechanism(plan), [], []
    for j, (name, links) in enumerate(zip(mechanism.joint_names, mechanism.joint_links, strict=True)):
        if _single(mechanism, links):
            names.append(name or f"joint {j}")
            dofs.append(links.start)
    if not names:
        raise PlannerError("a joint trajectory needs hinges or slides, but the plan's machine has none; write a CSV.")
    return names, mechanism.q_address[dofs], mechanism.nq + np.array(dofs)


def _mechanism(plan: ExportedMotion) -> Mechanism:
    mechanism = capabilities_of(getattr(plan.problem, "dynamics", None)).mechanism
    if mechanism is None:
        raise PlannerError(
            "a joint trajectory needs the names of joints, but the plan's dynamics have no Mechanism; write a CSV."
        )
    return mechanism


def _single(mechanism: Mechanism, links: slice) -> bool:
    return links.stop - links.start == 1 and mechanism.kind[links.start] == SCREW


def _duration(t: float) -> dict[str, int]:
    """A time as ROS has it: whole seconds and nanoseconds."""
    nanoseconds = round(float(t) * 1e9)
    return {"sec": nanoseconds // 10**9, "nanosec": nanoseconds % 10**9}


def _yaml(message: dict[str, Any]) -> Iterator[str]:
    """The lines of the message as YAML 1.1, where numbers with an exponent need a point."""
    yield "header: {stamp: {sec: 0, nanosec: 0}, frame_id: ''}"
    yield "joint_names:"
    yield from (f"- {json.dumps(name)}" for name in message["joint_names"])
    yield "points:"
    for point in message["points"]:
        at = point["time_from_start"]
        yield f"- positions: [{', '.join(map(_number, point['positions']))}]"
        yield f"  velocities: [{', '.join(map(_number, point['velocities']))}]"
        yield "  accelerations: []"
        yield "  effort: []"
        yield f"  time_from_start: {{sec: {at['sec']}, nanosec: {at['nanosec']}}}"


def _number(value: float) -> str:
    assert math.isfinite(value)
    text = repr(value)
    return text.replace("e", ".0e") if "e" in text and "." not in text else text


def _list(names: tuple[str, ...]) -> str:
    return f"{', '.join(names[:-1])} or {names[-1]}"
