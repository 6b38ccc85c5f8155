"""Collision shapes on links, and their signed distances, directions and nearest points. NumPy, K pairs at once.

A shape is a core, a segment or a box with half lengths h along its own axes, and a radius around it: a sphere is a
segment of no length, MuJoCo's box has radius 0. A plane is a half space. The signed distance of two shapes is that of
their cores less both radii. Where cores overlap it is minus the shortest way out, which for boxes and segments is along
a face's normal or the normal of two edges (the separating axes). n is the direction in which the first must move to
get away from the second, p a point on the line of that direction through both nearest points: so

    d distance / dt = n'(V_1(p) - V_2(p))

with the velocities V of both bodies there, whichever way n turns. The kernels repeat this arithmetic
(kernels.tree.clearance).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from planner.base.arguments import set_fields

TOUCHING = 1e-9  # m between cores, below which the separating axes say the direction
PARALLEL = 1e-12  # of squared lengths: lines that are so nearly parallel have no normal in common
TINY = 1e-300


class PlacedShapes(NamedTuple):
    """Cores and radii of K solids, or of one at K poses."""

    axes: np.ndarray  # (K, 3, 3), one axis a column
    centre: np.ndarray  # (K, 3) m
    half: np.ndarray  # (K, 3) m along the axes; of a line the third alone
    radius: np.ndarray  # (K,) m


class DistanceResult(NamedTuple):
    """How far apart two solids are, where the first must go to get away, and where they are nearest."""

    distance: np.ndarray  # (K,) m
    n: np.ndarray  # (K, 3)
    p: np.ndarray  # (K, 3) m


def segment_segment(a: PlacedShapes, b: PlacedShapes) -> DistanceResult:
    """Two lines: the nearest points of the whole lines, then each in turn put back (Ericson, section 5.1.9)."""
    v, w, r = _along(a), _along(b), a.centre - b.centre
    vv, ww, vw, vr, wr = (np.sum(x * y, axis=-1) for x, y in ((v, v), (w, w), (v, w), (v, r), (w, r)))
    pull = PARALLEL * vv * ww
    s = np.clip((vw * wr - vr * ww) / (vv * ww - vw * vw + pull + TINY), -1.0, 1.0)
    u = np.clip((vw * s + wr) / (ww + TINY), -1.0, 1.0)
    s = np.clip((vw * u - vr) / (vv + TINY), -1.0, 1.0)
    d = r + s[:, None] * v - u[:, None] * w
    length = np.sqrt(np.sum(d * d, axis=-1))
    n = d / (length + TINY)[:, None]
    return DistanceResult(length - a.radius - b.radius, n, a.centre + s[:, None] * v)


def segment_box(a: PlacedShapes, b: PlacedShapes) -> DistanceResult:
    """A line and a box."""
    x, d = _into(b, a.centre - b.centre), _into(b, _along(a))
    e, at = _line_from_box(x, d, b.half)
    return _signed(a, b, e, at, lambda k: _line_in_box(x[k], d[k], b.half[k]))


def of_boxes(a: PlacedShapes, b: PlacedShapes) -> DistanceResult:
    """Two boxes: outside of each other an edge of the first or a corner of the second is nearest."""
    x, h = _into(b, a.centre - b.centre), a.half
    R = np.swapaxes(b.axes, 1, 2) @ a.axes
    K, signs = len(x), (-1.0, 1.0)
    middles, edges = [], []
    for i, (j, k) in enumerate(((1, 2), (2, 0), (0, 1))):  # edges along each axis of the first
        for sj, sk in itertools.product(signs, repeat=2):
            middles.append(x + sj * h[:, j : j + 1] * R[:, :, j] + sk * h[:, k : k + 1] * R[:, :, k])
            edges.append(h[:, i : i + 1] * R[:, :, i])
    e, at = _line_from_box(np.concatenate(middles), np.concatenate(edges), np.tile(b.half, (12, 1)))
    corners = np.array(list(itertools.product(signs, repeat=3)))[:, None] * b.half  # (8, K, 3)
    y = np.einsum("nji,cnj->cni", R, corners - x)
    back = np.clip(y, -h, h) - y  # from the corners to the first box
    e = np.concatenate([e.reshape(12, K, 3), np.einsum("nij,cnj->cni", R, back)])
    at = np.concatenate([at.reshape(12, K, 3), corners])
    best, every = np.argmin(np.sum(e * e, axis=-1), axis=0), np.arange(K)
    return _signed(a, b, e[best, every], at[best, every], lambda k: _box_in_box(x[k], R[k], h[k], b.half[k]))


def _signed(
    a: PlacedShapes, b: PlacedShapes, e: np.ndarray, at: np.ndarray,
    within: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]],
) -> DistanceResult:  # fmt: skip
    """The distance of cores that are e (K, 3) apart at a point, in the axes of b; by `within` for those that touch."""
    length = np.sqrt(np.sum(e * e, axis=-1))
    n, p = e / np.maximum(length, TOUCHING)[:, None], at.copy()
    touching = np.flatnonzero(length <= TOUCHING)
    if len(touching):
        length[touching], n[touching], p[touching] = within(touching)
    n, p = (np.einsum("nij,nj->ni", b.axes, v) for v in (n, p))  # from the axes of b to those of the world
    return DistanceResult(length - a.radius - b.radius, n, p + b.centre)


def from_plane(a: PlacedShapes, b: PlacedShapes) -> DistanceResult:
    """A line or a box and the half space under a plane, which is through the centre of b across its third axis."""
    n = b.axes[:, :, 2]
    reach = a.half * np.einsum("nij,ni->nj", a.axes, n)
    p = a.centre - np.einsum("nij,nj->ni", a.axes, a.half * np.sign(reach))
    distance = np.sum(n * (a.centre - b.centre), axis=-1) - np.sum(np.abs(reach), axis=-1)
    return DistanceResult(distance - a.radius - b.radius, n, p)


def _along(line: PlacedShapes) -> np.ndarray:
    return line.half[:, 2:] * line.axes[:, :, 2]


def _into(b: PlacedShapes, v: np.ndarray) -> np.ndarray:
    """Vectors of the world (K, 3) in the axes of b."""
    return np.einsum("nji,nj->ni", b.axes, v)


def _line_from_box(x: np.ndarray, d: np.ndarray, h: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The least vector (K, 3) from a box to a line x + s d, |s| <= 1, and the point of the line; zero where they meet.

    Half the derivative of the squared distance is sum_i d_i (y_i - clamp(y_i)) at y = x + s d. It grows with s and is
    straight between the places where the line enters or leaves the slab of an axis: so its root lies on the straight
    piece between the last of these where it is not above 0 and the first where it is not below.
    """

    def slope(s: np.ndarray) -> np.ndarray:
        y = x + s[:, None] * d
        return np.sum(d * (y - np.clip(y, -h, h)), axis=-1)

    low, high = np.full(len(x), -1.0), np.full(len(x), 1.0)
    g_low, g_high = slope(low), slope(high)
    high, g_high = np.where(g_low >= 0.0, low, high), np.where(g_low >= 0.0, g_low, g_high)
    low, g_low = np.where(g_high <= 0.0, high, low), np.where(g_high <= 0.0, g_high, g_low)
    for i, side in itertools.product(range(3), (-1.0, 1.0)):
        across = np.where(np.abs(d[:, i]) > TINY, d[:, i], TINY)
        s = np.clip((side * h[:, i] - x[:, i]) / across, -1.0, 1.0)
        g = slope(s)
        up, down = (g <= 0.0) & (s > low), (g >= 0.0) & (s < high)
        low, g_low = np.where(up, s, low), np.where(up, g, g_low)
        high, g_high = np.where(down, s, high), np.where(down, g, g_high)
    s = low + (high - low) * (0.5 * TINY - g_low) / (g_high - g_low + TINY)
    y = x + np.clip(s, -1.0, 1.0)[:, None] * d
    return y - np.clip(y, -h, h), y


def _line_in_box(x: np.ndarray, d: np.ndarray, h: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The greatest separation (K,) over the separating axes, its direction and the point of the line there."""
    best, n, p = np.full(len(x), -np.inf), np.zeros_like(x), x.copy()
    for i in range(3):
        side = np.where(x[:, i] < 0.0, -1.0, 1.0)
        found = np.abs(x[:, i]) - h[:, i] - np.abs(d[:, i])
        normal = np.zeros_like(x)
        normal[:, i] = side
        best, n, p = _wider(best, n, p, found, normal, x - (side * np.sign(d[:, i]))[:, None] * d)
    for i in range(3):
        e = np.eye(3)[i]
        m, size = _normal(np.broadcast_to(e, x.shape), d)
        side = np.where(np.sum(m * x, axis=-1) < 0.0, -1.0, 1.0)
        m = m * side[:, None]
        found = np.where(size, np.sum(m * x - np.abs(m) * h, axis=-1), -np.inf)
        k, edge = np.cross(m, e), h * np.sign(m)
        s = np.sum(k * (edge - x), axis=-1) / np.where(size, np.sum(k * d, axis=-1), 1.0)
        best, n, p = _wider(best, n, p, found, m, x + np.clip(s, -1.0, 1.0)[:, None] * d)
    return best, n, p


def _box_in_box(
    x: np.ndarray, R: np.ndarray, a: np.ndarray, b: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The same for a box at x with axes R and half lengths a, in the frame of a box with half lengths b."""
    best, n, p = np.full(len(x), -np.inf), np.zeros_like(x), x.copy()
    for i in range(6):
        m = R[:, :, i - 3] if i >= 3 else np.broadcast_to(np.eye(3)[i], x.shape)
        m = m * np.where(np.sum(m * x, axis=-1) < 0.0, -1.0, 1.0)[:, None]
        reach = np.einsum("nij,ni->nj", R, m)
        found = np.sum(m * x - np.abs(reach) * a - np.abs(m) * b, axis=-1)
        of_a, of_b = x - np.einsum("nij,nj->ni", R, a * _sides(reach)), b * _sides(m)
        best, n, p = _wider(best, n, p, found, m, of_b if i >= 3 else of_a)
    for i, j in itertools.product(range(3), repeat=2):
        e, f = np.broadcast_to(np.eye(3)[i], x.shape), R[:, :, j]
        m, size = _normal(e, f)
        m = m * np.where(np.sum(m * x, axis=-1) < 0.0, -1.0, 1.0)[:, None]
        reach = np.einsum("nij,ni->nj", R, m)
        found = np.where(size, np.sum(m * x - np.abs(reach) * a - np.abs(m) * b, axis=-1), -np.inf)
        sides_a, sides_b = np.sign(reach), np.sign(m)
        sides_a[:, j], sides_b[:, i] = 0.0, 0.0
        of_a, of_b = x - np.einsum("nij,nj->ni", R, a * sides_a), b * sides_b  # middles of the two edges
        k = np.cross(m, e)
        s = np.sum(k * (of_b - of_a), axis=-1) / np.where(size, np.sum(k * f, axis=-1), 1.0)
        best, n, p = _wider(best, n, p, found, m, of_a + s[:, None] * f)
    return best, n, p


def _sides(values: np.ndarray) -> np.ndarray:
    """Signs, 0 where there is none to rounding: then the middle of a face or edge is as near as its corners."""
    return np.where(np.abs(values) < 1e-12, 0.0, np.sign(values))


def _normal(e: np.ndarray, f: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The normal (K, 3) of two directions, and whether they have one."""
    m = np.cross(e, f)
    mm, ff = np.sum(m * m, axis=-1), np.sum(f * f, axis=-1)
    size = mm > PARALLEL * ff
    return m / np.sqrt(np.where(size, mm, 1.0))[:, None], size


def _wider(best: np.ndarray, n: np.ndarray, p: np.ndarray, found: np.ndarray, m: np.ndarray, at: np.ndarray) -> tuple:
    more = found > best
    return np.where(more, found, best), np.where(more[:, None], m, n), np.where(more[:, None], at, p)


CAPSULE, BOX, PLANE = 0, 1, 2


@dataclass(frozen=True, eq=False)
class CollisionShape:
    """A sphere, capsule, box or plane, or what stands for a cylinder, an ellipsoid or a mesh.

    Attributes:
        name: For a sentence: "geom 'forearm'".
        geom: Its number in the user's file.
        link: Which carries it, -1 for the world.
        T: (4, 4) pose in the link's frame.
        half: (3,) half lengths of its core along its axes, m: of a line the third alone. Of a plane nothing counts.
        radius: Of everything around the core, m.
        plane: Whether it is the half space under its first two axes.
        overestimate: By how much it reaches beyond the shape that it stands for, at most, m.
    """

    name: str
    geom: int
    link: int
    T: np.ndarray
    half: np.ndarray
    radius: float
    plane: bool = False
    overestimate: float = 0.0

    def __post_init__(self) -> None:
        set_fields(self, T=np.array(self.T, dtype=float), half=np.array(self.half, dtype=float))
        self.T.flags.writeable = self.half.flags.writeable = False

    @property
    def kind(self) -> int:
        """LINE, BOX or PLANE."""
        return PLANE if self.plane else BOX if np.any(self.half[:2] > 0.0) else CAPSULE

    @property
    def reach(self) -> float:
        """Radius of the ball about its centre that holds it, m; of a plane infinite."""
        return float("inf") if self.plane else float(np.linalg.norm(self.half)) + self.radius


def in_order(a: CollisionShape, b: CollisionShape) -> tuple[CollisionShape, CollisionShape]:
    """Two solids in the order in which distances are computed: a plane last, else a box last."""
    return (b, a) if a.kind > b.kind else (a, b)


def placed(solids: Sequence[CollisionShape], T: np.ndarray) -> PlacedShapes:
    """Solids whose links are at T (..., P, 4, 4), one after the other."""
    at = (T @ np.array([solid.T for solid in solids])).reshape(-1, 4, 4)
    count = len(at) // len(solids)
    half, radius = (np.array([getattr(solid, name) for solid in solids]) for name in ("half", "radius"))
    return PlacedShapes(at[:, :3, :3], at[:, :3, 3], np.tile(half, (count, 1)), np.tile(radius, count))


def kind_of(a: CollisionShape, b: CollisionShape) -> int:
    """The place in MEASURES of how two solids in their order are measured."""
    return 3 if b.kind == PLANE else a.kind + b.kind


MEASURES = (segment_segment, segment_box, of_boxes, from_plane)
