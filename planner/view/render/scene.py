"""The three-dimensional part of a picture: machine, ghost, marks, force arrows, goal line, camera."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from types import TracebackType
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

from planner.base import gl
from planner.problem.appearance import Appearance
from planner.view.render.camera import Window, directions, moving_points, moving_window, scenery_of, whole_motion
from planner.view.render.environment import unobstructed, visible_model
from planner.view.render.film import Film
from planner.view.render.marks import SAME_PICTURE_PIXELS, GhostDrawer, Marks, Outline, ghost_paint, screen_difference
from planner.view.render.shapes import LinkCapsules, SceneGeoms, without_shadow

FORCE = (0.89, 0.12, 0.14, 1.0)
GOAL = (0.16, 0.17, 0.20, 1.0)
_FLOOR = 2.0  # camera distances: a shape of at least this radius is a floor
# Of a film: pixels of the shadow map, slices and stacks of a ball, in a picture of more than _FEW rows and of fewer.
# MuJoCo's own 4096, 28 and 16 take as long as all the rest of the picture and look the same.
_LARGE, _SMALL, _FEW = (1024, 20, 12), (512, 14, 8), 400
_CLEAR_SHARE = 0.7  # of the height of a picture beside another is free of words


class Label(NamedTuple):
    """Words at a point of a picture."""

    at: tuple[float, float]  # column and row
    words: str
    faint: bool


class Scene:
    """Draws the frames of a film, without any text. A context manager: it holds an OpenGL context."""

    def __init__(
        self, film: Film, width: int, height: int, *, ghost: bool = True, oversize: float = 2.0,
        beside: Sequence[Film] = (), narrow: bool = False, quick: bool = False, words: bool = True,
        transparent: bool = False, model: Any = None,
    ) -> None:  # fmt: skip
        """Open the model and an OpenGL context for a picture of width x height pixels.

        The picture is drawn `oversize` times larger in both directions, then shrunk: in software this costs no more
        than OpenGL's own multisampling, and smooths the edges of shadows too. The camera must also suit the films
        `beside` this one, of the same plan. `narrow` says that the picture is a part of a larger one, `quick` that it
        is one of many, `words` that some are written on it. A `transparent` one has an alpha channel, and neither sky
        nor floor. `model` is the film's visible_model(), where there is one already; it is changed.

        Raises:
            ModelError: MuJoCo refuses the model's text.
            PlannerError: The appearance names a site, body or tendon that the model does not have.
            RenderingUnavailable: The OpenGL library is there but does not work.
        """
        mujoco = gl.load_mujoco()
        self._mujoco = mujoco
        self._width, self._height, self._oversize = width, height, oversize
        model = visible_model([film]) if model is None else model
        self._film, self._appearance, self._ghost = film, unobstructed(film, model), ghost
        model.vis.quality.offsamples = 0
        narrow = narrow or bool(beside)
        if quick:
            quality = model.vis.quality
            most = _LARGE if height > _FEW else _SMALL
            for name, value in zip(("shadowsize", "numslices", "numstacks"), most, strict=True):
                setattr(quality, name, min(getattr(quality, name), value))
        self._model = model
        self._ghost_model = _without_scenery(model, self._appearance)
        self._data, self._ghost_data = mujoco.MjData(model), mujoco.MjData(model)
        self._option, self._link_capsules = mujoco.MjvOption(), LinkCapsules(model)
        self._ghost_drawer = GhostDrawer(self._ghost_model, self._link_capsules)
        self._camera = mujoco.MjvCamera()
        # An appearance's own camera is for wide pictures, unless it goes with the machine or is one of several.
        placed = not beside or self._appearance.accompany is not None or bool(self._appearance.views)
        self._fixed = self._appearance.distance is not None and placed
        self._look_at, self._camera.distance = self._place(width / height, beside, narrow, words)
        self._camera.azimuth, self._camera.elevation = self._appearance.azimuth, self._appearance.elevation
        # A floor has nothing below it to shade, and would speckle itself where the shadow map is coarse.
        is_plane = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
        self._ground = is_plane | (model.geom_rbound > _FLOOR * self._camera.distance)
        self._marks = Marks(film, model, ghost_paint(film.appearance) if ghost else None)
        if transparent:
            _hide(model, "geom", self._ground)
        self._pixel = 2.0 * self._camera.distance * np.tan(0.5 * np.radians(model.vis.global_.fovy)) / height  # m
        self._window = self._moving_window() if quick and not transparent else Window(0, 0, width, height)
        columns, rows = round(oversize * self._window.width), round(oversize * self._window.height)
        # The frame buffer that the model asks for may be smaller than the picture.
        model.vis.global_.offwidth = max(model.vis.global_.offwidth, columns)
        model.vis.global_.offheight = max(model.vis.global_.offheight, rows)
        backgrounds = [_before_sky(model, grey) for grey in (0, 255)] if transparent else [model]
        self._renderers = [gl.renderer(background, rows, columns) for background in backgrounds]
        self._pixels = np.empty((rows, columns, 3), np.uint8)
        self._outline = Outline(model, scenery_of(model, self._appearance)[0], self._link_capsules)
        self._points = self._ghost_points = np.empty((0, 3))  # of the frame drawn last
        self._picture, self._eyes = np.empty(0), self._renderers[0].scene.camera
        self._background: np.ndarray | None = None  # the picture drawn first

    def __enter__(self) -> Scene:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for renderer in self._renderers:
            renderer.close()

    def draw(self, frame: int, like: Scene | None = None) -> np.ndarray:
        """Frame number `frame` of the film: (height, width, 3) uint8, (height, width, 4) of a transparent one.

        `like` is a scene of a film of the same plan, seen by the same camera, that has just drawn this frame. Where
        nothing in the two pictures would be as much as half a pixel apart, its picture is taken.
        """
        self._pose(self._model, self._data, self._film.qpos[frame])
        self._pose(self._ghost_model, self._ghost_data, self._film.ghost_qpos[frame])
        self._points = self._outline.points(self._data)
        self._ghost_points = self._outline.points(self._ghost_data)
        self._camera.lookat[:] = self._look_at
        if self._fixed:
            self._camera.lookat[:] += self._film.shift[frame]
        if like is not None and self._is_like(like, frame):
            self._picture, self._eyes = like._picture, like._eyes
            return self._picture
        pictures = [self._rendered(renderer, frame) for renderer in self._renderers]
        self._picture = pictures[0] if len(pictures) == 1 else matted(*pictures)
        return self._picture

    def _rendered(self, renderer: Any, frame: int) -> np.ndarray:
        """The machines as they are posed, drawn by one renderer: (height, width, 3) uint8."""
        renderer.update_scene(self._data, self._camera, self._option)
        scene = renderer.scene
        for geom in scene.geoms[: scene.ngeom]:
            if geom.objtype == self._mujoco.mjtObj.mjOBJ_GEOM and self._ground[geom.objid]:
                without_shadow(geom)
        self._link_capsules.add(self._data, scene)
        if self._ghost:
            self._ghost_drawer.add(
                scene, self._ghost_data, ghost_paint(self._appearance), np.asarray(self._appearance.ghost_offset),
                self.difference, self._pixel, self._eye(), self._camera.distance,
            )  # fmt: skip
        shapes = SceneGeoms(scene, self._eye(), self._camera.distance, self._pixel / self._oversize)
        self._marks.add(shapes, self._data, float(self._film.t[frame]))
        for point, vector in zip(*self._arrows(frame), strict=True):
            shapes.arrow(point, vector, FORCE)
        if self._appearance.goal_line is not None:
            start, end = np.asarray(self._appearance.goal_line, dtype=float)
            shapes.dashes(start, end, GOAL)
        self._eyes = scene.camera
        return self._shown(renderer)

    def _shown(self, renderer: Any) -> np.ndarray:
        """The scene that a renderer holds, around which nothing moves but in the window: (height, width, 3) uint8."""
        size, whole = (self._width, self._height), self._background
        picture = np.empty((self._height, self._width, 3), np.uint8) if whole is None else whole.copy()
        eyes = [(one, one.frustum_center, one.frustum_bottom, one.frustum_top) for one in renderer.scene.camera]
        for window in self._window.tiles(*size) if whole is None else [self._window]:
            for camera, *frustum in eyes:
                camera.frustum_center, camera.frustum_bottom, camera.frustum_top = frustum
            window.look_through(renderer.scene.camera, *size)
            large = Image.fromarray(renderer.render(out=self._pixels))
            window.paste(np.asarray(large.resize((window.width, window.height), Image.Resampling.BOX)), picture)
        if self._window != Window(0, 0, *size):
            self._background = picture
        return picture

    def _moving_window(self) -> Window:
        """The part of the picture in which anything moves in the whole film."""
        film, seen = self._film, self._appearance
        if self._fixed and np.any(np.ptp(film.shift, axis=0)):
            return Window(0, 0, self._width, self._height)
        forces = film.points + np.asarray(seen.force_offset)
        machine = moving_points(self._model, film.qpos)
        parts = [forces, forces + seen.force_scale * film.forces]
        if self._ghost:
            parts.append(moving_points(self._ghost_model, film.ghost_qpos) + np.asarray(seen.ghost_offset))
        parts += [points for points, _ in self._marks.lines] + self._marks.goals
        others = np.concatenate([np.reshape(part, (-1, 3)) for part in parts])
        if not hasattr(self._mujoco.MjvGeom, "castshadow"):  # before MuJoCo 4 ghosts and arrows cast shadows, too
            machine = np.concatenate([machine, others])
        axes = np.stack(directions(self._camera.azimuth, self._camera.elevation))
        eye = self._look_at - self._camera.distance * axes[0]
        reach = self._marks.reach + self._link_capsules.radius
        return moving_window(self._model, machine, others, reach, eye, axes, self._width, self._height)

    @property
    def difference(self) -> float:
        """Distance of the machine from its ghost in the frame drawn last, in the model's unit of length."""
        return screen_difference(self._points, self._ghost_points)

    def _eye(self) -> np.ndarray:
        """(3,) where the camera is."""
        ahead = directions(self._camera.azimuth, self._camera.elevation)[0]
        return self._camera.lookat - self._camera.distance * ahead

    def _arrows(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Feet and vectors (C, 3) of the arrows of contact forces."""
        foot = self._film.points[frame] + np.asarray(self._appearance.force_offset)
        return foot, self._appearance.force_scale * self._film.forces[frame]

    def _is_like(self, other: Scene, frame: int) -> bool:
        """Whether the other scene's picture of this frame would do for this one."""
        least = SAME_PICTURE_PIXELS * self._pixel
        feet, arrows = self._arrows(frame)
        other_feet, others = other._arrows(frame)
        return (
            (self._width, self._height) == (other._width, other._height)
            and screen_difference(self._points, other._points) < least
            and screen_difference(self._ghost_points, other._ghost_points) < least
            and screen_difference(np.asarray(self._camera.lookat)[None], np.asarray(other._camera.lookat)[None]) < least
            and (
                not self._appearance.force_scale
                or (
                    arrows.shape == others.shape  # a machine that falls touches the ground with more of its shapes
                    and screen_difference(arrows, others) < least
                    and screen_difference(np.nan_to_num(feet), np.nan_to_num(other_feet)) < least
                )
            )
            and self._marks.difference(other._marks, float(self._film.t[frame])) < least
        )

    def labels(self, frame: int) -> list[Label]:
        """The numbers of goals in the picture just drawn, frame number `frame`."""
        numbers = self._marks.labels(float(self._film.t[frame]))
        return [Label(at, words, faint) for place, words, faint in numbers if (at := self.project(place)) is not None]

    def project(self, point: np.ndarray) -> tuple[float, float] | None:
        """(column, row) of a point of the scene in the last drawn picture, None for one behind the camera."""
        camera, other = self._eyes  # two eyes; the picture is seen from their middle
        eye = 0.5 * (np.asarray(camera.pos) + np.asarray(other.pos))
        ahead, up = np.asarray(camera.forward), np.asarray(camera.up)
        x, y, depth = np.stack([np.cross(ahead, up), up, ahead]) @ (np.asarray(point, dtype=float) - eye)
        if depth <= camera.frustum_near:
            return None
        scale = self._camera.distance / (self._pixel * depth)
        return self._width / 2 + scale * x, self._height / 2 - scale * y

    def _pose(self, model: Any, data: Any, qpos: np.ndarray) -> None:
        """Put a machine into a pose, as far as drawing needs it."""
        data.qpos[:] = qpos
        self._mujoco.mj_kinematics(model, data)
        self._mujoco.mj_comPos(model, data)
        self._mujoco.mj_camlight(model, data)
        self._mujoco.mj_tendon(model, data)

    def _place(self, aspect: float, beside: Sequence[Film], narrow: bool, words: bool) -> tuple[np.ndarray, float]:
        """The point (3,) that the camera looks at, before any displacement, and its distance from there."""
        appearance = self._appearance
        if self._fixed and appearance.distance is not None:
            # look_at stands for the pair; without the ghost the machine alone belongs in the middle.
            aside = 0.0 if self._ghost else 0.5 * np.asarray(appearance.ghost_offset)
            return np.asarray(appearance.look_at) - aside, appearance.distance
        room = _CLEAR_SHARE if narrow else 1.0
        films = [self._film, *beside]
        look_at, distance = whole_motion(films, self._model, appearance, aspect, self._ghost, room, words=words)
        extent, planes = self._model.stat.extent, self._model.vis.map
        planes.zfar = max(planes.zfar, 4.0 * distance / extent)
        planes.znear = min(planes.znear, 0.05 * distance / extent)
        return look_at, distance


def best_rows(film: Film, model: Any, width: int, height: int) -> int:
    """Number of rows in which the poses of a strip are largest; 1 where the appearance places the camera."""
    if film.appearance.distance is not None:
        return 1

    def size(rows: int) -> float:
        columns, high = -(-len(film) // rows), height / rows
        return high / whole_motion([film], model, film.appearance, width / columns / high, False, words=False)[1]

    return max(range(1, 1 + min(3, len(film))), key=size)


def _without_scenery(model: Any, appearance: Appearance) -> Any:
    """The model with its scenery hidden."""
    if not appearance.scenery:
        return model
    bodies, tendons = scenery_of(model, appearance)
    bare = copy.copy(model)
    for kind in ("geom", "site"):
        _hide(bare, kind, bodies[getattr(bare, f"{kind}_bodyid")])
    bare.tendon_matid[tendons], bare.tendon_rgba[tendons] = -1, 0.0
    return bare


def _hide(model: Any, kind: str, hidden: np.ndarray) -> None:
    """Make the geoms or sites with this mask invisible."""
    getattr(model, f"{kind}_matid")[hidden] = -1  # or its colour would be the material's
    getattr(model, f"{kind}_rgba")[hidden] = 0.0


def _before_sky(model: Any, grey: int) -> Any:
    """The model under a sky of one brightness, 0 to 255."""
    skies = np.flatnonzero(model.tex_type == gl.load_mujoco().mjtTexture.mjTEXTURE_SKYBOX)
    changed = copy.copy(model)
    for i in skies:
        size = model.tex_width[i] * model.tex_height[i] * model.tex_nchannel[i]
        changed.tex_data[model.tex_adr[i] : model.tex_adr[i] + size] = grey
    return changed


def matted(on_black: np.ndarray, on_white: np.ndarray) -> np.ndarray:
    """Colour and opacity (H, W, 4) uint8 of what was drawn (H, W, 3) on black and on white.

    On a background of brightness b a pixel of opacity a and colour c is a c + (1 - a) b, so the two differ by 1 - a.
    """
    black = on_black.astype(float)
    alpha = 255.0 - np.clip((on_white - black).mean(axis=-1, keepdims=True), 0.0, 255.0)
    colour = np.clip(255.0 * black / np.maximum(alpha, 1.0), 0.0, 255.0)
    return np.concatenate([colour, alpha], axis=-1).round().astype(np.uint8)
