"""Convert geoms of an MJCF to the shapes of contacts: planes, spheres that meet them, and capsules.

A capsule meets a plane with the spheres at its ends, a box with its corners, which are points; MuJoCo does the same (of
a box's corners it takes the lowest four at most). Other shapes get points of their own: see model.mjcf.contact_points.
"""

from __future__ import annotations

import itertools
import math
from typing import Any, NamedTuple

import numpy as np

from planner.base.gl import load_mujoco
from planner.model.contact.body_contact import Capsule
from planner.model.contact.laws import ALONG, Plane
from planner.model.mjcf.model_index import ModelIndex


def plane_of(survey: ModelIndex, geom: int) -> Plane | None:
    """The plane that spheres touch on a geom: a plane itself, or the uppermost face of a box, continued without end.

    None where it is neither, and where it moves, but on a slide along itself (a treadmill's belt).
    """
    mujoco, model, home = load_mujoco(), survey.model, survey.home
    axes, at = home.geom_xmat[geom].reshape(3, 3).T, home.geom_xpos[geom]
    if model.geom_type[geom] == int(mujoco.mjtGeom.mjGEOM_PLANE):
        normal = axes[2]
    elif model.geom_type[geom] == int(mujoco.mjtGeom.mjGEOM_BOX):
        up = -axes @ model.opt.gravity if np.any(model.opt.gravity) else axes[:, 2]
        axis = int(np.argmax(np.abs(up)))
        normal = math.copysign(1.0, up[axis]) * axes[axis]
        at = at + model.geom_size[geom][axis] * normal
    else:
        return None
    body, slide = int(model.body_weldid[model.geom_bodyid[geom]]), -1
    if body > 0:
        joint, slide = int(model.body_jntadr[body]), int(model.body_dofadr[body])
        only = model.body_dofnum[body] == 1 and model.body_weldid[model.body_parentid[body]] == 0
        slides = model.jnt_type[joint] == int(mujoco.mjtJoint.mjJNT_SLIDE)
        if not (only and slides and abs(home.xaxis[joint] @ normal) < ALONG):
            return None
    return Plane(normal, float(normal @ at), slide=slide)


class Sphere(NamedTuple):
    """A part of a geom that touches a plane as a sphere."""

    geom: int
    centre: np.ndarray  # (3,) in the geom's frame
    radius: float


def spheres_of(model: Any, geom: int) -> list[Sphere]:
    """The spheres that stand for a moving geom where it meets a plane."""
    kinds = load_mujoco().mjtGeom
    kind, size = model.geom_type[geom], model.geom_size[geom]
    if model.body_weldid[model.geom_bodyid[geom]] == 0:
        return []
    if kind == int(kinds.mjGEOM_SPHERE):
        return [Sphere(geom, np.zeros(3), float(size[0]))]
    if kind == int(kinds.mjGEOM_CAPSULE):
        return [Sphere(geom, np.array([0.0, 0.0, side * size[1]]), float(size[0])) for side in (-1.0, 1.0)]
    if kind == int(kinds.mjGEOM_BOX):
        return [Sphere(geom, size * np.array(corner), 0.0) for corner in itertools.product((-1.0, 1.0), repeat=3)]
    return []


def part_name(of: str, spheres: list[Sphere], k: int) -> str:
    """Name of the k-th of the spheres of a geom."""
    return {1: of, 2: f"{of} end {k + 1}"}.get(len(spheres), f"{of} corner {k + 1}")


def plane_and_spheres(survey: ModelIndex, geoms: tuple[int, int]) -> tuple[Plane, list[Sphere]] | None:
    """The plane of two geoms and the spheres of the other that meet it; None for other shapes."""
    for flat, other in (geoms, geoms[::-1]):
        plane, spheres = plane_of(survey, flat), spheres_of(survey.model, other)
        if plane is not None and spheres:
            return plane, spheres
    return None


def meets_plane(survey: ModelIndex, geoms: tuple[int, int]) -> tuple[int, int] | None:
    """A pair's geom that is a plane at rest, or the top of such a box, and the one that moves; None for others."""
    model = survey.model
    for flat, other in (geoms, geoms[::-1]):
        touches = spheres_of(model, other) or has_points(model, other)
        if touches and model.body_weldid[model.geom_bodyid[other]] and plane_of(survey, flat) is not None:
            return flat, other
    return None


def has_points(model: Any, geom: int) -> bool:
    """Whether a shape is replaced by points where it meets a plane."""
    kinds = load_mujoco().mjtGeom
    return model.geom_type[geom] in [int(kinds.mjGEOM_CYLINDER), int(kinds.mjGEOM_MESH), int(kinds.mjGEOM_ELLIPSOID)]


def capsule_of(survey: ModelIndex, geom: int) -> Capsule:
    """Convert a sphere or capsule to a part of a contact of two bodies."""
    model, T = survey.model, survey.geoms[geom]
    long = model.geom_type[geom] == int(load_mujoco().mjtGeom.mjGEOM_CAPSULE)
    radius, half = float(model.geom_size[geom][0]), float(model.geom_size[geom][1]) if long else 0.0
    return Capsule(int(survey.carriers[0][model.geom_bodyid[geom]]), T[:3, 3], half * T[:3, 2], radius)


def are_capsules(model: Any, geoms: tuple[int, int]) -> bool:
    """Whether both geoms are spheres or capsules, of two bodies that are not fixed to each other."""
    kinds = load_mujoco().mjtGeom
    round_ = [int(kinds.mjGEOM_SPHERE), int(kinds.mjGEOM_CAPSULE)]
    first, second = model.body_weldid[model.geom_bodyid[list(geoms)]]
    return bool(first != second and np.isin(model.geom_type[list(geoms)], round_).all())
