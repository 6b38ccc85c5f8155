"""Shapes that MuJoCo's model does not have: lines, dashes, balls, axes, arrows, and capsules for links without a shape.

MuJoCo forgets them with each frame. Of the shapes that it has, one is shown for each part: a link is often given twice,
by a mesh to be seen and by simpler shapes that collide, and then only the first is drawn.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from planner.base import gl
from planner.base.gl import load_mujoco

Paint = tuple[float, float, float, float]

# Thickness in units of the camera's distance: the same on the screen at any scale.
_DASH = 0.0016
_TRAIL = 0.002  # half of the width of a trail
_ARROW = 0.007
_SLIM = 0.045  # largest radius of an arrow's shaft, in parts of its length: a thicker one would be all head
_MIN_ARROW = 0.015  # length of the shortest arrow that can be seen
_DASHES = 24
_MIN_BALL = 7.0  # pixels of the picture before it is shrunk: radius of the smallest ball
_CORNERS = np.stack(np.meshgrid([-1.0, 1.0], [-1.0, 1.0], [-1.0, 1.0]), axis=-1).reshape(8, 3)
_AXES = ((0.83, 0.16, 0.15), (0.16, 0.58, 0.22), (0.13, 0.36, 0.82))  # x, y and z


class Rod(NamedTuple):
    """Sizes of an axis of a frame."""

    length: float
    radius: float

    def of(self, size: float) -> Rod:
        """In parts of a size."""
        return Rod(size * self.length, size * self.radius)


class SceneGeoms:
    """Adds shapes to a scene that MuJoCo has just filled."""

    def __init__(self, scene: Any, eye: np.ndarray, distance: float, pixel: float) -> None:
        """Add to MuJoCo's `scene`, seen from `eye` (3,) at `distance`, where a pixel has such a size."""
        self._mujoco, self._scene, self._distance = load_mujoco(), scene, distance
        self._eye, self._least_ball, self._line = (
            eye,
            _MIN_BALL * pixel,
            2.0 * _TRAIL * distance / pixel,
        )  # the width of a trail, in pixels

    def trail(self, points: np.ndarray, paint: Paint, part: float = 1.0, behind: float = 0.0) -> None:
        """A line through points (P, 3), its thickness a part of a trail's; `behind` moves it away from the camera.

        MuJoCo draws a line in a hundredth of the time that a capsule takes.
        """
        kind, away = self._mujoco.mjtGeom.mjGEOM_LINE, points + behind * (points - self._eye)
        for a, b in pairwise(away):
            self._connect(kind, max(1.0, part * self._line), a, b, paint)

    def dashes(self, start: np.ndarray, end: np.ndarray, paint: Paint) -> None:
        """A dashed line between two points (3,)."""
        cut = np.linspace(0.0, 1.0, 2 * _DASHES)[:, None]
        points = (1 - cut) * start + cut * end
        for a, b in zip(points[::2], points[1::2], strict=True):
            self._connect(self._mujoco.mjtGeom.mjGEOM_CAPSULE, _DASH * self._distance, a, b, paint)

    def ball(self, centre: np.ndarray, radius: float, paint: Paint) -> None:
        """A ball at a point (3,), large enough to be seen."""
        self._connect(self._mujoco.mjtGeom.mjGEOM_SPHERE, max(radius, self._least_ball), centre, centre, paint)

    def axes(self, origin: np.ndarray, R: np.ndarray, rod: Rod, opacity: float = 1.0) -> None:
        """The axes of a frame at a point (3,), the columns of R (3, 3): red, green and blue."""
        for axis, paint in zip(R.T, _AXES, strict=True):
            end = origin + rod.length * axis
            self._connect(self._mujoco.mjtGeom.mjGEOM_CAPSULE, rod.radius, origin, end, (*paint, opacity))

    def arrow(self, foot: np.ndarray, vector: np.ndarray, paint: Paint) -> None:
        """An arrow from a point (3,) along a vector (3,); none where one of them is unknown or the arrow too short."""
        length = float(np.linalg.norm(vector))
        if not np.isfinite(foot).all() or not length > _MIN_ARROW * self._distance:
            return
        width = min(_ARROW * self._distance, _SLIM * length)
        # MuJoCo draws an arrow half as long as it is asked to.
        self._connect(self._mujoco.mjtGeom.mjGEOM_ARROW, width, foot, foot + 2.0 * vector, paint)

    def _connect(self, kind: Any, width: float, start: np.ndarray, end: np.ndarray, paint: Paint) -> None:
        """A shape from start to end, or a ball at start, that casts no shadow."""
        mujoco, scene = self._mujoco, self._scene
        if scene.ngeom >= scene.maxgeom:
            return
        geom = scene.geoms[scene.ngeom]
        size, rgba = np.full(3, width), np.array(paint, np.float32)
        mujoco.mjv_initGeom(geom, kind, size, np.asarray(start, float), np.eye(3).ravel(), rgba)
        if kind != mujoco.mjtGeom.mjGEOM_SPHERE:
            mujoco.mjv_connector(geom, kind, width, np.asarray(start, float), np.asarray(end, float))
        geom.emission = 0.4
        without_shadow(geom)
        scene.ngeom += 1


def without_shadow(geom: Any) -> None:
    """Let a shape of a scene cast no shadow."""
    if hasattr(geom, "castshadow"):  # since MuJoCo 4
        geom.castshadow = 0


_LINK_PAINT = (0.58, 0.63, 0.70, 1.0)
_LINK_RADIUS = 0.018  # of the machine's size
_MIN_LINK_MASS = 1e-4  # of the machine's mass: a link that is lighter is a frame between two joints


class LinkCapsule(NamedTuple):
    """A capsule, or a ball where both ends are the same, in the frame of a body."""

    body: int
    start: np.ndarray  # (3,)
    end: np.ndarray  # (3,)


class LinkCapsules:
    """The links of a model without any shape that is drawn.

    Attributes:
        capsules: One or more for each link.
        radius: Of all of them, m.
        paint: Their colour.
    """

    paint = _LINK_PAINT

    def __init__(self, model: Any) -> None:
        """Find them where the file puts the joints."""
        mujoco = load_mujoco()
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        self._model = model
        self.capsules = tuple(_link_capsules(model, data))
        spread = float(np.ptp(data.xanchor, axis=0).max()) if model.njnt else 0.0
        if self.capsules and not spread + _longest(self.capsules) > 0.0:
            self.capsules = tuple(_inertia_rod(model, data, stick.body) for stick in self.capsules)
        self.radius = _LINK_RADIUS * (spread + _longest(self.capsules))

    def ends(self, data: Any) -> np.ndarray:
        """(2 S, 3) the ends of the sticks where MuJoCo's data puts the bodies."""
        return np.array([
            data.xpos[stick.body] + data.xmat[stick.body].reshape(3, 3) @ end
            for stick in self.capsules for end in (stick.start, stick.end)
        ]).reshape(-1, 3)  # fmt: skip

    def add(self, data: Any, scene: Any, paint: Paint = _LINK_PAINT) -> None:
        """Add the sticks to MuJoCo's scene where its data puts the bodies."""
        mujoco = load_mujoco()
        pairs = self.ends(data).reshape(-1, 2, 3)
        for ends in pairs[: max(0, scene.maxgeom - scene.ngeom)]:
            geom = scene.geoms[scene.ngeom]
            rgba, size = np.array(paint, np.float32), np.full(3, self.radius)
            mujoco.mjv_initGeom(geom, mujoco.mjtGeom.mjGEOM_SPHERE, size, ends[0], np.eye(3).ravel(), rgba)
            if np.linalg.norm(ends[1] - ends[0]) > 1e-9:
                mujoco.mjv_connector(geom, mujoco.mjtGeom.mjGEOM_CAPSULE, self.radius, *ends)
            geom.category = mujoco.mjtCatBit.mjCAT_DYNAMIC
            scene.ngeom += 1


def _link_capsules(model: Any, data: Any) -> list[LinkCapsule]:
    """From each joint of a link without shapes to the joints that it carries, or to its centre of mass."""
    links = model.body_weldid
    shaped = set(map(int, links[model.geom_bodyid]))
    carried: dict[int, list[int]] = {}
    for body in range(1, model.nbody):
        if links[body] == body:
            carried.setdefault(int(links[model.body_parentid[body]]), []).append(body)
    found: list[LinkCapsule] = []
    for link in sorted(set(map(int, links)) - shaped - {0}):
        mass = model.body_mass[links == link]
        if mass.sum() <= _MIN_LINK_MASS * model.body_mass.sum():
            continue
        R, p = data.xmat[link].reshape(3, 3), data.xpos[link]
        start = R.T @ (_joint_of(model, data, link) - p)
        ends = [R.T @ (_joint_of(model, data, child) - p) for child in carried.get(link, [])]
        far = [end for end in ends if np.linalg.norm(end - start) > 1e-6]
        if not far:
            centre = mass @ data.xipos[links == link] / mass.sum()
            far = [2.0 * R.T @ (centre - p) - start]  # as long as a rod with this centre
        found += [LinkCapsule(link, start, end) for end in far]
    return found


def _longest(capsules: Iterable[LinkCapsule]) -> float:
    return max((float(np.linalg.norm(stick.end - stick.start)) for stick in capsules), default=0.0)


def _inertia_rod(model: Any, data: Any, link: int) -> LinkCapsule:
    """A rod about a link's heaviest body, of its mass and largest moment of inertia, across the link's first joint."""
    body = int(np.argmax(np.where(model.body_weldid == link, model.body_mass, -1.0)))
    principal = data.ximat[body].reshape(3, 3)
    axis = data.xaxis[model.body_jntadr[link]] if model.body_jntnum[link] else np.zeros(3)
    across = principal[:, int(np.argmin(np.abs(axis @ principal)))]
    half = 0.5 * np.sqrt(12.0 * model.body_inertia[body].max() / model.body_mass[body]) * across
    R = data.xmat[body].reshape(3, 3)
    start, end = (R.T @ (data.xipos[body] + way * half - data.xpos[body]) for way in (-1.0, 1.0))
    return LinkCapsule(body, start, end)


def _joint_of(model: Any, data: Any, body: int) -> np.ndarray:
    """Where the first joint of a body is, (3,)."""
    if not model.body_jntnum[body]:
        return data.xpos[body]
    return data.xanchor[model.body_jntadr[body]]


SHOWN_GROUPS = 3  # geom groups that MuJoCo draws unless told otherwise
FAINT = 0.1  # opacity below which a shape is not seen
_COVERS = 0.6  # of the colliding shapes' size: smaller visual shapes are an ornament, eyes for example
_UNPAINTED = (0.5, 0.5, 0.5, 1.0)  # MuJoCo's default
_PAINTS = ((0.80, 0.82, 0.85, 1.0), (0.36, 0.47, 0.62, 1.0))  # of links in turn, along the tree


def moving(model: Any) -> np.ndarray:
    """Mask (ngeom,) of the geoms that move."""
    return model.body_weldid[model.geom_bodyid] != 0


def drawn(model: Any) -> np.ndarray:
    """Mask (ngeom,) of the geoms that MuJoCo draws and that can be seen."""
    return (_opacity(model) > FAINT) & (model.geom_group < SHOWN_GROUPS)


def _opacity(model: Any) -> np.ndarray:
    materials = model.geom_matid
    own = model.geom_rgba[:, 3]
    if not model.nmat:
        return own
    return np.where((materials >= 0) & np.all(model.geom_rgba == _UNPAINTED, axis=1), model.mat_rgba[materials, 3], own)


def show_one_shape_for_each_part(model: Any) -> None:
    """Hide the colliding shapes of links that have others to be seen; show the hidden ones of a link without others.

    Groups say which are which by convention alone, so what collides decides: shapes of a link that do not collide, and
    that are about as large as those that do, are there to be seen, unless the file puts both into one group above 0.
    Where the colliding ones have a group of their own, no link that has anything else shows a shape of that group; nor
    is any shown that one can see through.
    """
    mujoco = gl.load_mujoco()
    parts = _parts(model)
    solid = (_opacity(model) > FAINT) & (parts >= 0)
    shown = solid & drawn(model)
    for part in set(map(int, parts[solid & moving(model)])) - set(map(int, parts[shown])):
        shown |= solid & (parts == part)
    collides = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    low, high = geom_boxes(model, data, np.arange(model.ngeom))
    hidden = np.zeros(model.ngeom, bool)
    for part in set(map(int, parts[shown])):
        seen, solids = (np.flatnonzero(shown & (parts == part) & (collides == on)) for on in (False, True))
        if len(seen) and len(solids):
            size = [np.linalg.norm(high[few].max(axis=0) - low[few].min(axis=0)) for few in (seen, solids)]
            groups = model.geom_group[solids]  # one that the file gives to both kinds is to be seen
            hidden[solids] = (size[0] >= _COVERS * size[1]) & ~((groups > 0) & np.isin(groups, model.geom_group[seen]))
    proxies = set(model.geom_group[hidden]) - set(model.geom_group[shown & ~collides])
    for part in set(map(int, parts[shown & ~collides])):
        hidden |= shown & collides & (parts == part) & np.isin(model.geom_group, list(proxies))
    if np.any(hidden):  # a ball that one sees through, around what it guards
        hidden |= shown & collides & (_opacity(model) < 1.0)
    model.geom_group[shown] = 0
    gone = (parts >= 0) & (hidden | ~shown)
    model.geom_matid[gone], model.geom_rgba[gone, 3] = -1, 0.0


def _parts(model: Any) -> np.ndarray:
    """(ngeom,) the part of the machine that a geom belongs to: a link, or a body at rest; -1 for the world's own."""
    still = np.where(model.geom_bodyid == 0, -1, model.geom_bodyid)
    return np.where(moving(model), model.body_weldid[model.geom_bodyid], still)


def geom_boxes(model: Any, data: Any, geoms: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corners (G, 3), along the world's axes, of the boxes of some geoms where they are now."""
    R = data.geom_xmat[geoms].reshape(-1, 3, 3)
    centre = data.geom_xpos[geoms] + np.einsum("gij,gj->gi", R, model.geom_aabb[geoms, :3])
    half = np.einsum("gij,gj->gi", np.abs(R), model.geom_aabb[geoms, 3:])
    return centre - half, centre + half


class BoxCorners:
    """Corners of the boxes around some geoms of a model, wherever these are."""

    def __init__(self, model: Any, geoms: np.ndarray) -> None:
        self._geoms = geoms
        self._local = model.geom_aabb[geoms, None, :3] + model.geom_aabb[geoms, None, 3:] * _CORNERS  # (G, 8, 3)

    def at(self, data: Any) -> np.ndarray:
        """(8 G, 3) where MuJoCo's data puts them."""
        R = data.geom_xmat[self._geoms].reshape(-1, 3, 3)
        return (data.geom_xpos[self._geoms, None] + np.einsum("gij,gcj->gci", R, self._local)).reshape(-1, 3)


def paint_links(model: Any) -> None:
    """Give links two colours in turn where no moving shape has a colour of its own."""
    shapes = np.flatnonzero(moving(model))
    if not np.all(unpainted(model)[shapes]):
        return
    for geom in shapes:
        model.geom_rgba[geom] = _PAINTS[_depth(model, int(model.geom_bodyid[geom])) % 2]


def unpainted(model: Any) -> np.ndarray:
    """Mask (ngeom,) of the shapes without a material or a colour of their own."""
    return (model.geom_matid < 0) & np.all(model.geom_rgba == _UNPAINTED, axis=1)


def _depth(model: Any, body: int) -> int:
    """The number of moving links between a body and the world."""
    depth, link = 0, int(model.body_weldid[body])
    while link:
        depth, link = depth + 1, int(model.body_weldid[model.body_parentid[link]])
    return depth
