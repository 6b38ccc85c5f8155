"""Controls with which servos follow a motion: their controls are positions or velocities, and no forces."""

from __future__ import annotations

import numpy as np

from planner.dynamics import RigidBodyDynamics
from planner.dynamics.joint_forces import actuator_lengths, force_slopes
from planner.dynamics.quasi_static import quasi_static_controls


def servos_of(dynamics: RigidBodyDynamics) -> np.ndarray:
    """(nu,) whether the force of each control depends on the state: position and velocity servos."""
    found = np.zeros(dynamics.nu, dtype=bool)
    found[: dynamics.mechanism.nu] = dynamics.mechanism.actuators.depends_on_state
    return found


def servo_reference(dynamics: RigidBodyDynamics, xs: np.ndarray) -> np.ndarray:
    """Controls (N, nu) with which servos go along states (N+1, nx) without inertia; 0 for motors.

    Each is the static control in the middle of its stage, and what balances the servo's own damping there.
    """
    mechanism, servos, space = dynamics.mechanism, servos_of(dynamics), dynamics.space
    nq, nv, actuators = mechanism.nq, mechanism.nv, mechanism.actuators
    middle = space.integrate(xs[:-1], 0.5 * space.difference(xs[1:], xs[:-1]))
    us = np.array([quasi_static_controls(dynamics, x) for x in middle])
    rates, own = middle[:, nq : nq + nv] @ actuators.moment.T, us[:, : mechanism.nu]
    slopes = force_slopes(actuators, own, actuator_lengths(mechanism, middle[:, :nq]), rates)
    own -= rates * (slopes.by_rate / np.where(slopes.gain == 0.0, 1.0, slopes.gain))
    return np.where(servos, us, 0.0)
