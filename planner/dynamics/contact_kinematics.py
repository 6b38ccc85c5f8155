"""Contact point, normal and relative velocity of a sphere and a plane, or of two bodies, in NumPy, with derivatives.

The geometry of two bodies is that of model.contact.body_contact. The positions s = (s_1, s_2) of the closest points
along the axes solve g = 0, unless clamped to an end, with

    D = m_1 - m_2 + s_1 a_1 - s_2 a_2,   g = (a_1'D + b s_1, -a_2'D + b s_2),   G = dg/ds = (1 + b, -c; -c, 1 + b)

and c = a_1'a_2, so ds = -G^-1 dg over the unclamped s, with dg at constant s. Then

    d|D| = n'dD,   dn = (dD - n d|D|)/|D|,   dp = (dx_1 + dx_2)/2 - (r_1 - r_2) dn/2.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from planner.dynamics import kinematics
from planner.model.contact.body_contact import BodyContact, Capsule
from planner.model.contact.laws import Contact, slide_direction
from planner.model.mechanism import Frame, Mechanism

_NO_DIRECTION = 1e-12  # m, distance of closest points below which the normal is undefined


class PlaneContactKinematics:
    """Contact geometry and relative velocity of a sphere and a plane at K states; see BodyContactKinematics."""

    def __init__(self, mechanism: Mechanism, contact: Contact, q: np.ndarray, qd: np.ndarray) -> None:
        T = np.eye(4)
        T[:3, 3] = contact.centre
        self.mechanism, self.contact, self.frame = mechanism, contact, Frame(contact.link, T)
        n, law = contact.plane.normal, contact.law
        centre = kinematics.frame_pose(mechanism, q, self.frame)[:, :3, 3]
        self.e = contact.radius + law.reach + contact.plane.offset - centre @ n
        self.arm = (0.5 * self.e - contact.radius - 0.5 * law.reach)[:, None] * n  # from the centre
        self.p = centre + self.arm
        J = kinematics.jacobian(mechanism, q, self.frame)
        self.at_centre, self.angular = J[:, :3], J[:, 3:]
        self.J = self.at_centre + np.cross(self.angular, self.arm[:, :, None], axis=1)
        if contact.plane.slide >= 0:  # relative to a plane on a slide joint
            self.J[:, :, contact.plane.slide] -= slide_direction(mechanism, contact.plane)
        self.n = np.broadcast_to(n, centre.shape)
        self.v = np.einsum("kaj,kj->ka", self.J, qd) - contact.plane.velocity

    def derivatives(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Derivatives with respect to q of e (K, nv), n (K, 3, nv) and J (K, 3, nv, nv)."""
        D, n = kinematics.jacobian_derivatives(self.mechanism, q, self.frame), self.contact.plane.normal
        de = -np.einsum("a,kaj->kj", n, self.at_centre)
        darm = 0.5 * n[:, None] * de[:, None, :]  # (K, 3, nv)
        dJ = D[:, :3] + np.cross(D[:, 3:], self.arm[:, :, None, None], axis=1)
        return de, np.zeros_like(darm), dJ + np.cross(self.angular[:, :, :, None], darm[:, :, None, :], axis=1)


class ClosestPoints(NamedTuple):
    """The closest points of two axes at K states."""

    s: np.ndarray  # (K, 2) m, positions along the axes
    inverse: np.ndarray  # (K, 2, 2) inverse of dg/ds, zero in the rows and columns of clamped s
    D: np.ndarray  # (K, 3) m, from the second body's point to the first's


def closest_points(D: np.ndarray, a1: np.ndarray, a2: np.ndarray, half: tuple[float, float], b: float) -> ClosestPoints:
    """The closest points of two segments.

    Args:
        D: (K, 3) m, from the midpoint of the second segment to that of the first.
        a1: (K, 3) unit direction of the first segment, zeros for a point.
        a2: (K, 3) unit direction of the second segment, zeros for a point.
        half: Half lengths of both, m.
        b: Regularization of the axis positions, see planner.model.contact.body_contact.
    """
    points = half[0] == 0.0 or half[1] == 0.0
    c, d, g1, g2 = _dot(a1, a2), 1.0 + b, _dot(a1, D), -_dot(a2, D)
    determinant = 1.0 if points else _dot(np.cross(a1, a2), np.cross(a1, a2)) + b * (2.0 + b)
    s1 = np.clip(-(d * g1 + c * g2) / determinant, -half[0], half[0])
    free2 = (c * s1 - g2) / d  # then clamp one after the other: the minimum of the quadratic in the box
    s2 = np.clip(free2, -half[1], half[1])
    free1 = (c * s2 - g1) / d
    s1 = np.clip(free1, -half[0], half[0])
    moves1, moves2 = np.abs(free1) < half[0], np.abs(free2) < half[1]
    inverse = np.zeros((len(D), 2, 2))
    inverse[:, 0, 0] = np.where(moves1, np.where(moves2, d / determinant, 1.0 / d), 0.0)
    inverse[:, 1, 1] = np.where(moves2, np.where(moves1, d / determinant, 1.0 / d), 0.0)
    inverse[:, 0, 1] = inverse[:, 1, 0] = np.where(moves1 & moves2, c / determinant, 0.0)
    return ClosestPoints(np.stack([s1, s2], axis=1), inverse, D + s1[:, None] * a1 - s2[:, None] * a2)


class BodyContactKinematics:
    """Contact geometry and relative velocity of two bodies at K states.

    Attributes:
        n: (K, 3) unit normal, towards the first body.
        e: (K,) m, penetration into the law's surface.
        p: (K, 3) m, point of application of the force, in the world.
        J: (K, 3, nv) Jacobian of the first body's point at p minus that of the second's.
        v: (K, 3) m/s, relative velocity J qd.
    """

    def __init__(self, mechanism: Mechanism, contact: BodyContact, q: np.ndarray, qd: np.ndarray) -> None:
        self.mechanism, self.contact = mechanism, contact
        self._frames = tuple(_frame(part) for part in (contact.first, contact.second))
        poses = [kinematics.frame_pose(mechanism, q, frame) for frame in self._frames]
        m, self._axes = [T[:, :3, 3] for T in poses], [T[:, :3, 2] for T in poses]
        parts = (contact.first, contact.second)
        self._axes = [np.zeros_like(a) if part.length == 0.0 else a for a, part in zip(self._axes, parts, strict=True)]
        lengths = (parts[0].length, parts[1].length)
        self._closest = closest_points(m[0] - m[1], self._axes[0], self._axes[1], lengths, contact.axis_regularization)
        self._s = [self._closest.s[:, k, None] * self._axes[k] for k in range(2)]  # from the midpoints
        self._distance = np.hypot(np.linalg.norm(self._closest.D, axis=1), _NO_DIRECTION)
        self.n = self._closest.D / self._distance[:, None]
        self.e = parts[0].radius + parts[1].radius + contact.law.reach - self._distance
        self._shift = 0.5 * (parts[0].radius - parts[1].radius)
        x = [m[k] + self._s[k] for k in range(2)]
        self.p = 0.5 * (x[0] + x[1]) - self._shift * self.n
        self._arms = [self.p - m[k] for k in range(2)]
        jacobians = [kinematics.jacobian(mechanism, q, frame) for frame in self._frames]
        self._at_middle, self._angular = [J[:, :3] for J in jacobians], [J[:, 3:] for J in jacobians]
        self.J = self._at(self._arms, 0) - self._at(self._arms, 1)
        self.v = np.einsum("kaj,kj->ka", self.J, qd)

    @property
    def crossing(self) -> np.ndarray:
        """(K,) sine of the angle between the axes, 0 for a sphere; near 0 closest points are ill-conditioned."""
        return np.linalg.norm(np.cross(self._axes[0], self._axes[1]), axis=1)

    def _at(self, arms: list[np.ndarray], k: int) -> np.ndarray:
        """(K, 3, nv) Jacobian of the point of body k at arms[k] (K, 3), m, from its midpoint."""
        return self._at_middle[k] + np.cross(self._angular[k], arms[k][:, :, None], axis=1)

    def derivatives(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Derivatives with respect to q of e (K, nv), n (K, 3, nv) and J (K, 3, nv, nv)."""
        c, (a1, a2) = self._closest, self._axes
        at_axis = [self._at(self._s, k) for k in range(2)]  # at both ends of D, for constant s
        turned = [np.cross(self._angular[k], self._axes[k][:, :, None], axis=1) for k in range(2)]
        dD = at_axis[0] - at_axis[1]
        dg = np.stack([_rows(a1, dD) + _rows(c.D, turned[0]), -_rows(a2, dD) - _rows(c.D, turned[1])], axis=1)
        ds = -c.inverse @ dg  # (K, 2, nv)
        along = [self._axes[k][:, :, None] * ds[:, k, None] for k in range(2)]
        dD = dD + along[0] - along[1]
        ddistance = _rows(self.n, dD)
        dn = (dD - self.n[:, :, None] * ddistance[:, None]) / self._distance[:, None, None]
        dx = [at_axis[k] + along[k] for k in range(2)]
        dp = 0.5 * (dx[0] + dx[1]) - self._shift * dn
        changes = [self._change(q, k, dp - self._at_middle[k]) for k in range(2)]
        return -ddistance, dn, changes[0] - changes[1]

    def _change(self, q: np.ndarray, k: int, darm: np.ndarray) -> np.ndarray:
        """(K, 3, nv, nv) derivative of body k's Jacobian at p; darm (K, 3, nv) is that of p from its midpoint."""
        D = kinematics.jacobian_derivatives(self.mechanism, q, self._frames[k])
        point_jacobians = D[:, :3] + np.cross(D[:, 3:], self._arms[k][:, :, None, None], axis=1)
        return point_jacobians + np.cross(self._angular[k][:, :, :, None], darm[:, :, None, :], axis=1)


def contact_kinematics(
    mechanism: Mechanism, contact: Contact | BodyContact, q: np.ndarray, qd: np.ndarray
) -> PlaneContactKinematics | BodyContactKinematics:
    """Kinematics of a contact at K states, q (K, nq) and qd (K, nv)."""
    kind = PlaneContactKinematics if isinstance(contact, Contact) else BodyContactKinematics
    return kind(mechanism, contact, q, qd)  # type: ignore[arg-type]


def _frame(part: Capsule) -> Frame:
    """Frame at the midpoint of a capsule, with its z axis along the capsule's axis."""
    T, axis = np.eye(4), part.axis
    if part.length > 0.0:
        across = np.cross(np.eye(3)[np.argmin(np.abs(axis))], axis)
        across /= np.linalg.norm(across)
        T[:3, :3] = np.stack([across, np.cross(axis, across), axis], axis=1)
    T[:3, 3] = part.middle
    return Frame(part.link, T)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("ka,ka->k", a, b)


def _rows(a: np.ndarray, J: np.ndarray) -> np.ndarray:
    """(K, nv) the inner products of a (K, 3) with the columns of J (K, 3, nv)."""
    return np.einsum("ka,kaj->kj", a, J)
