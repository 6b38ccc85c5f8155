"""Static equilibrium of a machine on the ground, and its feet: the goal without slip, and whether they have to move.

At rest the bias force of a pose (gravity and springs) is that of actuators, contacts and stops together,

    bias(q, 0) = B u + sum_k J_k' f_k + stops,

where the contact law of model.contact.laws gives f_k by the penetration of contact k. `static_equilibrium` moves the
unactuated degrees of freedom, with the actuated joints fixed and thrusters off, by descent in potential energy until
their equations hold; where the machine falls that way it looks for a saddle of the energy, on which it can balance.
planner.dynamics.quasi_static computes the controls u.

A goal of leg joints leaves the position of the trunk open, and a trunk that stays would drag the feet. At rest on level
ground horizontal displacements are free, so the goal pose is displaced by the dq of the unactuated degrees of freedom
that minimizes sum_k f_k |J_k dq|^2 without lifting or tilting links in contact: f_k are the normal forces at rest, J_k
dq the slip of contact k, with J_k at the midpoint of start and goal.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.base.arguments import array
from planner.base.errors import PlannerError
from planner.dynamics.algorithms import mass_matrix
from planner.dynamics.contacts import contact_forces, contact_jacobians
from planner.dynamics.kinematics import center_of_mass
from planner.dynamics.quasi_static import carried_by_thrusters
from planner.dynamics.resting_poses import along_ground, extended, minimum_of_energy, saddle_of_energy
from planner.kernels.tree.mechanism_table import chain_of
from planner.model.capabilities import rolling_radii, roots, stands_on_ground, unactuated_basis
from planner.model.coordinates import coordinates_of_mechanism
from planner.model.mechanism import Mechanism

RANK = 1e-6  # relative to the largest singular value: of contact Jacobians
KEPT = 0.01  # m or rad: what a pose asks for to that, a machine that balances there does not change
NEAR_GROUND = 0.05  # m: who writes a pose puts feet down to some centimetres
MANY = 20  # largest number of contacts of a tree that determine its vertical displacement
UPWARDS = 0.8  # cosine of a plane's normal to the vertical: planes below it are walls
TURNS = 5  # largest number of iterations of the midpoint Jacobian
POSE_TOLERANCE = 1e-9  # m or rad, largest change of the goal at convergence
ON_AXIS = 0.01  # of the largest distance of contacts from an axis: those nearer to theirs resist no turn about it
STRIDE = 0.05  # m: feet that slip or rise by less on the way roll or deform, and need not leave the ground


def static_equilibrium(mechanism: Mechanism, x: Any, kept: np.ndarray | None = None) -> np.ndarray:
    """The rest state on the ground near a pose, with the actuated joints unchanged.

    Unactuated degrees of freedom (a free base, a passive joint) descend in potential energy from the height at which
    the lowest contact bears the weight; they are not displaced along the ground. A machine that falls that way, as on
    point feet or two wheels, is put where it balances: there forces are zero as well, and a small push tips it.

    Args:
        mechanism: A mechanism with contacts.
        x: (nx,) state or (nq,) pose; velocities are set to zero, activations are unchanged.
        kept: (nv,) bool, degrees of freedom that a machine that would tip has as they are asked for; None for none.

    Returns:
        (nx,).

    Raises:
        PlannerError: There are no contacts or no unactuated joints, or the pose falls over.
    """
    space, nq, nv = mechanism.space, mechanism.nq, mechanism.nv
    x = np.array(x, dtype=float) if np.shape(x) == (space.nx,) else np.concatenate(
        [array("x", x, (nq,)), np.zeros(space.nx - nq)]
    )  # fmt: skip
    x = mechanism.at_rest(array("x", x, (space.nx,)))
    if not mechanism.contacts:
        raise PlannerError(
            "the mechanism has no contacts, expected some: Mechanism.from_mjcf(..., contacts=ContactLaw(...))."
        )
    free = unactuated_basis(mechanism)
    if not free.shape[1]:
        raise PlannerError("every joint is driven, expected some that are not: the ground carries nothing here.")
    start = lowered_to_ground(mechanism, x)
    there, rests = minimum_of_energy(mechanism, start, free)
    if rests:
        return there
    there, balances = saddle_of_energy(mechanism, start, free)
    way = np.abs(mechanism.space.difference(there, x)[:nv])
    if balances and (kept is None or way[kept].max(initial=0.0) < KEPT):
        return there
    ground = contact_forces(mechanism, start[:nq], np.zeros(nv))
    centre, lowest = center_of_mass(mechanism, start[:nq]), ground.points[np.argsort(-ground.depths)[:2]]
    raise PlannerError(
        f"the pose does not stay on the ground: its centre of mass is at {_at(centre)} and its lowest contacts at "
        f"{_at(lowest[0])} and {_at(lowest[-1])} (x, y in m), expected driven joints that bring it over them."
    )


def lowered_to_ground(mechanism: Mechanism, x: np.ndarray) -> np.ndarray:
    """A state (nx,) displaced along the ground normals until each tree's lowest contact alone bears the tree's weight.

    Raises:
        PlannerError: No tree with contacts can be displaced vertically as a whole.
    """
    q, free, root = x[: mechanism.nq], unactuated_basis(mechanism), roots(mechanism)
    g = float(np.linalg.norm(mechanism.gravity))
    normals = np.array([contact.plane.normal for contact in mechanism.contacts])
    up = -mechanism.gravity / g if g > 0.0 else np.zeros(3)
    links = np.array([contact.link for contact in mechanism.contacts])
    grounds = normals @ up > UPWARDS if np.any(normals @ up > UPWARDS) else np.ones(len(normals), dtype=bool)
    depths, moves = contact_forces(mechanism, q, np.zeros(mechanism.nv)).depths, 0
    for first in np.unique(root[links[grounds]]):
        own, ways = np.flatnonzero(grounds & (root[links] == first)), free[:, np.any(free[root == first], axis=0)]
        some = own[np.argsort(-depths[own])[:MANY]]
        rise = np.einsum("ka,kaj->kj", normals[some], contact_jacobians(mechanism, q, some)) @ ways
        along = np.linalg.lstsq(rise, np.ones(len(rise)), rcond=None)[0] if ways.shape[1] else np.zeros(0)
        if not np.allclose(rise @ along, 1.0, atol=1e-6):
            continue
        deepest = int(own[np.argmax(depths[own])])
        load = g * float(mechanism.mass[root == first].sum())
        way = depths[deepest] - mechanism.contacts[deepest].law.rest_depth(load)
        x, moves = mechanism.space.integrate(x, extended(ways @ (way * along), mechanism.space.ndx)), moves + 1
    if not moves:
        raise PlannerError("the machine cannot be lowered as a whole, expected a trunk on a slide or a free joint.")
    return x


def clearance(mechanism: Mechanism, x: np.ndarray) -> float:
    """Clearance of the lowest contact of a state (nx,) above the ground, m; infinite without contacts."""
    depths = contact_forces(mechanism, x[: mechanism.nq], np.zeros(mechanism.nv)).depths
    return -float(np.max(depths, initial=-np.inf))


def stays_in_air(mechanism: Mechanism, x: np.ndarray) -> bool:
    """Whether a state (nx,) at rest is one in the air, where thrusters can carry the machine."""
    return clearance(mechanism, x) > NEAR_GROUND and carried_by_thrusters(mechanism)


def stands_somewhere(mechanism: Mechanism, xs: np.ndarray) -> bool:
    """Whether the ground carries a machine at rest in some of the states (K, nx): not in those where thrusters do."""
    return stands_on_ground(mechanism) and not all(stays_in_air(mechanism, x) for x in xs)


def _at(place: np.ndarray) -> str:
    return f"({place[0]:.6g}, {place[1]:.6g})"


def goal_without_foot_slip(mechanism: Mechanism, start: np.ndarray, goal: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """The goal (nx,) displaced along the ground so that the feet slip least from the start (nx,).

    Args:
        mechanism: A mechanism with contacts; start and goal are at rest on the ground.
        start: (nx,) state.
        goal: (nx,) state, at its height of static equilibrium.
        kept: (nv,) bool, degrees of freedom that the user's goal specifies; they do not change.

    Returns:
        (nx,); the unchanged goal if no degree of freedom may change, or no contact bears load at start and goal.
    """
    space, nq, nv = mechanism.space, mechanism.nq, mechanism.nv
    still = np.zeros(nv)
    normals = np.array([contact.plane.normal for contact in mechanism.contacts])
    loads = [np.einsum("ka,ka->k", normals, contact_forces(mechanism, x[:nq], still).forces) for x in (start, goal)]
    carry = np.flatnonzero((loads[0] > 0.0) & (loads[1] > 0.0))
    free = unactuated_basis(mechanism)
    free = free[:, ~np.any(free[kept] != 0.0, axis=0)]
    if not carry.size or not free.shape[1]:
        return goal
    n, root = normals[carry], np.sqrt(loads[0][carry] + loads[1][carry])
    links = np.unique([mechanism.contacts[k].link for k in carry])
    for _ in range(TURNS):
        way = space.difference(goal, start)
        q = space.integrate(start, 0.5 * way)[:nq]
        J = contact_jacobians(mechanism, q, carry)
        along = free @ along_ground(mechanism, q, free, links)
        if not along.shape[1]:
            return goal
        slides = (J - n[:, :, None] * np.einsum("ka,kaj->kj", n, J)[:, None]) * root[:, None, None]
        slides = slides.reshape(-1, nv)
        part = np.linalg.lstsq(slides @ along, -slides @ way[:nv], rcond=1e-9)[0]
        step = np.zeros(space.ndx)
        step[:nv] = along @ part
        goal = space.integrate(goal, step)
        if np.abs(step).max() < POSE_TOLERANCE:
            break
    return goal


def feet_move(mechanism: Mechanism, qs: np.ndarray) -> bool:
    """Whether a foot that bears load at the first of configurations (E, nq) has moved by more than STRIDE at another.

    Along the ground it is the slip J dq, which is zero where the foot rolls; away from it the distance. Where none
    bears load at first, whether one does later: the machine lands.
    """
    space, nq, nv = mechanism.space, mechanism.nq, mechanism.nv
    xs = np.hstack([qs, np.zeros((len(qs), space.nx - nq))])
    states = contact_forces(mechanism, qs, np.zeros((len(qs), nv)))
    carry = np.flatnonzero(states.forces[0].any(axis=1))
    if not carry.size:
        return bool(states.forces.any())
    slip = np.zeros((len(carry), 3))
    for k in range(1, len(qs)):
        if np.any(states.depths[k, carry] < -STRIDE):
            return True
        way = space.difference(xs[k], xs[k - 1])
        J = contact_jacobians(mechanism, space.integrate(xs[k - 1], 0.5 * way)[:nq], carry)
        n = np.array([mechanism.contacts[c].plane.normal for c in carry])
        shift = J @ way[:nv]
        slip += shift - n * np.einsum("ka,ka->k", n, shift)[:, None]
        if np.linalg.norm(slip, axis=1).max() > STRIDE:
            return True
    return False


def rolling_dofs(mechanism: Mechanism, q: np.ndarray) -> np.ndarray:
    """(nv,) bool, degrees of freedom along the ground, not driven, of a machine that stands on wheels at q (nq,)."""
    found = np.zeros(mechanism.nv, dtype=bool)
    carry = contact_forces(mechanism, q, np.zeros(mechanism.nv)).forces.any(axis=1)
    links = np.unique([mechanism.contacts[k].link for k in np.flatnonzero(carry)])
    free = unactuated_basis(mechanism)
    if np.any(rolling_radii(mechanism)[links.astype(int)]) and free.shape[1]:
        found = np.any(np.abs(free @ along_ground(mechanism, q, free, links)) > RANK, axis=1)
    return found


def rolling_speeds(mechanism: Mechanism, q: np.ndarray, radii: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """(nv,) rad/s of wheels of radii (nv,) m, 0 of others, at q (nq,) on a machine that moves at speeds (nv,)."""
    found = np.zeros(mechanism.nv)
    for k, contact in enumerate(mechanism.contacts):
        if radii[contact.link] > 0.0:
            J = np.abs(contact_jacobians(mechanism, q, np.array([k]))[0])
            J[:, contact.link] = 0.0
            found[contact.link] = max(found[contact.link], float(np.linalg.norm(J @ speed)) / radii[contact.link])
    return found


def carriers(mechanism: Mechanism, links: np.ndarray) -> np.ndarray:
    """(nv,) bool, degrees of freedom between the base and some links (nv,) bool: those that steer wheels."""
    found = np.zeros(mechanism.nv, dtype=bool)
    for i in np.flatnonzero(links):
        found[chain_of(mechanism.parent, int(i))[1:]] = True
    return found


def contact_stiffness(mechanism: Mechanism, q: np.ndarray) -> np.ndarray:
    """(nv,) N/m or N m/rad of the loaded contacts at q (nq,), as each degree of freedom feels it: sum_k K_k |J_k|^2.

    0 where the contacts lie on its axis, to ON_AXIS: it turns on them freely.
    """
    loads = np.linalg.norm(contact_forces(mechanism, q, np.zeros(mechanism.nv)).forces, axis=1)
    carry = np.flatnonzero(loads)
    if not carry.size:
        return np.zeros(mechanism.nv)
    K = np.array([loads[k] / mechanism.contacts[k].law.rest_depth(float(loads[k])) for k in carry])
    found = np.einsum("k,kaj->j", K, contact_jacobians(mechanism, q, carry) ** 2)
    turns = np.array([one.unit == "rad" for one in coordinates_of_mechanism(mechanism)[: mechanism.nv]])
    farthest = np.where(turns, found[turns].max(initial=0.0), 0.0)
    return np.where(found > ON_AXIS**2 * farthest, found, 0.0)


def stance_inertia(mechanism: Mechanism, q: np.ndarray) -> np.ndarray:
    """Effective inertia (nv,) of each degree of freedom at q (nq,) with the loaded contacts fixed, kg m^2 or kg.

    1 / A_ii of A = Z (Z' M Z)^-1 Z', Z a basis of the velocities with J Z = 0: at an ankle, the foot in the air, but
    the whole robot on the ground. 0 without loaded contacts, or where the contacts allow no velocity.
    """
    still = np.zeros(mechanism.nv)
    carry = np.flatnonzero(contact_forces(mechanism, q, still).forces.any(axis=1))
    if not carry.size:
        return still
    _, sizes, rows = np.linalg.svd(contact_jacobians(mechanism, q, carry).reshape(-1, mechanism.nv))
    Z = rows[int(np.sum(sizes > RANK * sizes.max(initial=0.0))) :].T
    A = np.diagonal(Z @ np.linalg.solve(Z.T @ mass_matrix(mechanism, q) @ Z, Z.T))
    return np.divide(1.0, A, out=still, where=np.linalg.norm(Z, axis=1) > RANK)
