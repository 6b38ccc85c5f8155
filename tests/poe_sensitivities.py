"""Derivatives of Fig. 2, by differentiating its recursion line by line (section 1.2; the paper's [15]).

All that a derivative needs is that of the exponential, dT/dq = T S^, which makes

    d Ad(T_i^-1) / dq_i = -ad(S_i) Ad(T_i^-1).

Derivatives with respect to q are along the group: the column of a ball's axis k is that of Q exp(e_k t) at t = 0.
A derivative of a twist or wrench is (6, 3 nv): columns for q, then for qd, then for qdd.
"""

from __future__ import annotations

import numpy as np

from planner.dynamics.product_of_exponentials import ad, hybrid_dynamics, inertias, twists
from planner.model.mechanism import BALL, BALL_NEXT, Mechanism
from planner.model.space import conjugate, hat, log_jacobian, log_quaternion, product, unit

Derivatives = tuple[np.ndarray, np.ndarray, np.ndarray]


def ad_transposed_of(F: np.ndarray) -> np.ndarray:
    """(6, 6): ad(V)' F as a linear function of V, for a wrench F (6,)."""
    result = np.zeros((6, 6))
    result[:3, :3] = hat(F[:3])
    result[:3, 3:] = result[3:, :3] = hat(F[3:])
    return result


def turning(mechanism: Mechanism, i: int) -> range:
    """The coordinates that the pose of link i in its parent depends on: its own; all three of a ball; none."""
    return range(i, i + {BALL: 3, BALL_NEXT: 0}.get(int(mechanism.kind[i]), 1))


def rnea_derivatives(mechanism: Mechanism, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> Derivatives:
    """Derivatives of rnea with respect to q (in the tangent), qd and qdd, (nv, nv) each.

    Args:
        mechanism: The machine.
        q: (nq,).
        qd: (nv,).
        qdd: (nv,).
    """
    n, parent, base, S, J = mechanism.nv, mechanism.parent, mechanism.base, mechanism.S, inertias(mechanism)
    X, V, V_base = twists(mechanism, q, qd)
    Vd, F = np.zeros((n + 1, 6)), np.zeros((n + 1, 6))
    Vd[-1, 3:] = -mechanism.gravity
    dV, dVd, dF = np.zeros((n + 1, 6, 3 * n)), np.zeros((n + 1, 6, 3 * n)), np.zeros((n + 1, 6, 3 * n))
    dV_base, dtau = np.zeros((n, 6, 3 * n)), np.zeros((n, 3 * n))
    for i in range(n):
        p, own_qd, own_qdd = parent[i], n + i, 2 * n + i
        before, dbefore = (V[p], dV[p]) if base[i] == p else (V_base[p], dV_base[p])
        # Fig. 2, V_i
        dV[i], dV_base[i] = X[i] @ dV[p], X[i] @ dbefore
        for j in turning(mechanism, i):
            dV[i, :, j] -= ad(S[j]) @ X[i] @ V[p]
            dV_base[i, :, j] -= ad(S[j]) @ X[i] @ before
        dV[i, :, own_qd] += S[i]
        # Fig. 2, Vd_i
        Vd[i] = S[i] * qdd[i] + X[i] @ Vd[p] + ad(V_base[i]) @ S[i] * qd[i]
        dVd[i] = X[i] @ dVd[p] - ad(S[i] * qd[i]) @ dV_base[i]
        for j in turning(mechanism, i):
            dVd[i, :, j] -= ad(S[j]) @ X[i] @ Vd[p]
        dVd[i, :, own_qd] += ad(V_base[i]) @ S[i]
        dVd[i, :, own_qdd] += S[i]
    for i in reversed(range(n)):
        p, momentum = parent[i], J[i] @ V[i]
        # Fig. 2, W_i
        F[i] += J[i] @ Vd[i] - ad(V[i]).T @ momentum
        dF[i] += J[i] @ dVd[i] - ad(V[i]).T @ J[i] @ dV[i] - ad_transposed_of(momentum) @ dV[i]
        # Fig. 2, tau_i
        dtau[i] = S[i] @ dF[i]
        # Fig. 2, W_i, its first term for the parent
        F[p] += X[i].T @ F[i]
        dF[p] += X[i].T @ dF[i]
        for j in turning(mechanism, i):
            dF[p, :, j] -= X[i].T @ ad(S[j]).T @ F[i]
    dq, dqd, dqdd = np.split(dtau, 3, axis=1)
    dq += np.diag(mechanism.stiffness) + ball_spring_derivative(mechanism, q)
    return dq, dqd + np.diag(mechanism.damping), dqdd + np.diag(mechanism.armature)


def ball_spring_derivative(mechanism: Mechanism, q: np.ndarray) -> np.ndarray:
    """Of the springs' torque on balls, (nv, nv) in the tangent."""
    m = mechanism
    result = np.zeros((m.nv, m.nv))
    for (a, i), stiffness, rest in zip(m.quaternions, m.ball_stiffness, m.ball_rest, strict=True):
        turned = log_quaternion(product(conjugate(rest), unit(q[a : a + 4])))
        result[i : i + 3, i : i + 3] = stiffness * log_jacobian(turned)
    return result


def hybrid_dynamics_derivatives(
    mechanism: Mechanism, q: np.ndarray, qd: np.ndarray, inputs: np.ndarray, prescribed: np.ndarray
) -> tuple[Derivatives, Derivatives]:
    """Derivatives of hybrid_dynamics' qdd and tau with respect to q (in the tangent), qd and inputs, (nv, nv) each.

    From rnea(q, qd, qdd) = tau: where the force is given, the accelerations change so that the force does not.

    Args:
        mechanism: The machine.
        q: (nq,).
        qd: (nv,).
        inputs: (nv,) qdd where prescribed, tau elsewhere.
        prescribed: (nv,) bool.
    """
    n, free = mechanism.nv, ~prescribed
    qdd, _ = hybrid_dynamics(mechanism, q, qd, inputs, prescribed)
    dq, dqd, M = rnea_derivatives(mechanism, q, qd, qdd)
    dqdd = np.zeros((n, 3 * n))  # columns: q, qd, inputs
    dqdd[prescribed, 2 * n + np.flatnonzero(prescribed)] = 1.0
    dtau = np.hstack([dq, dqd, np.zeros((n, n))]) + M @ dqdd  # as if the free joints did not give way
    given = np.zeros((n, 3 * n))
    given[free, 2 * n + np.flatnonzero(free)] = 1.0
    dqdd[free] = np.linalg.solve(M[np.ix_(free, free)], (given - dtau)[free])
    dtau += M[:, free] @ dqdd[free]
    dtau[free] = given[free]
    by_q, by_qd, by_input = np.split(dqdd, 3, axis=1)
    tau_by_q, tau_by_qd, tau_by_input = np.split(dtau, 3, axis=1)
    return (by_q, by_qd, by_input), (tau_by_q, tau_by_qd, tau_by_input)


def forward_dynamics_derivatives(mechanism: Mechanism, q: np.ndarray, qd: np.ndarray, tau: np.ndarray) -> Derivatives:
    """Derivatives of forward_dynamics with respect to q (in the tangent), qd and tau, (nv, nv) each.

    -M^-1 d rnea/dq, -M^-1 d rnea/dqd and M^-1, at the acceleration that tau causes.
    """
    return hybrid_dynamics_derivatives(mechanism, q, qd, tau, np.zeros(mechanism.nv, dtype=bool))[0]
