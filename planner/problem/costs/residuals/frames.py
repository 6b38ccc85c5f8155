"""Position of a frame, direction of an axis of it, its velocities: three rows each, in the world's axes; tilt, one row.

The readable twin of kernels.tree.residuals.frames.
"""

from __future__ import annotations

import numpy as np

from planner.kernels.tree.residuals.table import ANGULAR, BLUNT, POINTING, POSITION, TILT, TINY
from planner.model.space import cross
from planner.problem.costs.residuals.kinematics_cache import KinematicsCache


def framed(seen: KinematicsCache, t: int, moving: bool) -> tuple[np.ndarray, np.ndarray]:
    """Value (K, 3) of term t, and its derivative (K, 3, nv or 2 nv) where asked."""
    kind, frame = seen.arrays.kind[t], seen.frame(int(seen.arrays.ends[t, 0]))
    if kind in (POSITION, POINTING):
        T = seen.pose(frame)
        value = T[:, :3, 3] if kind == POSITION else T[:, :3, :3] @ seen.arrays.constant[t, :3]
        if not moving:
            return value, np.empty(0)
        J = seen.jacobian(frame)
        return value, J[:, :3] if kind == POSITION else np.cross(J[:, 3:], value[:, :, None], axis=1)
    if kind == TILT:
        return _tilted(seen, t, moving)
    rows = slice(3, 6) if kind == ANGULAR else slice(0, 3)
    J = seen.jacobian(frame)[:, rows]
    value = np.einsum("nai,ni->na", J, seen.v)
    return value, np.concatenate([seen.jacobian_rates(frame)[:, rows], J], axis=2) if moving else np.empty(0)


def tilt_bend(seen: KinematicsCache, t: int) -> tuple[np.ndarray, np.ndarray]:
    """Of a tilt the second derivative (K,) by how far the axis moves across its arc, and that by q, (K, nv)."""
    frame = seen.frame(int(seen.arrays.ends[t, 0]))
    b, n, sine, cosine = _arc(seen, t)
    return cosine * sine / (sine**2 + BLUNT), np.einsum("na,nai->ni", cross(b, n), seen.jacobian(frame)[:, 3:])


def _tilted(seen: KinematicsCache, t: int, moving: bool) -> tuple[np.ndarray, np.ndarray]:
    """The angle (K, 1) between a frame's axis and a direction, and its derivative (K, 1, nv)."""
    _, n, sine, cosine = _arc(seen, t)
    value = np.arctan2(sine, cosine)[:, None]
    if not moving:
        return value, np.empty(0)
    frame = seen.frame(int(seen.arrays.ends[t, 0]))
    return value, -np.einsum("na,nai->ni", n, seen.jacobian(frame)[:, 3:])[:, None]


def _arc(seen: KinematicsCache, t: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The axis b (K, 3), the direction n (K, 3) about which it would turn to d, sine and cosine (K,) of the tilt."""
    own = seen.arrays.constant[t]
    b, d = seen.pose(seen.frame(int(seen.arrays.ends[t, 0])))[:, :3, :3] @ own[:3], own[3:6]
    about = cross(b, np.broadcast_to(d, b.shape))
    sine = np.sqrt(np.sum(about**2, axis=1) + TINY)
    return b, about / sine[:, None], sine, b @ d
