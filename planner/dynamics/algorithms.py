"""Dynamics of a Mechanism as functions: one state or a batch in, NumPy out, compiled inside.

q, qd and qdd are MuJoCo's qpos, qvel and qacc in its order and frames (free joint: world linear, then body angular;
quaternion w first). tau (nv,) is the applied generalized force; gravity, springs, damping and armature are the
mechanism's own; actuators, contacts, stops and curves are not part of these functions:

    M(q) qdd + bias(q, qd) = tau                                                            (Eq. 6)

Derivatives with respect to q are with respect to a deviation of it, nv columns (see model.space). All take a single
state, q (nq,), or K of them, q (K, nq).
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, NamedTuple

import numpy as np

from planner.base.errors import PlannerError
from planner.dynamics.batch import Batch, kernel_model
from planner.kernels.tree import batch as tree_batch
from planner.kernels.tree.model import Model
from planner.model.mechanism import Frame, Mechanism
from planner.model.space import hat


class Derivatives(NamedTuple):
    """Partial derivatives (..., nv, nv) of a function of (q, qd, input)."""

    q: np.ndarray
    qd: np.ndarray
    input: np.ndarray


def forward_dynamics(mechanism: Mechanism, q: Any, qd: Any, tau: Any) -> np.ndarray:
    """Accelerations qdd (..., nv) from applied forces (Fig. 2, forward dynamics).

    Args:
        mechanism: The machine.
        q: (..., nq).
        qd: (..., nv).
        tau: (..., nv) N m or N.

    Raises:
        PlannerError: A wrong shape or a number that is not finite.
    """
    b = Batch(mechanism, q=q, qd=qd, tau=tau)
    return b.out(_forward(b, kernel_model(mechanism), b["tau"])[0])


def _forward(b: Batch, model: Model, inputs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    qdd, tau = np.empty_like(inputs), np.empty_like(inputs)
    b.call(tree_batch.forward, model, b["qd"], inputs, qdd, tau)
    return qdd, tau


def hybrid_dynamics(
    mechanism: Mechanism, q: Any, qd: Any, inputs: Any, prescribed: Collection[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Some joints are given their force, the others their acceleration (the paper's Cases 2 and 3).

    Args:
        mechanism: The machine.
        q: (..., nq).
        qd: (..., nv).
        inputs: (..., nv) forces or, for prescribed joints, accelerations.
        prescribed: Names of the joints whose accelerations are given.

    Returns:
        (qdd, tau), both (..., nv).
    """
    b = Batch(mechanism, q=q, qd=qd, inputs=inputs)
    mask = _prescribed(mechanism, prescribed)
    qdd, tau = _forward(b, kernel_model(mechanism, mask), b["inputs"])
    return b.out(qdd), b.out(tau)


def _prescribed(mechanism: Mechanism, names: Collection[str]) -> np.ndarray:
    if not isinstance(names, (str, Collection)):
        raise PlannerError(f"prescribed is {names!r}, expected names of joints.")
    mask = np.zeros(mechanism.nv, dtype=bool)
    for name in (names,) if isinstance(names, str) else names:
        mask[mechanism.joint(name)] = True
    return mask


def rnea(mechanism: Mechanism, q: Any, qd: Any, qdd: Any) -> np.ndarray:
    """Applied forces tau (..., nv) from accelerations (Fig. 2, inverse dynamics).

    Args:
        mechanism: The machine.
        q: (..., nq).
        qd: (..., nv).
        qdd: (..., nv).
    """
    b = Batch(mechanism, q=q, qd=qd, qdd=qdd)
    return b.out(_inverse(b, b["qd"], b["qdd"]))


def _inverse(b: Batch, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
    tau = np.empty_like(qdd)
    b.call(tree_batch.inverse, kernel_model(b.mechanism), qd, qdd, tau)
    return tau


def bias(mechanism: Mechanism, q: Any, qd: Any) -> np.ndarray:
    """Forces at zero acceleration (..., nv): Coriolis, gravity, damping and springs (h of Eq. 6)."""
    b = Batch(mechanism, q=q, qd=qd)
    return b.out(_inverse(b, b["qd"], np.zeros_like(b["qd"])))


def mass_matrix(mechanism: Mechanism, q: Any) -> np.ndarray:
    """M(q) (..., nv, nv), armature included (Eq. 6)."""
    b = Batch(mechanism, q=q)
    zero = np.zeros((b.K, mechanism.nv))
    return b.out(_inverse_derivatives(b, zero, zero)[2])


def _inverse_derivatives(b: Batch, qd: np.ndarray, qdd: np.ndarray) -> Derivatives:
    nv = b.mechanism.nv
    M, Dq, Dv = (np.empty((b.K, nv, nv)) for _ in range(3))
    b.call(tree_batch.derivatives, kernel_model(b.mechanism), qd, qdd, M, Dq, Dv, linearizing=True)
    return Derivatives(Dq, Dv, M)


def _outs(b: Batch, *values: np.ndarray) -> Derivatives:
    return Derivatives(*(b.out(value) for value in values))


def rnea_derivatives(mechanism: Mechanism, q: Any, qd: Any, qdd: Any) -> Derivatives:
    """Derivatives of tau by q, qd and qdd (which is M), each (..., nv, nv) (the recursive sensitivities of Fig. 2)."""
    b = Batch(mechanism, q=q, qd=qd, qdd=qdd)
    return _outs(b, *_inverse_derivatives(b, b["qd"], b["qdd"]))


def bias_derivatives(mechanism: Mechanism, q: Any, qd: Any) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives of the bias by q and qd, each (..., nv, nv)."""
    b = Batch(mechanism, q=q, qd=qd)
    result = _inverse_derivatives(b, b["qd"], np.zeros_like(b["qd"]))
    return b.out(result.q), b.out(result.qd)


def mass_matrix_derivatives(mechanism: Mechanism, q: Any) -> np.ndarray:
    """Derivative of M (..., nv, nv, nv) by q, the last axis."""
    b = Batch(mechanism, q=q)
    nv = mechanism.nv
    many = Batch(mechanism, q=np.repeat(b["q"], nv + 1, axis=0))
    qdd = np.tile(np.concatenate([np.zeros((1, nv)), np.eye(nv)]), (b.K, 1))
    forces = _inverse_derivatives(many, np.zeros_like(qdd), qdd).q.reshape(b.K, nv + 1, nv, nv)
    return b.out(np.swapaxes(forces[:, 1:] - forces[:, :1], 1, 2))  # M is linear in qdd: column k belongs to e_k


def forward_dynamics_derivatives(mechanism: Mechanism, q: Any, qd: Any, tau: Any) -> Derivatives:
    """Derivatives of qdd by q, qd and tau (which is the inverse of M), each (..., nv, nv)."""
    b = Batch(mechanism, q=q, qd=qd, tau=tau)
    qdd, _ = _forward(b, kernel_model(mechanism), b["tau"])
    by_q, by_qd, M = _inverse_derivatives(b, b["qd"], qdd)
    return _outs(b, -np.linalg.solve(M, by_q), -np.linalg.solve(M, by_qd), np.linalg.inv(M))


def hybrid_dynamics_derivatives(
    mechanism: Mechanism, q: Any, qd: Any, inputs: Any, prescribed: Collection[str]
) -> tuple[Derivatives, Derivatives]:
    """Derivatives of qdd and of tau by q, qd and inputs, each (..., nv, nv); see hybrid_dynamics."""
    b = Batch(mechanism, q=q, qd=qd, inputs=inputs)
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
        d[:, free] = 0.0  # given, not computed
    forces[2][:, free] = np.diag(free.astype(float))[free]
    return _outs(b, *accelerations), _outs(b, *forces)


def _places(b: Batch) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Per link: pose (K, nv, 4, 4) in the world, screws (K, nv, 6) about an origin, and that origin (K, nv, 3)."""
    model, nv = kernel_model(b.mechanism), b.mechanism.nv
    records = np.empty((b.K, nv, 18))
    b.call(tree_batch.places, model, records)
    origin = np.tile(model.origin, (b.K, 1, 1))
    for i in np.flatnonzero(model.floating_address >= 0):
        a = model.floating_address[i]
        origin[:, i] = b["q"][:, a : a + 3]
    T = np.zeros((b.K, nv, 4, 4))
    T[..., :3, :3] = records[..., :9].reshape(b.K, nv, 3, 3)
    T[..., :3, 3], T[..., 3, 3] = records[..., 9:12] + origin, 1.0
    T = T @ np.linalg.inv(model.own_frames)
    for i in np.flatnonzero(model.floating):  # the slides of a free joint, which the kernels leave at the origin
        first = model.floating_address[i]
        T[:, i, :3, 3] = 0.0
        count = int(b.mechanism.q_address[i]) - int(first) + 1
        T[:, i, :count, 3] = b["q"][:, first : first + count]
    return T, records[..., 12:], origin


def _framed(mechanism: Mechanism, frame: str | Frame) -> Frame:
    return frame if isinstance(frame, Frame) else mechanism.frame(frame)


def forward_kinematics(mechanism: Mechanism, q: Any) -> np.ndarray:
    """Poses (..., nbody, 4, 4) of MuJoCo's bodies, the world first."""
    b = Batch(mechanism, q=q)
    T = _places(b)[0]
    poses = [frame.T if frame.link < 0 else T[:, frame.link] @ frame.T for frame in mechanism.bodies]
    return b.out(np.stack([np.broadcast_to(pose, (b.K, 4, 4)) for pose in poses], axis=1))


def frame_pose(mechanism: Mechanism, q: Any, frame: str | Frame) -> np.ndarray:
    """Pose (..., 4, 4) of a site or body in the world."""
    b, f = Batch(mechanism, q=q), _framed(mechanism, frame)
    if f.link < 0:
        return b.out(np.tile(f.T, (b.K, 1, 1)))
    return b.out(_places(b)[0][:, f.link] @ f.T)


def _moving(mechanism: Mechanism, link: int) -> list[int]:
    """The links that move a link, itself included, from the root on."""
    chain = []
    while link >= 0:
        chain.append(link)
        link = int(mechanism.parent[link])
    return chain[::-1]


def jacobian(mechanism: Mechanism, q: Any, frame: str | Frame) -> np.ndarray:
    """Jacobian (..., 6, nv) of a site or body: rows linear, then angular, in the world's axes at the frame's origin."""
    b, f = Batch(mechanism, q=q), _framed(mechanism, frame)
    T, screws, origin = _places(b)
    J = np.zeros((b.K, 6, mechanism.nv))
    if f.link >= 0:
        p = (T[:, f.link] @ f.T)[:, :3, 3] - origin[:, f.link]
        for i in _moving(mechanism, f.link):
            J[:, 3:, i] = screws[:, i, :3]
            J[:, :3, i] = screws[:, i, 3:] + np.cross(screws[:, i, :3], p)
    return b.out(J)


def points_of(
    mechanism: Mechanism, q: Any, links: np.ndarray, offsets: np.ndarray, *, moving: bool = True
) -> tuple[np.ndarray, np.ndarray]:
    """Places (..., P, 3) of points of links in the world and, where asked, their Jacobians (..., P, 3, nv).

    Args:
        mechanism: The machine.
        q: (..., nq).
        links: (P,) which carry the points; -1 for the world.
        offsets: (P, 3) m, in the links' frames.
        moving: Whether Jacobians are wanted; else they are empty.
    """
    b = Batch(mechanism, q=q)
    T, screws, origin = _places(b)
    T = np.concatenate([T, np.tile(np.eye(4), (b.K, 1, 1, 1))], axis=1)  # the last one is the world's
    T = T[:, links]
    places = np.einsum("kpij,pj->kpi", T[..., :3, :3], offsets) + T[..., :3, 3]
    if not moving:
        return b.out(places), np.empty(0)
    J = np.zeros((b.K, len(links), mechanism.nv, 3))
    for p, link in enumerate(links):
        chain = _moving(mechanism, int(link))
        arm = places[:, p] - origin[:, link]
        J[:, p, chain] = screws[:, chain, 3:] + np.cross(screws[:, chain, :3], arm[:, None])
    return b.out(places), b.out(np.swapaxes(J, 2, 3))


def forward_kinematics_derivatives(mechanism: Mechanism, q: Any) -> np.ndarray:
    """Derivative of the bodies' poses by q as twists (..., nbody, 6, nv): linear and angular rows, as jacobian()."""
    b = Batch(mechanism, q=q)
    J = [jacobian(mechanism, b["q"], frame) for frame in mechanism.bodies]
    return b.out(np.stack(J, axis=1))


def jacobian_derivatives(mechanism: Mechanism, q: Any, frame: str | Frame) -> np.ndarray:
    """Derivative (..., 6, nv, nv) of jacobian() by q, the last axis."""
    b, f = Batch(mechanism, q=q), _framed(mechanism, frame)
    D = np.zeros((b.K, 6, mechanism.nv, mechanism.nv))
    if f.link < 0:
        return b.out(D)
    J = jacobian(mechanism, b["q"], f)
    chain = _moving(mechanism, f.link)
    block = np.array(mechanism.base)  # axes of one ball turn together
    for k in chain:
        turn = hat(J[:, 3:, k])
        for j in chain:
            # Moving dof k carries the axes at or beyond it, and the frame's origin with all of them.
            carried = j > k or (mechanism.kind[j] != 0 and mechanism.kind[k] != 0 and block[j] == block[k])
            if carried:
                D[:, 3:, j, k] = np.einsum("nab,nb->na", turn, J[:, 3:, j])
                D[:, :3, j, k] = np.einsum("nab,nb->na", turn, J[:, :3, j])
            else:
                D[:, :3, j, k] = np.cross(J[:, 3:, j], J[:, :3, k])
    return b.out(D)
