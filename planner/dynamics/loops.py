"""Loop closures of one state: closure error, Jacobian, and constrained accelerations.

Reference implementation of kernels.tree.loop_accelerations with the recursions of Fig. 2
(planner.dynamics.product_of_exponentials) and the equations of planner.model.loops. It is analytic: q, qd and tau may
be complex. Rows are those of the loops in order, then of the polynomial couplings.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.dynamics.product_of_exponentials import Ad, ad, bias, mass_matrix, twists, world_poses
from planner.model.loops import BAUMGARTE_RATE, LoopClosure, PolynomialCoupling
from planner.model.mechanism import Mechanism

_RANK_TOLERANCE = 1e-9  # relative to the largest singular value: redundant equations


def misses(mechanism: Mechanism, q: np.ndarray) -> np.ndarray:
    """Closure errors phi (rows,) at q (nq,), m or rad."""
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
    """The polynomial at the leader's coordinate and its first two derivatives."""
    p = np.polynomial.Polynomial(cam.coefficients)
    s = q[mechanism.q_address[cam.leader]] - cam.offsets[1]
    return p(s), p.deriv()(s), p.deriv(2)(s)


def jacobian(mechanism: Mechanism, q: np.ndarray) -> np.ndarray:
    """Constraint Jacobian J (rows, nv): J qd is phidot, but relative angular velocity in rows of rotations."""
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
    """Jacobian (6, nv) of a frame at its origin, linear then angular, in the world's axes."""
    place = (G[link] @ T)[:3, 3]
    J, i = np.zeros((6, mechanism.nv), dtype=G.dtype), link
    while i >= 0:
        angular, linear = screws[i, :3], screws[i, 3:]
        J[:, i] = *(linear + _cross(angular, place)), *angular
        i = int(mechanism.parent[i])
    return J


def closure_bias(mechanism: Mechanism, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
    """Jdot qd (rows,): second derivative of the closure error at zero joint acceleration."""
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
    """Acceleration (6,) of a frame's origin, linear then angular, in the world's axes, from a link's V and Vd."""
    R, p = G[:3, :3], T[:3, 3]
    linear = Vd[3:] + _cross(Vd[:3], p) + _cross(V[:3], V[3:] + _cross(V[:3], p))
    return np.concatenate([R @ linear, R @ Vd[:3]])


def closed_dynamics(
    mechanism: Mechanism, q: np.ndarray, qd: np.ndarray, tau: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Accelerations qdd (nv,) under tau (nv,), and constraint forces f (rows,), of minimum norm if redundant.

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
    """Positions q (nq,) and velocities (nv,) projected onto the loop closures, as kernels.tree.loop_projection.

    RK4 applies it after each stage: one minimum-norm step to first order, within the couplings.
    """
    G = np.eye(mechanism.nv) if mechanism.reduction is None else mechanism.reduction.G
    J = jacobian(mechanism, q) @ G
    step = -G @ np.linalg.lstsq(J, misses(mechanism, q), rcond=_RANK_TOLERANCE)[0]
    x = np.concatenate([q, np.zeros(mechanism.space.nx - len(q))])
    q = mechanism.space.integrate(x, np.append(step, np.zeros(mechanism.space.ndx - len(step))))[: len(q)]
    J = jacobian(mechanism, q)
    return q, qd - G @ np.linalg.lstsq(J @ G, J @ qd, rcond=_RANK_TOLERANCE)[0]


def _pseudo_inverse(S: np.ndarray) -> np.ndarray:
    """Pseudoinverse of a symmetric S (rows, rows); analytic in a small imaginary part."""
    values, vectors = np.linalg.eigh(np.real(S))
    keep = values > 1e-9 * values.max()
    V = vectors[:, keep]
    return V @ np.linalg.solve(V.T @ S @ V, V.T)
