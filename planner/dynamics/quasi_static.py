"""Controls of static equilibrium, and an equilibrium close to a state.

At rest the bias force (gravity and springs) equals the sum of actuator, contact and stop forces,

    bias(q, 0) = B u + b(q) + sum_k J_k' f_k + stops,

with B u + b(q) the actuator forces under controls u. An equilibrium of any dynamics satisfies x = f(x, u).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.base.arguments import array, short_repr
from planner.base.errors import PlannerError
from planner.dynamics.algorithms import bias
from planner.dynamics.assembly import feasible_directions, tangent_basis
from planner.dynamics.contacts import contact_forces, contact_jacobians, generalized_forces
from planner.dynamics.joint_forces import actuator_lengths, actuator_moments, gains_at, passive_forces
from planner.model.actuators import INTEGRATOR
from planner.model.capabilities import capabilities_of, thrusters, unactuated_basis
from planner.model.mechanism import Mechanism
from planner.model.mjcf.prescribed_joints import prescribed_dofs_of
from planner.model.space import space_of

FORCE_FIT_WEIGHT = 1e-3  # weight of the deviation from the contact law's forces, relative to 1 of the force balance
_RANK_TOLERANCE = 1e-10  # relative to the largest singular value: controls without effect
_BALANCED = 1e-6  # of the weight, N or N m
_CONVERGED = 1e-12  # largest entry of a Gauss-Newton step at convergence, in each coordinate's unit


def quasi_static_controls(
    dynamics: Any, x: Any, *, contacts: bool = True, keep_activations: bool = True, inertia: Any = 0.0
) -> np.ndarray:
    """Controls that balance gravity and springs at a pose, by least squares; of minimum norm without contacts.

    Prescribed joints get zero acceleration. Contacts close to the ground contribute forces within their friction cones.

    Args:
        dynamics: RigidBodyDynamics, or a Mechanism.
        x: (nq,) pose, or (nx,) state, of which positions and activations count.
        contacts: Whether contact forces contribute; else only the actuators balance the pose.
        keep_activations: Whether an INTEGRATOR actuator keeps its activation, with control 0. If not, its entry of
            the result is the activation that balances the pose.
        inertia: (nv,) N and N m, what a motion through the pose takes beyond rest; 0 for none.

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
    lengths = actuator_lengths(mechanism, q)
    force, gain = passive_forces(actuators, lengths), gains_at(actuators, lengths)
    force[fixed] += gain[fixed] * act[actuators.activation[fixed]]
    moment = actuator_moments(mechanism, q)
    missing = bias(mechanism, q, np.zeros(nv)) + inertia - moment.T @ force
    reach = moment.T * np.where(fixed, 0.0, gain)
    prescribed = prescribed_dofs_of(dynamics)
    Z = feasible_directions(mechanism, q)[0]  # constraint forces balance the other directions
    if len(prescribed):
        Z = Z.copy()
        Z[prescribed] = 0.0  # inverse dynamics gives their forces
    if mechanism.contacts and contacts:
        u = _supported_controls(mechanism, q, reach, missing, Z)
    else:
        u = np.linalg.lstsq(Z.T @ reach, Z.T @ missing, rcond=None)[0]
    return np.append(u, np.zeros(len(prescribed)))


def _supported_controls(
    mechanism: Mechanism, q: np.ndarray, reach: np.ndarray, tau: np.ndarray, Z: np.ndarray
) -> np.ndarray:
    """Controls (nu,) that with contact forces sum to a generalized force tau, by bounded least squares.

    Forces of contacts close to the ground are nonnegative combinations of their friction cone's edges (a pyramid of
    four). FORCE_FIT_WEIGHT selects the solution closest to the contact law's forces at this penetration.

    Args:
        mechanism: A mechanism with contacts.
        q: (nq,) pose.
        reach: (nv, nu) generalized forces per control.
        tau: (nv,) required generalized force of controls, contacts and stops, N and N m.
        Z: (nv, n) directions in which forces must balance.
    """
    from scipy.optimize import lsq_linear

    still, nu = np.zeros(mechanism.nv), reach.shape[1]
    law = contact_forces(mechanism, q, still)
    near = np.flatnonzero(law.depths > [-c.law.rest_depth(weight(mechanism)) for c in mechanism.contacts])
    J, pushing = contact_jacobians(mechanism, q, near), np.flatnonzero(law.forces.any(axis=1))
    pushed = np.einsum("kaj,ka->j", contact_jacobians(mechanism, q, pushing), law.forces[pushing])
    tau = tau - generalized_forces(mechanism, q, still) + pushed  # minus stops and exponential torques
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


def carried_by_thrusters(mechanism: Mechanism) -> bool:
    """Whether thrusters, with forces of any size, balance the weight of the machine as it is drawn."""
    q, free = mechanism.home[: mechanism.nq], unactuated_basis(mechanism)
    reach = free.T @ actuator_moments(mechanism, q)[thrusters(mechanism)].T
    if not reach.any():
        return False
    missing = free.T @ bias(mechanism, q, np.zeros(mechanism.nv))
    left = missing - reach @ np.linalg.lstsq(reach, missing, rcond=None)[0]
    return bool(np.abs(left).max() <= _BALANCED * np.abs(missing).max())


def weight(mechanism: Mechanism) -> float:
    """Total weight of a mechanism, N."""
    return float(mechanism.mass.sum() * np.linalg.norm(mechanism.gravity))


def equilibrium(
    dynamics: Any, x: np.ndarray, u: np.ndarray, free: np.ndarray | None = None, *,
    iterations: int = 20, tolerance: float = 0.0,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """State and control at equilibrium, x = f(x, u), of any dynamics, by Gauss-Newton from x and u.

    If there is none, the result is the last least-squares iterate.

    Args:
        dynamics: Any dynamics.
        x: (nx,) initial state.
        u: (nu,) initial control.
        free: (ndx,) bool, coordinates of x that may change, within couplings and loop closures; None for none.
        iterations: Largest number of iterations.
        tolerance: Largest state change in one stage at convergence, in each coordinate's unit.

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
    """Basis T (ndx, n) of the deviations of a state x (nx,) within couplings and loop closures: dx = T dx[indices].

    Returns:
        T, and the indices (n,) at which T is the identity. The identity and all indices for dynamics without a
        mechanism, or whose state is not the mechanism's.
    """
    mechanism, ndx = capabilities_of(dynamics).mechanism, space_of(dynamics).ndx
    if mechanism is None or mechanism.space.ndx != ndx:
        return np.eye(ndx), np.arange(ndx)
    return tangent_basis(mechanism, x)
