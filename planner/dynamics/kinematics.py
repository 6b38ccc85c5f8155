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
from planner.model.space import cross


class LinkPlaces:
    """Places of a mechanism's links at K configurations, computed once for poses and Jacobians of several frames.

    Args:
        mechanism: The machine.
        q: (K, nq) or (nq,) configurations, m and rad.

    Attributes:
        mechanism: The machine.
        q: (K, nq), K = 1 for a single configuration, as in all results.
        out: Result -> result, without its first axis where a single configuration was given.
        T: (K, nv, 4, 4) pose of each link in the world.
        screws: (K, nv, 6), angular and linear, about the origins.
        origin: (K, nv, 3), m.

    Raises:
        PlannerError: A wrong shape or a number that is not finite.
    """

    def __init__(self, mechanism: Mechanism, q: Any) -> None:
        call = KernelCall(mechanism, q=q)
        self.mechanism, self.q, self.out = mechanism, call["q"], call.out
        model, nv, K = kernel_model(mechanism), mechanism.nv, call.K
        records = np.empty((K, nv, 18))
        call.call(tree_batch.places, model, records)
        self.screws, self.origin = records[..., 12:], np.tile(model.origin, (K, 1, 1))
        for i in np.flatnonzero(model.floating_address >= 0):
            a = model.floating_address[i]
            self.origin[:, i] = self.q[:, a : a + 3]
        T = np.zeros((K, nv, 4, 4))
        T[..., :3, :3] = records[..., :9].reshape(K, nv, 3, 3)
        T[..., :3, 3], T[..., 3, 3] = records[..., 9:12] + self.origin, 1.0
        self.T = T @ np.linalg.inv(model.own_frames)
        for i in np.flatnonzero(model.floating):  # slides of a free joint, whose translation the kernels omit
            first = model.floating_address[i]
            self.T[:, i, :3, 3] = 0.0
            count = int(mechanism.q_address[i]) - int(first) + 1
            self.T[:, i, :count, 3] = self.q[:, first : first + count]

    def _frame(self, frame: str | Frame) -> Frame:
        return frame if isinstance(frame, Frame) else self.mechanism.frame(frame)

    def pose(self, frame: str | Frame) -> np.ndarray:
        """(K, 4, 4) of a frame, or of a site or body by its name, in the world."""
        frame = self._frame(frame)
        if frame.link < 0:
            return np.tile(frame.T, (len(self.q), 1, 1))
        return self.T[:, frame.link] @ frame.T

    def jacobian(self, frame: str | Frame) -> np.ndarray:
        """(K, 6, nv) of a frame: linear, then angular rows, in the world's axes at its origin."""
        frame = self._frame(frame)
        J = np.zeros((len(self.q), 6, self.mechanism.nv))
        if frame.link >= 0:
            arm = (self.T[:, frame.link] @ frame.T[:, 3])[:, None, :3] - self.origin[:, None, frame.link]
            chain = chain_of(self.mechanism.parent, frame.link)
            angular, linear = self.screws[:, chain, :3], self.screws[:, chain, 3:]
            J[:, 3:, chain] = np.swapaxes(angular, 1, 2)
            J[:, :3, chain] = np.swapaxes(linear + cross(angular, arm), 1, 2)
        return J

    def jacobian_derivatives(self, frame: str | Frame) -> np.ndarray:
        """(K, 6, nv, nv), the derivative of a frame's Jacobian: q is the last axis."""
        frame = self._frame(frame)
        m = self.mechanism
        D = np.zeros((len(self.q), 6, m.nv, m.nv))
        if frame.link < 0:
            return D
        chain = chain_of(m.parent, frame.link)
        J = np.swapaxes(self.jacobian(frame)[:, :, chain], 1, 2)
        by_j, by_k = J[:, :, None], J[:, None]
        # dof k moves the frame's origin, and the axes of its descendants and of its own ball, which rotate together
        j, k = np.array(chain)[:, None], np.array(chain)
        kind, block = np.asarray(m.kind), np.asarray(m.base)
        depends = ((j > k) | ((kind[j] != 0) & (kind[k] != 0) & (block[j] == block[k])))[..., None]
        angular = np.where(depends, cross(by_k[..., 3:], by_j[..., 3:]), 0.0)
        linear = np.where(depends, cross(by_k[..., 3:], by_j[..., :3]), cross(by_j[..., 3:], by_k[..., :3]))
        D[:, :, j, k] = np.moveaxis(np.concatenate([linear, angular], axis=-1), -1, 1)
        return D

    def points(self, links: np.ndarray, offsets: np.ndarray, *, moving: bool = True) -> tuple[np.ndarray, np.ndarray]:
        """(K, P, 3) m, positions of points of links, and if `moving` their Jacobians (K, P, 3, nv); see points_of."""
        K = len(self.q)
        T = np.concatenate([self.T, np.tile(np.eye(4), (K, 1, 1, 1))], axis=1)[:, links]  # the last one is the world's
        places = np.einsum("kpij,pj->kpi", T[..., :3, :3], offsets) + T[..., :3, 3]
        if not moving:
            return places, np.empty(0)
        J = np.zeros((K, len(links), self.mechanism.nv, 3))
        for p, link in enumerate(links):
            chain = chain_of(self.mechanism.parent, int(link))
            arm = places[:, p] - self.origin[:, link]
            J[:, p, chain] = self.screws[:, chain, 3:] + cross(self.screws[:, chain, :3], arm[:, None])
        return places, np.swapaxes(J, 2, 3)


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
    places = LinkPlaces(mechanism, q)
    return places.out(np.stack([places.pose(frame) for frame in mechanism.bodies], axis=1))


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
    places = LinkPlaces(mechanism, q)
    return places.out(places.pose(frame))


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
    places = LinkPlaces(mechanism, q)
    return places.out(places.jacobian(frame))


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
    places = LinkPlaces(mechanism, q)
    found, J = places.points(links, offsets, moving=moving)
    return places.out(found), places.out(J) if moving else J


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
    places = LinkPlaces(mechanism, q)
    return places.out(np.stack([places.jacobian(frame) for frame in mechanism.bodies], axis=1))


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
    places = LinkPlaces(mechanism, q)
    return places.out(places.jacobian_derivatives(frame))


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
    at = LinkPlaces(mechanism, b["q"])
    twists = at.screws * b["qd"][:, :, None]  # of each link, relative to its parent
    for i, parent in enumerate(mechanism.parent):
        if parent >= 0:
            twists[:, i] += twists[:, parent]
    T, origin, spin, moving = at.T[:, links], at.origin[:, links], twists[:, links, :3], twists[:, links, 3:]
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
