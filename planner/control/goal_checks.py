"""Whether a controller's goal can be met at all: sizes, ranges of joints, clearances, and the reach of a frame.

The reach of a frame is an upper bound. A point on the axis of a hinge is fixed in both of its links. So no pose takes
the frame farther from the first axis than the lengths from axis to axis in sum, and the travel of slides. A goal within
it may be out of reach too: the machine then goes as near as its cost lets it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from planner.control.controller_states import Fault
from planner.kernels.tree.mechanism_table import chain_of
from planner.model.capabilities import capabilities_of
from planner.model.mechanism import SCREW, Mechanism
from planner.problem.constraints.clearance import PairClearanceFunction
from planner.problem.problem import Problem
from planner.solvers.other_guesses import DIVERGENCE_FACTOR


def goal_fault(problem: Problem, goal: np.ndarray | Mapping[str, Any]) -> Fault | None:
    """What is wrong with a goal, states (..., nx) or a table of frames with positions (..., 3), m; or None."""
    mechanism = capabilities_of(problem.dynamics).mechanism
    if isinstance(goal, Mapping):
        for frame, places in goal.items():
            center, most = reach(mechanism, str(frame)) if mechanism is not None else (np.zeros(3), math.inf)
            if not np.abs(places).max() < DIVERGENCE_FACTOR:
                return Fault.GOAL_SIZE
            if np.linalg.norm(np.asarray(places) - center, axis=-1).max() > most:
                return Fault.GOAL_REACH
        return None
    if not np.abs(goal).max() < DIVERGENCE_FACTOR:
        return Fault.GOAL_SIZE
    xs, ranges, kept = np.atleast_2d(goal), problem.ranges, problem.trajectory_constraints
    if ranges is not None:
        columns, stage = slice(0, len(ranges.component) - ranges.at_end), -1 if problem.N == 1 else -2
        e = ranges.space.difference(xs, ranges.reference[-1])[:, ranges.component][:, columns]
        shift = ranges.space.difference(ranges.reference[stage], ranges.reference[-1])[ranges.component][columns]
        below, above = ranges.lower[stage, columns] + shift - e, e - ranges.upper[stage, columns] - shift
        tolerance = 0.0 if kept is None else kept.tolerance
        if np.any(np.maximum(below, above) > tolerance):
            return Fault.GOAL_RANGE
    for part in () if kept is None or kept.rows is None else kept.rows.parts:
        function = part.function
        if isinstance(function, PairClearanceFunction):
            us, n = np.zeros((len(xs), problem.dynamics.nu)), np.arange(len(xs))
            if np.any(function.values(xs, us, n) < 0.0):
                return Fault.GOAL_COLLIDES
    return None


def reach(mechanism: Mechanism, frame: str) -> tuple[np.ndarray, float]:
    """A fixed point (3,) of the world, m, and an upper bound of the frame's distance from it, m; infinite for balls."""
    own, length = mechanism.frame(frame), 0.0
    before: np.ndarray | None = None  # point of the last axis, in the frame of its link
    center = own.T[:3, 3]
    for i in chain_of(mechanism.parent, own.link)[::-1]:
        w, v = mechanism.S[i, :3], mechanism.S[i, 3:]
        hinge = float(w @ w) > 0.0
        if mechanism.kind[i] != SCREW:
            return center, math.inf
        point = np.cross(w, v) / (w @ w) if hinge else np.zeros(3)
        at = mechanism.T_home[i, :3, :3] @ point + mechanism.T_home[i, :3, 3]
        if before is None:
            center = at
        else:
            length += float(np.linalg.norm(at - before))
        if not hinge:
            length += float(np.abs(mechanism.joint_range[i] - mechanism.q_home[i]).max() * np.linalg.norm(v))
        before = point
    return center, length + (0.0 if before is None else float(np.linalg.norm(own.T[:3, 3] - before)))
