"""The ghost of the plan: its colour, and how it is drawn by its distance from the machine.

Two machines in almost the same place flicker, because MuJoCo draws now this surface in front and now that one. So a
ghost less than a pixel from its machine is not drawn; one a few pixels away is faint and moved away from the camera.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.base.gl import load_mujoco
from planner.problem.appearance import Appearance
from planner.view.render.shapes import LinkCapsules, Paint, drawn, moving, without_shadow

GHOST = (0.05, 0.62, 0.48)
_ASIDE = 0.34  # opacity of a ghost beside the machine
_IN_PLACE = 0.16  # opacity of a ghost in the machine, which must be seen through it
SAME_PICTURE_PIXELS = 0.5  # two pictures whose machines differ by less are drawn once
_FADE = (1.0, 4.0)  # pixels of difference at which a ghost is invisible, and fully visible
_MIN_OFFSET = 2e-3  # of its distance from the camera, by which a ghost is at least moved away from it
_OFFSET_RATIO, _MAX_OFFSET = 1.5, 0.03  # the same over the difference, and its maximum
_CORNERS = np.stack(np.meshgrid([-1.0, 1.0], [-1.0, 1.0], [-1.0, 1.0]), axis=-1).reshape(8, 3)


class Outline:
    """Points of the machine of a model by which two of its poses are compared: corners of its shapes' boxes."""

    def __init__(self, model: Any, scenery: np.ndarray, sticks: LinkCapsules) -> None:
        """Take the shapes that move and are seen, without the bodies (nbody,) of the scenery."""
        self._link_capsules = sticks
        self._geoms = np.flatnonzero(moving(model) & drawn(model) & ~scenery[model.geom_bodyid])
        self._bodies = np.flatnonzero(~scenery)[1:]
        middle, half = model.geom_aabb[self._geoms, None, :3], model.geom_aabb[self._geoms, None, 3:]
        self._local = middle + half * _CORNERS  # (G, 8, 3)

    def points(self, data: Any) -> np.ndarray:
        """(C, 3) where the points are in MuJoCo's data."""
        R = data.geom_xmat[self._geoms].reshape(-1, 3, 3)
        shapes = data.geom_xpos[self._geoms, None] + np.einsum("gij,gcj->gci", R, self._local)
        return np.concatenate([shapes.reshape(-1, 3), data.xpos[self._bodies], self._link_capsules.ends(data)])


def screen_difference(one: np.ndarray, other: np.ndarray) -> float:
    """The largest distance between points (C, 3) of two poses, in the model's unit of length."""
    return float(np.sqrt(np.max(np.sum((one - other) ** 2, axis=1), initial=0.0)))


def visibility(pixels: float) -> float:
    """Share 0..1 of its opacity with which a ghost is drawn that is so many pixels from its machine."""
    part = float(np.clip((pixels - _FADE[0]) / (_FADE[1] - _FADE[0]), 0.0, 1.0))
    return part * part * (3.0 - 2.0 * part)


def depth_offset(difference: float, distance: float) -> float:
    """By how much a ghost is moved away from the camera, as a share of its distance from the camera.

    Corresponding surfaces then do not intersect; where they differ a lot, hardly any offset is needed.
    """
    part = _OFFSET_RATIO * max(difference / distance, 1e-12)
    return max(_MIN_OFFSET, min(part, _MAX_OFFSET**2 / part))


def ghost_paint(appearance: Appearance) -> Paint:
    """Colour and opacity of the ghost."""
    opacity = _ASIDE if any(appearance.ghost_offset) else _IN_PLACE
    if appearance.ghost is None:
        return (*GHOST, opacity)
    return (*appearance.ghost.colour, opacity if appearance.ghost.opacity is None else appearance.ghost.opacity)


class GhostDrawer:
    """Adds copies of a model in other poses to MuJoCo's scenes, each in one colour and without shadows."""

    def __init__(self, model: Any, link_capsules: LinkCapsules) -> None:
        """Take the model whose moving shapes are drawn, and the capsules of its links without a shape."""
        mujoco = load_mujoco()
        self._model, self._link_capsules = model, link_capsules
        self._option, self._perturb = mujoco.MjvOption(), mujoco.MjvPerturb()

    def add(
        self, scene: Any, data: Any, paint: Paint, offset: np.ndarray, difference: float, pixel: float,
        eye: np.ndarray, distance: float,
    ) -> None:  # fmt: skip
        """Add the pose of MuJoCo's `data`, displaced by `offset` (3,), m.

        Without an offset it is the fainter the smaller its `difference` from the machine, m; `pixel` is the size of a
        pixel in space, m, `eye` (3,) the camera's position and `distance` that from the camera to the machine, m.
        """
        mujoco, first, back = load_mujoco(), scene.ngeom, 0.0
        if not np.any(offset):
            back, paint = depth_offset(difference, distance), (*paint[:3], paint[3] * visibility(difference / pixel))
        if paint[3] == 0.0:
            return
        kind = mujoco.mjtCatBit.mjCAT_DYNAMIC
        mujoco.mjv_addGeoms(self._model, data, self._option, self._perturb, kind, scene)
        self._link_capsules.add(data, scene)
        for geom in scene.geoms[first : scene.ngeom]:
            geom.pos[:] += offset + back * (geom.pos - eye)
            geom.matid, geom.rgba[:] = -1, paint if geom.rgba[3] > 0.0 else 0.0  # MuJoCo adds invisible tendons too
            geom.specular, geom.shininess, geom.reflectance, geom.emission = 0.0, 0.0, 0.0, 0.25
            without_shadow(geom)
