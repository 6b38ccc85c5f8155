"""Fig. 2, line by line: kinematics and dynamics by products of exponentials, for one state.

Twists V and screws S are (angular, linear) and wrenches F (moment, force), all in the frame of their own link:

    T_i = T_home_i exp6(S_i, q_i)                               pose of link i in its parent's frame
    V_i = Ad(T_i^-1) V_parent + S_i qd_i                        forward
    Vd_i = Ad(T_i^-1) Vd_parent + S_i qdd_i + ad(Ad(T_i^-1) V_parent) S_i qd_i
    F_i = sum over children of Ad(T_child^-1)' F_child + inertia_i Vd_i - ad(V_i)' inertia_i V_i     backward
    tau_i = S_i' F_i

Three extensions of the figure: a link has a parent instead of a predecessor (branching tree); gravity is an
acceleration of the world, Vd_0 = (0, -g); all screws of a ball rotate with the ball, so their bracket uses the twist of
the ball's parent (`base` in mechanism.py). In (nv+1, ...) arrays the last row is the world, index -1.

This file is the reference implementation of the compiled kernels. It does not check arguments, and is
analytic: q (quaternions too), qd and the inputs may be complex, so an imaginary step of 1e-30 in any of them gives
derivatives exact to rounding.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from planner.kernels.tree.mechanism_table import chain_of
from planner.model.mechanism import BALL, SCREW, Frame, Mechanism
from planner.model.passive_forces import drag_wrenches, tendon_forces
from planner.model.space import conjugate, hat, product


def exp6(S: np.ndarray, q: complex) -> np.ndarray:
    """The pose exp(S q) (4, 4): the angular part of S (6,) has norm 1 (revolute) or 0 (prismatic)."""
    H = hat(S[:3])
    T = np.eye(4, dtype=np.result_type(S, q))
    T[:3, :3] += np.sin(q) * H + (1.0 - np.cos(q)) * H @ H
    T[:3, 3] = (q * np.eye(3) + (1.0 - np.cos(q)) * H + (q - np.sin(q)) * H @ H) @ S[3:]
    return T


def inverse(T: np.ndarray) -> np.ndarray:
    """The inverse of a pose (4, 4)."""
    result = np.eye(4, dtype=T.dtype)
    result[:3, :3], result[:3, 3] = T[:3, :3].T, -T[:3, :3].T @ T[:3, 3]
    return result


def Ad(T: np.ndarray) -> np.ndarray:
    """Adjoint matrix (6, 6): maps a twist from the frame with pose T (4, 4) to the frame in which T is expressed."""
    result = np.zeros((6, 6), dtype=T.dtype)
    result[:3, :3] = result[3:, 3:] = T[:3, :3]
    result[3:, :3] = hat(T[:3, 3]) @ T[:3, :3]
    return result


def ad(V: np.ndarray) -> np.ndarray:
    """Matrix (6, 6) of the Lie bracket [V, .] with a twist V (6,)."""
    result = np.zeros((6, 6), dtype=V.dtype)
    result[:3, :3] = result[3:, 3:] = hat(V[:3])
    result[3:, :3] = hat(V[3:])
    return result


def rotation(quaternion: np.ndarray) -> np.ndarray:
    """The rotation matrix (3, 3) of a quaternion (4,) of any norm."""
    w, v = quaternion[0], quaternion[1:]
    return np.eye(3) + 2.0 * (w * hat(v) + hat(v) @ hat(v)) / np.sum(quaternion**2)


def rotation_vector(quaternion: np.ndarray) -> np.ndarray:
    """The rotation vector (3,), rad, of a quaternion (4,) of any norm; log_quaternion for complex arguments."""
    quaternion = quaternion / np.sqrt(np.sum(quaternion**2)) * (-1.0 if quaternion[0].real < 0.0 else 1.0)
    square = np.sum(quaternion[1:] ** 2)
    if abs(square) < 1e-8:  # asin(s) / s in a series, since sqrt has no derivative at 0
        return (2.0 + square / 3.0 + 3.0 * square**2 / 20.0) * quaternion[1:]
    sine = np.sqrt(square)
    return 4.0 * np.arctan(sine / (1.0 + quaternion[0])) / sine * quaternion[1:]


def inertias(mechanism: Mechanism) -> np.ndarray:
    """J_i of Fig. 2 (nv, 6, 6): mass and inertia about the origin of each link's frame."""
    result = np.zeros((mechanism.nv, 6, 6))
    for J, mass, com, inertia in zip(result, mechanism.mass, mechanism.com, mechanism.inertia, strict=True):
        C = hat(com)
        J[:3, :3], J[:3, 3:] = inertia - mass * C @ C, mass * C
        J[3:, :3], J[3:, 3:] = -mass * C, mass * np.eye(3)
    return result


def link_poses(mechanism: Mechanism, q: np.ndarray) -> np.ndarray:
    """Pose (nv, 4, 4) of each link in the frame of its parent at q (nq,)."""
    m = mechanism
    T = m.T_home.astype(q.dtype)
    for i in range(m.nv):
        if m.kind[i] == SCREW:
            T[i] = m.T_home[i] @ exp6(m.S[i], q[m.q_address[i]] - m.q_home[i])  # Fig. 2, T_{i-1,i} = M_i exp(S_i q_i)
        elif m.kind[i] == BALL:
            R = rotation(q[m.q_address[i] : m.q_address[i] + 4])
            anchor = np.array([m.S[i + 1, 5], m.S[i + 2, 3], m.S[i, 4]])  # of S_k = (e_k, anchor x e_k)
            turn = np.eye(4, dtype=q.dtype)
            turn[:3, :3], turn[:3, 3] = R, anchor - R @ anchor
            T[i] = m.T_home[i] @ turn
    return T


class Twists(NamedTuple):
    """Velocity part of the forward recursion of Fig. 2."""

    X: np.ndarray  # (nv, 6, 6) Ad(T_i^-1), from the parent's frame to the link's
    V: np.ndarray  # (nv+1, 6) twist of each link in its own frame; last the world
    V_base: np.ndarray  # (nv, 6) twist of link `base` in the link's frame


def twists(mechanism: Mechanism, q: np.ndarray, qd: np.ndarray) -> Twists:
    """Twists of all links at q (nq,) and qd (nv,)."""
    n, parent, base = mechanism.nv, mechanism.parent, mechanism.base
    X = np.array([Ad(inverse(T)) for T in link_poses(mechanism, q)]).reshape(n, 6, 6)
    V = np.zeros((n + 1, 6), dtype=np.result_type(X, qd))  # Fig. 2, V_0 = 0
    V_base = np.zeros((n, 6), dtype=V.dtype)
    for i in range(n):
        p = parent[i]
        V_base[i] = X[i] @ (V[p] if base[i] == p else V_base[p])
        V[i] = X[i] @ V[p] + mechanism.S[i] * qd[i]  # Fig. 2, V_i
    return Twists(X, V, V_base)


def internal_forces(mechanism: Mechanism, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
    """Passive forces (nv,) on the left of Eq. 6: springs and dampers of joints and tendons, minus compensation."""
    m = mechanism
    extension = np.where(m.kind == SCREW, q[m.q_address] - m.spring_rest, 0.0)
    forces = m.damping * qd + m.stiffness * extension
    for (a, i), stiffness, rest in zip(m.quaternions, m.ball_stiffness, m.ball_rest, strict=True):
        forces[i : i + 3] += stiffness * rotation_vector(product(conjugate(rest), q[a : a + 4]))
    return forces - tendon_forces(m, q, qd) - compensation(m, q)


def compensation(mechanism: Mechanism, q: np.ndarray) -> np.ndarray:
    """Generalized forces tau (nv,) of gravity compensation: minus the weight of the compensated masses."""
    m = mechanism
    X = np.array([Ad(inverse(T)) for T in link_poses(m, q)]).reshape(m.nv, 6, 6)
    up, F = np.zeros((m.nv + 1, 6), dtype=X.dtype), np.zeros((m.nv + 1, 6), dtype=X.dtype)
    tau = np.zeros(m.nv, dtype=X.dtype)
    up[-1, 3:] = -m.gravity
    for i in range(m.nv):
        up[i] = X[i] @ up[m.parent[i]]
    for i in reversed(range(m.nv)):
        F[i, :3] += hat(m.gravcomp_first_moment[i]) @ up[i, 3:]
        F[i, 3:] += m.gravcomp_mass[i] * up[i, 3:]
        tau[i] = m.S[i] @ F[i]
        F[m.parent[i]] += X[i].T @ F[i]
    return tau


def rnea(mechanism: Mechanism, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
    """Fig. 2, inverse dynamics: tau (nv,) = M(q) qdd + bias(q, qd).

    Args:
        mechanism: The machine.
        q: (nq,) as MuJoCo's qpos; quaternions may have any norm.
        qd: (nv,) as qvel.
        qdd: (nv,) as qacc.
    """
    n, parent, S, J = mechanism.nv, mechanism.parent, mechanism.S, inertias(mechanism)
    X, V, V_base = twists(mechanism, q, qd)
    Vd = np.zeros((n + 1, 6), dtype=np.result_type(V, qdd))
    F, tau = np.zeros_like(Vd), np.zeros(n, dtype=Vd.dtype)
    Vd[-1, 3:] = -mechanism.gravity  # Fig. 2, Vd_0, with gravity
    F[:-1] -= drag_wrenches(mechanism, V)
    for i in range(n):
        Vd[i] = S[i] * qdd[i] + X[i] @ Vd[parent[i]] + ad(V_base[i]) @ S[i] * qd[i]  # Fig. 2, Vd_i
    for i in reversed(range(n)):
        F[i] += J[i] @ Vd[i] - ad(V[i]).T @ J[i] @ V[i]  # Fig. 2, W_i
        tau[i] = S[i] @ F[i]  # Fig. 2, tau_i
        F[parent[i]] += X[i].T @ F[i]  # Fig. 2, W_i, its first term for the parent
    return tau + mechanism.armature * qdd + internal_forces(mechanism, q, qd)


def bias(mechanism: Mechanism, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
    """The bias forces h (nv,) of Eq. 6: Coriolis, gravity and its compensation, springs and dampers."""
    return rnea(mechanism, q, qd, np.zeros(mechanism.nv))


def mass_matrix(mechanism: Mechanism, q: np.ndarray) -> np.ndarray:
    """Mass matrix M (nv, nv) of Eq. 6 with armature, by the composite rigid body algorithm.

    Fig. 2 for unit accelerations at rest without gravity: the links outside a joint move as one rigid body.
    """
    n, parent, S, J = mechanism.nv, mechanism.parent, mechanism.S, inertias(mechanism)
    X = twists(mechanism, q, np.zeros(n)).X
    M = np.zeros((n, n), dtype=X.dtype)
    M += np.diag(mechanism.armature)
    composite = np.zeros((n + 1, 6, 6), dtype=X.dtype)
    for i in reversed(range(n)):
        composite[i] += J[i]
        composite[parent[i]] += X[i].T @ composite[i] @ X[i]
        F = composite[i] @ S[i]  # Fig. 2, W_i for Vd = S_i
        M[i, i] += S[i] @ F
        j = i
        while parent[j] >= 0:
            F, j = X[j].T @ F, parent[j]
            M[i, j] = M[j, i] = S[j] @ F  # Fig. 2, tau_j
    return M


def hybrid_dynamics(
    mechanism: Mechanism, q: np.ndarray, qd: np.ndarray, inputs: np.ndarray, prescribed: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Section 1.2, partially actuated systems: inputs are accelerations of some joints and forces of the others.

    Articulated body algorithm: the wrench on the subtree of link i is F_i = articulated_i Vd_i + rest_i. Toward the
    parent, S_i is eliminated if the joint's force is the input; if its acceleration is, the joint is rigid.

    Args:
        mechanism: The machine.
        q: (nq,) as qpos.
        qd: (nv,) as qvel.
        inputs: (nv,) qdd where prescribed, tau elsewhere.
        prescribed: (nv,) bool, whose acceleration is the input.

    Returns:
        qdd (nv,) and tau (nv,).
    """
    n, parent, S, J = mechanism.nv, mechanism.parent, mechanism.S, inertias(mechanism)
    X, V, V_base = twists(mechanism, q, qd)
    dtype = np.result_type(V, inputs)
    internal = internal_forces(mechanism, q, qd)
    articulated, rest = np.zeros((n + 1, 6, 6), dtype=dtype), np.zeros((n + 1, 6), dtype=dtype)
    rest[:-1] -= drag_wrenches(mechanism, V)
    coriolis, U, D = np.zeros((n, 6), dtype=dtype), np.zeros((n, 6), dtype=dtype), np.zeros(n, dtype=dtype)
    for i in reversed(range(n)):
        articulated[i] += J[i]
        rest[i] -= ad(V[i]).T @ J[i] @ V[i]  # Fig. 2, W_i at Vd_i = 0
        coriolis[i] = ad(V_base[i]) @ S[i] * qd[i]  # Fig. 2, the bracket of Vd_i
        U[i], D[i] = articulated[i] @ S[i], S[i] @ articulated[i] @ S[i] + mechanism.armature[i]
        if prescribed[i]:
            A, b = articulated[i], rest[i] + articulated[i] @ (coriolis[i] + S[i] * inputs[i])
        else:  # tau_i = S_i' W_i of Fig. 2, solved for qdd_i
            A = articulated[i] - np.outer(U[i], U[i]) / D[i]
            b = rest[i] + A @ coriolis[i] + U[i] * (inputs[i] - internal[i] - S[i] @ rest[i]) / D[i]
        articulated[parent[i]] += X[i].T @ A @ X[i]
        rest[parent[i]] += X[i].T @ b
    Vd = np.zeros((n + 1, 6), dtype=dtype)
    Vd[-1, 3:] = -mechanism.gravity
    qdd, tau = np.array(inputs, dtype=dtype), np.array(inputs, dtype=dtype)
    for i in range(n):
        Vd[i] = X[i] @ Vd[parent[i]] + coriolis[i]  # Fig. 2, Vd_i without S_i qdd_i
        if prescribed[i]:
            tau[i] = U[i] @ Vd[i] + D[i] * qdd[i] + S[i] @ rest[i] + internal[i]
        else:
            qdd[i] = (tau[i] - internal[i] - S[i] @ rest[i] - U[i] @ Vd[i]) / D[i]
        Vd[i] += S[i] * qdd[i]
    return qdd, tau


def forward_dynamics(mechanism: Mechanism, q: np.ndarray, qd: np.ndarray, tau: np.ndarray) -> np.ndarray:
    """Accelerations qdd (nv,) under tau (nv,): the hybrid dynamics in which no joint is prescribed."""
    return hybrid_dynamics(mechanism, q, qd, tau, np.zeros(mechanism.nv, dtype=bool))[0]


def world_poses(mechanism: Mechanism, q: np.ndarray) -> np.ndarray:
    """Pose (nv+1, 4, 4) of each link in the world; section 1.2, the product of exponentials."""
    T = link_poses(mechanism, q)
    G = np.empty((mechanism.nv + 1, 4, 4), dtype=T.dtype)
    G[-1] = np.eye(4)
    for i in range(mechanism.nv):
        G[i] = G[mechanism.parent[i]] @ T[i]
    return G


def forward_kinematics(mechanism: Mechanism, q: np.ndarray) -> np.ndarray:
    """Poses (nbody, 4, 4) of MuJoCo's bodies in the world."""
    G = world_poses(mechanism, q)
    return np.array([G[body.link] @ body.T for body in mechanism.bodies])


def jacobian(mechanism: Mechanism, q: np.ndarray, frame: Frame) -> np.ndarray:
    """Jacobian (6, nv) of a frame at its origin, linear then angular rows, in the world's axes, as mj_jacSite."""
    G = world_poses(mechanism, q)
    position = (G[frame.link] @ frame.T)[:3, 3]
    J = np.zeros((6, mechanism.nv), dtype=G.dtype)
    for i in chain_of(mechanism.parent, frame.link):
        angular, linear = np.split(Ad(G[i]) @ mechanism.S[i], 2)  # at the world's origin
        J[:, i] = *(linear + np.cross(angular, position)), *angular
    return J
