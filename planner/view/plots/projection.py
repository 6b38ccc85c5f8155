"""Parallel projection of points in space onto a picture."""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.base.arguments import array
from planner.dynamics.kinematics import frame_pose
from planner.model.mechanism import Frame, Mechanism
from planner.problem.appearance import View
from planner.view.render.camera import directions

# Views of a machine that walks along x, with y to its left.
SIDE, FRONT, TOP = View(90.0, 0.0, label="side"), View(180.0, 0.0, label="front"), View(90.0, -90.0, label="top")


def projected(points: np.ndarray, view: View) -> np.ndarray:
    """Points (..., 3) as seen from a view: to the right and up, (..., 2)."""
    return np.asarray(points) @ np.stack(axes_of(view)).T


def axes_of(view: View) -> tuple[np.ndarray, np.ndarray]:
    """The directions (3,) of space that are right and up in a view."""
    return directions(view.azimuth, view.elevation)[1:]


def frame_points(mechanism: Mechanism, q: Any, frames: tuple[str | Frame, ...]) -> np.ndarray:
    """Positions (K, P, 3), m, of P frames, sites or bodies, at joint positions (K, nq) or states (K, nx)."""
    q = array("q", np.asarray(q)[..., : mechanism.nq], ("K", mechanism.nq))
    return np.stack([frame_pose(mechanism, q, frame)[:, :3, 3] for frame in frames], axis=1)
