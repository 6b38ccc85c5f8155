"""Moments of the actuators at a pose: the generalized forces per unit of their forces, as MuJoCo's actuator_moment."""

from __future__ import annotations

import numpy as np

from planner.dynamics.product_of_exponentials import jacobian, world_poses
from planner.model.mechanism import SCREW, Frame, Mechanism


def actuator_moments(mechanism: Mechanism, q: np.ndarray) -> np.ndarray:
    """Moments (nu, nv) at a pose q (nq,), real or complex; `mechanism.actuators.moment` without actuators at sites."""
    actuators = mechanism.actuators
    if not actuators.site_wrenches:
        return actuators.moment
    moments = actuators.moment.astype(q.dtype)
    poses = world_poses(mechanism, q)
    for one in actuators.site_wrenches:
        place, R = np.eye(4), poses[one.frame][:3, :3]
        place[:3, 3] = one.place
        J = jacobian(mechanism, q, Frame(one.link, place))[:, one.dofs]
        moments[one.actuator, one.dofs] += J[:3].T @ (R @ one.force) + J[3:].T @ (R @ one.torque)
    return moments


def generalized_actuator_forces(mechanism: Mechanism, q: np.ndarray, forces: np.ndarray) -> np.ndarray:
    """Generalized forces (N, nv) of the actuators' forces (N, nu) at poses q (N, nq)."""
    if not mechanism.actuators.site_wrenches:
        return forces @ mechanism.actuators.moment
    return np.array([force @ actuator_moments(mechanism, one) for one, force in zip(q, forces, strict=True)])


def actuator_lengths(mechanism: Mechanism, q: np.ndarray) -> np.ndarray:
    """Actuator lengths (..., nu), moment q over hinges and slides, at poses q (..., nq), m and rad; 0 at sites."""
    screws = np.zeros((mechanism.nu, mechanism.nq))
    for i in range(mechanism.nv):
        if mechanism.kind[i] == SCREW:
            screws[:, mechanism.q_address[i]] += mechanism.actuators.moment[:, i]
    return q @ screws.T
