"""Closed chains for the reader and for one state: what is to be zero, its derivative, and the accelerations.

The twin of kernels.tree.loop_accelerations, on Fig. 2's recursions (planner.dynamics.product_of_exponentials);
planner.model.loops has the
equations. It is analytic as poe is: q, qd and tau may be complex. Rows are those of the loops in their order, then of
the cams.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.dynamics.product_of_exponentials import Ad, ad, bias, mass_matrix, twists, world_poses
from planner.model.loops import BAUMGARTE_RATE, LoopClosure, PolynomialCoupling
from planner.model.mechanism import Mechanism

_RANK_TOLERANCE = 1e-9  # of the largest singular value: redundant equations


def misses(mechanism: Mechanism, q: np.ndarray) -> np.ndarray:
    """Phi (rows,) at q (nq,): m of places, rad of rotations and hinges."""
    G = world_poses(mechanism, q)
    parts = [_miss(loop, G) for loop in mechanism.loops]
    parts += [
        np.array([_follower(mechanism, cam, q) - _polynomial(mechanism, cam, q)[0]])
        for cam in mechanism.polynomial_couplings
    ]
    return np.concatenate(parts)


def _miss(loop: LoopClosure, G: np.ndarray) -> np.ndarray:
    first, second = (G[link] @ T for link, T in zip(loop.links, loop.frames, strict=True))
    place = first[:3, 3] - second[:3, 3]
    if not loop.rigid:
        return place
    turn = sum(_cross(second[:3, c], first[:3, c]) for c in range(3))
    return np.concatenate([place, 0.5 * turn])


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def _follower(mechanism: Mechanism, cam: PolynomialCoupling, q: np.ndarray) -> Any:
    return q[mechanism.q_address[cam.follower]] - cam.offsets[0]


def _polynomial(mechanism: Mechanism, cam: PolynomialCoupling, q: np.ndarray) -> tuple[Any, Any, Any]:
    """The value to follow and its first two derivatives by the leader's coordinate."""
    p = np.polynomial.Polynomial(cam.coefficients)
    s = q[mechanism.q_address[cam.leader]] - cam.offsets[1]
    return p(s), p.deriv()(s), p.deriv(2)(s)


def jacobian(mechanism: Mechanism, q: np.ndarray) -> np.ndarray:
    """J (rows, nv): phidot = J qd but for rotations, whose rows are those of angular velocities."""
    G = world_poses(mechanism, q)
    screws = np.array([Ad(pose) @ S for pose, S in zip(G, mechanism.S, strict=False)])  # at the world's origin
    rows = []
    for loop in mechanism.loops:
        ends = [_moves(mechanism, G, screws, link, T) for link, T in zip(loop.links, loop.frames, strict=True)]
        rows.append((ends[0] - ends[1])[: loop.rows])
    for cam in mechanism.polynomial_couplings:
        row = np.zeros((1, mechanism.nv), dtype=G.dtype)
        row[0, cam.follower], row[0, cam.leader] = 1.0, -_polynomial(mechanism, cam, q)[1]
        rows.append(row)
    return np.concatenate(rows)


def _moves(mechanism: Mechanism, G: np.ndarray, screws: np.ndarray, link: int, T: np.ndarray) -> np.ndarray:
    """(6, nv) linear and angular velocity of a frame's origin, in the world's axes."""
    place = (G[link] @ T)[:3, 3]
    J, i = np.zeros((6, mechanism.nv), dtype=G.dtype), link
    while i >= 0:
        angular, linear = screws[i, :3], screws[i, 3:]
        J[:, i] = *(linear + _cross(angular, place)), *angular
        i = int(mechanism.parent[i])
    return J


def closure_bias(mechanism: Mechanism, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
    """Jdot qd (rows,): the accelerations of what is to be zero when no joint accelerates."""
    n, S = mechanism.nv, mechanism.S
    X, V, V_base = twists(mechanism, q, qd)
    G = world_poses(mechanism, q)
    Vd = np.zeros_like(V)
    for i in range(n):
        Vd[i] = X[i] @ Vd[mechanism.parent[i]] + ad(V_base[i]) @ S[i] * qd[i]  # Fig. 2, Vd_i without S_i qdd_i
    parts = []
    for loop in mechanism.loops:
        ends = [_acceleration(G[i], V[i], Vd[i], T) for i, T in zip(loop.links, loop.frames, strict=True)]
        parts.append((ends[0] - ends[1])[: loop.rows])
    parts += [
        np.array([-_polynomial(mechanism, cam, q)[2] * qd[cam.leader] ** 2]) for cam in mechanism.polynomial_couplings
    ]
    return np.concatenate(parts)


def _acceleration(G: np.ndarray, V: np.ndarray, Vd: np.ndarray, T: np.ndarray) -> np.ndarray:
    """(6,) linear and angular acceleration of a frame's origin in the world's axes, of a link's twist and its rate."""
    R, p = G[:3, :3], T[:3, 3]
    linear = Vd[3:] + _cross(Vd[:3], p) + _cross(V[:3], V[3:] + _cross(V[:3], p))
    return np.concatenate([R @ linear, R @ Vd[:3]])


def closed_dynamics(
    mechanism: Mechanism, q: np.ndarray, qd: np.ndarray, tau: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Accelerations qdd (nv,) under tau (nv,), and the constraints' forces f (rows,), least squares where redundant.

    M qdd + h = tau + J'f,   J qdd = -Jdot qd - 2 rate J qd - rate^2 phi
    """
    J, G = jacobian(mechanism, q), np.eye(mechanism.nv) if mechanism.reduction is None else mechanism.reduction.G
    W = G @ np.linalg.solve(G.T @ mass_matrix(mechanism, q) @ G, G.T)
    free = W @ (tau - bias(mechanism, q, qd))
    wanted = (
        -closure_bias(mechanism, q, qd) - 2.0 * BAUMGARTE_RATE * (J @ qd) - BAUMGARTE_RATE**2 * misses(mechanism, q)
    )
    f = _pseudo_inverse(J @ W @ J.T) @ (wanted - J @ free)
    return free + W @ J.T @ f, f


def projected_state(mechanism: Mechanism, q: np.ndarray, qd: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions q (nq,) and velocities (nv,) where a stage of RK4 leaves them: kernels.tree.loop_projection.

    The smallest steps that close the chains to first order; couplings keep what they couple.
    """
    G = np.eye(mechanism.nv) if mechanism.reduction is None else mechanism.reduction.G
    J = jacobian(mechanism, q) @ G
    step = -G @ np.linalg.lstsq(J, misses(mechanism, q), rcond=_RANK_TOLERANCE)[0]
    x = np.concatenate([q, np.zeros(mechanism.space.nx - len(q))])
    q = mechanism.space.integrate(x, np.append(step, np.zeros(mechanism.space.ndx - len(step))))[: len(q)]
    J = jacobian(mechanism, q)
    return q, qd - G @ np.linalg.lstsq(J @ G, J @ qd, rcond=_RANK_TOLERANCE)[0]


def _pseudo_inverse(S: np.ndarray) -> np.ndarray:
    """Of a symmetric S (rows, rows) that may be singular; analytic in a small imaginary part."""
    values, vectors = np.linalg.eigh(np.real(S))
    keep = values > 1e-9 * values.max()
    V = vectors[:, keep]
    return V @ np.linalg.solve(V.T @ S @ V, V.T)
