"""How a frame stands against one that it should be: rotation vector, or logarithm of SE(3).

The readable twin of kernels.tree.residuals.orientation, which has the formulas.
"""

from __future__ import annotations

import numpy as np

from planner.kernels.tree.residuals.table import POSE
from planner.model.space import hat, log_jacobian, log_quaternion
from planner.problem.costs.residuals.kinematics_cache import KinematicsCache

_SERIES_THRESHOLD = 0.04  # rad^2, below it a series: its next term is below rounding


def orientation_residual(seen: KinematicsCache, t: int, moving: bool) -> tuple[np.ndarray, np.ndarray]:
    """Value (K, 3 or 6) of term t, and its derivative (K, 3 or 6, nv) where asked."""
    frame, reference = seen.frame_of(t), seen.arrays.references(t)
    T, R_ref = seen.pose(frame), reference[:, :9].reshape(-1, 3, 3)
    R, back = T[:, :3, :3], np.swapaxes(R_ref, 1, 2)
    phi, shift = log_quaternion(quaternion_of(back @ R)), np.zeros((len(T), 3))
    value = phi
    if seen.arrays.kind[t] == POSE:
        shift = np.einsum("nij,nj->ni", back, T[:, :3, 3] - reference[:, 9:])
        value = np.concatenate([np.einsum("nij,nj->ni", log_jacobian(-phi), shift), phi], axis=1)
    if not moving:
        return value, np.empty(0)
    J = seen.jacobian(frame)
    own = log_jacobian(phi) @ np.swapaxes(R, 1, 2)  # log(R_ref' R exp(e)), e in R's own axes
    turn = own @ J[:, 3:]
    if seen.arrays.kind[t] != POSE:
        return value, turn
    return value, np.concatenate([own @ J[:, :3] + _bent(phi, shift) @ turn, turn], axis=1)


def _bent(phi: np.ndarray, t: np.ndarray) -> np.ndarray:
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
