"""Default Appearance of a machine, from the axes and the names of its joints; marks and panels of a problem's task.

Panels show goal errors and constrained quantities over time, with their bounds. A residual may name its components by
`names`, and its function may have `shown(xs, us, n) -> (K, R)`, values for pictures in place of the solver's (see
planner.problem.residual).
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Collection, Sequence
from dataclasses import replace
from itertools import takewhile
from typing import Any
from xml.etree import ElementTree

import numpy as np

from planner.model.capabilities import capabilities_of
from planner.model.coordinates import ANGLE, FORCE, LENGTH, MOMENT, controls_of_mechanism
from planner.model.mechanism import BALL, SCREW, Mechanism
from planner.problem.appearance import Appearance, BoundedPanel, GoalMark, Panel, Readout
from planner.problem.constraints.constraint import Constraint
from planner.problem.constraints.constraint_stack import StackEntry
from planner.problem.goals import between
from planner.problem.problem import Problem
from planner.problem.tasks.goal import Follow
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
_GOALS = {"m": "distance", "rad": "angle", "m/s": "speed"}
StatesControls = tuple[np.ndarray, np.ndarray]  # states (N+1, nx) and controls (N, nu)


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
    plots = []
    for title, unit, part in panels:
        plots += [Panel(words, unit, states=curves) for words, curves in small_multiples(title, part)]
    for unit in dict.fromkeys(unit for _, _, unit in controls):
        of_unit = [(i, name) for i, name, own in controls if own == unit]
        title, label = _CONTROLS.get(unit, ("Controls", "control"))
        plots += [Panel(words, label, controls=curves) for words, curves in small_multiples(title, of_unit)]
    readouts = [*((i, label, "m") for i, label in lengths), *((i, label, "rad") for i, label in angles)]
    shown = tuple(Readout(label, i, unit) for i, label, unit in readouts[:_READOUTS])
    return Appearance(
        title=name[1] if name else "", readouts=shown, scenery=_belts(mechanism), azimuth=azimuth, elevation=elevation,
        may_turn=True, plots=tuple(plots),
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


def task_panels(problem: Problem, t: np.ndarray, motions: Sequence[StatesControls]) -> list[BoundedPanel]:
    """Panels of goals and constraints; none for a problem without either.

    Args:
        problem: Of the plan.
        t: (N+1,) s, the knots.
        motions: States and controls of the plan, then of its replays, at the knots.
    """
    return [*_of_goals(problem, t, motions), *_of_constraints(problem, t, motions)]


def _of_goals(problem: Problem, t: np.ndarray, motions: Sequence[StatesControls]) -> list[BoundedPanel]:
    """Panels by unit: the error of each goal of a task over time, and its tolerance at the goal's times."""
    units: dict[str, dict[bytes, tuple[list[str], np.ndarray, np.ndarray]]] = {}
    for one in problem.goal_specs or ():
        if one.tolerance is None:
            continue
        asked = np.array([problem.N] if one.times is None else np.round(np.array(one.times) / problem.dynamics.dt), int)
        values, upper = np.full((len(motions), len(t)), np.nan), np.full(len(t), np.inf)
        for (xs, _), curve in zip(motions, values, strict=True):
            if len(asked) == 1:
                curve[:] = one.error(xs)
            else:  # of a path: the largest that is nearest to each knot
                np.fmax.at(curve, asked, one.error(between(t, xs, np.array(one.times))))
        upper[asked] = one.tolerance
        # Goals with equal errors at all times share a curve, e.g. the speed of a frame that stops twice.
        names, _, bound = units.setdefault(one.unit, {}).setdefault(values[0].tobytes(), ([], values, upper))
        names.append(one.name)
        bound[:] = np.minimum(bound, upper)
    panels = []
    for unit, found in units.items():
        curves = list(found.values())
        for first in range(0, len(curves), MAX_CURVES):
            few = curves[first : first + MAX_CURVES]
            what, names = _shared([_shared(names)[0] for names, _, _ in few])  # "speed of hand" at 1 s and at 2 s
            upper = np.stack([bound for _, _, bound in few], axis=1)
            displacement = np.stack([values for _, values, _ in few], axis=2)
            title = f"Goals: {what or _GOALS.get(unit, 'miss')}"
            lower, label = np.full_like(upper, -np.inf), f"miss, {unit}"
            panels.append(BoundedPanel(title, label, t, names, tuple(displacement), lower, upper, decades=True))
    return panels


def _of_constraints(problem: Problem, t: np.ndarray, motions: Sequence[StatesControls]) -> list[BoundedPanel]:
    """Panels of the components of each constraint; constraints of one component and equal bounds share a panel."""
    rows = None if problem.trajectory_constraints is None else problem.trajectory_constraints.rows
    alike: dict[Any, list[tuple[StackEntry, np.ndarray, np.ndarray]]] = {}
    for k, part in enumerate(() if rows is None else rows.parts):
        if part.at_end:  # values at the end of a stage repeat those at the start of the next, except for the control
            continue
        assert rows is not None
        lower, upper = (
            side[:, part.columns] / rows.scale[part.columns] for side in (rows.specified_lower, rows.specified_upper)
        )
        if part.function.of_controls:
            lower[-1], upper[-1] = lower[-2], upper[-2]
        key = (part.constraint.unit, lower.tobytes(), upper.tobytes()) if part.function.rows == 1 else k
        alike.setdefault(key, []).append((part, lower, upper))
    panels = []
    for found in alike.values():
        for first in range(0, len(found), MAX_CURVES):
            few = found[first : first + MAX_CURVES]
            values = np.concatenate([[_values(part, *motion) for motion in motions] for part, _, _ in few], axis=2)
            lower, upper = (np.concatenate(side, axis=1) for side in list(zip(*few, strict=True))[1:])
            names = tuple(name for part, _, _ in few for name in _names(part))
            what = few[0][0].constraint.name if len(few) == 1 else _shared(names)[0]
            names = names if len(few) == 1 or not what else _shared(names)[1]
            panels.append(_nearest(few[0][0].constraint.unit, what, t, names, values, lower, upper))
    return panels


def _values(part: StackEntry, xs: np.ndarray, us: np.ndarray) -> np.ndarray:
    """(N+1, R) values of a constraint; at the end with the last control. NaN where states or controls diverged."""
    n = np.arange(len(xs))
    last = np.minimum(n, len(us) - 1)
    measure, u = part.function, us[last]
    found = np.full((len(xs), measure.rows), np.nan)
    known = np.flatnonzero(np.isfinite(xs).all(axis=1) & np.isfinite(u).all(axis=1))
    values = getattr(measure, "shown", measure.values)
    if len(known):
        found[known] = values(xs[known], u[known], (last if measure.of_controls else n)[known])
    return found


def _nearest(
    unit: str, what: str, t: np.ndarray, names: tuple[str, ...], values: np.ndarray, lower: np.ndarray,
    upper: np.ndarray,
) -> BoundedPanel:  # fmt: skip
    """The panel of values (motions, K, R): at most MAX_CURVES components, by smallest margin in the plan."""
    margin = np.minimum(np.nan_to_num(values[0], nan=np.inf) - lower, upper - np.nan_to_num(values[0], nan=-np.inf))
    margin = np.where(np.isfinite(margin), margin, np.inf).min(axis=0)
    asked = np.flatnonzero((np.isfinite(lower) | np.isfinite(upper)).any(axis=0))
    shown = np.sort(asked[np.argsort(margin[asked], kind="stable")[:MAX_CURVES]])
    title = f"Constraint: {what}" if what else "Constraints"
    if len(shown) < len(asked):
        title += f", the {MAX_CURVES} nearest to their bound of {len(asked)}"
    lower, upper, values = lower[:, shown], upper[:, shown], values[..., shown]
    keeps_clear = not np.isfinite(upper).any() and bool(np.all(lower[np.isfinite(lower)] > 0.0))
    return BoundedPanel(
        title, unit or "h", t, tuple(names[k] for k in shown), tuple(values), lower, upper, decades=keeps_clear
    )


def _names(part: StackEntry) -> tuple[str, ...]:
    """(R,) names of a constraint's components."""
    own, R = tuple(getattr(part.constraint.of, "names", ())), part.function.rows
    if R == 1:
        return (part.constraint.name,)
    return own if len(own) == R else tuple(f"row {r}" for r in range(1, R + 1))


def _shared(names: Sequence[str]) -> tuple[str, tuple[str, ...]]:
    """The common first words of all names, and the remainder of each: "position of hand" and "at 1 s"."""
    if len(names) == 1:
        return names[0], tuple(names)
    columns = zip(*(name.split() for name in names), strict=False)
    common = [words[0] for words in takewhile(lambda words: len(set(words)) == 1, columns)]
    rest = [name.split()[len(common) :] for name in names]
    while common and common[-1] in ("of", "at"):
        if common.pop() == "at":
            rest = [["at", *words] for words in rest]
    return " ".join(common), tuple(" ".join(words) or "at the end" for words in rest)
