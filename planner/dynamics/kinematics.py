"""Kinematics of a Mechanism as compiled functions of one state or a batch: poses, Jacobians, momentum.

Conventions are those of planner.dynamics.algorithms. Internal forces cannot change the momentum: in flight only gravity
acts, so the centre of mass follows a parabola and the angular momentum about it is constant, whatever the joints do; a
plan satisfies both to the order of its integrator.

    m c = sum m_i c_i,    L = sum R_i I_i R_i' w_i + m_i (c_i - c) x (v_i - v)    over the links i, in the world's axes.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.base.arguments import short_repr
from planner.base.errors import PlannerError
from planner.dynamics.batch import KernelCall, kernel_model
from planner.kernels.tree import batch as tree_batch
from planner.kernels.tree.mechanism_table import chain_of
from planner.model.mechanism import Frame, Mechanism
from planner.model.space import cross, hat


def link_places(b: KernelCall) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
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
    for i in np.flatnonzero(model.floating):  # slides of a free joint, whose translation the kernels omit
        first = model.floating_address[i]
        T[:, i, :3, 3] = 0.0
        count = int(b.mechanism.q_address[i]) - int(first) + 1
        T[:, i, :count, 3] = b["q"][:, first : first + count]
    return T, records[..., 12:], origin


def _framed(mechanism: Mechanism, frame: str | Frame) -> Frame:
    return frame if isinstance(frame, Frame) else mechanism.frame(frame)


def forward_kinematics(mechanism: Mechanism, q: Any) -> np.ndarray:
    """Poses of MuJoCo's bodies (product of exponentials).

    Args:
        mechanism: The machine.
        q: (..., nq) configurations, m and rad.

    Returns:
        (..., nbody, 4, 4) in the world, the world first.

    Raises:
        PlannerError: A wrong shape or a number that is not finite.
    """
    b = KernelCall(mechanism, q=q)
    T = link_places(b)[0]
    poses = [frame.T if frame.link < 0 else T[:, frame.link] @ frame.T for frame in mechanism.bodies]
    return b.out(np.stack([np.broadcast_to(pose, (b.K, 4, 4)) for pose in poses], axis=1))


def frame_pose(mechanism: Mechanism, q: Any, frame: str | Frame) -> np.ndarray:
    """Pose of a site or body.

    Args:
        mechanism: The machine.
        q: (..., nq) configurations, m and rad.
        frame: A Frame, or the name of a site or body.

    Returns:
        (..., 4, 4) in the world.

    Raises:
        PlannerError: A wrong shape or a number that is not finite; no such frame.
    """
    b, f = KernelCall(mechanism, q=q), _framed(mechanism, frame)
    if f.link < 0:
        return b.out(np.tile(f.T, (b.K, 1, 1)))
    return b.out(link_places(b)[0][:, f.link] @ f.T)


def jacobian(mechanism: Mechanism, q: Any, frame: str | Frame) -> np.ndarray:
    """Geometric Jacobian of a site or body.

    Args:
        mechanism: The machine.
        q: (..., nq) configurations, m and rad.
        frame: A Frame, or the name of a site or body.

    Returns:
        (..., 6, nv): rows linear, then angular, in the world's axes at the frame's origin.

    Raises:
        PlannerError: A wrong shape or a number that is not finite; no such frame.
    """
    b, f = KernelCall(mechanism, q=q), _framed(mechanism, frame)
    T, screws, origin = link_places(b)
    J = np.zeros((b.K, 6, mechanism.nv))
    if f.link >= 0:
        p = (T[:, f.link] @ f.T)[:, None, :3, 3] - origin[:, None, f.link]
        chain = chain_of(mechanism.parent, f.link)
        angular, linear = screws[:, chain, :3], screws[:, chain, 3:]
        J[:, 3:, chain] = np.swapaxes(angular, 1, 2)
        J[:, :3, chain] = np.swapaxes(linear + cross(angular, p), 1, 2)
    return b.out(J)


def points_of(
    mechanism: Mechanism, q: Any, links: np.ndarray, offsets: np.ndarray, *, moving: bool = True
) -> tuple[np.ndarray, np.ndarray]:
    """Positions (..., P, 3), m, of points of links in the world and, if `moving`, their Jacobians (..., P, 3, nv).

    Args:
        mechanism: The machine.
        q: (..., nq) configurations, m and rad.
        links: (P,) link of each point; -1 for the world.
        offsets: (P, 3) positions in the links' frames, m.
        moving: Whether to compute the Jacobians; else the array is empty.
    """
    b = KernelCall(mechanism, q=q)
    T, screws, origin = link_places(b)
    T = np.concatenate([T, np.tile(np.eye(4), (b.K, 1, 1, 1))], axis=1)  # the last one is the world's
    T = T[:, links]
    places = np.einsum("kpij,pj->kpi", T[..., :3, :3], offsets) + T[..., :3, 3]
    if not moving:
        return b.out(places), np.empty(0)
    J = np.zeros((b.K, len(links), mechanism.nv, 3))
    for p, link in enumerate(links):
        chain = chain_of(mechanism.parent, int(link))
        arm = places[:, p] - origin[:, link]
        J[:, p, chain] = screws[:, chain, 3:] + cross(screws[:, chain, :3], arm[:, None])
    return b.out(places), b.out(np.swapaxes(J, 2, 3))


def forward_kinematics_derivatives(mechanism: Mechanism, q: Any) -> np.ndarray:
    """Derivative of forward_kinematics by q, as twists.

    Args:
        mechanism: The machine.
        q: (..., nq) configurations, m and rad.

    Returns:
        (..., nbody, 6, nv): linear and angular rows, as jacobian().

    Raises:
        PlannerError: A wrong shape or a number that is not finite.
    """
    b = KernelCall(mechanism, q=q)
    J = [jacobian(mechanism, b["q"], frame) for frame in mechanism.bodies]
    return b.out(np.stack(J, axis=1))


def jacobian_derivatives(mechanism: Mechanism, q: Any, frame: str | Frame) -> np.ndarray:
    """Derivative of jacobian.

    Args:
        mechanism: The machine.
        q: (..., nq) configurations, m and rad.
        frame: A Frame, or the name of a site or body.

    Returns:
        dJ/dq (..., 6, nv, nv): q is the last axis.

    Raises:
        PlannerError: A wrong shape or a number that is not finite; no such frame.
    """
    b, f = KernelCall(mechanism, q=q), _framed(mechanism, frame)
    D = np.zeros((b.K, 6, mechanism.nv, mechanism.nv))
    if f.link < 0:
        return b.out(D)
    J = jacobian(mechanism, b["q"], f)
    chain = chain_of(mechanism.parent, f.link)
    block = np.array(mechanism.base)  # axes of one ball rotate together
    for k in chain:
        turn = hat(J[:, 3:, k])
        for j in chain:
            # dof k moves the axes of its descendants and of its own ball, and the frame's origin.
            depends = j > k or (mechanism.kind[j] != 0 and mechanism.kind[k] != 0 and block[j] == block[k])
            if depends:
                D[:, 3:, j, k] = np.einsum("nab,nb->na", turn, J[:, 3:, j])
                D[:, :3, j, k] = np.einsum("nab,nb->na", turn, J[:, :3, j])
            else:
                D[:, :3, j, k] = cross(J[:, 3:, j], J[:, :3, k])
    return b.out(D)


def center_of_mass(mechanism: Mechanism, q: Any) -> np.ndarray:
    """Position of the centre of mass in the world, (..., 3), m.

    Args:
        mechanism: The machine; bodies fixed to the world do not count.
        q: (..., nq) configurations, m and rad.

    Raises:
        PlannerError: A wrong shape, a number that is not finite, or a machine without mass.
    """
    masses, offsets, links = _massive(mechanism)
    places, _ = points_of(mechanism, q, links, offsets, moving=False)
    return np.einsum("l,...li->...i", masses, places) / masses.sum()


def center_of_mass_jacobian(mechanism: Mechanism, q: Any) -> np.ndarray:
    """Derivative of center_of_mass by the velocities at q (..., nq): (..., 3, nv), in m per unit of each.

    Raises:
        PlannerError: As center_of_mass.
    """
    masses, offsets, links = _massive(mechanism)
    _, J = points_of(mechanism, q, links, offsets)
    return np.einsum("l,...lij->...ij", masses, J) / masses.sum()


def angular_momentum(mechanism: Mechanism, q: Any, qd: Any) -> np.ndarray:
    """Angular momentum about the centre of mass, in the world's axes, (..., 3), kg m^2/s.

    Args:
        mechanism: The machine; bodies fixed to the world do not count.
        q: (..., nq) configurations, m and rad.
        qd: (..., nv) velocities, m/s and rad/s.

    Raises:
        PlannerError: A wrong shape, a number that is not finite, or a machine without mass.
    """
    masses, offsets, links = _massive(mechanism)
    b = KernelCall(mechanism, q=q, qd=qd)
    T, screws, origin = link_places(b)
    twists = screws * b["qd"][:, :, None]  # of each link, relative to its parent
    for i, parent in enumerate(mechanism.parent):
        if parent >= 0:
            twists[:, i] += twists[:, parent]
    T, origin, spin, moving = T[:, links], origin[:, links], twists[:, links, :3], twists[:, links, 3:]
    R = T[..., :3, :3]
    places = np.einsum("klij,lj->kli", R, offsets) + T[..., :3, 3]
    speeds = moving + np.cross(spin, places - origin)
    own = np.einsum("klji,klj->kli", R, spin)  # angular velocity in the link's own axes
    spins = np.einsum("klij,ljm,klm->ki", R, mechanism.inertia[links], own)
    c, v = (np.einsum("l,kli->ki", masses, values)[:, None] / masses.sum() for values in (places, speeds))
    return b.out(spins + np.einsum("l,kli->ki", masses, np.cross(places - c, speeds - v)))


def _massive(mechanism: Mechanism) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Links with mass: mass (L,), kg, centre of mass (L, 3) in the link's frame, m, and indices (L,)."""
    if not isinstance(mechanism, Mechanism):
        raise PlannerError(f"mechanism is {short_repr(mechanism)}, expected a Mechanism.")
    links = np.flatnonzero(mechanism.mass > 0.0)
    if not len(links):
        raise PlannerError("the mechanism has no mass, expected at least one link that has.")
    return mechanism.mass[links], mechanism.com[links], links
