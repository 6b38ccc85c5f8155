"""Loop closures: closure error, Jacobian and constrained accelerations of one state, constraint forces along a plan.

The first three are a reference implementation of kernels.tree.rounds with the recursions of Fig. 2
(planner.dynamics.product_of_exponentials) and the equations of planner.model.couplings. It is analytic: q, qd and tau
may be complex. Rows are those of the loops in order, then of the polynomial couplings.

Constraint forces along states and controls, e.g. the load of a pin or the grip of two hands, are compiled. With qdd the
accelerations, M qdd + h - tau - friction = J'f + coupling forces, which W = G (G' M G)^-1 G' eliminates:

    f = (J W J')^+ J W (M qdd + h - tau - friction)

With redundant constraints f is the minimum-norm solution.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from planner.base.arguments import array
from planner.base.errors import PlannerError
from planner.dynamics import algorithms, kinematics
from planner.dynamics.joint_forces import friction_forces
from planner.dynamics.product_of_exponentials import Ad, ad, bias, mass_matrix, twists, world_poses
from planner.dynamics.rigid_body import RigidBodyDynamics
from planner.kernels.tree.mechanism_table import chain_of
from planner.model.coordinates import Coordinate
from planner.model.couplings import BAUMGARTE_RATE, LoopClosure, PolynomialCoupling
from planner.model.mechanism import Frame, Mechanism
from planner.model.space import cross

_RANK_TOLERANCE = 1e-9  # relative to the largest singular value, or eigenvalue of J W J': redundant equations


def misses(mechanism: Mechanism, q: np.ndarray) -> np.ndarray:
    """Closure errors phi (rows,) at q (nq,), m or rad."""
    G = world_poses(mechanism, q)
    parts = [_miss(loop, G) for loop in mechanism.loops]
    parts += [
        np.array([q[mechanism.q_address[cam.follower]] - cam.offsets[0] - _polynomial(mechanism, cam, q)[0]])
        for cam in mechanism.polynomial_couplings
    ]
    return np.concatenate(parts)


def _miss(loop: LoopClosure, G: np.ndarray) -> np.ndarray:
    first, second = (G[link] @ T for link, T in zip(loop.links, loop.frames, strict=True))
    place = first[:3, 3] - second[:3, 3]
    if not loop.rigid:
        return place
    turn = sum(cross(second[:3, c], first[:3, c]) for c in range(3))
    return np.concatenate([place, 0.5 * turn])


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
    J = np.zeros((6, mechanism.nv), dtype=G.dtype)
    for i in chain_of(mechanism.parent, link):
        angular, linear = screws[i, :3], screws[i, 3:]
        J[:, i] = *(linear + cross(angular, place)), *angular
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
    linear = Vd[3:] + cross(Vd[:3], p) + cross(V[:3], V[3:] + cross(V[:3], p))
    return np.concatenate([R @ linear, R @ Vd[:3]])


def closed_dynamics(
    mechanism: Mechanism, q: np.ndarray, qd: np.ndarray, tau: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Accelerations qdd (nv,) under tau (nv,), and constraint forces f (rows,), of minimum norm if redundant.

    M qdd + h = tau + J'f,   J qdd = -Jdot qd - 2 rate J qd - rate^2 phi
    """
    J, G = jacobian(mechanism, q), mechanism.independent_directions
    W = G @ np.linalg.solve(G.T @ mass_matrix(mechanism, q) @ G, G.T)
    free = W @ (tau - bias(mechanism, q, qd))
    wanted = (
        -closure_bias(mechanism, q, qd) - 2.0 * BAUMGARTE_RATE * (J @ qd) - BAUMGARTE_RATE**2 * misses(mechanism, q)
    )
    f = _pseudo_inverse(J @ W @ J.T) @ (wanted - J @ free)
    return free + W @ J.T @ f, f


def _pseudo_inverse(S: np.ndarray) -> np.ndarray:
    """Pseudoinverse of a symmetric S (rows, rows); analytic in a small imaginary part."""
    values, vectors = np.linalg.eigh(np.real(S))
    keep = values > _RANK_TOLERANCE * values.max()
    V = vectors[:, keep]
    return V @ np.linalg.solve(V.T @ S @ V, V.T)


def constraint_forces(dynamics: RigidBodyDynamics, xs: Any, us: Any) -> np.ndarray:
    """Constraint forces f (K, rows), N and N m, at states xs (K, nx) under controls us (K, nu); see constraint_names.

    The force of a loop acts on its first frame, in the world's axes, and with the opposite sign on the second.

    Raises:
        PlannerError: The machine has no loop closures, or a wrong shape.
    """
    if not isinstance(dynamics, RigidBodyDynamics) or not dynamics.capabilities.loops:
        raise PlannerError("the dynamics have no closed chains, expected RigidBodyDynamics of a machine with some.")
    us = array("us", us, ("K", dynamics.nu))
    xs = array("xs", xs, (len(us), dynamics.nx))
    m = dynamics.mechanism
    q, qd = xs[:, : m.nq], xs[:, m.velocities]
    tree = replace(m, loops=(), polynomial_couplings=(), friction_loss=np.zeros(m.nv))
    free = RigidBodyDynamics(replace(tree, couplings=()), dynamics.dt, dynamics.integrator, dynamics.prescribed)
    qdd = dynamics.rates(xs, us)[:, m.nv : 2 * m.nv]
    tau = algorithms.rnea(tree, q, qd, free.rates(xs, us)[:, m.nv : 2 * m.nv])  # not used at prescribed joints
    left = algorithms.rnea(tree, q, qd, qdd) - tau - friction_forces(m, qd, qdd)[0]
    G = m.independent_directions
    given = [dof for name in dynamics.prescribed for dof in range(m.nv)[m.joint(name)]]
    G = G[:, ~np.any(G[given] != 0.0, axis=0)]
    W = G @ np.linalg.solve(G.T @ algorithms.mass_matrix(tree, q) @ G, np.broadcast_to(G.T, (len(xs), *G.T.shape)))
    JW = constraint_jacobians(m, q) @ W
    S = JW @ constraint_jacobians(m, q).swapaxes(1, 2)
    return (np.linalg.pinv(S, rcond=_RANK_TOLERANCE, hermitian=True) @ (JW @ left[:, :, None]))[:, :, 0]


def constraint_jacobians(m: Mechanism, q: np.ndarray) -> np.ndarray:
    """Constraint Jacobians J (K, rows, nv) of planner.dynamics.loops at configurations q (K, nq)."""
    parts = []
    for loop in m.loops:
        first, second = (kinematics.jacobian(m, q, Frame(i, T)) for i, T in zip(loop.links, loop.frames, strict=True))
        parts.append((first - second)[:, : loop.rows])
    for cam in m.polynomial_couplings:
        row, p = np.zeros((len(q), 1, m.nv)), np.polynomial.Polynomial(cam.coefficients)
        row[:, 0, cam.follower] = 1.0
        row[:, 0, cam.leader] = -p.deriv()(q[:, m.q_address[cam.leader]] - cam.offsets[1])
        parts.append(row)
    return np.concatenate(parts, axis=1)


def constraint_names(mechanism: Mechanism) -> tuple[Coordinate, ...]:
    """Name and unit of each component of constraint_forces: "equality 'pin' x" in N, of a weld also moments in N m."""
    rows = []
    for loop in mechanism.loops:
        rows += [Coordinate(f"{loop.name} {axis}", "N") for axis in "xyz"]
        rows += [Coordinate(f"{loop.name} about {axis}", "N m") for axis in "xyz"] if loop.rigid else []
    for cam in mechanism.polynomial_couplings:
        turns = np.any(mechanism.S[cam.follower, :3] != 0.0)
        rows.append(Coordinate(cam.name, "N m" if turns else "N"))
    return tuple(rows)
