"""The three-dimensional part of a picture: the machine, the ghost of the plan, force arrow, goal line, camera.

Only kinematics is computed here. The one thing that a picture adds to the model is drawn as loose shapes, which
MuJoCo forgets with the next frame.
"""

from __future__ import annotations

from types import TracebackType
from typing import Any

import numpy as np
from PIL import Image

from planner import gl
from planner.errors import RenderingUnavailable
from planner.film import Film
from planner.replay import compile_model
from planner.stage import Stage

GHOST = (0.05, 0.62, 0.48, 0.34)
FORCE = (0.89, 0.12, 0.14, 1.0)
GOAL = (0.16, 0.17, 0.20, 1.0)

# Thickness of lines and arrows, in units of the camera's distance: the same on the screen at any scale.
_LINE = 0.0016
_ARROW = 0.007
_DASHES = 24


class Scene:
    """Draws the frames of a film, without any text. A context manager: it holds an OpenGL context."""

    def __init__(self, film: Film, width: int, height: int, *, ghost: bool = True, oversize: float = 2.0) -> None:
        """Open the model and an OpenGL context.

        Args:
            film: What to draw.
            width: Pixels.
            height: Pixels.
            ghost: Draw the plan beside the machine. Without it, the camera looks at the machine alone.
            oversize: Draw so many times larger in both directions, then shrink. In software this costs no more than
                OpenGL's own multisampling, and smooths the edges of shadows too.

        Raises:
            ModelError: MuJoCo refuses the model's text.
            RenderingUnavailable: The OpenGL library is there but does not work.
        """
        mujoco = gl.load_mujoco()
        self._mujoco = mujoco
        self._film = film
        self._stage = film.stage or Stage(title="")
        self._ghost = ghost
        self._width, self._height = width, height
        model = compile_model(film.mjcf)
        # The frame buffer that the model asks for may be smaller than the picture.
        columns, rows = round(oversize * width), round(oversize * height)
        model.vis.quality.offsamples = 0
        model.vis.global_.offwidth = max(model.vis.global_.offwidth, columns)
        model.vis.global_.offheight = max(model.vis.global_.offheight, rows)
        self._model = model
        self._data, self._ghost_data = mujoco.MjData(model), mujoco.MjData(model)
        self._option, self._perturb = mujoco.MjvOption(), mujoco.MjvPerturb()
        self._camera = mujoco.MjvCamera()
        try:
            self._renderer: Any = mujoco.Renderer(model, rows, columns)
        except (mujoco.FatalError, RuntimeError, ImportError) as error:
            raise RenderingUnavailable(f"OpenGL refuses to draw: {str(error).splitlines()[0]}.") from error
        self._pixels = np.empty((rows, columns, 3), np.uint8)

    def __enter__(self) -> Scene:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._renderer.close()

    def draw(self, frame: int) -> np.ndarray:
        """Frame number `frame` of the film: (height, width, 3) uint8."""
        self._pose(self._data, self._film.qpos[frame])
        self._aim(self._film.rise[frame])
        self._renderer.update_scene(self._data, self._camera, self._option)
        scene = self._renderer.scene
        for geom in scene.geoms[: scene.ngeom]:
            if geom.type == self._mujoco.mjtGeom.mjGEOM_PLANE:
                # A floor has nothing below it to shade, and would speckle itself where the shadow map is coarse.
                _without_shadow(geom)
        if self._ghost:
            self._add_ghost(self._film.ghost_qpos[frame])
        self._add_force(self._film.force[frame], self._film.point[frame])
        if self._stage.goal_line is not None:
            self._add_dashes(*np.asarray(self._stage.goal_line, dtype=float))
        large = Image.fromarray(self._renderer.render(out=self._pixels))
        return np.asarray(large.resize((self._width, self._height), Image.Resampling.BOX))

    def project(self, point: np.ndarray) -> tuple[float, float] | None:
        """Where a point of the scene is in the last drawn picture: (column, row), or None behind the camera."""
        camera = self._renderer.scene.camera[0]
        eye, ahead, up = np.asarray(camera.pos), np.asarray(camera.forward), np.asarray(camera.up)
        x, y, depth = np.stack([np.cross(ahead, up), up, ahead]) @ (np.asarray(point, dtype=float) - eye)
        if depth <= camera.frustum_near:
            return None
        scale = self._height / 2 * camera.frustum_near / (camera.frustum_top * depth)
        return self._width / 2 + scale * x, self._height / 2 - scale * y

    def _pose(self, data: Any, qpos: np.ndarray) -> None:
        """Put a machine into a pose, as far as drawing needs it."""
        data.qpos[:] = qpos
        self._mujoco.mj_kinematics(self._model, data)
        self._mujoco.mj_comPos(self._model, data)
        self._mujoco.mj_camlight(self._model, data)
        self._mujoco.mj_tendon(self._model, data)

    def _aim(self, rise: float) -> None:
        if self._film.stage is None:
            self._mujoco.mjv_defaultFreeCamera(self._model, self._camera)
            return
        stage = self._stage
        # look_at stands for the pair; without the ghost the machine alone belongs in the middle.
        aside = 0.0 if self._ghost else 0.5 * np.asarray(stage.ghost_offset)
        self._camera.lookat[:] = np.asarray(stage.look_at) - aside + np.array([0.0, 0.0, rise])
        self._camera.distance = stage.distance
        self._camera.azimuth, self._camera.elevation = stage.azimuth, stage.elevation

    def _add_ghost(self, qpos: np.ndarray) -> None:
        mujoco, scene = self._mujoco, self._renderer.scene
        self._pose(self._ghost_data, qpos)
        first = scene.ngeom
        mujoco.mjv_addGeoms(
            self._model, self._ghost_data, self._option, self._perturb, mujoco.mjtCatBit.mjCAT_DYNAMIC, scene
        )
        for geom in scene.geoms[first : scene.ngeom]:
            geom.pos[:] += self._stage.ghost_offset
            geom.matid = -1
            geom.rgba[:] = GHOST
            geom.specular, geom.shininess, geom.reflectance, geom.emission = 0.0, 0.0, 0.0, 0.25
            _without_shadow(geom)

    def _add_force(self, force: float, point: np.ndarray) -> None:
        length = force * self._stage.force_scale
        width = _ARROW * self._camera.distance
        # Shorter than its own head an arrow is a blot.
        if not np.all(np.isfinite(point)) or length < 3 * width:
            return
        foot = point + np.asarray(self._stage.force_offset)
        arrow = self._mujoco.mjtGeom.mjGEOM_ARROW
        self._connect(arrow, width, foot, foot + np.array([0.0, 0.0, length]), FORCE)

    def _add_dashes(self, start: np.ndarray, end: np.ndarray) -> None:
        capsule = self._mujoco.mjtGeom.mjGEOM_CAPSULE
        cut = np.linspace(0.0, 1.0, 2 * _DASHES)[:, None]
        points = (1 - cut) * start + cut * end
        for a, b in zip(points[::2], points[1::2], strict=True):
            self._connect(capsule, _LINE * self._camera.distance, a, b, GOAL)

    def _connect(self, kind: Any, width: float, start: np.ndarray, end: np.ndarray, rgba: tuple[float, ...]) -> None:
        """A shape from start to end that casts no shadow."""
        mujoco, scene = self._mujoco, self._renderer.scene
        if scene.ngeom >= scene.maxgeom:
            return
        geom = scene.geoms[scene.ngeom]
        mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.zeros(9), np.array(rgba, np.float32))
        mujoco.mjv_connector(geom, kind, width, np.asarray(start, float), np.asarray(end, float))
        geom.emission = 0.4
        _without_shadow(geom)
        scene.ngeom += 1


def _without_shadow(geom: Any) -> None:
    if hasattr(geom, "castshadow"):  # since MuJoCo 4
        geom.castshadow = 0
