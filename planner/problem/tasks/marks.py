"""What a picture shows of a task: goals, paths, and the frames that they and constraints are about. Data only."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from planner.problem.appearance import Appearance, GoalMark
from planner.problem.constraints.constraint import Constraint
from planner.problem.tasks.follow import Follow
from planner.problem.tasks.timed_task import Task, TimedGoal

MAX_SEGMENTS = 64  # straight pieces of a path


def with_marks(appearance: Appearance, task: Task | None, constraints: Sequence[Constraint] = ()) -> Appearance:
    """The appearance with what a task asks for; the same where there is neither a task nor a constraint of a frame."""
    goals = () if task is None else task.goals
    follows = () if task is None else task.follows
    framed = [one for one in goals if one.goal.frame is not None]
    asked = [path.frame for path in follows] + [one.goal.frame for one in framed]
    kept = [frame for one in constraints if isinstance(frame := getattr(one.of, "frame", None), str)]
    frames = tuple(dict.fromkeys(frame for frame in (*asked, *kept) if frame is not None))
    if not frames:
        return appearance
    times = sorted({one.time for one in framed})
    return replace(
        appearance, trail=frames, frames=frames,
        goals=tuple(_mark(one, str(times.index(one.time) + 1) if len(times) > 1 else "") for one in framed),
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
    """(K, 3) the corners of a path; of many, points at equal times."""
    t = path.times(duration)
    if len(t) > MAX_SEGMENTS + 1:
        t = np.linspace(t[0], t[-1], MAX_SEGMENTS + 1)
    return path.at(t, duration)


def _point(value: Any) -> tuple[float, float, float]:
    x, y, z = (float(part) for part in value)
    return x, y, z
