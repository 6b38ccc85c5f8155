"""States of a problem file: a keyframe, numbers, or a table of joints, closed where joints depend on each other."""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.base.arguments import array, did_you_mean, short_repr
from planner.base.errors import PlannerError
from planner.dynamics.assembly import assembled, with_joints
from planner.dynamics.rigid_body import RigidBodyDynamics
from planner.model.capabilities import floating_dofs
from planner.model.coordinates import coordinates_of_mechanism
from planner.model.couplings import CLOSED, check_closed
from planner.model.mechanism import Mechanism
from planner.model.mjcf.prescribed_joints import prescribed_dofs_of
from planner.problem.costs.tracking import states

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
