"""The part of a film's picture in which anything moves. The rest is drawn once.

Seen by a camera at rest, what differs between two frames lies around the machine, its ghost, marks and arrows, around
their shadows, and around what reflecting planes show of all that.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from planner.base.gl import load_mujoco
from planner.view.render.environment import is_directional
from planner.view.render.shapes import SHOWN_GROUPS, LinkCapsules, moving

_MARGIN = 1.0 / 45.0  # of the picture's height: lines, balls and arrows have a thickness in pixels
_GRID = 4  # pixels: 5 drawn ones at the oversize of a film, 1.25, so that a window shrinks as the whole picture does
_MOST = 0.8  # of the picture; a larger window saves nothing
_STEEP = 0.1  # least downward part of a ray of light whose shadow is followed
_CORNERS = np.stack(np.meshgrid([-1.0, 1.0], [-1.0, 1.0], [-1.0, 1.0]), axis=-1).reshape(8, 3)


class Window(NamedTuple):
    """A part of a picture, pixels; it may reach over the right and the lower end."""

    left: int
    top: int
    width: int
    height: int

    def tiles(self, width: int, height: int) -> Iterator[Window]:
        """Windows of this size that cover a picture."""
        for top in range(0, height, self.height):
            for left in range(0, width, self.width):
                yield Window(left, top, self.width, self.height)

    def paste(self, part: np.ndarray, picture: np.ndarray) -> None:
        """Write the part of a picture that this window shows into the picture."""
        here = picture[self.top : self.top + self.height, self.left : self.left + self.width]
        here[:] = part[: here.shape[0], : here.shape[1]]

    def look_through(self, cameras: Any, width: int, height: int) -> None:
        """Narrow MuJoCo's cameras, which see a whole picture, to this window."""
        for camera in cameras:
            top, size = camera.frustum_top, 2.0 * camera.frustum_top / height  # of a pixel
            camera.frustum_center += size * (self.left + 0.5 * (self.width - width))
            camera.frustum_top = top - size * self.top
            camera.frustum_bottom = top - size * (self.top + self.height)


def swept(model: Any, path: np.ndarray) -> np.ndarray:
    """Points (M, 3) around all that moves in the poses path (P, nq): boxes of shapes, sites, links and tendons."""
    mujoco = load_mujoco()
    data, capsules, points = mujoco.MjData(model), LinkCapsules(model), []
    geoms = np.flatnonzero(moving(model))
    sites = np.flatnonzero((model.body_weldid[model.site_bodyid] != 0) & (model.site_group < SHOWN_GROUPS))
    local = model.geom_aabb[geoms, None, :3] + model.geom_aabb[geoms, None, 3:] * _CORNERS  # (G, 8, 3)
    for qpos in path:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        R = data.geom_xmat[geoms].reshape(-1, 3, 3)
        corners = data.geom_xpos[geoms, None] + np.einsum("gij,gcj->gci", R, local)
        points += [corners.reshape(-1, 3), data.site_xpos[sites], capsules.ends(data)]
        if model.ntendon:
            mujoco.mj_comPos(model, data)
            mujoco.mj_tendon(model, data)
            points.append(data.wrap_xpos.reshape(-1, 3)[: data.ten_wrapadr[-1] + data.ten_wrapnum[-1]].copy())
    return np.concatenate(points)


def moving_window(
    model: Any, machine: np.ndarray, others: np.ndarray, reach: float, eye: np.ndarray, axes: np.ndarray,
    width: int, height: int,
) -> Window:  # fmt: skip
    """The window in which all is that moves; the whole picture where that is not known.

    Args:
        model: MuJoCo's, as it is drawn.
        machine: (M, 3) points around what moves and casts shadows.
        others: (K, 3) points around what moves and casts none.
        reach: How far something may be beyond these points, in the model's unit of length.
        eye: (3,) where the camera is.
        axes: (3, 3) the directions ahead, right and up, as rows.
        width: Of the picture, pixels.
        height: Pixels.

    Returns:
        The window; its sides are multiples of four pixels, or the picture's.
    """
    whole = Window(0, 0, width, height)
    machine, others = (points[np.isfinite(points).all(axis=1)] for points in (machine, others))
    if model.nskin or model.nflex or not len(machine):
        return whole
    data = load_mujoco().MjData(model)
    load_mujoco().mj_kinematics(model, data)
    load_mujoco().mj_comPos(model, data)
    load_mujoco().mj_camlight(model, data)
    shadows = [_shadow(model, data, light, machine) for light in np.flatnonzero(model.light_castshadow).tolist()]
    points = np.concatenate([machine, others, *shadows])
    points = np.concatenate([points, *(_mirrored(model, data, geom, points) for geom in _mirrors(model))])
    depth, right, up = ((points - eye) @ axes.T).T
    scale = 0.5 * height / np.tan(0.5 * np.radians(model.vis.global_.fovy))  # pixels of what is 1 wide at a depth of 1
    if not np.all(depth > reach):  # so is a point that is not finite
        return whole
    reach += float(np.max(model.tendon_width, initial=0.0))
    margin = _MARGIN * height + reach * scale / float(depth.min())
    columns, rows = 0.5 * width + scale * right / depth, 0.5 * height - scale * up / depth
    left, right_end = _span(columns, margin, width)
    top, bottom = _span(rows, margin, height)
    small = (right_end - left) * (bottom - top) < _MOST * width * height
    return Window(left, top, right_end - left, bottom - top) if small else whole


def _span(at: np.ndarray, margin: float, size: int) -> tuple[int, int]:
    """First pixel and end, on the grid, of places `at` (M,) with a margin around them, within 0 to about `size`."""
    low, high = np.clip([at.min() - margin, at.max() + margin], 0, size)
    first = min(int(low) // _GRID, (size - 1) // _GRID)
    return _GRID * first, _GRID * max(first + 1, -(-int(np.ceil(high)) // _GRID))


def _shadow(model: Any, data: Any, light: int, points: np.ndarray) -> np.ndarray:
    """Where the shadows of points (M, 3) end at the latest: at the lowest thing at rest. NaN for a light that moves."""
    rests = np.flatnonzero(~moving(model) & (model.geom_rgba[:, 3] > 0.0))
    if not len(rests):
        return points[:0]
    flat = model.geom_type == load_mujoco().mjtGeom.mjGEOM_PLANE
    below = data.geom_xpos[:, 2] - np.where(flat, 0.0, model.geom_rbound)
    level = data.geom_xmat[:, 8] > 1.0 - 1e-6
    rays = np.full_like(points, data.light_xdir[light])
    if not is_directional(model, light):
        rays = points - data.light_xpos[light]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    moves = model.body_weldid[model.light_bodyid[light]] != 0 or model.light_mode[light] != 0
    if moves or not np.all(rays[:, 2] < -_STEEP) or not np.all(level[rests] | ~flat[rests]):
        return np.full((1, 3), np.nan)
    length = np.maximum(points[:, 2] - below[rests].min(), 0.0) / -rays[:, 2]
    return points + length[:, None] * rays


def _mirrors(model: Any) -> np.ndarray:
    """Shapes with a material that reflects."""
    if not model.nmat:
        return np.zeros(0, int)
    return np.flatnonzero((model.geom_matid >= 0) & (model.mat_reflectance[model.geom_matid] > 0.0))


def _mirrored(model: Any, data: Any, geom: int, points: np.ndarray) -> np.ndarray:
    """Points (M, 3) as a plane, or the upper face of a box, shows them; NaN for one that moves."""
    if moving(model)[geom]:
        return np.full((1, 3), np.nan)
    normal = data.geom_xmat[geom].reshape(3, 3)[:, 2]
    face = 0.0 if model.geom_type[geom] == load_mujoco().mjtGeom.mjGEOM_PLANE else model.geom_size[geom, 2]
    height = (points - data.geom_xpos[geom]) @ normal - face
    return points - 2.0 * height[:, None] * normal
