"""Default Appearance of a machine, from the axes and the names of its joints."""

from __future__ import annotations

import itertools
import re
from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import Any
from xml.etree import ElementTree

import numpy as np

from planner.model.capabilities import capabilities_of
from planner.model.coordinates import ANGLE, FORCE, LENGTH, MOMENT, controls_of_mechanism
from planner.model.mechanism import BALL, SCREW, Mechanism
from planner.problem.appearance import Appearance, GoalMark, Panel, Readout
from planner.problem.constraints.constraint import Constraint
from planner.problem.tasks.follow import Follow
from planner.problem.tasks.timed_task import Task, TimedGoal

MAX_CURVES = 8  # of a panel, for distinct colours
_READOUTS = 8
_CONTROLS = {
    MOMENT: ("Controls: torques", "torque, N m"), FORCE: ("Controls: forces", "force, N"),
    ANGLE: ("Controls: targets of servos", "angle, rad"), LENGTH: ("Controls: targets of servos", "position, m"),
}  # fmt: skip
_PARALLEL = 1e-6
MAX_SEGMENTS = 64  # straight pieces of a path

Curves = list[tuple[int, str]]


def appearance_of(problem: Any) -> Appearance:
    """The problem's own appearance, else one from its mechanism, else an empty one."""
    appearance = getattr(problem, "appearance", None)
    mechanism = capabilities_of(getattr(problem, "dynamics", None)).mechanism
    if appearance is None and mechanism is not None:
        return default_appearance(mechanism, getattr(problem.dynamics, "prescribed", ()))
    return appearance or Appearance(title="")


def default_appearance(mechanism: Mechanism, prescribed: Collection[str] = ()) -> Appearance:
    """A camera across the plane of motion, the first joints as numbers, and plots of states and controls.

    The accelerations of prescribed joints are controls too.
    """
    azimuth, elevation = _view(mechanism)
    name = re.search(r"<mujoco[^>]*\bmodel=[\"']([^\"']+)[\"']", mechanism.mjcf)
    angles, lengths, turning, moving = _curves(mechanism)
    controls = [(i, one.name, one.unit) for i, one in enumerate(controls_of_mechanism(mechanism))]
    for joint, links in zip(mechanism.joint_names, mechanism.joint_links, strict=True):
        if joint in prescribed:
            accelerations = range(len(controls), len(controls) + links.stop - links.start)
            controls += [(i, f"acceleration of {joint}", "") for i in accelerations]
    panels = (
        ("Joint angles", "angle, rad", angles), ("Positions", "position, m", lengths),
        ("Angular velocities", "angular velocity, rad/s", turning), ("Velocities", "velocity, m/s", moving),
    )  # fmt: skip
    plots = [
        Panel(words, unit, states=curves)
        for title, unit, part in panels
        for words, curves in small_multiples(title, part)
    ]
    for unit in dict.fromkeys(unit for _, _, unit in controls):
        of_unit = [(i, name) for i, name, own in controls if own == unit]
        title, label = _CONTROLS.get(unit, ("Controls", "control"))
        plots += [Panel(words, label, controls=curves) for words, curves in small_multiples(title, of_unit)]
    readouts = [*((i, label, "m") for i, label in lengths), *((i, label, "rad") for i, label in angles)]
    shown = tuple(Readout(label, i, unit) for i, label, unit in readouts[:_READOUTS])
    return Appearance(
        title=name[1] if name else "", readouts=shown, scenery=_belts(mechanism), azimuth=azimuth, elevation=elevation,
        plots=tuple(plots),
    )  # fmt: skip


def _curves(mechanism: Mechanism) -> tuple[Curves, Curves, Curves, Curves]:
    """Angles, lengths and the velocities of both: (index in the state, label). Quaternions are not drawn."""
    found: tuple[Curves, Curves, Curves, Curves] = ([], [], [], [])
    turns = np.any(mechanism.S[:, :3] != 0.0, axis=1)
    for number, (name, links) in enumerate(zip(mechanism.joint_names, mechanism.joint_links, strict=True)):
        for k, i in enumerate(range(links.start, links.stop)):
            label = name or f"joint {number}"
            if links.stop - links.start > 1:
                label += f" {'xyz'[k % 3]}"
            if mechanism.kind[i] == SCREW:
                found[0 if turns[i] else 1].append((int(mechanism.q_address[i]), label))
            found[2 if turns[i] else 3].append((mechanism.nq + i, label))
    return found


def _belts(mechanism: Mechanism) -> tuple[str, ...]:
    """Names of the moving bodies with planes of contacts, e.g. the belt of a treadmill."""
    slides = {contact.plane.slide for contact in mechanism.contacts} - {-1}
    if not slides:
        return ()
    named = zip(mechanism.joint_names, mechanism.joint_links, strict=True)
    joints = {name for name, links in named if name and links.start in slides}
    bodies = ElementTree.fromstring(mechanism.mjcf).iter("body")
    carrying = [body for body in bodies if any(joint.get("name") in joints for joint in body.findall("joint"))]
    return tuple(name for body in carrying if (name := body.get("name")))


def small_multiples(title: str, curves: Curves) -> list[tuple[str, tuple[tuple[int, str], ...]]]:
    """Titles and curves of the fewest panels with at most MAX_CURVES curves each."""
    panels = -(-len(curves) // MAX_CURVES)
    ends = [round(k * len(curves) / panels) for k in range(panels + 1)] if panels else []
    parts = list(itertools.pairwise(ends))
    if len(parts) == 1:
        return [(title, tuple(curves))]
    return [(f"{title}, {a + 1} to {b} of {len(curves)}", tuple(curves[a:b])) for a, b in parts]


def _view(mechanism: Mechanism) -> tuple[float, float]:
    """Azimuth and elevation of a camera: across the plane of a planar machine, else from ahead and above."""
    R = np.empty((mechanism.nv, 3, 3))
    for i, parent in enumerate(mechanism.parent):
        R[i] = (np.eye(3) if parent < 0 else R[parent]) @ mechanism.T_home[i, :3, :3]
    angular, linear = (np.einsum("iab,ib->ia", R, mechanism.S[:, part]) for part in (slice(3), slice(3, 6)))
    turns = np.any(angular != 0.0, axis=1)
    normal = None if np.any(mechanism.kind == BALL) else _normal(angular[turns], linear[~turns])
    return (130.0, -18.0) if normal is None else _across(normal)


def _normal(axes: np.ndarray, ways: np.ndarray) -> np.ndarray | None:
    """(3,) unit normal of the plane of motion, for axes of hinges (A, 3) and slides (W, 3); None if not planar."""
    slides = [np.cross(a, b) for a, b in itertools.combinations(ways, 2)]
    for one in (*np.eye(3)[[1, 0, 2]], *axes[:1], *slides):
        normal = one / max(float(np.linalg.norm(one)), _PARALLEL)
        parallel = np.all(np.abs(np.cross(axes, normal)) < _PARALLEL)
        if parallel and np.any(normal) and np.all(np.abs(ways @ normal) < _PARALLEL):
            return normal
    return None


def _across(normal: np.ndarray) -> tuple[float, float]:
    """Azimuth and elevation, degrees, of a camera that looks along a normal (3,): x to the right, or y, or from above.

    Angles and lengths in the plane perpendicular to it are shown without distortion.
    """
    x, y, z = (np.where(np.abs(normal) < _PARALLEL, 0.0, normal) + 0.0).tolist()
    if (-z, y, -x) < (0.0, 0.0, 0.0):
        x, y, z = 0.0 - x, 0.0 - y, 0.0 - z  # -x would make a negative zero
    azimuth = np.degrees(np.arctan2(y, x)) if x or y else 90.0
    return float(azimuth), float(np.degrees(np.arcsin(np.clip(z, -1.0, 1.0))))


def with_marks(appearance: Appearance, task: Task | None, constraints: Sequence[Constraint] = ()) -> Appearance:
    """The appearance with marks of a task's goals and paths; unchanged if no goal, path or constraint has a frame."""
    goals = () if task is None else task.goals
    follows = () if task is None else task.follows
    of_frames = [one for one in goals if one.goal.frame is not None]
    asked = [path.frame for path in follows] + [one.goal.frame for one in of_frames]
    constrained_frames = [frame for one in constraints if isinstance(frame := getattr(one.of, "frame", None), str)]
    frames = tuple(dict.fromkeys(frame for frame in (*asked, *constrained_frames) if frame is not None))
    if not frames:
        return appearance
    times = sorted({one.time for one in of_frames})
    return replace(
        appearance, trail=frames, frames=frames,
        goals=tuple(_mark(one, str(times.index(one.time) + 1) if len(times) > 1 else "") for one in of_frames),
        paths=tuple(_line(path, task.duration) for path in follows if task is not None and path.frame is not None),
    )  # fmt: skip


def _mark(one: TimedGoal, number: str) -> GoalMark:
    goal, turned = one.goal, one.goal.quaternion
    from scipy.spatial.transform import Rotation  # 0.4 s that `planner run` need not pay

    orientation = None if turned is None else Rotation.from_quat(turned[[1, 2, 3, 0]]).as_matrix()
    direction = None if goal.direction is None else _point(goal.direction[1])
    position = None if goal.position is None else _point(goal.position)
    return GoalMark(str(goal.frame), one.time, position, orientation, direction, number)


def _line(path: Follow, duration: float) -> np.ndarray:
    """(K, 3) m, corners of a path; if more than MAX_SEGMENTS + 1, points at equal times."""
    t = path.times(duration)
    if len(t) > MAX_SEGMENTS + 1:
        t = np.linspace(t[0], t[-1], MAX_SEGMENTS + 1)
    return path.at(t, duration)


def _point(value: Any) -> tuple[float, float, float]:
    x, y, z = (float(part) for part in value)
    return x, y, z
