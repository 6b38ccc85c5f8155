"""Where a machine ends that stands, when nobody says: where feet that do not slide carry it.

Who asks legs to bend seldom says where the trunk goes, and a trunk that is to stay while its legs swing would have to
drag its feet. Along the ground a machine at rest may stand anywhere, so among these places the goal takes the one to
which its feet roll, or slide least: of all motions of what no actuator drives that neither lift nor tilt what touches,
the one with the least sum of f |J dq|^2, f the normal forces at rest and J dq how far each contact slides, J taken
midway.
"""

from __future__ import annotations

import numpy as np

from planner.dynamics.algorithms import mass_matrix
from planner.dynamics.contacts import contact_forces, contact_jacobians
from planner.dynamics.statics import along_ground
from planner.model.capabilities import unactuated_basis
from planner.model.mechanism import Mechanism

TURNS = 5  # of taking J midway again; each is nearer by the square of the way
POSE_TOLERANCE = 1e-9  # m or rad
RANK = 1e-6  # of the largest: what feet leave free


def goal_without_foot_slip(mechanism: Mechanism, start: np.ndarray, goal: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """The goal (nx,) moved along the ground to where its feet slide least on the way from the start (nx,).

    Args:
        mechanism: With contacts; start and goal are at rest on the ground.
        start: (nx,).
        goal: (nx,), at the right height.
        kept: (nv,) which degrees of freedom stay as they are in the goal, because somebody asked for them.

    Returns:
        (nx,), the goal itself where nothing may move or nothing carries the machine at both ends.
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


def stance_inertia(mechanism: Mechanism, q: np.ndarray) -> np.ndarray:
    """The inertia (nv,) that each degree of freedom moves while what carries the machine at q (nq,) stays in place.

    kg m^2 or kg: 1 / A_ii of A = Z (Z' M Z)^-1 Z', Z a basis of the velocities with J Z = 0. An ankle in the air moves
    a foot, and on the ground all that stands on it. 0 where nothing carries it, or the feet leave it no motion.
    """
    still = np.zeros(mechanism.nv)
    carry = np.flatnonzero(contact_forces(mechanism, q, still).forces.any(axis=1))
    if not carry.size:
        return still
    _, sizes, rows = np.linalg.svd(contact_jacobians(mechanism, q, carry).reshape(-1, mechanism.nv))
    Z = rows[int(np.sum(sizes > RANK * sizes.max(initial=0.0))) :].T
    A = np.diagonal(Z @ np.linalg.solve(Z.T @ mass_matrix(mechanism, q) @ Z, Z.T))
    return np.divide(1.0, A, out=still, where=np.linalg.norm(Z, axis=1) > RANK)
