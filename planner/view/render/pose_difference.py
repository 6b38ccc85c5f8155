"""How far apart two poses of a machine are: it decides what is drawn once for two panels, and how a ghost looks.

Two machines in almost the same place flicker: MuJoCo draws now this surface in front and now that one. So a ghost that
is less than a pixel from its machine is not drawn, one a few pixels away is faint and further from the camera by as
much as it differs, and the film says in words how far apart they are.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.view.render.looks import drawn, moving
from planner.view.render.sticks import Sticks

SAME_PICTURE_PIXELS = 0.5  # pixels: two pictures whose machines differ by less are drawn once
_UNSEEN, _SEEN = 1.0, 4.0  # pixels from which a ghost begins to show, and from which it shows in full
_GHOST_OFFSET = 2e-3  # of its distance from the camera: how far a ghost in the machine is drawn behind it
_BEHIND, _MOST = 1.5, 0.03  # the same, in parts of what it differs by; and at most, before the two stand apart
_CORNERS = np.stack(np.meshgrid([-1.0, 1.0], [-1.0, 1.0], [-1.0, 1.0]), axis=-1).reshape(8, 3)


class Outline:
    """Points of the machine of a model by which two of its poses are compared: corners of its shapes' boxes."""

    def __init__(self, model: Any, scenery: np.ndarray, sticks: Sticks) -> None:
        """Take the shapes that move and are seen, without the bodies (nbody,) of the scenery."""
        self._sticks = sticks
        self._geoms = np.flatnonzero(moving(model) & drawn(model) & ~scenery[model.geom_bodyid])
        self._bodies = np.flatnonzero(~scenery)[1:]
        middle, half = model.geom_aabb[self._geoms, None, :3], model.geom_aabb[self._geoms, None, 3:]
        self._local = middle + half * _CORNERS  # (G, 8, 3)

    def points(self, data: Any) -> np.ndarray:
        """(C, 3) where the points are in MuJoCo's data."""
        R = data.geom_xmat[self._geoms].reshape(-1, 3, 3)
        shapes = data.geom_xpos[self._geoms, None] + np.einsum("gij,gcj->gci", R, self._local)
        return np.concatenate([shapes.reshape(-1, 3), data.xpos[self._bodies], self._sticks.ends(data)])


def screen_difference(one: np.ndarray, other: np.ndarray) -> float:
    """The largest distance between points (C, 3) of two poses, in the model's unit of length."""
    return float(np.sqrt(np.max(np.sum((one - other) ** 2, axis=1), initial=0.0)))


def visibility(pixels: float) -> float:
    """Share 0..1 of its opacity with which a ghost is drawn that is so many pixels from its machine."""
    part = float(np.clip((pixels - _UNSEEN) / (_SEEN - _UNSEEN), 0.0, 1.0))
    return part * part * (3.0 - 2.0 * part)


def behind(difference: float, distance: float) -> float:
    """How far a ghost is drawn behind its machine, in parts of its distance from the camera.

    It is so far behind that no two surfaces that belong together meet, and hardly where they are wide apart.
    """
    part = max(difference / distance, 1e-12)
    return max(_GHOST_OFFSET, min(_BEHIND * part, _MOST**2 / (_BEHIND * part)))
