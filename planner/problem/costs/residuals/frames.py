"""Position of a frame, direction of an axis of it, its velocities: three rows each, in the world's axes.

The readable twin of kernels.tree.residuals.frames.
"""

from __future__ import annotations

import numpy as np

from planner.kernels.tree.residuals.table import ANGULAR, POINTING, POSITION
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
    rows = slice(3, 6) if kind == ANGULAR else slice(0, 3)
    J = seen.jacobian(frame)[:, rows]
    value = np.einsum("nai,ni->na", J, seen.v)
    return value, np.concatenate([seen.jacobian_rates(frame)[:, rows], J], axis=2) if moving else np.empty(0)
