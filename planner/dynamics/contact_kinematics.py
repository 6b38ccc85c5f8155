"""Contact point, normal and relative velocity of a sphere and a plane, or of two bodies; distances of solids; in NumPy.

The geometry of two bodies is that of model.contact.body_contact. The positions s = (s_1, s_2) of the closest points
along the axes solve g = 0, unless clamped to an end, with

    D = m_1 - m_2 + s_1 a_1 - s_2 a_2,   g = (a_1'D + b s_1, -a_2'D + b s_2).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from planner.dynamics.kinematics import LinkPlaces
from planner.kernels.tree.mechanism_table import chain_of
from planner.model.contact.body_contact import BodyContact, Capsule
from planner.model.contact.laws import Contact, slide_direction
from planner.model.contact.signed_distance import MEASURES, CollisionShape, PlacedShapes, kind_of
from planner.model.mechanism import Frame, Mechanism

_NO_DIRECTION = 1e-12  # m, distance of closest points below which the normal is undefined


class PlaneContactKinematics:
    """Contact geometry and relative velocity of a sphere and a plane at K states; see BodyContactKinematics.

    `turning` (K, 3, nv) is the Jacobian of the angular velocity that spinning and rolling friction resist.
    """

    def __init__(self, places: LinkPlaces, contact: Contact, qd: np.ndarray) -> None:
        self.contact, frame = contact, Frame.at(contact.link, contact.centre)
        n, law = contact.plane.normal, contact.law
        centre = places.pose(frame)[:, :3, 3]
        self.e = contact.radius + law.reach + contact.plane.offset - centre @ n
        arm = (0.5 * self.e - contact.radius - 0.5 * law.reach)[:, None] * n  # from the centre
        self.p = centre + arm
        J = places.jacobian(frame)
        self.turning = J[:, 3:]
        self.J = J[:, :3] + np.cross(J[:, 3:], arm[:, :, None], axis=1)
        if contact.plane.slide >= 0:  # relative to a plane on a slide joint
            self.J[:, :, contact.plane.slide] -= slide_direction(places.mechanism, contact.plane)
        self.n = np.broadcast_to(n, centre.shape)
        self.v = np.einsum("kaj,kj->ka", self.J, qd) - contact.plane.velocity


class ClosestPoints(NamedTuple):
    """The closest points of two axes at K states."""

    s: np.ndarray  # (K, 2) m, positions along the axes
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
    # then clamp one after the other: the minimum of the quadratic in the box
    s2 = np.clip((c * s1 - g2) / d, -half[1], half[1])
    s1 = np.clip((c * s2 - g1) / d, -half[0], half[0])
    return ClosestPoints(np.stack([s1, s2], axis=1), D + s1[:, None] * a1 - s2[:, None] * a2)


class BodyContactKinematics:
    """Contact geometry and relative velocity of two bodies at K states.

    Attributes:
        n: (K, 3) unit normal, towards the first body.
        e: (K,) m, penetration into the law's surface.
        p: (K, 3) m, point of application of the force, in the world.
        J: (K, 3, nv) Jacobian of the first body's point at p minus that of the second's.
        v: (K, 3) m/s, relative velocity J qd.
        axes: (K, 3) unit directions of both axes, zeros for spheres.
        closest: The closest points of the axes.
    """

    def __init__(self, places: LinkPlaces, contact: BodyContact, qd: np.ndarray) -> None:
        self.contact, parts = contact, (contact.first, contact.second)
        frames = [_frame(part) for part in parts]
        poses = [places.pose(frame) for frame in frames]
        m, lengths = [T[:, :3, 3] for T in poses], (parts[0].length, parts[1].length)
        self.axes = [T[:, :3, 2] if length else np.zeros_like(m[0]) for T, length in zip(poses, lengths, strict=True)]
        self.closest = closest_points(m[0] - m[1], self.axes[0], self.axes[1], lengths, contact.axis_regularization)
        distance = np.hypot(np.linalg.norm(self.closest.D, axis=1), _NO_DIRECTION)
        self.n = self.closest.D / distance[:, None]
        self.e = parts[0].radius + parts[1].radius + contact.law.reach - distance
        x = [m[k] + self.closest.s[:, k, None] * self.axes[k] for k in range(2)]
        self.p = 0.5 * (x[0] + x[1]) - 0.5 * (parts[0].radius - parts[1].radius) * self.n
        jacobians = [places.jacobian(frame) for frame in frames]
        at_p = [J[:, :3] + np.cross(J[:, 3:], (self.p - m[k])[:, :, None], axis=1) for k, J in enumerate(jacobians)]
        self.J = at_p[0] - at_p[1]
        self.v = np.einsum("kaj,kj->ka", self.J, qd)

    @property
    def crossing(self) -> np.ndarray:
        """(K,) sine of the angle between the axes, 0 for a sphere; near 0 closest points are ill-conditioned."""
        return np.linalg.norm(np.cross(self.axes[0], self.axes[1]), axis=1)


def contact_kinematics(
    places: LinkPlaces, contact: Contact | BodyContact, qd: np.ndarray
) -> PlaneContactKinematics | BodyContactKinematics:
    """Kinematics of a contact at K states: places of the links, and qd (K, nv)."""
    kind = PlaneContactKinematics if isinstance(contact, Contact) else BodyContactKinematics
    return kind(places, contact, qd)  # type: ignore[arg-type]


def _frame(part: Capsule) -> Frame:
    """Frame at the midpoint of a capsule, with its z axis along the capsule's axis."""
    axis, rotation = part.axis, None
    if part.length > 0.0:
        across = np.cross(np.eye(3)[np.argmin(np.abs(axis))], axis)
        across /= np.linalg.norm(across)
        rotation = np.stack([across, np.cross(axis, across), axis], axis=1)
    return Frame.at(part.link, part.middle, rotation)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("ka,ka->k", a, b)


class SignedDistances:
    """Signed distances of P pairs of solids of a machine and its world, m.

    Args:
        mechanism: The machine.
        pairs: (P,) pairs, each in the order of model.contact.collision_shapes.in_order.
    """

    def __init__(self, mechanism: Mechanism, pairs: Sequence[tuple[CollisionShape, CollisionShape]]) -> None:
        self.mechanism = mechanism
        solids = list({id(solid): solid for pair in pairs for solid in pair}.values())
        place = {id(solid): i for i, solid in enumerate(solids)}
        self._link = np.array([solid.link for solid in solids], dtype=np.int64)
        self._T = np.array([solid.T for solid in solids]).reshape(-1, 4, 4)
        self._half = np.array([solid.half for solid in solids]).reshape(-1, 3)
        self._radius = np.array([solid.radius for solid in solids])
        self._reach = np.array([solid.reach for solid in solids])
        self._pairs = np.array([[place[id(solid)] for solid in pair] for pair in pairs], dtype=np.int64).reshape(-1, 2)
        self._kind = np.array([kind_of(*pair) for pair in pairs], dtype=np.int64)
        self._flat = np.array([pair[1].plane for pair in pairs], dtype=bool)
        chains = [[set(chain_of(mechanism.parent, solid.link)) for solid in pair] for pair in pairs]
        # Joints that move both solids of a pair do not change its distance.
        self._sign = np.zeros((len(pairs), mechanism.nv))
        for k, (one, other) in enumerate(chains):
            self._sign[k, sorted(one - other)], self._sign[k, sorted(other - one)] = 1.0, -1.0

    def values(self, q: Any, beyond: np.ndarray | float = np.inf) -> np.ndarray:
        """Distances (K, P), m, at poses q (K, nq).

        Values above the threshold `beyond` (P,), m, may be the smaller distance of the bounding spheres.
        """
        T = self._places(LinkPlaces(self.mechanism, q).T)
        return self._measured(T, beyond)[0]

    def derivatives(self, q: Any, beyond: np.ndarray | float = np.inf) -> tuple[np.ndarray, np.ndarray]:
        """Distances (K, P), m, and their derivatives by q (K, P, nv), zero for distances above `beyond`, m."""
        at = LinkPlaces(self.mechanism, q)
        values, n, p = self._measured(self._places(at.T), beyond)
        arms = p[:, :, None] - at.origin[:, None]  # (K, P, nv, 3)
        moments = np.cross(arms, n[:, :, None])
        angular, linear = at.screws[..., :3], at.screws[..., 3:]
        along = np.einsum("kia,kpia->kpi", angular, moments) + np.einsum("kia,kpa->kpi", linear, n)
        return values, self._sign * along

    def motion_bound(self, q: Any, dq: np.ndarray) -> np.ndarray:
        """Upper bound (K, P), m, of the relative displacement of points of a pair of solids under dq (K, nv).

        Each joint contributes its largest speed over the bounding sphere of the solid that it moves; for a plane, which
        is unbounded, over that of the other solid.
        """
        at = LinkPlaces(self.mechanism, q)
        centres = self._places(at.T)[..., :3, 3]
        found = np.zeros((len(centres), len(self._pairs)))
        for k, (a, b) in enumerate(self._pairs):
            for i in np.flatnonzero(self._sign[k]):
                s = a if self._sign[k, i] > 0.0 or self._flat[k] else b
                w, v = at.screws[:, i, :3], at.screws[:, i, 3:]
                speed = np.linalg.norm(v + np.cross(w, centres[:, s] - at.origin[:, i]), axis=-1)
                found[:, k] += np.abs(dq[:, i]) * (speed + np.linalg.norm(w, axis=-1) * self._reach[s])
        return found

    def _places(self, T: np.ndarray) -> np.ndarray:
        """Poses (K, S, 4, 4) of the solids, from the link poses T (K, nv, 4, 4)."""
        world = np.broadcast_to(np.eye(4), (len(T), 1, 4, 4))
        return np.concatenate([T, world], axis=1)[:, self._link] @ self._T

    def _measured(self, T: np.ndarray, beyond: np.ndarray | float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Distances (K, P), unit normals and points (K, P, 3), m, of solids with poses T (K, S, 4, 4)."""
        a, b = self._pairs.T
        way = T[:, a][..., :3, 3] - T[:, b][..., :3, 3]
        over = np.sum(way * T[:, b][..., :3, 2], axis=-1)
        far = np.where(self._flat, over, np.sqrt(np.sum(way * way, axis=-1)))
        values = far - self._reach[a] - np.where(self._flat, 0.0, self._reach[b])
        n, p = np.zeros((2, *values.shape, 3))
        near = values < beyond
        for kind, measure in enumerate(MEASURES):
            k, i = np.nonzero(near & (self._kind == kind))
            if len(k):
                values[k, i], n[k, i], p[k, i] = measure(self._placed(T, k, a[i]), self._placed(T, k, b[i]))
        return values, n, p

    def _placed(self, T: np.ndarray, k: np.ndarray, s: np.ndarray) -> PlacedShapes:
        return PlacedShapes(T[k, s, :3, :3], T[k, s, :3, 3], self._half[s], self._radius[s])


def distance_lower_bound(values: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """Lower bounds (K-1, P), m, of distances between consecutive poses, from the distances `values` (K, P) at them, m.

    A distance changes by at most the relative displacement, `moved` (K-1, P), m, so the bound is half the sum of both
    distances minus half of it.
    """
    return 0.5 * (values[:-1] + values[1:] - moved)
