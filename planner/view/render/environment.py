"""The setting of a machine: a sky, a floor and light where its model has none, and a camera from which it is seen.

A default camera turns until what is at rest does not hide the motion: a wall, a shelf, the far side of a cabinet.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import replace
from typing import Any
from xml.etree import ElementTree

import numpy as np

from planner.base import gl
from planner.base.gl import load_mujoco
from planner.model.mjcf.model_index import compile_model
from planner.problem.appearance import Appearance
from planner.view.render.camera import MARGIN, Box, directions, scenery_of, standing_back, swept_box, swept_points
from planner.view.render.film import Film
from planner.view.render.shapes import drawn, geom_boxes, moving, paint_links, show_one_shape_for_each_part, unpainted

_CELL = 0.125  # of the machine's size, about: the side of the floor's squares
_BELOW = 2e-3  # of the machine's size: how far our floor is below a shape that stands on it, or the two would flicker
_GAP = 0.08  # of the machine's size: how far it is below a machine that does not stand on it, so that this is seen
_STANDS = 0.01  # of the machine's size: how far a machine that stands at the height 0 may sink below it
_GONE = 10.0  # sizes of the machine: no floor is laid under a replay that fell as far
_LEVEL = 0.7  # upward part of the normal of a floor
_LAMP_REACH = 3.0  # distance of our lamp, in sizes of the machine
_LIT_BY_OTHERS, _GLOW = 0.6, 0.3  # brightness of our floor in others' light, which may glare, and without any
_AMBIENT = 0.3  # where the model has light and does not say how much comes from everywhere: MuJoCo's 0.1 is night
_COARSE = 10.0  # sizes of the machine: in a model as large as that, MuJoCo's map of shadows is too coarse for it

_OURS = "planner {}"
"""A name in the model for what is added; a user's name would hardly have a space."""
_SKY = {"type": "skybox", "builtin": "gradient", "rgb1": "0.55 0.70 0.88", "rgb2": "0.93 0.95 0.97", "width": "64",
        "height": "384"}  # fmt: skip
_SQUARES = {"type": "2d", "builtin": "checker", "rgb1": "0.92 0.925 0.935", "rgb2": "0.83 0.845 0.865", "mark": "edge",
            "markrgb": "0.76 0.78 0.81", "width": "512", "height": "512"}  # fmt: skip
_PAVED = {"texuniform": "true", "specular": "0.05", "shininess": "0.1"}
_PLANE = {"type": "plane", "size": "0 0 1", "contype": "0", "conaffinity": "0", "group": "0", "rgba": "1 1 1 1"}
_LAMP = {"dir": "-0.35 0.45 -1", "diffuse": "0.45 0.45 0.45", "specular": "0.1 0.1 0.1", "castshadow": "true"}


def visible_model(films: Sequence[Film]) -> Any:
    """The model of films of one plan as it is drawn; ModelError where MuJoCo refuses its text."""
    model, ours = _furnished(films[0])
    paint_links(model)
    show_one_shape_for_each_part(model)
    _lay_floor(model, films, ours)
    return model


def _furnished(film: Film) -> tuple[Any, int]:
    """The model with a floor of ours, perhaps one too many, and with a sky and light if it has none; our floor."""
    mujoco = gl.load_mujoco()
    root = ElementTree.fromstring(film.mjcf)
    assets, world = (_part(root, name) for name in ("asset", "worldbody"))
    lit = root.find(".//worldbody//light") is not None
    if not any(texture.get("type") == "skybox" for texture in root.iter("texture")):
        ElementTree.SubElement(assets, "texture", _SKY | {"name": _OURS.format("sky")})
    squares, paving = _OURS.format("squares"), _OURS.format("paving")
    ElementTree.SubElement(assets, "texture", _SQUARES | {"name": squares})
    ElementTree.SubElement(assets, "material", _PAVED | {"name": paving, "texture": squares})
    ElementTree.SubElement(world, "geom", _PLANE | {"name": _OURS.format("floor"), "material": paving})
    if not lit:
        ElementTree.SubElement(world, "light", _LAMP | {"name": _OURS.format("lamp")})
    model = copy.copy(compile_model(ElementTree.tostring(root, encoding="unicode"), film.assets))
    ours = int(model.geom(_OURS.format("floor")).id)
    if lit:
        model.geom_rgba[ours, :3] = _LIT_BY_OTHERS
        model.mat_emission[model.geom_matid[ours]] = _GLOW
        if root.find(".//visual/headlight") is None:
            model.vis.headlight.ambient[:] = np.maximum(model.vis.headlight.ambient, _AMBIENT)
    else:
        lamp = model.light(_OURS.format("lamp")).id
        if hasattr(model, "light_type"):  # since MuJoCo 3.3.3
            model.light_type[lamp] = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
        else:
            model.light_directional[lamp] = 1
        model.vis.headlight.ambient[:], model.vis.headlight.diffuse[:] = 0.4, 0.3
        model.vis.headlight.specular[:] = 0.05
    return model, ours


def _part(root: ElementTree.Element, name: str) -> ElementTree.Element:
    found = root.find(name)
    return ElementTree.SubElement(root, name) if found is None else found


def _lay_floor(model: Any, films: Sequence[Film], ours: int) -> None:
    """Put our floor under all poses of all films, or hide it where the model has one of its own.

    No file has this floor, so nothing may touch it or go through it. A machine that stays above the height 0 has it
    there.
    """
    mujoco = gl.load_mujoco()
    data, scenery = mujoco.MjData(model), scenery_of(model, films[0].appearance)[0]
    box = swept_box(model, films[0].path_ghost_qpos, scenery)
    size, middle = float(np.max(box.high - box.low)), 0.5 * (box.low + box.high)
    planned = _lowest(box)
    lowest = min(planned, _lowest_mark(films[0]), *(_lowest(swept_box(model, one.path_qpos, scenery)) for one in films))
    gone = not lowest > planned - _GONE * size
    mujoco.mj_kinematics(model, data)
    rests = drawn(model) & ~moving(model) & (model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE)
    lowest = float(geom_boxes(model, data, np.flatnonzero(rests))[0][:, 2].min(initial=lowest))
    stands = -_STANDS * size <= lowest <= size
    height = min(lowest, 0.0) - _BELOW * size if stands else lowest - _GAP * size
    g = model.opt.gravity
    power, rest = divmod(np.log10(_CELL * size), 1.0)
    cell = 10.0**power * next(k for k in (5.0, 2.0, 1.0) if np.log10(k) <= rest)
    model.mat_texrepeat[model.geom_matid[ours]] = 0.5 / cell  # a texture is two squares wide
    _pave(model, data, ours)
    level = not np.any(g) or g[2] < -_LEVEL * np.linalg.norm(g)
    if level and not gone and not _has_floor(model, data, ours, scenery, size):
        model.geom_pos[ours, 2] = height
        model.geom_sameframe[ours] = 0  # or MuJoCo would leave it in the world's origin
    else:
        model.geom_matid[ours], model.geom_rgba[ours, 3] = -1, 0.0
    lamp = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_LIGHT, _OURS.format("lamp"))
    if lamp >= 0:
        model.light_pos[lamp] = middle - _LAMP_REACH * size * model.light_dir[lamp]
        model.light_castshadow[lamp] = model.stat.extent < _COARSE * size


def _pave(model: Any, data: Any, ours: int) -> None:
    """Let floors that nobody painted look like ours, without an end: for contacts a plane has none."""
    planes = (model.geom_type == gl.load_mujoco().mjtGeom.mjGEOM_PLANE) & (data.geom_xmat[:, 8] > _LEVEL)
    bare = np.flatnonzero(planes & ~moving(model) & unpainted(model))
    model.geom_matid[bare], model.geom_rgba[bare] = model.geom_matid[ours], model.geom_rgba[ours]
    model.geom_size[bare, :2] = 0.0


def _lowest(box: Box) -> float:
    """The height of the lowest point in a swept box, m, without the room around it."""
    return float(box.low[2] + MARGIN / (1.0 + 2.0 * MARGIN) * np.max(box.high - box.low))


def _lowest_mark(film: Film) -> float:
    """The height of the lowest goal or path, m; infinite where there is none."""
    goals = [one.position for one in film.appearance.goals if one.position is not None]
    return min((float(np.min(places[:, 2])) for places in (np.reshape(goals, (-1, 3)), *film.appearance.paths)
                if len(places)), default=np.inf)  # fmt: skip


def _has_floor(model: Any, data: Any, ours: int, scenery: np.ndarray, size: float) -> bool:
    """Whether there is scenery, or a plane, field of heights or box of the world that looks up, wide as the machine."""
    kinds = gl.load_mujoco().mjtGeom
    if np.any(drawn(model) & scenery[model.geom_bodyid]):
        return True
    for i in np.flatnonzero(drawn(model) & ~moving(model)):
        upward = abs(data.geom_xmat[i].reshape(3, 3)[2, 2]) > _LEVEL
        endless = model.geom_type[i] == kinds.mjGEOM_PLANE and not np.all(model.geom_size[i, :2])
        flat = any(model.geom_type[i] == kind for kind in (kinds.mjGEOM_PLANE, kinds.mjGEOM_HFIELD, kinds.mjGEOM_BOX))
        if i != ours and upward and (endless or (flat and np.all(model.geom_size[i, :2] > 0.5 * size))):
            return True
    return False


_POSES, _POINTS = 12, 240  # of the planned motion, and in all of them
_HIDDEN = 0.15  # share of the points behind something at rest with which a camera stays where it is
# The share of points that a turn must make visible, at the least: half a turn; one that sees the motion edge-on.
_TURN, _EDGE_ON = 0.1, 0.4
_TURNS = (0.0, 30.0, -30.0, 60.0, -60.0, 90.0, -90.0, 120.0, -120.0, 150.0, -150.0, 180.0)  # degrees
_ELEVATIONS = (-18.0, -35.0, -55.0)  # degrees, beside its own: a box is seen into from above
_ASPECT, _ROOM = 16.0 / 9.0, 0.7  # the camera is as far away as in any picture: one with words, beside another
_REACH = 0.98  # of the way from the camera to a point: what is closer to the point than that hides nothing


def unobstructed(film: Film, model: Any) -> Appearance:
    """A film's appearance, its camera turned as little as needed to see the plan, where the appearance allows it.

    `model` is MuJoCo's, as it is drawn. All films of a plan get the same camera, since it is the plan that counts.
    """
    seen = film.appearance
    hiding = drawn(model) & ~moving(model) & (model.geom_type != load_mujoco().mjtGeom.mjGEOM_PLANE)
    if not seen.may_turn or not np.any(hiding):
        return seen
    path = film.path_ghost_qpos[:: -(-len(film.path_ghost_qpos) // _POSES)]
    points = swept_points(model, path, scenery_of(model, seen)[0])
    points = points[:: -(-len(points) // _POINTS)]
    sight = _Sight(model, film.qpos[0], hiding, points)
    own = sight.hidden(seen.azimuth, seen.elevation)
    if own <= _HIDDEN:
        return seen
    whole, best, angles = sight.area(seen.azimuth, seen.elevation), own, (seen.azimuth, seen.elevation)
    for elevation in (seen.elevation, *_ELEVATIONS):
        for turn in _TURNS:
            loss = sight.hidden(seen.azimuth + turn, elevation)
            loss += _TURN * (abs(turn) + abs(elevation - seen.elevation)) / 180.0
            loss += _EDGE_ON * max(0.0, 1.0 - sight.area(seen.azimuth + turn, elevation) / max(whole, 1e-12))
            if loss < best:
                best, angles = loss, (seen.azimuth + turn, elevation)
    return replace(seen, azimuth=angles[0], elevation=angles[1])


class _Sight:
    """What a camera sees of points (M, 3) past the shapes `hiding` (ngeom,) of a model."""

    def __init__(self, model: Any, qpos: np.ndarray, hiding: np.ndarray, points: np.ndarray) -> None:
        mujoco = load_mujoco()
        self._mujoco, self._model, self._hiding, self._points = mujoco, model, hiding, points
        self._data = mujoco.MjData(model)
        self._data.qpos[:] = qpos
        mujoco.mj_kinematics(model, self._data)
        self._middle = 0.5 * (points.min(axis=0) + points.max(axis=0))

    def area(self, azimuth: float, elevation: float) -> float:
        """How far the points are spread over the picture, seen in a direction, degrees: an area."""
        flat = (self._points - self._points.mean(axis=0)) @ np.stack(directions(azimuth, elevation)[1:]).T
        return float(np.sqrt(max(0.0, np.linalg.det(flat.T @ flat))))

    def hidden(self, azimuth: float, elevation: float) -> float:
        """Share of the points that are hidden from a camera in this direction, degrees, that sees all of them."""
        angles = azimuth, elevation, float(self._model.vis.global_.fovy)
        distance = standing_back(self._points - self._middle, *angles, _ASPECT, _ROOM)
        eye = self._middle - distance * directions(azimuth, elevation)[0]
        only = np.array([1, 0, 0, 0, 0, 0], np.uint8)
        groups = self._model.geom_group.copy()
        self._model.geom_group[:] = np.where(self._hiding, 0, 1)
        nearest = [
            self._mujoco.mj_ray(self._model, self._data, eye, point - eye, only, 1, -1, np.zeros(1, np.int32))
            for point in self._points
        ]
        self._model.geom_group[:] = groups
        return float(np.mean([0.0 <= part < _REACH for part in nearest]))
