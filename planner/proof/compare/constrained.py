"""Accelerations from MuJoCo's own terms with exact equality constraints: the reference for couplings and loop closures.

MuJoCo's equalities are soft. With its M, forces, Jacobians and their rates, the exact accelerations are

    qdd = W qfrc + W J'f,   J qdd + Jdot qd + 2 rate J qd + rate^2 phi = 0,   W = G (G'MG)^-1 G'

G of the couplings, J, Jdot qd and phi of connects, welds and cams (both of planner.model.couplings), all by MuJoCo's
mj_jac and mj_jacDot at the anchors in the compiled model.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from planner.base.gl import load_mujoco
from planner.model.couplings import BAUMGARTE_RATE, PolynomialCoupling
from planner.model.mechanism import Mechanism
from planner.model.mjcf.equalities import joined, joins
from planner.model.space import cross

_RANK_TOLERANCE = 1e-9  # relative to the largest eigenvalue of J W J'; smaller ones are of redundant equations
_APART = 1e-3  # relative to the largest singular value of J; smaller ones are ignored by the projection


def constrained_acceleration(model: Any, data: Any, mechanism: Mechanism) -> np.ndarray:
    """Accelerations (nv,) from the terms of mj_forward in data; qacc_smooth for a tree. `mechanism` is the model's."""
    if not (mechanism.couplings or mechanism.loops or mechanism.polynomial_couplings):
        return data.qacc_smooth.copy()
    W = _mobility(model, data, mechanism)
    free = W @ data.qfrc_smooth
    if not (mechanism.loops or mechanism.polynomial_couplings):
        return free
    J, drift, phi = _rows(model, data, mechanism.polynomial_couplings)
    lacks = drift + 2.0 * BAUMGARTE_RATE * (J @ data.qvel) + BAUMGARTE_RATE**2 * phi
    return free - W @ J.T @ _inverse(J @ W @ J.T) @ (lacks + J @ free)


def closure_rounding(model: Any, data: Any, mechanism: Mechanism) -> float:
    """Error of constrained accelerations per unit of rounding in A = J W J' and the closures' accelerations c.

    It is the largest component of |W J' A^+| (|J| |W| |J'| |f| + |c|) with the forces f = A^+ c (Skeel), which grows
    without bound where a chain comes to lie in line. 0 without loop closures.
    """
    if not (mechanism.loops or mechanism.polynomial_couplings):
        return 0.0
    W = _mobility(model, data, mechanism)
    J, drift, _ = _rows(model, data, mechanism.polynomial_couplings)
    inverse, free = _inverse(J @ W @ J.T), W @ data.qfrc_smooth
    c = np.abs(J) @ (np.abs(free) + 2.0 * BAUMGARTE_RATE * np.abs(data.qvel)) + np.abs(drift)
    f = np.abs(inverse @ (drift + 2.0 * BAUMGARTE_RATE * (J @ data.qvel) + J @ free))
    terms = np.abs(J) @ np.abs(W) @ np.abs(J.T) @ f + c
    return float(np.max(np.abs(W @ J.T) @ np.abs(inverse) @ terms))


def _inverse(A: np.ndarray) -> np.ndarray:
    """Pseudoinverse of A = J W J', without its redundant equations."""
    values, vectors = np.linalg.eigh(A)
    keep = values > _RANK_TOLERANCE * values.max()
    return (vectors[:, keep] / values[keep]) @ vectors[:, keep].T


def _mobility(model: Any, data: Any, mechanism: Mechanism) -> np.ndarray:
    """(nv, nv) W = G (G'MG)^-1 G' of MuJoCo's mass matrix."""
    mass = np.empty((model.nv, model.nv))
    for row, axis in zip(mass, np.eye(model.nv), strict=True):
        load_mujoco().mj_mulM(model, data, row, axis)
    G = np.eye(model.nv) if mechanism.reduction is None else mechanism.reduction.G
    return G @ np.linalg.solve(G.T @ mass @ G, G.T)


def steps_back(model: Any, data: Any, mechanism: Mechanism, held: Sequence[int] | np.ndarray) -> None:
    """Project positions and velocities of data onto the loop closures, as at the end of an RK4 stage of a plan.

    Minimum-norm steps that close loops to first order (kernels.tree.loop_projection); `held` dofs are fixed.
    """
    G = np.eye(model.nv) if mechanism.reduction is None else mechanism.reduction.G
    G = G[:, ~np.any(G[np.asarray(held, dtype=int)] != 0.0, axis=0)]
    for of_positions in (True, False):
        load_mujoco().mj_fwdPosition(model, data)
        J, _, phi = _rows(model, data, mechanism.polynomial_couplings)
        step = -G @ np.linalg.lstsq(J @ G, phi if of_positions else J @ data.qvel, rcond=_APART)[0]
        if of_positions:
            load_mujoco().mj_integratePos(model, data.qpos, step, 1.0)
        else:
            data.qvel += step


def _rows(model: Any, data: Any, cams: tuple[PolynomialCoupling, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """J (rows, nv), Jdot qd and phi (rows,) of all loop-closure equalities.

    Equalities that are disabled in MuJoCo's flags are included.
    """
    parts = [_held(model, data, i) for i in map(int, np.flatnonzero(model.eq_active0)) if joins(model, i)]
    parts += [_cam(model, data, cam) for cam in cams]
    J, drift, phi = (np.concatenate(one) for one in zip(*parts, strict=True))
    return J, drift, phi


def _held(model: Any, data: Any, i: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """J, Jdot qd and phi of a connect or weld equality, from the poses of its two bodies in `data`."""
    mujoco = load_mujoco()
    bodies, frames, rigid = joined(model, i)
    J, drift, places, axes = np.zeros((6, model.nv)), np.zeros(6), [], []
    for sign, body, T in zip((1.0, -1.0), bodies, frames, strict=True):
        R = data.xmat[body].reshape(3, 3)
        places.append(data.xpos[body] + R @ T[:3, 3])
        axes.append(R @ T[:3, :3])
        own, rate = np.zeros((6, model.nv)), np.zeros((6, model.nv))
        mujoco.mj_jac(model, data, own[:3], own[3:], places[-1], body)
        mujoco.mj_jacDot(model, data, rate[:3], rate[3:], places[-1], body)
        J += sign * own
        drift += sign * rate @ data.qvel
    apart = places[0] - places[1]
    if not rigid:
        return J[:3], drift[:3], apart
    turn = 0.5 * cross(axes[1].T, axes[0].T).sum(axis=0)
    return J, drift, np.concatenate([apart, turn])


def _cam(model: Any, data: Any, cam: PolynomialCoupling) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """J, Jdot qd and phi of a nonlinear joint equality (cam)."""
    p = np.polynomial.Polynomial(cam.coefficients)
    follower, leader = (
        data.qpos[model.jnt_qposadr[model.dof_jntid[dof]]] - offset
        for dof, offset in zip((cam.follower, cam.leader), cam.offsets, strict=True)
    )
    J = np.zeros((1, model.nv))
    J[0, cam.follower], J[0, cam.leader] = 1.0, -p.deriv()(leader)
    drift = -p.deriv(2)(leader) * data.qvel[cam.leader] ** 2
    return J, np.array([drift]), np.array([follower - p(leader)])
