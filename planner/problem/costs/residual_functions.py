"""Residuals of a machine's states and their Jacobians in NumPy, by kind: the reference of kernels.tree.residuals.

Each function takes a KinematicsCache of K states, the number t of a term and whether its Jacobian is required. It
returns the value (K, rows) and the Jacobian (K, rows, nv), or (K, rows, 2 nv) of velocities; the module
kernels.tree.residuals.kinds lists the kinds.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import numpy as np

from planner.dynamics.contacts import smoothstep
from planner.dynamics.kinematics import LinkPlaces
from planner.kernels.tree.residuals import kinds
from planner.kernels.tree.residuals.frames import BLUNT
from planner.kernels.tree.residuals.layout import PARALLEL, TINY
from planner.kernels.tree.residuals.solids import FIRST_AXES, FIRST_HALF, SECOND_AXES, SECOND_HALF, TAKEN_OFF
from planner.model.contact import signed_distance
from planner.model.contact.signed_distance import PlacedShapes
from planner.model.mechanism import Frame, Mechanism
from planner.model.space import cross, hat, log_jacobian, log_quaternion
from planner.problem.costs.residual_arrays import ResidualArrays

_SERIES_THRESHOLD = 0.04  # rad^2, squared angle below which a series is used: its next term is below rounding


ResidualFunctionOfKind = Callable[["KinematicsCache", int, bool], tuple[np.ndarray, np.ndarray]]
RESIDUALS: dict[int, ResidualFunctionOfKind] = {}


def of_kinds(*numbers: int) -> Callable[[ResidualFunctionOfKind], ResidualFunctionOfKind]:
    """Decorator of the function of some kinds."""

    def register(function: ResidualFunctionOfKind) -> ResidualFunctionOfKind:
        RESIDUALS.update(dict.fromkeys(numbers, function))
        return function

    return register


class KinematicsCache:
    """Points and frames of a mechanism at states xs (K, nx), computed once for all terms of ResidualArrays."""

    def __init__(self, mechanism: Mechanism, arrays: ResidualArrays, xs: np.ndarray) -> None:
        self.mechanism, self.arrays, self.nv = mechanism, arrays, mechanism.nv
        self.q, self.v = xs[:, : mechanism.nq], xs[:, mechanism.velocities]

    @cached_property
    def places(self) -> LinkPlaces:
        """The links at the states."""
        return LinkPlaces(self.mechanism, self.q)

    @cached_property
    def positions(self) -> np.ndarray:
        """(K, P, 3) m, of the points in the world."""
        m = self.arrays
        positions, _ = self.places.points(m.link, m.offset, moving=False)
        return m.share[:, None] * positions + np.swapaxes(m.world, 0, 1)

    @cached_property
    def jacobians(self) -> np.ndarray:
        """(K, P, 3, nv), derivatives of the positions."""
        m = self.arrays
        return m.share[:, None, None] * self.places.points(m.link, m.offset)[1]

    @cached_property
    def velocities(self) -> np.ndarray:
        """(K, P, 3) m/s, of the points."""
        return np.einsum("npai,ni->npa", self.jacobians, self.v)

    def velocity_by_q(self, p: int) -> np.ndarray:
        """(K, 3, nv), the derivative of point p's velocity with respect to the configuration."""
        by_q = self.places.jacobian_derivatives(self.frame(p))[:, :3]
        return self.arrays.share[p] * np.einsum("najk,nj->nak", by_q, self.v)

    def frame(self, p: int, rotation: np.ndarray | None = None) -> Frame:
        """The frame at point p with a rotation (3, 3) in its link's frame."""
        return Frame.at(int(self.arrays.link[p]), self.arrays.offset[p], rotation)

    def frame_of(self, t: int) -> Frame:
        """The frame of term t, with the rotation in its constants."""
        return self.frame(int(self.arrays.ends[t, 0]), self.arrays.constant[t, :9].reshape(3, 3))

    def pose(self, frame: Frame) -> np.ndarray:
        """(K, 4, 4) of a frame."""
        return self.places.pose(frame)

    def jacobian(self, frame: Frame) -> np.ndarray:
        """(K, 6, nv) of a frame: linear, then angular rows, in the world's axes."""
        return self.places.jacobian(frame)

    def jacobian_rates(self, frame: Frame) -> np.ndarray:
        """(K, 6, nv), the derivative of the frame's velocity with respect to the configuration."""
        return np.einsum("najk,nj->nak", self.places.jacobian_derivatives(frame), self.v)


@of_kinds(kinds.HEIGHT, kinds.DISTANCE, kinds.VELOCITY)
def point_residual(cache: KinematicsCache, t: int, derivatives: bool) -> tuple[np.ndarray, np.ndarray]:
    """Height, distance or velocity of points, one row.

    Heights are n'p - level, velocities n'(v_1 - v_2) of points that are fixed to their links. Distances are |d| - level
    with d between the nearest points of two segments: since those are nearest, their motion along the segments does not
    change |d| to first order, and the Jacobian is that of two fixed points.
    """
    m, of_velocity = cache.arrays, cache.arrays.kind[t] == kinds.VELOCITY
    i, j, k, l = (int(end) for end in m.ends[t])
    n, level, ones = m.constant[t, :3], m.constant[t, 3], np.ones(len(cache.q))
    direction = np.tile(n, (len(cache.q), 1))
    if of_velocity:
        value, points, factors = (cache.velocities[:, i] - cache.velocities[:, j]) @ n, (i, j), (ones, -ones)
    elif m.kind[t] == kinds.HEIGHT:
        value, points, factors = cache.positions[:, i] @ n - level, (i,), (ones,)
    else:
        d, s, u = nearest_on_segments(*(cache.positions[:, end] for end in (i, j, k, l)))
        length = np.sqrt(np.sum(d * d, axis=-1) + TINY)
        value, direction = length - level, d / length[:, None]
        points, factors = (i, j, k, l), (1.0 - s, s, u - 1.0, -u)
    if not derivatives:
        return value[:, None], np.empty(0)
    row = np.zeros((len(cache.q), 2 * cache.nv if of_velocity else cache.nv))
    for point, factor in zip(points, factors, strict=True):
        J = cache.jacobians[:, point]
        if of_velocity:
            J = np.concatenate([cache.velocity_by_q(point), J], axis=2)
        row += factor[:, None] * np.einsum("na,nai->ni", direction, J)
    return value[:, None], row[:, None]


def nearest_on_segments(
    a0: np.ndarray, a1: np.ndarray, b0: np.ndarray, b1: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns d (..., 3) from the nearest point b0 + u (b1 - b0) to the nearest point a0 + s (a1 - a0), and s, u.

    The nearest points of the lines, then each in turn clipped to its segment: exact, since the squared
    distance is convex in (s, u) (Ericson, Real-Time Collision Detection, section 5.1.9). The ends (..., 3) of a segment
    may be the same.
    """
    v, w, r = a1 - a0, b1 - b0, a0 - b0
    vv, ww, vw = (np.sum(x * y, axis=-1) for x, y in ((v, v), (w, w), (v, w)))
    vr, wr = np.sum(v * r, axis=-1), np.sum(w * r, axis=-1)
    slack = PARALLEL * vv * ww
    s = np.clip((vw * wr - vr * ww + 0.5 * slack) / (vv * ww - vw * vw + slack + TINY), 0.0, 1.0)
    u = np.clip((vw * s + wr) / (ww + TINY), 0.0, 1.0)
    s = np.clip((vw * u - vr) / (vv + TINY), 0.0, 1.0)
    return r + s[..., None] * v - u[..., None] * w, s, u


@of_kinds(kinds.POSITION, kinds.POINTING, kinds.LINEAR, kinds.ANGULAR)
def frame_residual(cache: KinematicsCache, t: int, derivatives: bool) -> tuple[np.ndarray, np.ndarray]:
    """Position of a frame, direction of an axis, linear or angular velocity: three rows, in the world's axes."""
    kind, frame = cache.arrays.kind[t], cache.frame(int(cache.arrays.ends[t, 0]))
    if kind in (kinds.POSITION, kinds.POINTING):
        T = cache.pose(frame)
        value = T[:, :3, 3] if kind == kinds.POSITION else T[:, :3, :3] @ cache.arrays.constant[t, :3]
        if not derivatives:
            return value, np.empty(0)
        J = cache.jacobian(frame)
        return value, J[:, :3] if kind == kinds.POSITION else np.cross(J[:, 3:], value[:, :, None], axis=1)
    rows = slice(3, 6) if kind == kinds.ANGULAR else slice(0, 3)
    J = cache.jacobian(frame)[:, rows]
    value = np.einsum("nai,ni->na", J, cache.v)
    return value, np.concatenate([cache.jacobian_rates(frame)[:, rows], J], axis=2) if derivatives else np.empty(0)


@of_kinds(kinds.TILT)
def tilt_residual(cache: KinematicsCache, t: int, derivatives: bool) -> tuple[np.ndarray, np.ndarray]:
    """The angle between a frame's axis and a direction, rad: one row."""
    _, n, sine, cosine = _arc(cache, t)
    value = np.arctan2(sine, cosine)[:, None]
    if not derivatives:
        return value, np.empty(0)
    frame = cache.frame(int(cache.arrays.ends[t, 0]))
    return value, -np.einsum("na,nai->ni", n, cache.jacobian(frame)[:, 3:])[:, None]


def tilt_curvature(cache: KinematicsCache, t: int) -> tuple[np.ndarray, np.ndarray]:
    """Second derivative (K,) of a tilt by rotation perpendicular to its arc, and that rotation's Jacobian (K, nv)."""
    frame = cache.frame(int(cache.arrays.ends[t, 0]))
    b, n, sine, cosine = _arc(cache, t)
    return cosine * sine / (sine**2 + BLUNT), np.einsum("na,nai->ni", cross(b, n), cache.jacobian(frame)[:, 3:])


def _arc(cache: KinematicsCache, t: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The axis b (K, 3), the axis n (K, 3) of the rotation from b to d, sine and cosine (K,) of the tilt."""
    own = cache.arrays.constant[t]
    b, d = cache.pose(cache.frame(int(cache.arrays.ends[t, 0])))[:, :3, :3] @ own[:3], own[3:6]
    normal = cross(b, np.broadcast_to(d, b.shape))
    sine = np.sqrt(np.sum(normal**2, axis=1) + TINY)
    return b, normal / sine[:, None], sine, b @ d


@of_kinds(kinds.MASS_CENTRE)
def center_of_mass_residual(cache: KinematicsCache, t: int, derivatives: bool) -> tuple[np.ndarray, np.ndarray]:
    """The centre of mass, m: three rows, means of the links' weighted by their masses."""
    m = cache.mechanism
    links = np.flatnonzero(m.mass > 0.0)
    share = m.mass[links] / m.mass.sum()
    positions, J = cache.places.points(links, m.com[links], moving=derivatives)
    value = np.einsum("l,nla->na", share, positions)
    return value, np.einsum("l,nlai->nai", share, J) if derivatives else J


@of_kinds(kinds.SLIP)
def slip_residual(cache: KinematicsCache, t: int, derivatives: bool) -> tuple[np.ndarray, np.ndarray]:
    """Tangential velocity of the lowest point of a sphere near a plane, times how near it is: three rows, m/s."""
    n, (level, radius, per) = cache.arrays.constant[t, :3], cache.arrays.constant[t, 3:6]
    frame = cache.frame(int(cache.arrays.ends[t, 0]))
    share, slope = smoothstep(1.0 / per - cache.pose(frame)[:, :3, 3] @ n + level, 1.0 / per)
    if not share.any():  # a foot that is up all along
        return np.zeros((len(share), 3)), np.zeros((len(share), 3, 2 * cache.nv))
    along = np.eye(3) - np.outer(n, n)
    J = cache.jacobian(frame)
    lowest = along @ np.hstack([np.eye(3), radius * hat(n)])  # of a twist at the centre, with the arm -radius n
    speed = np.einsum("nai,ni->na", lowest @ J, cache.v)
    value = share[:, None] * speed
    if not derivatives:
        return value, np.empty(0)
    by_q = share[:, None, None] * (lowest @ cache.jacobian_rates(frame))
    by_q -= (slope[:, None] * speed)[:, :, None] * (n @ J[:, :3])[:, None]
    return value, np.concatenate([by_q, share[:, None, None] * (lowest @ J)], axis=2)


_SHAPE_DISTANCES = {
    kinds.LINE_BOX: signed_distance.segment_box,
    kinds.BOXES: signed_distance.of_boxes,
    kinds.OVER_PLANE: signed_distance.from_plane,
}


@of_kinds(kinds.LINE_BOX, kinds.BOXES, kinds.OVER_PLANE)
def distance_residual(cache: KinematicsCache, t: int, derivatives: bool) -> tuple[np.ndarray, np.ndarray]:
    """The signed distance of two collision shapes, m: one row.

    With the direction n and the point p of model.contact.signed_distance the Jacobian is n'(J_1(p) - J_2(p)), J that
    of a point at p which is fixed to either link.
    """
    constant, K = cache.arrays.constant[t], len(cache.q)
    frames = [
        cache.frame(int(end), constant[first : first + 9].reshape(3, 3))
        for end, first in zip(cache.arrays.ends[t], (FIRST_AXES, SECOND_AXES), strict=False)
    ]
    T = [cache.pose(frame) for frame in frames]
    half = [constant[first : first + 3] for first in (FIRST_HALF, SECOND_HALF)]
    shapes = [PlacedShapes(pose[:, :3, :3], pose[:, :3, 3], np.tile(h, (K, 1)), np.zeros(K))
              for pose, h in zip(T, half, strict=True)]  # fmt: skip
    found = _SHAPE_DISTANCES[int(cache.arrays.kind[t])](*shapes)
    value = (found.distance - constant[TAKEN_OFF])[:, None]
    if not derivatives:
        return value, np.empty(0)
    row = np.zeros((K, cache.nv))
    for sign, frame, pose in zip((1.0, -1.0), frames, T, strict=True):
        J = cache.jacobian(frame)
        moment = np.cross(found.p - pose[:, :3, 3], found.n)
        row += sign * (np.einsum("na,nai->ni", found.n, J[:, :3]) + np.einsum("na,nai->ni", moment, J[:, 3:]))
    return value, row[:, None]


@of_kinds(kinds.ORIENTATION, kinds.POSE)
def orientation_residual(cache: KinematicsCache, t: int, derivatives: bool) -> tuple[np.ndarray, np.ndarray]:
    """Rotation vector from a reference (3 rows), or logarithm of SE(3) (6 rows); kernels' orientation has formulas."""
    frame, reference = cache.frame_of(t), cache.arrays.references(t)
    T, R_ref = cache.pose(frame), reference[:, :9].reshape(-1, 3, 3)
    R, back = T[:, :3, :3], np.swapaxes(R_ref, 1, 2)
    phi, shift = log_quaternion(quaternion_of(back @ R)), np.zeros((len(T), 3))
    value, of_pose = phi, cache.arrays.kind[t] == kinds.POSE
    if of_pose:
        shift = np.einsum("nij,nj->ni", back, T[:, :3, 3] - reference[:, 9:])
        value = np.concatenate([np.einsum("nij,nj->ni", log_jacobian(-phi), shift), phi], axis=1)
    if not derivatives:
        return value, np.empty(0)
    J = cache.jacobian(frame)
    own = log_jacobian(phi) @ np.swapaxes(R, 1, 2)  # log(R_ref' R exp(e)), e in R's own axes
    angular = own @ J[:, 3:]
    if not of_pose:
        return value, angular
    return value, np.concatenate([own @ J[:, :3] + _log_jacobian_derivative(phi, shift) @ angular, angular], axis=1)


def _log_jacobian_derivative(phi: np.ndarray, t: np.ndarray) -> np.ndarray:
    """The derivative (K, 3, 3) of Jl^-1(phi) t by phi, of phi (K, 3) and a fixed t (K, 3)."""
    f, slope = (part[:, None, None] for part in _factor(np.sum(phi**2, axis=1)))
    across, H, G = np.einsum("nij,nj->ni", hat(phi), t), hat(phi), hat(t)
    twice = np.einsum("nij,nj->ni", H, across)
    # -1/2 d x t + f (d x (phi x t) + phi x (d x t)) + 2 f' (phi'd) phi x (phi x t)
    return 0.5 * G - f * (hat(across) + H @ G) + 2.0 * slope * twice[:, :, None] * phi[:, None]


def _factor(square: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The f of (1 - hat/2 + f hat^2) and its derivative by the squared angle (K,)."""
    s, half = square, 0.5 * np.sqrt(np.maximum(square, _SERIES_THRESHOLD))
    cot = 1.0 / np.tan(half)
    far = 4.0 * half**2
    f = (1.0 - half * cot) / far
    slope = ((half * (1.0 + cot * cot) - cot) / (8.0 * half) - f) / far
    near_f = 1.0 / 12.0 + s * (1.0 / 720.0 + s * (1.0 / 30240.0 + s * (1.0 / 1209600.0 + s / 47900160.0)))
    near_slope = 1.0 / 720.0 + s * (1.0 / 15120.0 + s * (1.0 / 403200.0 + s / 11975040.0))
    return np.where(s < _SERIES_THRESHOLD, near_f, f), np.where(s < _SERIES_THRESHOLD, near_slope, slope)


def rotation_of(quaternion: np.ndarray) -> np.ndarray:
    """Rotation matrix (..., 3, 3) of a unit quaternion (..., 4), w first."""
    w, v = quaternion[..., :1, None], quaternion[..., 1:]
    H = hat(v)
    return np.eye(3) + 2.0 * (w * H + H @ H)


def quaternion_of(R: np.ndarray) -> np.ndarray:
    """Unit quaternion (..., 4), w first, of a rotation matrix (..., 3, 3)."""
    diagonal = np.diagonal(R, axis1=-2, axis2=-1)
    signs = np.array([[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]])
    # 4 q q', of which the row with the largest diagonal is far from zero
    outer = np.empty((*R.shape[:-2], 4, 4))
    outer[..., range(4), range(4)] = 1.0 + diagonal @ signs.T
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        outer[..., 0, i + 1] = outer[..., i + 1, 0] = R[..., k, j] - R[..., j, k]
        outer[..., i + 1, j + 1] = outer[..., j + 1, i + 1] = R[..., i, j] + R[..., j, i]
    largest = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), axis=-1)
    rows = np.take_along_axis(outer, largest[..., None, None], axis=-2)[..., 0, :]
    return rows / np.linalg.norm(rows, axis=-1, keepdims=True)
