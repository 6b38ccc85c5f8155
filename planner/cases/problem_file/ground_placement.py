"""Start and goal of a problem file on the ground: for settle = true, or where settle = "auto" finds that they stand."""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.base.arguments import short_repr
from planner.base.errors import PlannerError
from planner.dynamics.stance import goal_without_foot_slip
from planner.dynamics.statics import lowered_to_ground, static_equilibrium
from planner.model.mechanism import Mechanism

MAX_PLACEMENT_SHIFT = 0.05  # m or rad: who writes a pose puts feet down to some centimetres
SAME_POSE_TOLERANCE = 1e-6  # m or rad: poses at rest are found as exactly as forces balance


def place_on_ground(
    mechanism: Mechanism, table: dict[str, Any], start: np.ndarray, goal: np.ndarray
) -> tuple[np.ndarray, np.ndarray, dict[str, str]]:
    """Start and goal (nx,) as they are planned, and by these names a sentence about what was done to each.

    With settle = "auto" and a law of the ground, what is at rest is put down from any height, and a sentence says so:
    files let machines fall from a little above. A pose that does not balance is put down as it is.

    Raises:
        PlannerError: settle is none of true, false and "auto"; true, and a pose does not stay on the ground.
    """
    settle = table["settle"]
    if not (isinstance(settle, bool) or settle == "auto"):
        raise PlannerError(f"settle is {short_repr(settle)}, expected true, false or 'auto'.")
    if settle is True:
        return _settled("start", start, mechanism), _settled("goal", goal, mechanism), {}
    if settle is False or table["contacts"] != "ground" or not mechanism.contacts:
        return start, goal, {}
    asked = np.abs(mechanism.space.difference(goal, start)[: mechanism.nv]) > SAME_POSE_TOLERANCE
    start, note = _lower_to_ground("start", start, mechanism)
    goal, other = _lower_to_ground("goal", goal, mechanism)
    there = goal_without_foot_slip(mechanism, start, goal, asked)
    way = float(np.abs(mechanism.space.difference(there, goal)).max())
    if way > MAX_PLACEMENT_SHIFT:
        other += f" goal goes {way:.2g} m or rad along the ground, where feet that do not slide carry it."
    goal = there
    if np.abs(mechanism.space.difference(goal, start)).max() < SAME_POSE_TOLERANCE:
        goal = start.copy()
    return start, goal, {name: said for name, said in (("start", note), ("goal", other)) if said}


def _settled(name: str, x: np.ndarray, mechanism: Mechanism) -> np.ndarray:
    try:
        return static_equilibrium(mechanism, x)
    except PlannerError as error:
        raise PlannerError(f"settle of {name}: {error}") from None


def _lower_to_ground(name: str, x: np.ndarray, mechanism: Mechanism) -> tuple[np.ndarray, str]:
    """The state on the ground, or as it is, and a sentence about it; "" where there is nothing to say."""
    if np.any(x[mechanism.nq : mechanism.nq + mechanism.nv]):
        return x, f"{name} is not put on the ground, since it moves."
    try:
        there = static_equilibrium(mechanism, x)
    except PlannerError as error:
        return lowered_to_ground(
            mechanism, x
        ), f"{name} is put on the ground, where it does not balance by itself: {error}"
    way = float(np.abs(mechanism.space.difference(there, x)).max())
    said = f"{name} is put on the ground, {way:.2g} m or rad from what was asked; settle = false leaves it there."
    return there, said if way > MAX_PLACEMENT_SHIFT else ""
