"""Controls that hold a machine at rest, and the equilibrium nearest to a state.

At rest the bias force of a pose (gravity and springs) is that of actuators, contacts and stops together,

    bias(q, 0) = B u + b(q) + sum_k J_k' f_k + stops,

with B u + b(q) the forces of actuators under controls u. Dynamics of any kind have an equilibrium where x = f(x, u).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.base.arguments import array, short_repr
from planner.base.errors import PlannerError
from planner.dynamics.algorithms import bias
from planner.dynamics.assembly import feasible_directions, tangent_basis
from planner.dynamics.contacts import contact_forces, contact_jacobians, generalized_forces
from planner.model.actuators import INTEGRATOR
from planner.model.capabilities import capabilities_of
from planner.model.mechanism import SCREW, Mechanism
from planner.model.mjcf.prescribed_joints import prescribed_dofs_of
from planner.model.space import space_of

FORCE_FIT_WEIGHT = 1e-3  # weight of "each contact force is that of the contact law", beside 1 for holding the pose
_RANK_TOLERANCE = 1e-10  # of the largest singular value: controls that change nothing
_CONVERGED = 1e-12  # largest entry of a Newton step, in each coordinate's unit


def quasi_static_controls(dynamics: Any, x: Any, *, contacts: bool = True, keep_activations: bool = True) -> np.ndarray:
    """Controls that hold a pose against gravity and springs, as far as the actuators can: the smallest such controls.

    Joints without an actuator are left to themselves, and prescribed joints get zero acceleration. Contacts near the
    ground carry the machine as far as they can, within their cones of friction.

    Args:
        dynamics: RigidBodyDynamics, or a Mechanism.
        x: (nq,) pose, or (nx,) state, of which positions and activations count.
        contacts: Whether the ground carries what it can. Without, the actuators hold the machine in the air.
        keep_activations: Whether an actuator that integrates its control stays at its activation, with control 0. If
            not, its entry of the result is the activation that holds the pose.

    Returns:
        (nu,) controls of the dynamics, or of the mechanism.

    Raises:
        PlannerError: Dynamics without a mechanism, or a wrong shape.
    """
    mechanism = dynamics if isinstance(dynamics, Mechanism) else capabilities_of(dynamics).mechanism
    if mechanism is None:
        raise PlannerError(f"dynamics is {short_repr(dynamics)}, expected RigidBodyDynamics or a Mechanism.")
    nq, nv, actuators = mechanism.nq, mechanism.nv, mechanism.actuators
    x = array("x", x, (nq if np.shape(x) == (nq,) else mechanism.space.nx,))
    q, act = x[:nq], np.append(x[nq + nv :], np.zeros(mechanism.na))
    fixed = actuators.dynamics == INTEGRATOR if keep_activations else np.zeros(mechanism.nu, dtype=bool)
    force = actuators.bias[:, 0] + actuators.bias[:, 1] * actuator_lengths(mechanism, q)
    force[fixed] += actuators.gain[fixed] * act[actuators.activation[fixed]]
    missing = bias(mechanism, q, np.zeros(nv)) - actuators.moment.T @ force
    reach = actuators.moment.T * np.where(fixed, 0.0, actuators.gain)
    prescribed = prescribed_dofs_of(dynamics)
    Z = feasible_directions(mechanism, q)[0]  # couplings and closed chains give what they must
    if len(prescribed):
        Z = Z.copy()
        Z[prescribed] = 0.0  # their forces are whatever their accelerations need
    if mechanism.contacts and contacts:
        u = _supported_controls(mechanism, q, reach, missing, Z)
    else:
        u = np.linalg.lstsq(Z.T @ reach, Z.T @ missing, rcond=None)[0]
    return np.append(u, np.zeros(len(prescribed)))


def actuator_lengths(mechanism: Mechanism, q: np.ndarray) -> np.ndarray:
    """(..., nu) lengths of actuators at poses q (..., nq), m and rad: over hinges and slides alone."""
    screws = np.zeros((mechanism.nu, mechanism.nq))
    for i in range(mechanism.nv):
        if mechanism.kind[i] == SCREW:
            screws[:, mechanism.q_address[i]] += mechanism.actuators.moment[:, i]
    return q @ screws.T


def _supported_controls(
    mechanism: Mechanism, q: np.ndarray, reach: np.ndarray, tau: np.ndarray, Z: np.ndarray
) -> np.ndarray:
    """Controls (nu,) that together with the ground give a generalized force; least squares where they cannot.

    A contact near the ground pushes with nonnegative multiples of the edges of its friction cone (a pyramid of four).
    Of several solutions the one whose contact forces are nearest to those of the contact law at this depth.

    Args:
        mechanism: With contacts.
        q: (nq,) pose.
        reach: (nv, nu) generalized forces per control.
        tau: (nv,) generalized force that controls, contacts and stops give together.
        Z: (nv, n) directions in which forces are to be in balance.
    """
    from scipy.optimize import lsq_linear

    still, nu = np.zeros(mechanism.nv), reach.shape[1]
    law = contact_forces(mechanism, q, still)
    near = np.flatnonzero(law.depths > [-weight(mechanism) / c.law.stiffness for c in mechanism.contacts])
    J, pushing = contact_jacobians(mechanism, q, near), np.flatnonzero(law.forces.any(axis=1))
    pushed = np.einsum("kaj,ka->j", contact_jacobians(mechanism, q, pushing), law.forces[pushing])
    tau = tau - generalized_forces(mechanism, q, still) + pushed  # less stops
    edges = [_cone_edges(mechanism.contacts[k]) for k in near]
    columns = np.hstack([reach, *(Jk.T @ edge for Jk, edge in zip(J, edges, strict=True))])
    rows, wanted, at = [Z.T @ columns], [Z.T @ tau], nu
    for k, edge in zip(near, edges, strict=True):
        row = np.zeros((3, columns.shape[1]))
        row[:, at : at + edge.shape[1]] = FORCE_FIT_WEIGHT * edge
        rows.append(row)
        wanted.append(FORCE_FIT_WEIGHT * law.forces[k])
        at += edge.shape[1]
    lower = np.where(np.arange(at) < nu, -np.inf, 0.0)
    return lsq_linear(np.vstack(rows), np.concatenate(wanted), (lower, np.inf), method="bvls").x[:nu]


def _cone_edges(contact: Any) -> np.ndarray:
    """(3, 1 or 4) edges of the friction cone: contact forces at rest are their nonnegative combinations."""
    n = contact.plane.normal
    if contact.law.friction == 0.0:
        return n[:, None]
    across = np.linalg.svd(n[None])[2][1:]
    return np.array([n + side * contact.law.friction * t for t in across for side in (-1.0, 1.0)]).T


def weight(mechanism: Mechanism) -> float:
    """The weight of all bodies, N."""
    return float(mechanism.mass.sum() * np.linalg.norm(mechanism.gravity))


def equilibrium(
    dynamics: Any, x: np.ndarray, u: np.ndarray, free: np.ndarray | None = None, *,
    iterations: int = 20, tolerance: float = 0.0,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """State and control at which a step of any dynamics changes nothing, x = f(x, u), by Gauss-Newton from x and u.

    Where no such control exists, the result is the last iterate of least squares.

    Args:
        dynamics: Any.
        x: (nx,) state.
        u: (nu,) first control.
        free: (ndx,) bool, coordinates of x that may change, along couplings and closed chains; None for none.
        iterations: The largest number of Newton steps.
        tolerance: Drift in one stage, in each coordinate's unit, at which it stops.

    Returns:
        x (nx,) and u (nu,).
    """
    space = space_of(dynamics)
    free = np.zeros(space.ndx, dtype=bool) if free is None else free
    for _ in range(iterations):
        drift = space.difference(dynamics.step(x[None], u[None])[0], x)
        if np.abs(drift).max() <= tolerance:
            break
        A, B = (part[0] for part in dynamics.linearize(np.stack([x, x]), u[None]))
        T, places = state_directions(dynamics, x) if free.any() else (np.zeros((space.ndx, 0)), np.zeros(0, dtype=int))
        T = T[:, free[places]]
        J = np.concatenate([(A - np.eye(len(A))) @ T, B], axis=1)
        if not (np.isfinite(J).all() and np.isfinite(drift).all()):
            break
        step = np.linalg.lstsq(J, -drift, rcond=_RANK_TOLERANCE)[0]
        if not np.isfinite(step).all():
            break
        x, u = space.integrate(x, T @ step[: T.shape[1]]), u + step[T.shape[1] :]
        if np.abs(step).max(initial=0.0) < _CONVERGED:
            break
    return x, u


def state_directions(dynamics: Any, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Directions T (ndx, n) that couplings and closed chains leave to a state x (nx,): dx = T dx[places].

    Returns:
        T, and places (n,) at which T is the identity. The identity and all places for dynamics without a mechanism, or
        whose state holds more than the mechanism's.
    """
    mechanism, ndx = capabilities_of(dynamics).mechanism, space_of(dynamics).ndx
    if mechanism is None or mechanism.space.ndx != ndx:
        return np.eye(ndx), np.arange(ndx)
    return tangent_basis(mechanism, x)
