"""Forces at the joints, with derivatives: of the actuators, with their moments at a pose, and of friction loss.

Forces at a state, and their slopes, are asked here, so that nothing outside knows the force laws. Actuators.by_law and
depends_on_state say where gain u + bias does not suffice. Moments are as MuJoCo's actuator_moment.

MuJoCo's friction loss is a constraint, the force -clip(D (a + beta v), loss) on a joint with velocity v and
acceleration a. Below the loss it acts like an armature D with a damper beta D. The plan smooths the same force:

    f = -loss s(x),   x = D (a + beta v) / loss,   s(x) = x up to 1 - b, 1 from 1 + b, a parabola between, and odd

f depends on the acceleration, so it is not part of the bias: a solves M a + bias = tau + f(a).
The kernels repeat it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from planner.dynamics.product_of_exponentials import jacobian, world_poses
from planner.kernels.force_laws import law_terms
from planner.model.actuators import DIRECT, Actuators
from planner.model.mechanism import SCREW, Frame, Mechanism

BEND = 0.08
"""Half width b of the smoothing, relative to the loss; the force error is at most b/4.

Replay errors over their tolerances: fingers at breakaway 1.4 with b = 0.5, a light damped wrist 2.4 with 0.2; 0.5 here.
"""


def actuator_moments(mechanism: Mechanism, q: np.ndarray) -> np.ndarray:
    """Moments (nu, nv) at a pose q (nq,), real or complex; `mechanism.actuators.moment` without actuators at sites."""
    actuators = mechanism.actuators
    if not actuators.wrenches:
        return actuators.moment
    moments = actuators.moment.astype(q.dtype)
    poses = world_poses(mechanism, q)
    for one in actuators.wrenches:
        R = poses[one.frame][:3, :3]
        J = jacobian(mechanism, q, Frame.at(one.link, one.place))[:, one.dofs]
        moments[one.actuator, one.dofs] += J[:3].T @ (R @ one.force) + J[3:].T @ (R @ one.torque)
    return moments


def actuator_lengths(mechanism: Mechanism, q: np.ndarray) -> np.ndarray:
    """Actuator lengths (..., nu), moment q over hinges and slides, at poses q (..., nq), m and rad; 0 at sites."""
    return q[..., mechanism.q_address] @ _length_rows(mechanism).T


def _length_rows(mechanism: Mechanism) -> np.ndarray:
    """(nu, nv) derivatives of the lengths, which are over the hinge and slide joints."""
    return np.where(mechanism.kind == SCREW, mechanism.actuators.moment, 0.0)


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


def forces_at(mechanism: Mechanism, xs: np.ndarray, us: np.ndarray) -> np.ndarray:
    """The actuators' forces (K, nu), without clamps, at states xs (K, nx) and controls us (K, nu)."""
    return actuator_forces(mechanism.actuators, *_inputs(mechanism, xs, us))


def force_derivatives_at(mechanism: Mechanism, xs: np.ndarray, us: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives of forces_at by the deviation (K, nu, ndx) and by each one's own control (K, nu).

    The latter are 0 for actuators with activations.
    """
    acts, nv, own = mechanism.actuators, mechanism.nv, np.flatnonzero(mechanism.actuators.dynamics != DIRECT)
    slopes, by_x = force_slopes(acts, *_inputs(mechanism, xs, us)), np.zeros((len(xs), acts.nu, mechanism.space.ndx))
    by_x[:, :, :nv] = slopes.by_length[:, :, None] * _length_rows(mechanism)
    by_x[:, :, nv : 2 * nv] = slopes.by_rate[:, :, None] * acts.moment
    by_x[:, own, 2 * nv + acts.activation[own]] = slopes.gain[:, own]
    return by_x, np.where(acts.dynamics == DIRECT, slopes.gain, 0.0)


def _inputs(mechanism: Mechanism, xs: np.ndarray, us: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Controls or activations, lengths and length rates, each (K, nu)."""
    acts, nq, nv, given = mechanism.actuators, mechanism.nq, mechanism.nv, us.copy()
    own = np.flatnonzero(acts.dynamics != DIRECT)
    given[:, own] = xs[:, nq + nv + acts.activation[own]]
    return given, actuator_lengths(mechanism, xs[:, :nq]), xs[:, nq : nq + nv] @ acts.moment.T


def saturation(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Smoothed saturation s(x) and its derivative."""
    x = np.clip(x, -1.0 - BEND, 1.0 + BEND)
    bent = np.maximum(np.abs(x) - (1.0 - BEND), 0.0)
    return x - np.sign(x) * bent**2 / (4.0 * BEND), 1.0 - bent / (2.0 * BEND)


def friction_forces(mechanism: Mechanism, qd: np.ndarray, qdd: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Friction (..., nv), N m and N, at qd and qdd (..., nv), and its derivative by qdd (..., nv), at most 0."""
    loss, inertia = mechanism.friction_loss, mechanism.friction_inertia
    rubs = loss > 0.0
    x = inertia * (qdd + mechanism.friction_rate * qd) / np.where(rubs, loss, 1.0)
    force, slope = saturation(x)
    return -loss * force, np.where(rubs, -inertia * slope, 0.0)
