"""Start and goal of a problem file on the ground: for settle = true, or where settle = "auto" finds that they stand.

And how far its contacts are smoothed for a motion on feet that stay.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from planner.base.arguments import short_repr
from planner.base.errors import PlannerError
from planner.cases.problem_file.keys import RAMP, RESOLVED
from planner.cases.problem_file.states import state_of
from planner.dynamics.contacts import contact_forces
from planner.dynamics.statics import (
    NEAR_GROUND,
    feet_move,
    goal_without_foot_slip,
    lowered_to_ground,
    static_equilibrium,
    stays_in_air,
)
from planner.model.contact.laws import ContactLaw
from planner.model.mechanism import Mechanism
from planner.model.mjcf.contact_mode import STANDING
from planner.problem.tasks.goal import Goal, json_value

STANCE_RAMP = 6e-5
"""m. MuJoCo has no ramp: with the usual 0.6 mm of the ground's law, points of a foot that bear little tilt ankles of
humanoids by 2 mrad, more than passes where joints move by less than 0.1 rad. Feet that have to move want the long one,
for the gradient where they land and lift: with 0.06 mm for all, 13 of 20 tasks of benchmarks/moving.py passed, 16 with
the long one."""
SAME_POSE_TOLERANCE = 1e-6  # m or rad: poses at rest are found as exactly as forces balance


def place_on_ground(
    mechanism: Mechanism, table: dict[str, Any], start: np.ndarray, goal: np.ndarray
) -> tuple[np.ndarray, np.ndarray, dict[str, str]]:
    """Start and goal (nx,) as they are planned, and by these names a sentence about what was done to each.

    With settle = "auto" and a law of the ground, what is at rest is put down from any height, and a sentence says so:
    files let machines fall from a little above. A pose that does not balance is put down as it is, and so is one that
    is tilted on purpose, of a machine that balances upright; thrusters keep a machine that they can carry in the air.

    Raises:
        PlannerError: settle is none of true, false and "auto"; true, and a pose does not stay on the ground.
    """
    settle = table["settle"]
    if not (isinstance(settle, bool) or settle == "auto"):
        raise PlannerError(f"settle is {short_repr(settle)}, expected true, false or 'auto'.")
    if settle is True:
        return _settled("start", start, mechanism), _settled("goal", goal, mechanism), {}
    if not _puts_down(mechanism, table):
        return start, goal, {}
    asked = np.abs(mechanism.space.difference(goal, start)[: mechanism.nv]) > SAME_POSE_TOLERANCE
    asked |= _named_in(table.get("goal"), mechanism)
    start, note = _lower_to_ground("start", start, mechanism)
    goal, other = _lower_to_ground("goal", goal, mechanism)
    there = goal_without_foot_slip(mechanism, start, goal, asked)
    way = float(np.abs(mechanism.space.difference(there, goal)).max())
    if way > NEAR_GROUND:
        other += f" goal goes {way:.2g} m or rad along the ground, where feet that do not slide carry it."
    goal = there
    if np.abs(mechanism.space.difference(goal, start)).max() < SAME_POSE_TOLERANCE:
        goal = start.copy()
    return start, goal, {name: said for name, said in (("start", note), ("goal", other)) if said}


def whole_poses_on_ground(mechanism: Mechanism, table: dict[str, Any], goals: Sequence[Goal]) -> list[Goal]:
    """Goals as they are planned: whole poses at rest, of a keyframe or of all positions, put on the ground."""
    if not _puts_down(mechanism, table):
        return list(goals)
    return [_goal_on_ground(mechanism, goal) for goal in goals]


def stance_ramp(mechanism: Mechanism, table: dict[str, Any], start: np.ndarray, goal: np.ndarray) -> float | None:
    """The ramp of contacts with the ground, m, where feet of several points stay from the start to the goal (nx,).

    None to keep the law's.
    """
    if RESOLVED in table:  # a plan keeps the law that it was made with
        return table[RESOLVED].get(RAMP)
    qs = np.stack([start, goal])[:, : mechanism.nq]
    if table["contacts"] not in STANDING or not mechanism.contacts or feet_move(mechanism, qs):
        return None
    loaded = contact_forces(mechanism, qs[0], np.zeros(mechanism.nv)).forces.any(axis=1)
    _, points = np.unique([mechanism.contacts[k].link for k in np.flatnonzero(loaded)], return_counts=True)
    return STANCE_RAMP if np.any(points > 1) else None  # a foot that is a ball does not tilt in its ramp


def with_ramp(mechanism: Mechanism, ramp: float | None) -> Mechanism:
    """The machine with contacts smoothed over at most a ramp, m, the ramps of their forces in proportion."""
    if ramp is None:
        return mechanism

    def sharper(law: ContactLaw) -> ContactLaw:
        share = min(1.0, ramp / law.ramp) if law.ramp > 0.0 else 1.0
        return replace(law, ramp=share * law.ramp, force_ramp=share * float(law.force_ramp or 0.0))

    return replace(mechanism, contacts=tuple(replace(one, law=sharper(one.law)) for one in mechanism.contacts))


def _puts_down(mechanism: Mechanism, table: dict[str, Any]) -> bool:
    """Whether poses at rest are put on the ground without being asked to."""
    return table["settle"] is not False and table["contacts"] in STANDING and bool(mechanism.contacts)


def _goal_on_ground(mechanism: Mechanism, goal: Goal) -> Goal:
    if goal.through or goal.joints is None or isinstance(goal.joints, Mapping):
        return goal
    x = state_of("joints of a goal", json_value(goal.joints), mechanism, mechanism.home)
    x[mechanism.nq :] = 0.0
    there, _ = _lower_to_ground("goal", x, mechanism)
    return replace(goal, joints=there[: mechanism.nq])


def _named_in(goal: Any, mechanism: Mechanism) -> np.ndarray:
    """(nv,) bool, what a table of joints names, equal to the start or not; none of a keyframe or of numbers."""
    found = np.zeros(mechanism.nv, dtype=bool)
    for name in goal if isinstance(goal, Mapping) else ():
        found[mechanism.joint(name)] = True
    return found


def _settled(name: str, x: np.ndarray, mechanism: Mechanism) -> np.ndarray:
    try:
        return static_equilibrium(mechanism, x)
    except PlannerError as error:
        raise PlannerError(f"settle of {name}: {error}") from None


def _lower_to_ground(name: str, x: np.ndarray, mechanism: Mechanism) -> tuple[np.ndarray, str]:
    """The state on the ground, or as it is, and a sentence about it; "" where there is nothing to say."""
    if np.any(x[mechanism.velocities]):
        return x, f"{name} is not put on the ground, since it moves."
    if stays_in_air(mechanism, x):
        return x, f"{name} is not put on the ground, since thrusters carry it in the air."
    turned = np.abs(mechanism.space.difference(x, mechanism.home)[: mechanism.nv]) > SAME_POSE_TOLERANCE
    try:
        there = static_equilibrium(mechanism, x, turned & np.any(mechanism.S[:, :3] != 0.0, axis=1))
    except PlannerError as error:
        return lowered_to_ground(
            mechanism, x
        ), f"{name} is put on the ground, where it does not balance by itself: {error}"
    way = float(np.abs(mechanism.space.difference(there, x)).max())
    said = f"{name} is put on the ground, {way:.2g} m or rad from what was asked; settle = false leaves it there."
    return there, said if way > NEAR_GROUND else ""
