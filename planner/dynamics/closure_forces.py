"""Constraint forces of loop closures along states and controls, e.g. the load of a pin or the grip of two hands.

With qdd the compiled accelerations, M qdd + h - tau - friction = J'f + coupling forces, which W = G (G' M G)^-1 G'
eliminates:

    f = (J W J')^+ J W (M qdd + h - tau - friction)

With redundant constraints f is the minimum-norm solution.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from planner.base.arguments import array
from planner.base.errors import PlannerError
from planner.dynamics.algorithms import mass_matrix, rnea
from planner.dynamics.friction import friction_forces
from planner.dynamics.kinematics import jacobian
from planner.dynamics.rigid_body import RigidBodyDynamics
from planner.model.coordinates import Coordinate
from planner.model.mechanism import Frame, Mechanism

_RANK_TOLERANCE = 1e-9  # relative to the largest eigenvalue of J W J': redundant constraints


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
    q, qd = xs[:, : m.nq], xs[:, m.nq : m.nq + m.nv]
    tree = replace(m, loops=(), polynomial_couplings=(), friction_loss=np.zeros(m.nv))
    free = RigidBodyDynamics(replace(tree, couplings=()), dynamics.dt, dynamics.integrator, dynamics.prescribed)
    qdd = dynamics.rates(xs, us)[:, m.nv : 2 * m.nv]
    tau = rnea(tree, q, qd, free.rates(xs, us)[:, m.nv : 2 * m.nv])  # not used at prescribed joints
    left = rnea(tree, q, qd, qdd) - tau - friction_forces(m, qd, qdd)[0]
    G = np.eye(m.nv) if m.reduction is None else m.reduction.G
    given = [dof for name in dynamics.prescribed for dof in range(m.nv)[m.joint(name)]]
    G = G[:, ~np.any(G[given] != 0.0, axis=0)]
    W = G @ np.linalg.solve(G.T @ mass_matrix(tree, q) @ G, np.broadcast_to(G.T, (len(xs), *G.T.shape)))
    JW = constraint_jacobians(m, q) @ W
    S = JW @ constraint_jacobians(m, q).swapaxes(1, 2)
    return (np.linalg.pinv(S, rcond=_RANK_TOLERANCE, hermitian=True) @ (JW @ left[:, :, None]))[:, :, 0]


def constraint_jacobians(m: Mechanism, q: np.ndarray) -> np.ndarray:
    """Constraint Jacobians J (K, rows, nv) of planner.dynamics.loops at configurations q (K, nq)."""
    parts = []
    for loop in m.loops:
        first, second = (jacobian(m, q, Frame(i, T)) for i, T in zip(loop.links, loop.frames, strict=True))
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
