"""Start and goal at the stops of their joints: off those that are bounds, at rest on those that press."""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.cases.problem_file.ground_placement import SAME_POSE_TOLERANCE
from planner.dynamics.rest_on_stops import rest_on_stops
from planner.model.capabilities import stands_on_ground
from planner.model.mechanism import Mechanism
from planner.problem.joint_limits import moved_inside_limits


def off_stops(
    mechanism: Mechanism, table: dict[str, Any], x0: np.ndarray, goal: np.ndarray
) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """Start and goal off the stops whose ranges hold, and sentences about it."""
    kept = (table.get("limits") or {}).get("position")
    if stands_on_ground(mechanism) or not (kept == "model" or isinstance(kept, dict)):  # what stands has been put down
        return x0, goal, ()
    limited = kept if isinstance(kept, dict) else {}
    (x0, first), (goal, second) = (
        moved_inside_limits(mechanism, what, x, limited) for what, x in (("start", x0), ("goal", goal))
    )
    return x0, goal, tuple(filter(None, (first, second)))


def at_rest_on_stops(
    mechanism: Mechanism, table: dict[str, Any], x0: np.ndarray, goal: np.ndarray, notes: dict[str, str]
) -> tuple[np.ndarray, np.ndarray, dict[str, str]]:
    """Start and goal (nx,) with closed chains at rest on the stops that they lean on, and the notes with one of each.

    A chain of whose undriven joints the table names one stays where that is asked for.
    """
    found = []
    for name, x in (("start", x0), ("goal", goal)):
        moves = bool(np.any(x[mechanism.velocities]))
        asked = table.get(name)
        names = asked if isinstance(asked, dict) else {}
        given = {dof for joint in names for dof in range(*mechanism.joint(joint).indices(mechanism.nv))}
        found.append(x if moves else rest_on_stops(mechanism, x, given))
        change = mechanism.space.difference(found[-1], x)[: mechanism.nv]
        if np.abs(change).max() > SAME_POSE_TOLERANCE:
            i = int(np.argmax(np.abs(change)))
            far = f"{abs(change[i]):.2g} rad or m"
            said = f"{mechanism.joint_of(i)} of the {name} goes {far} to where its closed chain leans on a stop."
            notes = notes | {name: f"{notes.get(name, '')} {said}".strip()}
    return found[0], found[1], notes
