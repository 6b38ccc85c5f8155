"""Moments of the actuators at a pose: the generalized forces per unit of their forces, as MuJoCo's actuator_moment."""

from __future__ import annotations

import numpy as np

from planner.dynamics.product_of_exponentials import jacobian, world_poses
from planner.model.actuators import DIRECT
from planner.model.mechanism import SCREW, Frame, Mechanism


def actuator_moments(mechanism: Mechanism, q: np.ndarray) -> np.ndarray:
    """Moments (nu, nv) at a pose q (nq,), real or complex; `mechanism.actuators.moment` without actuators at sites."""
    actuators = mechanism.actuators
    if not actuators.wrenches:
        return actuators.moment
    moments = actuators.moment.astype(q.dtype)
    poses = world_poses(mechanism, q)
    for one in actuators.wrenches:
        place, R = np.eye(4), poses[one.frame][:3, :3]
        place[:3, 3] = one.place
        J = jacobian(mechanism, q, Frame(one.link, place))[:, one.dofs]
        moments[one.actuator, one.dofs] += J[:3].T @ (R @ one.force) + J[3:].T @ (R @ one.torque)
    return moments


def actuator_lengths(mechanism: Mechanism, q: np.ndarray) -> np.ndarray:
    """Actuator lengths (..., nu), moment q over hinges and slides, at poses q (..., nq), m and rad; 0 at sites."""
    screws = np.zeros((mechanism.nu, mechanism.nq))
    for i in range(mechanism.nv):
        if mechanism.kind[i] == SCREW:
            screws[:, mechanism.q_address[i]] += mechanism.actuators.moment[:, i]
    return q @ screws.T


def force_rows(mechanism: Mechanism) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives of the actuators' forces by the state (nu, nx) and by its deviation (nu, ndx).

    They depend on the state by length, its rate and activations, linearly.
    """
    acts, space, nv = mechanism.actuators, mechanism.space, mechanism.nv
    by_q, by_x = np.zeros((acts.nu, space.nx)), np.zeros((acts.nu, space.ndx))
    for i in np.flatnonzero(mechanism.kind == SCREW):  # lengths are over the hinge and slide joints
        by_q[:, mechanism.q_address[i]] += acts.bias[:, 1] * acts.moment[:, i]
        by_x[:, i] = acts.bias[:, 1] * acts.moment[:, i]
    by_q[:, mechanism.nq : mechanism.nq + nv] = by_x[:, nv : 2 * nv] = acts.bias[:, 2, None] * acts.moment
    for j in np.flatnonzero(acts.dynamics != DIRECT):
        k = acts.activation[j]
        by_q[j, mechanism.nq + nv + k] = by_x[j, 2 * nv + k] = acts.gain[j]
    return by_q, by_x
