"""Friction loss of joints (MuJoCo's dof_frictionloss), in NumPy: reference implementation of the kernels.

MuJoCo's friction loss is a constraint, the force -clip(D (a + beta v), loss) on a joint with velocity v and
acceleration a. Below the loss it acts like an armature D with a damper beta D. The plan smooths the same force:

    f = -loss s(x),   x = D (a + beta v) / loss,   s(x) = x up to 1 - b, 1 from 1 + b, a parabola between, and odd

f depends on the acceleration, so it is not part of the bias: a solves M a + bias = tau + f(a).
"""

from __future__ import annotations

import numpy as np

from planner.model.mechanism import Mechanism

BEND = 0.08
"""Half width b of the smoothing, relative to the loss; the force error is at most b/4.

Replay errors over their tolerances: fingers at breakaway 1.4 with b = 0.5, a light damped wrist 2.4 with 0.2; 0.5 here.
"""
_ROUNDS, _MET = 30, 1e-13


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


def with_friction(mechanism: Mechanism, M: np.ndarray, tau: np.ndarray, qd: np.ndarray) -> np.ndarray:
    """Accelerations (nv,) that solve M qdd = tau + friction(qd, qdd), by Newton's method.

    They minimize a convex function; an exact line search limits every Newton step.

    Args:
        mechanism: A mechanism with friction loss.
        M: (nv, nv) mass matrix.
        tau: (nv,) all applied forces but friction, minus the bias, N m and N.
        qd: (nv,) velocities, rad/s and m/s.
    """
    from scipy.optimize import root_scalar  # local: the import takes half a second

    qdd = np.where(mechanism.friction_loss > 0.0, -mechanism.friction_rate * qd, 0.0)  # initial guess: all stick
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
