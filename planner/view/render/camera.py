"""Place a camera that sees a whole motion: the points that the moving shapes sweep, and the distance to them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from planner.base.arguments import short_repr
from planner.base.errors import PlannerError
from planner.base.gl import load_mujoco
from planner.problem.appearance import Appearance
from planner.view.render.film import Film
from planner.view.render.shapes import LinkCapsules, drawn, geom_boxes, moving

_MARGIN, _NARROW_MARGIN = 1.25, 1.06  # the picture's half sizes over the motion's, with words around it and without
# Of half the picture's height: how far a motion is put below its middle, where there is room; where the free part of a
# picture ends, above and below. Its caption begins at 0.71 (overlay.py).
_LOWER, _TOP, _BOTTOM = 0.15, 0.8, 0.69
MARGIN = 0.05  # around what moves, in parts of its largest side
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
    bodies, capsules = np.flatnonzero(~scenery & _carrying(model))[1:], LinkCapsules(model)
    swept = []
    for qpos in path:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        swept += [*geom_boxes(model, data, geoms), data.xpos[bodies], capsules.ends(data)]
    points = np.concatenate([np.reshape(one, (-1, 3)) for one in swept])
    if len(points):
        return points
    return model.stat.center + 0.5 * model.stat.extent * np.array([[-1.0] * 3, [1.0] * 3])  # nothing but a world


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


def angles_of_camera(model: Any, name: str) -> tuple[float, float]:
    """Azimuth and elevation, degrees, in which a camera of the model looks in its home pose.

    Raises:
        PlannerError: The model has no camera of this name.
    """
    mujoco = load_mujoco()
    names = [model.camera(i).name for i in range(model.ncam)]
    if name not in names:
        known = f"one of: {', '.join(names)}, or azimuth and elevation" if names else "azimuth and elevation, degrees"
        raise PlannerError(f"the model has no camera {short_repr(name)}, expected {known}.")
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_camlight(model, data)
    x, y, z = -data.cam_xmat[names.index(name)].reshape(3, 3)[:, 2]  # a camera looks along its -z
    return float(np.degrees(np.arctan2(y, x))), float(np.degrees(np.arcsin(np.clip(z, -1.0, 1.0))))
