"""Poses between those of a task where the straight way from one to the next is not free."""

from __future__ import annotations

import numpy as np

from planner.problem.collision_checker import CollisionChecker
from planner.problem.initial_guess import minimum_jerk
from planner.problem.tasks.poses import Poses

PARTS = 8  # of a way around: its inner poses are passed, with a spline between them
_EVEN = np.linspace(0.0, 1.0, 1001)
_FROM_REST = minimum_jerk(_EVEN)[0]


def with_via_poses(poses: Poses, free: CollisionChecker, seed: int = 0) -> Poses:
    """The poses with others between them, so that the way through all of them touches nothing.

    Stages between that have no room for more stay as they are, and so does a way that is not found: then the solver
    has to find it.
    """
    stages, found, stops = [int(poses.stages[0])], [poses.q[0]], [bool(poses.at_rest[0])]
    for k in range(1, len(poses.q)):
        a, b = int(poses.stages[k - 1]), int(poses.stages[k])
        way = free.find_path(poses.q[k - 1], poses.q[k], seed) if b - a > PARTS else None
        straight = None if way is None else way[0] + np.linspace(0.0, 1.0, len(way))[:, None] * (way[-1] - way[0])
        if way is not None and np.abs(way - straight).max() > 1e-9:
            part = np.arange(1, PARTS) / PARTS
            rests = poses.at_rest[k - 1] and poses.at_rest[k]
            when = np.interp(part, _FROM_REST, _EVEN) if rests else part
            stages += (a + np.round(when * (b - a))).astype(int).tolist()
            found += list(way[np.round(part * (len(way) - 1)).astype(int)])
            stops += [False] * len(part)
        stages.append(b)
        found.append(poses.q[k])
        stops.append(bool(poses.at_rest[k]))
    return Poses(np.array(stages), np.array(found), np.array(stops))
