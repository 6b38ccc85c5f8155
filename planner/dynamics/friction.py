"""Friction loss of joints (MuJoCo's dof_frictionloss), in NumPy: the readable twin of the kernels.

MuJoCo's friction loss is a constraint, the force -clip(D (a + beta v), loss) on a joint that moves at v and
accelerates by a. So friction holds a joint as an armature D with a damper beta D would, until that takes more than
the loss. The plan has the same force with a bend:

    f = -loss s(x),   x = D (a + beta v) / loss,   s(x) = x up to 1 - b, 1 from 1 + b, a parabola between, and odd

It depends on the acceleration, so it is no part of the bias, but of the accelerations that solve
M a + bias = tau + f(a).
"""

from __future__ import annotations

import numpy as np

from planner.model.mechanism import Mechanism

BEND = 0.08
"""Either way of the loss; a quarter of it is what the force is off at most. Of what passes, a hand's fingers that break
loose are off by 1.4 times with .5, and a light wrist that a damper holds back by 2.4 times with .2; here by half.
"""
_ROUNDS, _MET = 30, 1e-13


def saturation(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """s(x) and its slope."""
    x = np.clip(x, -1.0 - BEND, 1.0 + BEND)
    bent = np.maximum(np.abs(x) - (1.0 - BEND), 0.0)
    return x - np.sign(x) * bent**2 / (4.0 * BEND), 1.0 - bent / (2.0 * BEND)


def friction_forces(mechanism: Mechanism, qd: np.ndarray, qdd: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Friction (..., nv), N m and N, at velocities and accelerations (..., nv), and its slope by qdd, less than 0."""
    loss, inertia = mechanism.friction_loss, mechanism.friction_inertia
    rubs = loss > 0.0
    x = inertia * (qdd + mechanism.friction_rate * qd) / np.where(rubs, loss, 1.0)
    force, slope = saturation(x)
    return -loss * force, np.where(rubs, -inertia * slope, 0.0)


def with_friction(mechanism: Mechanism, M: np.ndarray, tau: np.ndarray, qd: np.ndarray) -> np.ndarray:
    """Accelerations (nv,) that solve M qdd = tau + friction(qd, qdd), by Newton's method.

    They are the minimum of a convex function, along which every step goes as far as it sinks.

    Args:
        mechanism: With friction loss.
        M: (nv, nv) mass matrix.
        tau: (nv,) all forces but friction, less the bias.
        qd: (nv,).
    """
    from scipy.optimize import root_scalar  # half a second that `planner run` does not pay

    qdd = np.where(mechanism.friction_loss > 0.0, -mechanism.friction_rate * qd, 0.0)  # as if friction held every joint
    force, slope = friction_forces(mechanism, qd, qdd)
    qdd = np.linalg.solve(M - np.diag(slope), tau + force - slope * qdd)
    for _ in range(_ROUNDS):
        force, slope = friction_forces(mechanism, qd, qdd)
        size = mechanism.friction_loss + mechanism.friction_inertia * np.abs(qdd)
        if np.all(np.abs(M @ qdd - tau - force) <= _MET * (size + np.abs(tau).max())):
            break
        step = np.linalg.solve(M - np.diag(slope), tau + force - M @ qdd)

        def uphill(part: float, qdd: np.ndarray = qdd, step: np.ndarray = step) -> float:
            there = qdd + part * step
            return float(step @ (M @ there - tau - friction_forces(mechanism, qd, there)[0]))

        qdd = qdd + step * (1.0 if uphill(1.0) <= 0.0 else root_scalar(uphill, bracket=(0.0, 1.0)).root)
    return qdd
