"""Signed distances of two solids: one row each. The readable twin of kernels.tree.residuals.solids.

With the direction n and the point p of model.contact.signed_distance the derivative is n'(J_1(p) - J_2(p)), J the
Jacobians
of what is fixed to each link and at p.
"""

from __future__ import annotations

import numpy as np

from planner.kernels.tree.residuals.table import (
    BOXES,
    FIRST_AXES,
    FIRST_HALF,
    LINE_BOX,
    OVER_PLANE,
    SECOND_AXES,
    SECOND_HALF,
    TAKEN_OFF,
)
from planner.model.contact import signed_distance
from planner.model.contact.signed_distance import PlacedShapes
from planner.problem.costs.residuals.kinematics_cache import KinematicsCache

_MEASURES = {
    LINE_BOX: signed_distance.segment_box,
    BOXES: signed_distance.of_boxes,
    OVER_PLANE: signed_distance.from_plane,
}


def apart(seen: KinematicsCache, t: int, moving: bool) -> tuple[np.ndarray, np.ndarray]:
    """Value (K, 1) of term t, and its derivative (K, 1, nv) where asked."""
    constant, K = seen.arrays.constant[t], len(seen.q)
    frames = [
        seen.frame(int(end), constant[first : first + 9].reshape(3, 3))
        for end, first in zip(seen.arrays.ends[t], (FIRST_AXES, SECOND_AXES), strict=False)
    ]
    T = [seen.pose(frame) for frame in frames]
    half = [constant[first : first + 3] for first in (FIRST_HALF, SECOND_HALF)]
    cores = [PlacedShapes(pose[:, :3, :3], pose[:, :3, 3], np.tile(h, (K, 1)), np.zeros(K))
             for pose, h in zip(T, half, strict=True)]  # fmt: skip
    near = _MEASURES[int(seen.arrays.kind[t])](*cores)
    value = (near.distance - constant[TAKEN_OFF])[:, None]
    if not moving:
        return value, np.empty(0)
    row = np.zeros((K, seen.nv))
    for sign, frame, pose in zip((1.0, -1.0), frames, T, strict=True):
        J = seen.jacobian(frame)
        moment = np.cross(near.p - pose[:, :3, 3], near.n)
        row += sign * (np.einsum("na,nai->ni", near.n, J[:, :3]) + np.einsum("na,nai->ni", moment, J[:, 3:]))
    return value, row[:, None]
