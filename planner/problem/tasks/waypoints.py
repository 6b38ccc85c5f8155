"""Via points without times: goals in order, whose shares of the duration are chosen.

They are passed at first in proportion to the way of the joints; an objective moves them (planner.solvers.waypoints).
The indices of those goals are the entry WAYPOINTS of what a plan's table has resolved.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from planner.base.errors import PlannerError
from planner.problem.tasks.goal import Goal
from planner.problem.tasks.poses import Poses
from planner.problem.tasks.timed_task import Task

WAYPOINTS = "waypoints"


def undated_waypoints(goals: Sequence[Goal]) -> tuple[int, ...]:
    """The via points without a time that come before a goal of the end."""
    ends = [k for k, one in enumerate(goals) if one.time is None and one.share in (None, 1.0) and not one.through]
    return tuple(k for k, goal in enumerate(goals) if goal.undated and ends and k < ends[-1])


def dated_evenly(goals: Sequence[Goal], waypoints: Sequence[int], N: int) -> list[Goal]:
    """The goals with their waypoints at equal parts of the duration.

    Raises:
        PlannerError: There are not two stages for each; or other goals before the end, which have times.
    """
    dated = [k for k, goal in enumerate(goals) if k not in waypoints and (goal.time, goal.share) != (None, None)]
    if dated:
        raise PlannerError(
            f"goal {waypoints[0] + 1} is passed without a time, and goal {dated[0] + 1} has one: expected a time or a "
            "share for each goal before the end, or for none."
        )
    parts = len(waypoints) + 1
    if 2 * parts > N:
        raise PlannerError(f"there are {N} stages for {len(waypoints)} via points, expected at least {2 * parts}.")
    return with_stages(goals, waypoints, np.round(N * np.arange(1, parts) / parts).astype(int), N)


def dated_by_way(task: Task, waypoints: Sequence[int], poses: Poses) -> list[Goal]:
    """The goals of a task with their waypoints in proportion to the way of the joints, rad or m, between its poses."""
    xs = np.tile(task.mechanism.home, (len(poses.q), 1))
    xs[:, : task.mechanism.nq] = poses.q
    ways = np.linalg.norm(task.mechanism.space.difference(xs[1:], xs[:-1]), axis=1)
    along = np.concatenate([[0.0], np.cumsum(ways)])
    at = {int(stage): k for k, stage in enumerate(poses.stages)}
    shares = [along[at[task.goals[k].stage]] / max(along[-1], 1e-12) for k in waypoints]
    goals = [one.goal for one in task.goals]
    return with_stages(goals, waypoints, np.round(task.N * np.array(shares)).astype(int), task.N)


def with_stages(goals: Sequence[Goal], waypoints: Sequence[int], stages: np.ndarray, N: int) -> list[Goal]:
    """The goals with their waypoints at stages (W,) of N, in order and at least one stage apart."""
    room = np.arange(1, len(stages) + 1)
    stages = np.maximum.accumulate(np.clip(stages, room, N - room[::-1]) - room) + room
    dated = list(goals)
    for k, stage in zip(waypoints, np.minimum(stages, N - room[::-1]), strict=True):
        dated[k] = replace(goals[k], share=int(stage) / N)
    return dated
