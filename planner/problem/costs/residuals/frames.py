"""Position of a frame, direction of an axis of it, its velocities: three rows each, in the world's axes; tilt, one row.

The readable twin of kernels.tree.residuals.frames.
"""

from __future__ import annotations

import numpy as np

from planner.kernels.tree.residuals.table import ANGULAR, POINTING, POSITION, TILT, TINY
from planner.model.space import cross
from planner.problem.costs.residuals.seen import Seen


def framed(seen: Seen, t: int, moving: bool) -> tuple[np.ndarray, np.ndarray]:
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


def _tilted(seen: Seen, t: int, moving: bool) -> tuple[np.ndarray, np.ndarray]:
    """The angle (K, 1) between a frame's axis and a direction, and its derivative (K, 1, nv)."""
    frame, own = seen.frame(int(seen.arrays.ends[t, 0])), seen.arrays.constant[t]
    b, d = seen.pose(frame)[:, :3, :3] @ own[:3], own[3:6]
    about = cross(b, np.broadcast_to(d, b.shape))
    sine = np.sqrt(np.sum(about**2, axis=1, keepdims=True) + TINY)
    value = np.arctan2(sine, (b @ d)[:, None])
    return value, -np.einsum("na,nai->ni", about / sine, seen.jacobian(frame)[:, 3:])[:, None] if moving else np.empty(
        0
    )
