"""Moments of the actuators at a pose, as MuJoCo's actuator_moment, and their forces at a state, with derivatives.

What asks for forces, stiffness, damping or gains asks here: nothing outside knows the force laws.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from planner.dynamics.product_of_exponentials import jacobian, world_poses
from planner.kernels.force_laws import law_terms
from planner.model.actuators import DIRECT, Actuators
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


class ForceSlopes(NamedTuple):
    """Derivatives (..., nu) of the actuators' forces."""

    gain: np.ndarray  # by control or activation
    by_length: np.ndarray
    by_rate: np.ndarray


def actuator_forces(
    actuators: Actuators, given: np.ndarray, lengths: np.ndarray, rates: np.ndarray | None = None
) -> np.ndarray:
    """Forces (..., nu) without clamps; `given` are controls or activations, all (..., nu). Without rates: at rest."""
    rates = np.zeros_like(lengths) if rates is None else rates
    force = actuators.gain * given + (
        actuators.bias[:, 0] + actuators.bias[:, 1] * lengths + actuators.bias[:, 2] * rates
    )
    for law in actuators.laws:
        a = law.actuator
        force[..., a] += law_terms(law, given[..., a], lengths[..., a], rates[..., a])[0]
    return force


def passive_forces(actuators: Actuators, lengths: np.ndarray, rates: np.ndarray | None = None) -> np.ndarray:
    """Forces (..., nu) without input: the force is this plus the gain at the state times what is given."""
    return actuator_forces(actuators, np.zeros_like(lengths), lengths, rates)


def force_slopes(
    actuators: Actuators, given: np.ndarray, lengths: np.ndarray, rates: np.ndarray | None = None
) -> ForceSlopes:
    """Derivatives of actuator_forces."""
    rates = np.zeros_like(lengths) if rates is None else rates
    shape = np.shape(lengths)
    slopes = ForceSlopes(*(np.tile(part, (*shape[:-1], 1)) for part in (actuators.gain, *actuators.bias[:, 1:].T)))
    for law in actuators.laws:
        a = law.actuator
        for slope, term in zip(slopes, law_terms(law, given[..., a], lengths[..., a], rates[..., a])[1:], strict=True):
            slope[..., a] += term
    return slopes


def gains_at(actuators: Actuators, lengths: np.ndarray, rates: np.ndarray | None = None) -> np.ndarray:
    """Force per unit of control or activation (..., nu) at lengths and rates (..., nu)."""
    return force_slopes(actuators, np.zeros_like(lengths), lengths, rates).gain


class StateForces(NamedTuple):
    """Forces (K, nu) of the actuators at states, and their derivatives."""

    force: np.ndarray
    by_x: np.ndarray  # (K, nu, ndx) by the deviation of a mechanism's state
    by_u: np.ndarray  # (K, nu) by each one's own control, 0 for those with activations


def forces_at(mechanism: Mechanism, xs: np.ndarray, us: np.ndarray) -> StateForces:
    """The actuators' forces at states xs (K, nx) and controls us (K, nu), with derivatives."""
    acts, nq, nv = mechanism.actuators, mechanism.nq, mechanism.nv
    own = np.flatnonzero(acts.dynamics != DIRECT)
    given = us.copy()
    given[:, own] = xs[:, nq + nv + acts.activation[own]]
    lengths, rates = actuator_lengths(mechanism, xs[:, :nq]), xs[:, nq : nq + nv] @ acts.moment.T
    slopes, by_x = force_slopes(acts, given, lengths, rates), np.zeros((len(xs), acts.nu, mechanism.space.ndx))
    screws = np.where(mechanism.kind == SCREW, acts.moment, 0.0)  # lengths are over the hinge and slide joints
    by_x[:, :, :nv] = slopes.by_length[:, :, None] * screws
    by_x[:, :, nv : 2 * nv] = slopes.by_rate[:, :, None] * acts.moment
    by_x[:, own, 2 * nv + acts.activation[own]] = slopes.gain[:, own]
    return StateForces(
        actuator_forces(acts, given, lengths, rates), by_x, np.where(acts.dynamics == DIRECT, slopes.gain, 0.0)
    )
