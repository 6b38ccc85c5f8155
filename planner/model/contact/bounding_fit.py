"""Fit a round line or a round box around points, so that it reaches beyond their hull as little as possible.

A core with half lengths h gets the radius of the farthest point from it, so every fit holds all points. What is made
small is the fourth root of the mean of (s_fit(n) - s_hull(n))^4 over directions n, s the support: for one body inside
of another the largest difference of the two is the distance between their surfaces.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

DIRECTIONS = 150  # that a fit looks at
SEEN = 4000  # that its excess is measured with
TIGHTER = 0.75  # of the excess of a line: what a box, which takes longer to compute with, must be better than
STEPS = 600  # of the search for a line or a box


class BoundingFit(NamedTuple):
    """A core's pose and half lengths, m, the radius around it, and how far it reaches beyond the hull."""

    T: np.ndarray  # (4, 4)
    half: np.ndarray  # (3,)
    radius: float
    overestimate: float


def fit_bounding_shape(points: np.ndarray) -> BoundingFit:
    """The line around points (n, 3), or the box where it is tighter."""
    return _fitted(np.ascontiguousarray(points, dtype=float).tobytes())


@lru_cache(maxsize=256)  # a problem is built again for every finer step
def _fitted(points: bytes) -> BoundingFit:
    corners = _corners(np.frombuffer(points).reshape(-1, 3))
    support = np.max(sphere(SEEN) @ corners.T, axis=1)
    line, box = (
        min((_search(corners, support, start) for start in _starts(corners, lines)), key=lambda fit: fit.overestimate)
        for lines in (True, False)
    )
    return box if box.overestimate < TIGHTER * line.overestimate else line


def round_points(sizes: np.ndarray) -> np.ndarray:
    """Points (n, 3) whose hull holds an ellipsoid of these half axes (3,)."""
    return 1.01 * np.asarray(sizes) * sphere(2 * DIRECTIONS)


def rim_points(radius: float, half: float) -> np.ndarray:
    """Points (64, 3) whose hull holds a cylinder along z."""
    angle = 2.0 * np.pi * np.arange(32) / 32
    out = radius / np.cos(np.pi / 32)
    rim = np.column_stack([out * np.cos(angle), out * np.sin(angle), np.zeros(32)])
    up = np.array([0.0, 0.0, half])
    return np.concatenate([rim + up, rim - up])


@lru_cache(maxsize=4)
def sphere(count: int) -> np.ndarray:
    """Directions (count, 3) that cover a sphere evenly, by Fibonacci's spiral."""
    i = np.arange(count) + 0.5
    z, angle = 1.0 - 2.0 * i / count, np.pi * (1.0 + np.sqrt(5.0)) * i
    r = np.sqrt(1.0 - z * z)
    return np.column_stack([r * np.cos(angle), r * np.sin(angle), z])


def _corners(points: np.ndarray) -> np.ndarray:
    """The points at the corners of their hull; all of them where they are flat."""
    from scipy.spatial import ConvexHull, QhullError  # only where shapes are fitted

    try:
        return points[ConvexHull(points).vertices]
    except QhullError:
        return np.unique(points, axis=0)


def _starts(corners: np.ndarray, lines: bool) -> list[np.ndarray]:
    """Cores to begin with: a turn (3,), a centre (3,) and half lengths, along the axes of the file and the spread."""
    from scipy.spatial.transform import Rotation

    few = len(corners) < 3  # of which a reduced decomposition has no three axes; of many the full one takes seconds
    frames = [np.eye(3), np.linalg.svd(corners - corners.mean(axis=0), full_matrices=few)[2].T]
    found = []
    for axes in frames:
        axes = axes * np.sign(np.linalg.det(axes))
        local = corners @ axes
        size, middle = 0.5 * np.ptp(local, axis=0), 0.5 * (local.max(axis=0) + local.min(axis=0))
        order = np.argsort(size)
        order = order if np.linalg.det(np.eye(3)[:, order]) > 0.0 else order[[1, 0, 2]]
        axes, size, middle = axes[:, order], size[order], middle[order]
        turn, centre = Rotation.from_matrix(axes).as_rotvec(), axes @ middle
        if lines:
            found.append(np.concatenate([turn, centre, [max(size[2] - size[1], 0.05 * size[2])]]))
        else:
            found.append(np.concatenate([turn, centre, np.maximum(size - 0.5 * size[0], 0.02 * size[2])]))
    return found


def _search(corners: np.ndarray, seen_support: np.ndarray, start: np.ndarray) -> BoundingFit:
    """The fit found from a start; `seen_support` (SEEN,) is the support of the corners, over sphere(SEEN)."""
    from scipy.optimize import minimize

    scale = 0.5 * float(np.linalg.norm(np.ptp(corners, axis=0))) or 1.0
    directions = sphere(DIRECTIONS)
    support = np.max(directions @ corners.T, axis=1) / scale
    unit = np.ascontiguousarray(corners.T) / scale  # by coordinate: three long rows

    def beyond(z: np.ndarray) -> float:
        axes, centre, half = _core(z)
        local = np.abs(axes.T @ unit - (centre @ axes)[:, None])
        local -= half[:, None]
        np.maximum(local, 0.0, out=local)
        radius = np.sqrt(np.einsum("ij,ij->j", local, local).max())
        gap = directions @ centre + np.abs(directions @ axes) @ half + radius - support
        square = gap * gap
        return float(square @ square / len(gap)) ** 0.25

    z0 = start.copy()
    z0[3:] /= scale
    steps = np.vstack([z0, z0 + 0.15 * np.eye(len(z0))])
    z = minimize(beyond, z0, method="Nelder-Mead", options={"initial_simplex": steps, "maxfev": STEPS}).x
    axes, centre, half = _core(z)
    centre, half = scale * centre, scale * half
    local = (corners - centre) @ axes
    radius = float(np.linalg.norm(local - np.clip(local, -half, half), axis=1).max())
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = axes, centre
    seen = sphere(SEEN)
    gap = seen @ centre + np.abs(seen @ axes) @ half + radius - seen_support
    return BoundingFit(T, half, radius, float(gap.max()))


def _core(z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Axes (3, 3), centre (3,) and half lengths (3,) of what a search varies."""
    x, y, w = z[:3]
    angle = float(np.sqrt(x * x + y * y + w * w))
    a, b = (1.0, 0.5) if angle < 1e-8 else (np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle**2)
    S = np.array([[0.0, -w, y], [w, 0.0, -x], [-y, x, 0.0]])
    half = np.abs(z[6:]) if len(z) == 9 else np.array([0.0, 0.0, abs(z[6])])
    return np.eye(3) + a * S + b * S @ S, z[3:6], half
