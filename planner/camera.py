"""Where a camera must stand to see a whole motion: the box that the moving shapes sweep, and the distance to it."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from planner.gl import load_mujoco

_MARGIN = 1.12  # the picture's half sizes over the motion's


class Box(NamedTuple):
    """Corners of a box along the world's axes."""

    low: np.ndarray  # (3,)
    high: np.ndarray  # (3,)

    def beside(self, offset: np.ndarray) -> Box:
        """The box of this one and of the same, displaced."""
        return Box(np.minimum(self.low, self.low + offset), np.maximum(self.high, self.high + offset))


def swept_box(model: Any, path: np.ndarray) -> Box:
    """The box around everything that moves, over the poses path (P, nq)."""
    mujoco = load_mujoco()
    data = mujoco.MjData(model)
    moving = np.flatnonzero(model.body_weldid[model.geom_bodyid] != 0)
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for qpos in path:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        R = data.geom_xmat[moving].reshape(-1, 3, 3)
        centre = data.geom_xpos[moving] + np.einsum("gij,gj->gi", R, model.geom_aabb[moving, :3])
        half = np.einsum("gij,gj->gi", np.abs(R), model.geom_aabb[moving, 3:])
        points = np.concatenate([centre - half, centre + half, data.xpos[1:]])
        if len(points):
            low, high = np.minimum(low, points.min(axis=0)), np.maximum(high, points.max(axis=0))
    if not np.isfinite(low).all():  # nothing but a world
        low, high = model.stat.center - model.stat.extent / 2, model.stat.center + model.stat.extent / 2
    least = 0.05 * max(float(np.max(high - low)), 1e-3)
    return Box(low - least, high + least)


def standing_back(box: Box, azimuth: float, elevation: float, fovy: float, aspect: float) -> float:
    """The distance from the box's centre at which a camera sees all of it.

    Args:
        box: What to see.
        azimuth: Of the camera, degrees (MuJoCo's convention).
        elevation: Of the camera, degrees.
        fovy: Vertical field of view, degrees.
        aspect: Width of the picture over its height.
    """
    a, e = np.radians([azimuth, elevation])
    ahead = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    up = np.array([-np.sin(e) * np.cos(a), -np.sin(e) * np.sin(a), np.cos(e)])
    right = np.cross(ahead, up)
    half = 0.5 * (box.high - box.low)
    corners = half * np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    tangent = np.tan(0.5 * np.radians(fovy))
    needed = np.maximum(np.abs(corners @ up) / tangent, np.abs(corners @ right) / (tangent * aspect))
    return float(np.max(_MARGIN * needed - corners @ ahead))
