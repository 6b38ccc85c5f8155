"""Place a camera that sees a whole motion, by what it sweeps; and the part of a film's picture in which anything moves.

The rest of the picture is drawn once. Seen by a camera at rest, what differs between two frames lies around the
machine, its ghost, marks and arrows, around their shadows, and around what reflecting planes show of all that.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from planner.base.arguments import array, short_repr
from planner.base.errors import PlannerError
from planner.base.gl import load_mujoco
from planner.problem.appearance import Appearance
from planner.view.render.film import Film
from planner.view.render.shapes import SHOWN_GROUPS, BoxCorners, LinkCapsules, drawn, moving

_MARGIN, _NARROW_MARGIN = 1.25, 1.06  # the picture's half sizes over the motion's, with words around it and without
# Of half the picture's height: how far a motion is put below its middle, where there is room; where the free part of a
# picture ends, above and below. Its caption begins at 0.71 (overlay.py).
_LOWER, _TOP, _BOTTOM = 0.15, 0.8, 0.69
MARGIN = 0.05  # around what moves, in parts of its largest side
_POINT = 1e-3  # m: least side of what is seen of a machine that is a point
_ASTRAY = 0.5  # how far a replay that leaves the plan is followed, in largest sides of the plan's box


class Box(NamedTuple):
    """Corners of a box along the world's axes."""

    low: np.ndarray  # (3,)
    high: np.ndarray  # (3,)


def whole_motion(
    films: Sequence[Film], model: Any, appearance: Appearance, aspect: float, ghost: bool, room: float = 1.0,
    *, words: bool = True,
) -> tuple[np.ndarray, float]:  # fmt: skip
    """Point (3,) and distance (m) at which a camera sees all of some films of one plan, and its goals.

    `aspect` is width over height; `room` is the part of the height that words leave free; without any `words` the
    motion fills the picture. A diverging replay is followed only close to the plan.
    """
    scenery = scenery_of(model, appearance)[0]
    plan = swept_points(model, films[0].path_ghost_qpos, scenery)
    swept = [kept_near(plan, swept_points(model, film.path_qpos, scenery)) for film in films]
    points = np.concatenate([plan, *swept])
    if ghost:
        points = np.concatenate([points, points + np.asarray(appearance.ghost_offset)])
    goals = [one.position for one in appearance.goals if one.position is not None]
    points = np.concatenate([points, np.reshape(goals, (-1, 3)), *appearance.paths])
    angles = appearance.azimuth, appearance.elevation, model.vis.global_.fovy
    axes = np.stack(directions(*angles[:2]))
    along = points @ axes.T
    middle = 0.5 * (along.min(axis=0) + along.max(axis=0)) @ axes
    if not words or room < 1.0:
        return middle, standing_back(points - middle, *angles, aspect, room, _MARGIN if words else _NARROW_MARGIN)
    distance = standing_back(points - middle, *angles, aspect, 0.5 * (_TOP + _BOTTOM) * _MARGIN)
    return middle + between_words(points - middle, *angles, distance), distance


def kept_near(plan: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points (M, 3), at most _ASTRAY of the plan's largest side beyond the box of its points (P, 3)."""
    low, high = plan.min(axis=0), plan.max(axis=0)
    most = _ASTRAY * float(np.max(high - low))
    return np.clip(points, low - most, high + most)


def scenery_of(model: Any, appearance: Appearance) -> tuple[np.ndarray, np.ndarray]:
    """Masks of the bodies (nbody,) and tendons (ntendon,) that are scenery; PlannerError for an unknown name."""
    bodies, tendons = np.zeros(model.nbody, bool), np.zeros(model.ntendon, bool)
    named = {model.body(i).name: (bodies, i) for i in range(1, model.nbody)}
    named |= {model.tendon(i).name: (tendons, i) for i in range(model.ntendon)}
    for name in appearance.scenery:
        if name not in named:
            known = ", ".join(filter(None, named)) or "none"
            raise PlannerError(f"the scenery is {name!r}, expected a body or tendon of the model: {known}.")
        mask, i = named[name]
        mask[i] = True
    for i in range(1, model.nbody):
        bodies[i] |= bodies[model.body_parentid[i]]
    return bodies, tendons


def swept_box(model: Any, path: np.ndarray, scenery: np.ndarray) -> Box:
    """The box around swept_points(), with room around it."""
    points = swept_points(model, path, scenery)
    low, high = points.min(axis=0), points.max(axis=0)
    least = MARGIN * max(float(np.max(high - low)), 1e-3)
    return Box(low - least, high + least)


def swept_points(model: Any, path: np.ndarray, scenery: np.ndarray) -> np.ndarray:
    """Points (M, 3) around all that moves and carries it, without the scenery (nbody,), in the poses path (P, nq).

    Bodies at rest that carry nothing, a wall for example, may be anywhere: no camera goes back to see them.
    """
    mujoco = load_mujoco()
    data = mujoco.MjData(model)
    moved = moving(model) & ~scenery[model.geom_bodyid]
    geoms = np.flatnonzero(moved & drawn(model) if np.any(moved & drawn(model)) else moved)
    boxes = BoxCorners(model, geoms)
    bodies, capsules = np.flatnonzero(~scenery & _carrying(model))[1:], LinkCapsules(model)
    swept = []
    for qpos in path:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        swept += [boxes.at(data), data.xpos[bodies], capsules.ends(data)]
    points = np.concatenate([np.reshape(one, (-1, 3)) for one in swept])
    if len(points) and np.any(np.ptp(points, axis=0)):
        return points
    middle = points[0] if len(points) else model.stat.center  # a point that stays, or nothing but a world
    return middle + 0.5 * max(model.stat.extent, _POINT) * np.array([[-1.0] * 3, [1.0] * 3])


def _carrying(model: Any) -> np.ndarray:
    """Mask (nbody,) of the bodies that move or carry one that moves."""
    carrying = model.body_weldid != 0
    for body in range(model.nbody - 1, 0, -1):  # children come after their parents
        carrying[model.body_parentid[body]] |= carrying[body]
    return carrying


def standing_back(
    points: np.ndarray, azimuth: float, elevation: float, fovy: float, aspect: float, room: float = 1.0,
    margin: float = _MARGIN,
) -> float:  # fmt: skip
    """Distance at which a camera, angles in degrees, sees points (M, 3) about what it looks at; see whole_motion()."""
    ahead, right, up = directions(azimuth, elevation)
    tangent = np.tan(0.5 * np.radians(fovy))
    needed = np.maximum(np.abs(points @ up) / (tangent * room), np.abs(points @ right) / (tangent * aspect))
    return float(np.max(margin * needed - points @ ahead))


def between_words(points: np.ndarray, azimuth: float, elevation: float, fovy: float, distance: float) -> np.ndarray:
    """Displacement (3,), m, of what a camera looks at, from what points (M, 3) are about: they stay clear of the words.

    Numbers are at the picture's top, captions at its bottom.
    """
    ahead, _, up = directions(azimuth, elevation)
    tangent, height = np.tan(0.5 * np.radians(fovy)), points @ up
    half = tangent * (distance + points @ ahead)  # of the picture's height, at each point
    highest, lowest = np.min(height + _BOTTOM * half), np.max(height - _TOP * half)
    return up * float(np.clip(_LOWER * distance * tangent, lowest, highest))


def directions(azimuth: float, elevation: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Directions (3,) of space that are ahead, right and up for a camera, angles in degrees (MuJoCo's convention)."""
    a, e = np.radians([azimuth, elevation])
    ahead = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    up = np.array([-np.sin(e) * np.cos(a), -np.sin(e) * np.sin(a), np.cos(e)])
    return ahead, np.cross(ahead, up), up


def checked_direction(camera: Any) -> tuple[float, float]:
    """Azimuth and elevation, degrees, of a camera that is given by its line of sight.

    Raises:
        PlannerError: They are no two numbers, or nothing looks up or down so far.
    """
    azimuth, elevation = map(float, array("camera", camera, (2,)))
    if abs(elevation) > 90.0:
        raise PlannerError(
            f"camera is {azimuth:g},{elevation:g}, expected azimuth and elevation, the latter from -90 (down) to 90 "
            "(up) degrees, e.g. 90,-15."
        )
    return azimuth, elevation


def angles_of_camera(model: Any, name: str) -> tuple[float, float]:
    """Azimuth and elevation, degrees, in which a camera of the model looks in its home pose.

    Raises:
        PlannerError: The model has no camera of this name.
    """
    mujoco = load_mujoco()
    names = [model.camera(i).name for i in range(model.ncam)]
    if name not in names:
        known = f"one of: {', '.join(names)}, or " if names else ""
        known += "azimuth and elevation, degrees, e.g. 90,-15"
        raise PlannerError(f"the model has no camera {short_repr(name)}, expected {known}.")
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_camlight(model, data)
    x, y, z = -data.cam_xmat[names.index(name)].reshape(3, 3)[:, 2]  # a camera looks along its -z
    return float(np.degrees(np.arctan2(y, x))), float(np.degrees(np.arcsin(np.clip(z, -1.0, 1.0))))


_WINDOW_MARGIN = 1.0 / 45.0  # of the picture's height: lines, balls and arrows have a thickness in pixels
_GRID = 4  # pixels: 5 drawn ones at the oversize of a film, 1.25, so that a window shrinks as the whole picture does
_MOST = 0.8  # of the picture; a larger window saves nothing
_STEEP = 0.1  # least downward part of a ray of light whose shadow is followed


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


def moving_points(model: Any, path: np.ndarray) -> np.ndarray:
    """Points (M, 3) around all that moves in the poses path (P, nq): boxes of shapes, sites, links and tendons."""
    mujoco = load_mujoco()
    data, capsules, points = mujoco.MjData(model), LinkCapsules(model), []
    corners = BoxCorners(model, np.flatnonzero(moving(model)))
    sites = np.flatnonzero((model.body_weldid[model.site_bodyid] != 0) & (model.site_group < SHOWN_GROUPS))
    for qpos in path:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        points += [corners.at(data), data.site_xpos[sites], capsules.ends(data)]
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
    margin = _WINDOW_MARGIN * height + reach * scale / float(depth.min())
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
    if not _is_directional(model, light):
        rays = points - data.light_xpos[light]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    moves = model.body_weldid[model.light_bodyid[light]] != 0 or model.light_mode[light] != 0
    if moves or not np.all(rays[:, 2] < -_STEEP) or not np.all(level[rests] | ~flat[rests]):
        return np.full((1, 3), np.nan)
    length = np.maximum(points[:, 2] - below[rests].min(), 0.0) / -rays[:, 2]
    return points + length[:, None] * rays


def _is_directional(model: Any, light: int) -> bool:
    """Whether all rays of a light are parallel, as the sun's."""
    if hasattr(model, "light_type"):  # since MuJoCo 3.3.3
        return model.light_type[light] == load_mujoco().mjtLightType.mjLIGHT_DIRECTIONAL
    return bool(model.light_directional[light])


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
