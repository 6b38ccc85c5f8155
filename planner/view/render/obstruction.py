"""Turn a default camera until what is at rest does not hide the motion: a wall, a shelf, the far side of a cabinet."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from planner.base.gl import load_mujoco
from planner.problem.appearance import Appearance
from planner.view.render.camera import directions, scenery_of, standing_back, swept_points
from planner.view.render.film import Film
from planner.view.render.shapes import drawn, moving

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
