"""Heights, distances and velocities of points: one row each. The readable twin of kernels.tree.residuals.scalars.

Heights are n'p - level; distances |d| - radii, with d from the nearest point of one line to that of the other. Since
those are nearest, that they move along the lines does not change |d| to first order: the derivative is that of two
fixed points, which share the motion of the ends. Velocities are d'(V_1 - V_2), with the velocities V of points that are
fixed to their links.
"""

from __future__ import annotations

import numpy as np

from planner.kernels.tree.residuals.table import HEIGHT, PARALLEL, TINY, VELOCITY
from planner.problem.costs.residuals.kinematics_cache import KinematicsCache


def scalar(seen: KinematicsCache, t: int, moving: bool) -> tuple[np.ndarray, np.ndarray]:
    """Value (K, 1) of term t, and its derivative (K, 1, nv or 2 nv) where asked."""
    m, fast = seen.arrays, seen.arrays.kind[t] == VELOCITY
    i, j, k, l = (int(end) for end in m.ends[t])
    n, level, ones = m.constant[t, :3], m.constant[t, 3], np.ones(len(seen.q))
    direction = np.tile(n, (len(seen.q), 1))
    if fast:
        value, points, factors = (seen.velocities[:, i] - seen.velocities[:, j]) @ n, (i, j), (ones, -ones)
    elif m.kind[t] == HEIGHT:
        value, points, factors = seen.places[:, i] @ n - level, (i,), (ones,)
    else:
        d, s, u = nearest(*(seen.places[:, end] for end in (i, j, k, l)))
        length = np.sqrt(np.sum(d * d, axis=-1) + TINY)
        value, direction = length - level, d / length[:, None]
        points, factors = (i, j, k, l), (1.0 - s, s, u - 1.0, -u)
    if not moving:
        return value[:, None], np.empty(0)
    row = np.zeros((len(seen.q), 2 * seen.nv if fast else seen.nv))
    for point, factor in zip(points, factors, strict=True):
        moves = seen.jacobians[:, point]
        if fast:
            moves = np.concatenate([seen.turning(point), moves], axis=2)
        row += factor[:, None] * np.einsum("na,nai->ni", direction, moves)
    return value[:, None], row[:, None]


def nearest(
    a0: np.ndarray, a1: np.ndarray, b0: np.ndarray, b1: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns d (..., 3) from the nearest point of b to that of a, and where: a0 + s (a1 - a0), b0 + u (b1 - b0).

    The nearest points of the whole lines, then each in turn put back onto its segment: exact, since the squared
    distance is convex in (s, u) (Ericson, Real-Time Collision Detection, section 5.1.9). The ends (..., 3) of a segment
    may be the same.
    """
    v, w, r = a1 - a0, b1 - b0, a0 - b0
    vv, ww, vw = (np.sum(x * y, axis=-1) for x, y in ((v, v), (w, w), (v, w)))
    vr, wr = np.sum(v * r, axis=-1), np.sum(w * r, axis=-1)
    pull = PARALLEL * vv * ww
    s = np.clip((vw * wr - vr * ww + 0.5 * pull) / (vv * ww - vw * vw + pull + TINY), 0.0, 1.0)
    u = np.clip((vw * s + wr) / (ww + TINY), 0.0, 1.0)
    s = np.clip((vw * u - vr) / (vv + TINY), 0.0, 1.0)
    return r + s[..., None] * v - u[..., None] * w, s, u
