"""Feet of a standing robot: its default goal, the pose reached with minimum foot slip, and whether feet have to move.

A goal of leg joints leaves the position of the trunk open, and a trunk that stays would drag the feet. At rest on level
ground horizontal displacements are free, so the goal pose is displaced by the dq of the unactuated degrees of freedom
that minimizes sum_k f_k |J_k dq|^2 without lifting or tilting links in contact: f_k are the normal forces at rest, J_k
dq the slip of contact k, with J_k at the midpoint of start and goal.
"""

from __future__ import annotations

import numpy as np

from planner.dynamics.algorithms import mass_matrix
from planner.dynamics.contacts import contact_forces, contact_jacobians
from planner.dynamics.statics import along_ground
from planner.model.capabilities import rolling_radii, unactuated_basis
from planner.model.mechanism import Mechanism

TURNS = 5  # largest number of iterations of the midpoint Jacobian
POSE_TOLERANCE = 1e-9  # m or rad, largest change of the goal at convergence
STRIDE = 0.05  # m: feet that slip or rise by less on the way roll or deform, and need not leave the ground
RANK = 1e-6  # relative to the largest singular value: rank tolerance of the contact Jacobian


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

    Along the ground it is the slip J dq, which is zero where the foot rolls; away from it the distance.
    """
    space, nq, nv = mechanism.space, mechanism.nq, mechanism.nv
    xs = np.hstack([qs, np.zeros((len(qs), space.nx - nq))])
    states = contact_forces(mechanism, qs, np.zeros((len(qs), nv)))
    carry = np.flatnonzero(states.forces[0].any(axis=1))
    slip = np.zeros((len(carry), 3))
    for k in range(1, len(qs)):
        if not carry.size or np.any(states.depths[k, carry] < -STRIDE):
            break
        way = space.difference(xs[k], xs[k - 1])
        J = contact_jacobians(mechanism, space.integrate(xs[k - 1], 0.5 * way)[:nq], carry)
        n = np.array([mechanism.contacts[c].plane.normal for c in carry])
        shift = J @ way[:nv]
        slip += shift - n * np.einsum("ka,ka->k", n, shift)[:, None]
        if np.linalg.norm(slip, axis=1).max() > STRIDE:
            break
    else:
        return False
    return bool(carry.size)


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
        while (i := int(mechanism.parent[i])) >= 0:
            found[i] = True
    return found


def contact_stiffness(mechanism: Mechanism, q: np.ndarray) -> np.ndarray:
    """(nv,) N/m or N m/rad of the loaded contacts at q (nq,), as each degree of freedom feels it: sum_k K_k |J_k|^2."""
    loads = np.linalg.norm(contact_forces(mechanism, q, np.zeros(mechanism.nv)).forces, axis=1)
    carry = np.flatnonzero(loads)
    if not carry.size:
        return np.zeros(mechanism.nv)
    K = np.array([loads[k] / mechanism.contacts[k].law.rest_depth(float(loads[k])) for k in carry])
    return np.einsum("k,kaj->j", K, contact_jacobians(mechanism, q, carry) ** 2)


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
