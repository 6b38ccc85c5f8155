"""Task: the goals and paths of a problem at its stages, checked for contradictions."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from planner.base.arguments import array, choice, number
from planner.base.errors import PlannerError
from planner.model.mechanism import SCREW, Mechanism
from planner.problem.goals import MIN_TOLERANCES
from planner.problem.tasks.goal import PARTS, Follow, Goal

DEFAULT_TOLERANCES = {
    "position": MIN_TOLERANCES["m"],
    "orientation": MIN_TOLERANCES["rad"],
    "pointing": MIN_TOLERANCES["rad"],
    "velocity": MIN_TOLERANCES["m/s"],
}
PATH_TOLERANCES = {"m": 2.0 * MIN_TOLERANCES["m"], "rad": 2.0 * MIN_TOLERANCES["rad"]}  # default of a path
PATH_PARTS = 10  # of a stage, at whose ends a path is judged: held controls bend a motion little within them


@dataclass(frozen=True)
class TimedGoal:
    """A goal at its stage."""

    goal: Goal
    stage: int  # 1 to N, the nearest: the cost weighs its knot
    time: float  # s, as asked for: the proof judges the motion there, between two knots too
    last: bool  # Whether its stage is the end
    label: str  # In messages: "goal 2 (hand at 1 s)"
    tolerances: dict[str, float]  # By PARTS
    joints: dict[int, float] = field(default_factory=dict)  # Of a goal of joints: positions by degree of freedom

    @property
    def when(self) -> str:
        """The time behind a name: " at 1 s", nothing for the end."""
        return "" if self.last else f" at {self.time:.4g} s"


@dataclass(frozen=True)
class Task:
    """Goals in the order of their times, and paths, of a machine in N stages of dt."""

    mechanism: Mechanism
    goals: tuple[TimedGoal, ...]
    follows: tuple[Follow, ...]
    N: int
    dt: float

    @property
    def duration(self) -> float:
        """Duration, s."""
        return self.N * self.dt

    @property
    def rests(self) -> bool:
        """Whether the machine is at rest at the end: not if a via point or a path with times ends there."""
        passed = any(one.goal.through for one in self.goals if one.last)
        ends = any(np.shape(path.points)[1] > path.width and self.span(path)[1] == self.N for path in self.follows)
        return not (passed or (ends and not any(one.last for one in self.goals)))

    def span(self, path: Follow) -> tuple[int, int]:
        """The first and the last stage of a path."""
        times = path.times(self.duration)
        return round(float(times[0]) / self.dt), round(float(times[-1]) / self.dt)

    def judged_times(self, path: Follow) -> np.ndarray:
        """(K,) s, at which a path is judged: its own points', and PATH_PARTS equal parts of every stage."""
        own = path.times(self.duration)
        first, last = np.clip(own[[0, -1]], 0.0, self.duration)
        part = self.dt / PATH_PARTS
        even = part * np.arange(np.ceil(first / part), np.floor(last / part) + 1)
        return np.unique(np.clip(np.concatenate([own, even]), first, last))

    def positions_at(self, path: Follow, stages: np.ndarray) -> np.ndarray:
        """The points (K, n) of a path at stages (K,)."""
        return path.at(self.dt * stages, self.duration)

    def tolerance(self, path: Follow) -> float:
        """Max allowed distance from a path, in its unit."""
        if path.tolerance is not None:
            return path.tolerance
        return min(PATH_TOLERANCES[unit] for unit in self.units(path))

    def units(self, path: Follow) -> list[str]:
        """The unit of each number of a path."""
        if path.joints is None:
            return ["m"] * 3
        return [unit_of(self.mechanism, self.mechanism.joint(name).start) for name in path.joints]


def task_of(
    mechanism: Mechanism, goals: list[Goal], follows: list[Follow], N: int, dt: float, tolerance: Any = None
) -> Task:
    """The task of goals and paths.

    Args:
        mechanism: The machine.
        goals: In the order of their times.
        follows: Paths.
        N: Stages.
        dt: s, of a stage.
        tolerance: Of goals that state none: a number, or a table by PARTS; None for the default ones.

    Raises:
        PlannerError: A frame, joint or keyframe that the machine does not have; times out of order or outside of the
            duration.
    """
    defaults = Goal(frame="", pointing=(0, 0, 1), tolerance=_goal_tolerances(tolerance)).tolerances(DEFAULT_TOLERANCES)
    timed, before = [], 0.0
    for k, goal in enumerate(goals, 1):
        time, name = goal.after(N * dt), goal.frame or "joints"
        label = f"goal {k} ({name})" if goal.time is goal.share is None else f"goal {k} ({name} at {time:g} s)"
        if time > N * dt * (1.0 + 1e-9):
            raise PlannerError(f"{label} is after the end, expected a time of at most the duration of {N * dt:g} s.")
        if time < before - 1e-9:
            raise PlannerError(
                f"{label} comes before the one above it, which is at {before:g} s: expected goals in the order of "
                "their times, and those without a time, which are at the end, last."
            )
        before, stage = time, max(round(time / dt), 1)
        if goal.frame is not None:
            mechanism.frame(goal.frame)  # refuses an unknown name
        for one in _with_bases(mechanism, goal, label):
            joints = joints_of(mechanism, one, label)
            timed.append(TimedGoal(one, stage, time, stage == N, label, one.tolerances(defaults), joints))
    for path in follows:
        _check_path(mechanism, path, N * dt)
    return Task(mechanism, tuple(timed), tuple(follows), N, dt)


def _goal_tolerances(tolerance: Any) -> Any:
    """The entries of a problem's tolerance that goals have; tables name joints and kinds of goals too."""
    if isinstance(tolerance, dict):
        return {name: value for name, value in tolerance.items() if name in PARTS and value != "soft"} or None
    return None if tolerance == "soft" else tolerance


def _with_bases(mechanism: Mechanism, goal: Goal, label: str) -> list[Goal]:
    """The goal; if it has free joints, one of the other joints, and one of the pose of the body of each free joint."""
    bases = {
        name: links for name, links in zip(mechanism.joint_names, mechanism.joint_links, strict=True)
        if links.stop - links.start == 6
    }  # fmt: skip
    given = goal.joints
    if given is None or not bases or (isinstance(given, dict) and not set(given) & set(bases)):
        return [goal]
    if not isinstance(given, dict):
        q = mechanism.keyframe(given)[: mechanism.nq] if isinstance(given, str) else np.asarray(given, dtype=float)
        if q.shape != (mechanism.nq,):
            return [goal]  # joints_of says what is expected
        starts = [int(mechanism.q_address[links.start]) for links in mechanism.joint_links]
        ends = [*starts[1:], mechanism.nq]
        parts = zip(mechanism.joint_names, starts, ends, strict=True)
        given = {name: q[a:b] if b - a > 1 else float(q[a]) for name, a, b in parts}
    found, others = [], {name: value for name, value in given.items() if name not in bases}
    for name in (one for one in given if one in bases):
        pose = array(f"{name} of {label}, [x, y, z] m and a quaternion, w first", given[name], (7,))
        body = next((k for k, one in enumerate(mechanism.bodies) if one.link == bases[name].stop - 1), -1)
        frame = mechanism.body_names[body] if body >= 0 else ""
        if not frame:
            raise PlannerError(f"{label} names {name!r}, whose body has no name: expected a name in the model.")
        found.append(replace(goal, joints=None, frame=frame, position=pose[:3], orientation=pose[3:]))
    return [*found, *([replace(goal, joints=others)] if others else [])]


def joints_of(mechanism: Mechanism, goal: Goal, label: str) -> dict[int, float]:
    """Positions by degree of freedom of a goal of joints; empty for one of a frame."""
    given = goal.joints
    if given is None:
        return {}
    screws = [i for i in range(mechanism.nv) if mechanism.kind[i] == SCREW and _is_single_dof(mechanism, i)]
    if isinstance(given, str):
        given = mechanism.keyframe(given)[: mechanism.nq]
    elif isinstance(given, dict):
        found = {}
        for name, value in given.items():
            i = mechanism.joint(choice(f"a joint of {label}", name, [n for n in mechanism.joint_names if n])).start
            if i not in screws:
                raise PlannerError(f"{label} names {name!r}, a ball joint: expected hinges, slides and free joints.")
            found[i] = number(f"{name} of {label}", value)
        return found
    given = np.asarray(given, dtype=float).ravel()
    if len(given) != mechanism.nq or len(screws) != mechanism.nv:
        names = ", ".join(name for name in mechanism.joint_names if name)
        expected = f"expected a table of hinges and slides, or all {mechanism.nq} positions ({names})"
        raise PlannerError(f"{label} has {len(given)} numbers, {expected}.")
    return {i: float(given[mechanism.q_address[i]]) for i in screws}


def _is_single_dof(mechanism: Mechanism, dof: int) -> bool:
    links = next(one for one in mechanism.joint_links if one.start <= dof < one.stop)
    return links.stop - links.start == 1


def unit_of(mechanism: Mechanism, dof: int) -> str:
    """The unit of a degree of freedom, "rad" or "m"."""
    return "rad" if np.any(mechanism.S[dof, :3]) else "m"


def _check_path(mechanism: Mechanism, path: Follow, duration: float) -> None:
    if path.frame is not None:
        mechanism.frame(path.frame)
    for name in path.joints or ():
        links = mechanism.joint(name)
        if mechanism.kind[links.start] != SCREW or links.stop - links.start > 1:
            raise PlannerError(f"follow names {name!r}, a ball or free joint: expected hinges and slides.")
    first, last = path.times(duration)[[0, -1]]
    if first < 0.0 or last > duration * (1.0 + 1e-9):
        raise PlannerError(
            f"the path of {path.what} is from {first:g} to {last:g} s, expected times between 0 and the duration of "
            f"{duration:g} s."
        )
