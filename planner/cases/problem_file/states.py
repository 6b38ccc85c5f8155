"""Start and goal of a problem file: as states, put down on the ground, off the stops of joints or at rest on them.

A state is a keyframe, numbers, or a table of joints, closed where joints depend on each other. It is put down for
settle = true, or where settle = "auto" finds that the machine stands; then the contacts' ramp is chosen too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from planner.base.arguments import array, did_you_mean, short_repr
from planner.base.errors import PlannerError
from planner.cases.problem_file.keys import RAMP, RESOLVED
from planner.dynamics.assembly import assembled, with_joints
from planner.dynamics.contacts import contact_forces
from planner.dynamics.rest_on_stops import rest_on_stops
from planner.dynamics.rigid_body import RigidBodyDynamics
from planner.dynamics.statics import (
    NEAR_GROUND,
    feet_move,
    goal_without_foot_slip,
    lowered_to_ground,
    static_equilibrium,
    stays_in_air,
)
from planner.model.capabilities import floating_dofs, stands_on_ground
from planner.model.contact.laws import ContactLaw
from planner.model.coordinates import coordinates_of_mechanism
from planner.model.couplings import CLOSED, check_closed
from planner.model.mechanism import Mechanism
from planner.model.mjcf.contact_mode import STANDING
from planner.model.mjcf.prescribed_joints import prescribed_dofs_of
from planner.problem.costs.tracking import states
from planner.problem.joint_limits import moved_inside_limits
from planner.problem.tasks.goal import Goal, json_value

MOVED = 1e-3  # rad or m: to close chains a start or a goal may move so far without a word
SOFT = 0.02  # rad or m, a goal's own tolerance: numbers and keyframes that nearly keep a coupling are put on it
HOME = "home"  # of a model without a keyframe of that name: the pose in which its file draws it, Mechanism.home


def states_of(mechanism: Mechanism, as_drawn: bool = True) -> str:
    """The forms of a start or a goal, for a message; `as_drawn`: also the pose in which the file draws the machine."""
    nq, nv = mechanism.nq, mechanism.nv
    keyframes = f"a keyframe ({', '.join(mechanism.keyframes)}), " if mechanism.keyframes else ""
    home = f"{HOME!r} (as the file draws it), " if as_drawn and HOME not in mechanism.keyframes else ""
    joints = ", ".join(name for name in mechanism.joint_names if name) or "but no joint has a name"
    return f"{keyframes}{home}{nq} or {nq + nv} numbers (positions, velocities), or a table of joints ({joints})"


def state_of(
    name: str, value: Any, mechanism: Mechanism, base: np.ndarray, notes: list[str] | None = None
) -> np.ndarray:
    """The state (nx,) of a keyframe, of positions (and velocities), or of `base` with some joints changed.

    Coordinates that follow others are where these put them: a table need not name them, and numbers, or a keyframe
    that a soft simulator has left, are nearly there. Closed chains are closed by least squares; where that moves a
    whole pose by more than MOVED a sentence is added to the notes.
    """
    nq, nv = mechanism.nq, mechanism.nv
    if isinstance(value, dict):
        return states(name, with_joints(name, value, mechanism, base), mechanism.space, ())
    x, most = base.copy(), CLOSED
    if isinstance(value, str):
        poses = {HOME: mechanism.home} | mechanism.keyframes
        if value not in poses:
            hint = did_you_mean(value, poses)
            raise PlannerError(f"{name} is {short_repr(value)}, expected {states_of(mechanism)}.{hint}")
        x, most = poses[value].copy(), SOFT
    elif isinstance(value, list) and not any(isinstance(part, (list, dict)) for part in value):
        if len(value) not in (nq, nq + nv, len(x)):
            raise PlannerError(f"{name} has {len(value)} numbers, expected {states_of(mechanism)}.")
        x[nq:] = 0.0
        x[: len(value)], most = array(name, value, ("n",)), SOFT
    else:
        raise PlannerError(f"{name} is {short_repr(value)}, expected {states_of(mechanism)}.")
    check_closed(name, x, mechanism, most)
    told, x = x, assembled(mechanism, x, name=name)
    moved = mechanism.space.difference(x, states(name, told, mechanism.space, ()))[:nv]
    if notes is not None and mechanism.has_closed_chains and np.abs(moved).max() > MOVED:
        most = int(np.argmax(np.abs(moved)))
        place = coordinates_of_mechanism(mechanism)[most]
        notes.append(f"{name} is moved so that its chains close, {place.name} by {moved[most]:.3g} {place.unit}.")
    return states(name, x, mechanism.space, ())


def carried_along(goal: Any, dynamics: RigidBodyDynamics) -> np.ndarray:
    """(nv,) bool, bases that a table of joints does not name, and that nothing holds or drives."""
    mechanism = dynamics.mechanism
    if not isinstance(goal, dict):
        return np.zeros(mechanism.nv, dtype=bool)
    found = floating_dofs(mechanism)
    found[prescribed_dofs_of(dynamics)] = False
    for name in goal:
        found[mechanism.joint(name)] = False
    return found


STANCE_RAMP = 6e-5
"""m. MuJoCo has no ramp: with the usual 0.6 mm of the ground's law, points of a foot that bear little tilt ankles of
humanoids by 2 mrad, more than passes where joints move by less than 0.1 rad. Feet that have to move want the long one,
for the gradient where they land and lift: with 0.06 mm for all, 13 of 20 tasks of benchmarks/moving.py passed, 16 with
the long one."""
SAME_POSE_TOLERANCE = 1e-6  # m or rad: poses at rest are found as exactly as forces balance


def placed(
    mechanism: Mechanism, table: dict[str, Any], x0: np.ndarray, goal: np.ndarray
) -> tuple[np.ndarray, np.ndarray, dict[str, str], tuple[str, ...]]:
    """Start and goal on the ground, off the stops of joints or at rest on them; notes on each of them, and on stops."""
    x0, goal, notes = place_on_ground(mechanism, table, x0, goal)
    x0, goal, stops = off_stops(mechanism, table, x0, goal)
    return *at_rest_on_stops(mechanism, table, x0, goal, notes), stops


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
