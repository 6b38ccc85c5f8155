"""Shapes that belong to no model: lines, dashes, balls, axes, arrows. MuJoCo forgets them with each frame."""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

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
