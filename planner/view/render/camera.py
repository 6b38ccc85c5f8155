"""Place a camera that sees a whole motion: the box that the moving shapes sweep, and the distance to it."""

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

_MARGIN, _NARROW_MARGIN = 1.12, 1.02  # the picture's half sizes over the motion's, with words around it and without
_LOWER = 0.2  # of half the picture's height: how far a motion is put below its middle, where there is room
MARGIN = 0.05  # around what moves, in parts of its largest side
_ASTRAY = 0.5  # how far a replay that leaves the plan is followed, in largest sides of the plan's box


class Box(NamedTuple):
    """Corners of a box along the world's axes."""

    low: np.ndarray  # (3,)
    high: np.ndarray  # (3,)

    def beside(self, offset: np.ndarray) -> Box:
        """The box around this box and its displaced copy."""
        return Box(np.minimum(self.low, self.low + offset), np.maximum(self.high, self.high + offset))

    def joined(self, other: Box, most: float) -> Box:
        """The box around this box and another, at most `most` larger on every side."""
        low = np.maximum(np.minimum(self.low, other.low), self.low - most)
        return Box(low, np.minimum(np.maximum(self.high, other.high), self.high + most))


def whole_motion(
    films: Sequence[Film], model: Any, appearance: Appearance, aspect: float, ghost: bool, room: float = 1.0,
    *, words: bool = True,
) -> tuple[np.ndarray, float]:  # fmt: skip
    """Point (3,) and distance (m) at which a camera sees all of some films of one plan, and its goals.

    `aspect` is width over height; `room` is the part of the height that words leave free; without any `words` the
    motion fills the picture. A diverging replay is followed only close to the plan.
    """
    scenery = scenery_of(model, appearance)[0]
    plan = box = swept_box(model, films[0].path_ghost_qpos, scenery)
    for film in films:
        swept = swept_box(model, film.path_qpos, scenery)
        box = box.joined(plan.joined(swept, _ASTRAY * float(np.max(plan.high - plan.low))), np.inf)
    if ghost:
        box = box.beside(np.asarray(appearance.ghost_offset))
    goals = [one.position for one in appearance.goals if one.position is not None]
    for places in (np.reshape(goals, (-1, 3)), *appearance.paths):
        if len(places):
            box = box.joined(Box(places.min(axis=0), places.max(axis=0)), np.inf)
    angles = appearance.azimuth, appearance.elevation, model.vis.global_.fovy
    distance = standing_back(box, *angles, aspect, room, _MARGIN if words else _NARROW_MARGIN)
    above = below_words(box, *angles, distance) if room == 1.0 and words else 0.0
    return 0.5 * (box.low + box.high) + above, distance


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
    """The box around everything that moves and carries it, without the scenery (nbody,), over the poses path (P, nq).

    Bodies at rest that carry nothing, a wall for example, may be anywhere: no camera goes back to see them.
    """
    mujoco = load_mujoco()
    data = mujoco.MjData(model)
    moved = moving(model) & ~scenery[model.geom_bodyid]
    geoms = np.flatnonzero(moved & drawn(model) if np.any(moved & drawn(model)) else moved)
    bodies, capsules = np.flatnonzero(~scenery & _carrying(model))[1:], LinkCapsules(model)
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for qpos in path:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        points = np.concatenate([*geom_boxes(model, data, geoms), data.xpos[bodies], capsules.ends(data)])
        if len(points):
            low, high = np.minimum(low, points.min(axis=0)), np.maximum(high, points.max(axis=0))
    if not np.isfinite(low).all():  # nothing but a world
        low, high = model.stat.center - model.stat.extent / 2, model.stat.center + model.stat.extent / 2
    least = MARGIN * max(float(np.max(high - low)), 1e-3)
    return Box(low - least, high + least)


def _carrying(model: Any) -> np.ndarray:
    """Mask (nbody,) of the bodies that move or carry one that moves."""
    carrying = model.body_weldid != 0
    for body in range(model.nbody - 1, 0, -1):  # children come after their parents
        carrying[model.body_parentid[body]] |= carrying[body]
    return carrying


def standing_back(
    box: Box, azimuth: float, elevation: float, fovy: float, aspect: float, room: float = 1.0,
    margin: float = _MARGIN,
) -> float:  # fmt: skip
    """Distance from the box's centre at which a camera, angles in degrees, sees all of the box; see whole_motion()."""
    ahead, right, up = directions(azimuth, elevation)
    half = 0.5 * (box.high - box.low)
    corners = half * np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    tangent = np.tan(0.5 * np.radians(fovy))
    needed = np.maximum(np.abs(corners @ up) / (tangent * room), np.abs(corners @ right) / (tangent * aspect))
    return float(np.max(margin * needed - corners @ ahead))


def below_words(box: Box, azimuth: float, elevation: float, fovy: float, distance: float) -> np.ndarray:
    """Displacement (3,), m, of the camera's point above a box, which stays in the picture: numbers are at the top."""
    _, _, up = directions(azimuth, elevation)
    visible = distance * np.tan(0.5 * np.radians(fovy))
    free = visible - _MARGIN * 0.5 * float((box.high - box.low) @ np.abs(up))
    return up * max(0.0, min(free, _LOWER * visible))


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
