"""Dynamics of a Mechanism as compiled functions of one state or a batch, with NumPy arrays.

q, qd and qdd are MuJoCo's qpos, qvel and qacc in its order and frames (free joint: world linear, then body angular;
quaternion w first). tau (nv,) is the applied generalized force; gravity and its compensation, springs, damping, tendons
and armature are the mechanism's own. Actuators, contacts, stops and exponential torques are excluded, as is
friction loss, which depends on qdd (planner.dynamics.joint_forces):

    M(q) qdd + bias(q, qd) = tau                                                            (Eq. 6)

Loop closures are excluded. Only forward_dynamics and its derivatives include couplings, with G (G' M G)^-1 G' in place
of M^-1 (see planner.model.couplings); hybrid_dynamics raises for them.

Derivatives with respect to q are with respect to a deviation of it, nv columns (see model.space). All take a single
state, q (nq,), or K of them, q (K, nq).
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, NamedTuple

import numpy as np

from planner.base.errors import PlannerError
from planner.dynamics.batch import KernelCall, kernel_model
from planner.kernels.tree import batch as tree_batch
from planner.kernels.tree.mechanism_table import Model
from planner.model.mechanism import Mechanism


class Derivatives(NamedTuple):
    """Partial derivatives (..., nv, nv) of a function of (q, qd, input)."""

    q: np.ndarray
    qd: np.ndarray
    input: np.ndarray


def forward_dynamics(mechanism: Mechanism, q: Any, qd: Any, tau: Any) -> np.ndarray:
    """Forward dynamics: accelerations from applied forces (Fig. 2).

    Args:
        mechanism: The machine.
        q: (..., nq) configurations, m and rad.
        qd: (..., nv) velocities, m/s and rad/s.
        tau: (..., nv) applied forces, N and N m.

    Returns:
        qdd (..., nv), m/s^2 and rad/s^2.

    Raises:
        PlannerError: A wrong shape or a number that is not finite; closed chains.
    """
    b = KernelCall(mechanism, q=q, qd=qd, tau=tau)
    _check_tree(mechanism)
    return b.out(_accelerations(b))


def _check_tree(mechanism: Mechanism) -> None:
    if mechanism.has_closed_chains:
        first = (*mechanism.loops, *mechanism.polynomial_couplings)[0]
        raise PlannerError(
            f"the mechanism has {first.name}, which closes a chain, and these are "
            "dynamics of a tree, expected planner.dynamics.closed_dynamics, or RigidBodyDynamics(...).rates."
        )


def _accelerations(b: KernelCall) -> np.ndarray:
    """Accelerations (K, nv) of forward_dynamics, with couplings."""
    if b.mechanism.reduction is None:
        return _forward(b, kernel_model(b.mechanism), b["tau"])[0]
    zero = np.zeros_like(b["qd"])
    W = reduced_inverse(b.mechanism, _inverse_derivatives(b, zero, zero).input)
    return np.einsum("kij,kj->ki", W, b["tau"] - _inverse(b, b["qd"], zero))


def reduced_inverse(mechanism: Mechanism, M: np.ndarray) -> np.ndarray:
    """G (G' M G)^-1 G' (..., nv, nv) of mass matrices M (..., nv, nv): the inverse without couplings."""
    if mechanism.reduction is None:
        return np.linalg.inv(M)
    G = mechanism.reduction.G
    return G @ np.linalg.inv(G.T @ M @ G) @ G.T


def _forward(b: KernelCall, model: Model, inputs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    qdd, tau = np.empty_like(inputs), np.empty_like(inputs)
    b.call(tree_batch.forward, model, b["qd"], inputs, qdd, tau)
    return qdd, tau


def hybrid_dynamics(
    mechanism: Mechanism, q: Any, qd: Any, inputs: Any, prescribed: Collection[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Hybrid dynamics: inputs are forces of some joints and accelerations of the others (the paper's Cases 2 and 3).

    Args:
        mechanism: The machine.
        q: (..., nq) configurations, m and rad.
        qd: (..., nv) velocities, m/s and rad/s.
        inputs: (..., nv) forces, N and N m, or, for prescribed joints, accelerations, m/s^2 and rad/s^2.
        prescribed: Names of the joints whose accelerations are inputs.

    Returns:
        (qdd, tau), both (..., nv).

    Raises:
        PlannerError: A wrong shape or a number that is not finite; an unknown joint; couplings; closed chains.
    """
    b = KernelCall(mechanism, q=q, qd=qd, inputs=inputs)
    mask = _prescribed(mechanism, prescribed)
    qdd, tau = _forward(b, kernel_model(mechanism, mask), b["inputs"])
    return b.out(qdd), b.out(tau)


def _prescribed(mechanism: Mechanism, names: Collection[str]) -> np.ndarray:
    if not isinstance(names, (str, Collection)):
        raise PlannerError(f"prescribed is {names!r}, expected names of joints.")
    _check_tree(mechanism)
    if mechanism.couplings:
        raise PlannerError(
            f"the mechanism has {mechanism.couplings[0].name} and hybrid dynamics know no couplings, expected "
            "RigidBodyDynamics(..., prescribed=...).rates."
        )
    mask = np.zeros(mechanism.nv, dtype=bool)
    for name in (names,) if isinstance(names, str) else names:
        mask[mechanism.joint(name)] = True
    return mask


def rnea(mechanism: Mechanism, q: Any, qd: Any, qdd: Any) -> np.ndarray:
    """Inverse dynamics by the recursive Newton-Euler algorithm (Fig. 2).

    Args:
        mechanism: The machine.
        q: (..., nq) configurations, m and rad.
        qd: (..., nv) velocities, m/s and rad/s.
        qdd: (..., nv) accelerations, m/s^2 and rad/s^2.

    Returns:
        The applied forces tau (..., nv), N and N m.

    Raises:
        PlannerError: A wrong shape or a number that is not finite.
    """
    b = KernelCall(mechanism, q=q, qd=qd, qdd=qdd)
    return b.out(_inverse(b, b["qd"], b["qdd"]))


def _inverse(b: KernelCall, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
    tau = np.empty_like(qdd)
    b.call(tree_batch.inverse, kernel_model(b.mechanism), qd, qdd, tau)
    return tau


def bias(mechanism: Mechanism, q: Any, qd: Any) -> np.ndarray:
    """Forces at zero acceleration (h of Eq. 6): Coriolis, gravity and its compensation, damping, springs, tendons.

    Args:
        mechanism: The machine.
        q: (..., nq) configurations, m and rad.
        qd: (..., nv) velocities, m/s and rad/s.

    Returns:
        h (..., nv), N and N m.

    Raises:
        PlannerError: A wrong shape or a number that is not finite.
    """
    b = KernelCall(mechanism, q=q, qd=qd)
    return b.out(_inverse(b, b["qd"], np.zeros_like(b["qd"])))


def mass_matrix(mechanism: Mechanism, q: Any) -> np.ndarray:
    """The mass matrix M(q), armature included (Eq. 6).

    Args:
        mechanism: The machine.
        q: (..., nq) configurations, m and rad.

    Returns:
        M (..., nv, nv), kg, kg m and kg m^2.

    Raises:
        PlannerError: A wrong shape or a number that is not finite.
    """
    b = KernelCall(mechanism, q=q)
    zero = np.zeros((b.K, mechanism.nv))
    return b.out(_inverse_derivatives(b, zero, zero)[2])


def _inverse_derivatives(b: KernelCall, qd: np.ndarray, qdd: np.ndarray) -> Derivatives:
    nv = b.mechanism.nv
    M, Dq, Dv = (np.empty((b.K, nv, nv)) for _ in range(3))
    b.call(tree_batch.derivatives, kernel_model(b.mechanism), qd, qdd, M, Dq, Dv, linearizing=True)
    return Derivatives(Dq, Dv, M)


def _outs(b: KernelCall, *values: np.ndarray) -> Derivatives:
    return Derivatives(*(b.out(value) for value in values))


def rnea_derivatives(mechanism: Mechanism, q: Any, qd: Any, qdd: Any) -> Derivatives:
    """Derivatives of rnea by the recursive sensitivities of Fig. 2.

    Args:
        mechanism: The machine.
        q: (..., nq) configurations, m and rad.
        qd: (..., nv) velocities, m/s and rad/s.
        qdd: (..., nv) accelerations, m/s^2 and rad/s^2.

    Returns:
        Derivatives of tau by q, qd and, as `input`, qdd (which is M), each (..., nv, nv).

    Raises:
        PlannerError: A wrong shape or a number that is not finite.
    """
    b = KernelCall(mechanism, q=q, qd=qd, qdd=qdd)
    return _outs(b, *_inverse_derivatives(b, b["qd"], b["qdd"]))


def bias_derivatives(mechanism: Mechanism, q: Any, qd: Any) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives of bias.

    Args:
        mechanism: The machine.
        q: (..., nq) configurations, m and rad.
        qd: (..., nv) velocities, m/s and rad/s.

    Returns:
        Derivatives of h by q and by qd, each (..., nv, nv).

    Raises:
        PlannerError: A wrong shape or a number that is not finite.
    """
    b = KernelCall(mechanism, q=q, qd=qd)
    result = _inverse_derivatives(b, b["qd"], np.zeros_like(b["qd"]))
    return b.out(result.q), b.out(result.qd)


def mass_matrix_derivatives(mechanism: Mechanism, q: Any) -> np.ndarray:
    """Derivative of mass_matrix.

    Args:
        mechanism: The machine.
        q: (..., nq) configurations, m and rad.

    Returns:
        dM/dq (..., nv, nv, nv): q is the last axis.

    Raises:
        PlannerError: A wrong shape or a number that is not finite.
    """
    b = KernelCall(mechanism, q=q)
    nv = mechanism.nv
    many = KernelCall(mechanism, q=np.repeat(b["q"], nv + 1, axis=0))
    qdd = np.tile(np.concatenate([np.zeros((1, nv)), np.eye(nv)]), (b.K, 1))
    forces = _inverse_derivatives(many, np.zeros_like(qdd), qdd).q.reshape(b.K, nv + 1, nv, nv)
    return b.out(np.swapaxes(forces[:, 1:] - forces[:, :1], 1, 2))  # M is linear in qdd: column k belongs to e_k


def forward_dynamics_derivatives(mechanism: Mechanism, q: Any, qd: Any, tau: Any) -> Derivatives:
    """Derivatives of forward_dynamics.

    Args:
        mechanism: The machine.
        q: (..., nq) configurations, m and rad.
        qd: (..., nv) velocities, m/s and rad/s.
        tau: (..., nv) applied forces, N and N m.

    Returns:
        Derivatives of qdd by q, qd and, as `input`, tau (which is the inverse of M, or with
        couplings G (G' M G)^-1 G'), each (..., nv, nv).

    Raises:
        PlannerError: A wrong shape or a number that is not finite; closed chains.
    """
    b = KernelCall(mechanism, q=q, qd=qd, tau=tau)
    _check_tree(mechanism)
    qdd = _accelerations(b)
    by_q, by_qd, M = _inverse_derivatives(b, b["qd"], qdd)
    if mechanism.reduction is not None:
        W = reduced_inverse(mechanism, M)
        return _outs(b, -W @ by_q, -W @ by_qd, W)
    return _outs(b, -np.linalg.solve(M, by_q), -np.linalg.solve(M, by_qd), np.linalg.inv(M))


def hybrid_dynamics_derivatives(
    mechanism: Mechanism, q: Any, qd: Any, inputs: Any, prescribed: Collection[str]
) -> tuple[Derivatives, Derivatives]:
    """Derivatives of hybrid_dynamics, with the same arguments.

    Args:
        mechanism: The machine.
        q: (..., nq) configurations, m and rad.
        qd: (..., nv) velocities, m/s and rad/s.
        inputs: (..., nv) forces, or accelerations of prescribed joints.
        prescribed: Names of the joints whose accelerations are inputs.

    Returns:
        Derivatives of qdd and of tau by q, qd and inputs, each (..., nv, nv).

    Raises:
        PlannerError: A wrong shape or a number that is not finite; an unknown joint; couplings; closed chains.
    """
    b = KernelCall(mechanism, q=q, qd=qd, inputs=inputs)
    mask = _prescribed(mechanism, prescribed)
    qdd, _ = _forward(b, kernel_model(mechanism, mask), b["inputs"])
    by_q, by_qd, M = _inverse_derivatives(b, b["qd"], qdd)
    free = ~mask
    accelerations = []
    rest = [by_q, by_qd, np.tile(np.where(free, 0.0, 1.0) * M, (1, 1, 1)) - np.diag(free.astype(float))]
    for term in rest:  # M_ff dqdd_f = dtau_f - (dtau/d.)_f
        result = np.zeros_like(M)
        result[:, free] = -np.linalg.solve(M[:, free][:, :, free], term[:, free])
        accelerations.append(result)
    accelerations[2][:, mask, mask] = 1.0
    forces = [d + M @ a for d, a in zip((by_q, by_qd, np.zeros_like(M)), accelerations, strict=True)]
    for d in forces[:2]:
        d[:, free] = 0.0  # inputs, so constant
    forces[2][:, free] = np.diag(free.astype(float))[free]
    return _outs(b, *accelerations), _outs(b, *forces)
