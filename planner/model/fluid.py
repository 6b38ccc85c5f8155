"""Drag of a still fluid on the bodies of a machine: MuJoCo's inertia-box model. Data only.

A body moves through the fluid as the box with its inertia does. In the frame of its inertia, every component of its
twist is opposed by itself: by viscosity in proportion, by density in proportion to its square. So drag is a sum of
wrenches of fixed direction in the link's frame,

    W = -(linear + quadratic |x|) x screw,   x = screw' V,

with V the twist of the link: (angular, linear), as all twists and wrenches of the planner.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

_LEAST = 1e-15  # MuJoCo's mjMINVAL: lighter bodies feel nothing, and no box is thinner than its root


@dataclass(frozen=True, eq=False)
class Drag:
    """One term of drag on a link."""

    link: int
    screw: np.ndarray  # (6,) direction of the wrench (moment, force) in the link's frame
    linear: float  # N per m/s or N m per rad/s
    quadratic: float  # N per (m/s)^2 or N m per (rad/s)^2


def drags_of(model: Any, links: np.ndarray, inertial: np.ndarray) -> tuple[Drag, ...]:
    """The drag of a compiled MjModel whose passive forces are on.

    Args:
        model: The MjModel.
        links: (nbody,) link that carries each body, -1 for the world.
        inertial: (nbody, 4, 4) inertial frames of the bodies in the frames of their links.
    """
    density, viscosity = max(model.opt.density, 0.0), max(model.opt.viscosity, 0.0)
    if density == viscosity == 0.0:
        return ()
    found: list[Drag] = []
    for body in np.flatnonzero((links >= 0) & (model.body_mass >= _LEAST)):
        R, centre = inertial[body, :3, :3], inertial[body, :3, 3]
        for screw, linear, quadratic in _terms(model.body_mass[body], model.body_inertia[body], density, viscosity):
            moment, force = R @ screw[:3], R @ screw[3:]
            found.append(Drag(int(links[body]), np.append(moment + np.cross(centre, force), force), linear, quadratic))
    return tuple(found)


def _terms(
    mass: float, inertia: np.ndarray, density: float, viscosity: float
) -> Iterator[tuple[np.ndarray, float, float]]:
    """Direction in the inertial frame and coefficients of the six terms of a body (mj_inertiaBoxFluidModel)."""
    box = np.sqrt(np.maximum(np.sum(inertia) - 2.0 * inertia, _LEAST) / mass * 6.0)
    diameter = np.sum(box) / 3.0
    for k in range(3):
        one, other = np.delete(box, k)
        turning = density * box[k] * (one**4 + other**4) / 64.0
        yield np.eye(6)[k], np.pi * diameter**3 * viscosity, turning
        yield np.eye(6)[3 + k], 3.0 * np.pi * diameter * viscosity, 0.5 * density * one * other


def drag_wrenches(mechanism: Any, V: np.ndarray) -> np.ndarray:
    """Wrenches (nv, 6) of drag on the links, in their frames, at their twists V (nv, 6), which may be complex."""
    W = np.zeros((mechanism.nv, 6), dtype=V.dtype)
    for drag in mechanism.drags:
        x = drag.screw @ V[drag.link]
        size = np.where(np.real(x) < 0.0, -x, x)
        W[drag.link] -= (drag.linear + drag.quadratic * size) * x * drag.screw
    return W
