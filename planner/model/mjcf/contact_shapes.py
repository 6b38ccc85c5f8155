"""Convert geoms of an MJCF to the shapes of contacts: planes, spheres and points that meet them, and capsules.

A capsule meets a plane with the spheres at its ends, a box with its corners, which are points; MuJoCo does the same (of
a box's corners it takes the lowest four at most). Of cylinders, meshes and ellipsoids MuJoCo finds up to four points,
which jump from edge to edge while the geom rolls. A plan wants points that stay on the body, so its text gets spheres
of POINT_RADIUS there, which touch planes and nothing else. MuJoCo replays the plan's text with the same spheres, and
"your file" judges the true shape. A cylinder has RIM of them at each rim, a mesh and an ellipsoid up to MAX_POINTS that
nearly span the hull. A wheel, a round shape that a hinge turns about its own axis, rolls on two spheres of its radius
in the planes of its rims: on a level axis they touch where it does.
"""

from __future__ import annotations

import itertools
import math
import re
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np

from planner.base.gl import load_mujoco
from planner.model.contact.body_contact import Capsule
from planner.model.contact.bounding_fit import sphere
from planner.model.contact.laws import ALONG, Plane
from planner.model.mjcf.model_index import ModelIndex, mesh_vertices, pose
from planner.model.mjcf.text import written


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


RADIUS = 1e-4  # m: the excess of a point over its shape
RIM = 8  # points of a circle: their octagon is 7.6 % of the radius inside it midway between two
MAX_POINTS = 12  # points of a mesh or an ellipsoid
CLOSE = 1e-3  # of a shape's size: what is missing of it then does not matter
ROUND = 0.02  # of a wheel's radius: how far its tread may be from a circle
_DIRECTIONS, _TURNS = 400, 72
_NAME = re.compile(r"(.*) \(point \d+\)")


class Wheel(NamedTuple):
    """A round shape that a hinge turns about its own axis."""

    axis: np.ndarray  # (3,) unit vector in the geom's frame
    centre: np.ndarray  # (3,) m, on the axis, midway between the rims
    radius: float  # m
    half_width: float  # m, from the centre to each rim


def wheel_of(model: Any, geom: int) -> Wheel | None:
    """A shape as a wheel; None where no hinge of its body turns it about an axis around which it is round."""
    mujoco, body = load_mujoco(), int(model.geom_bodyid[geom])
    joint = int(model.body_jntadr[body])
    if model.body_jntnum[body] != 1 or model.jnt_type[joint] != int(mujoco.mjtJoint.mjJNT_HINGE):
        return None
    T = pose(model.geom_pos[geom], model.geom_quat[geom])
    axis, centre = T[:3, :3].T @ model.jnt_axis[joint], T[:3, :3].T @ (model.jnt_pos[joint] - T[:3, 3])
    turns = 2.0 * np.pi * np.arange(_TURNS) / _TURNS
    across = np.linalg.svd(axis[None])[2][1:]  # (2, 3), perpendicular to the axis
    directions = np.stack([np.cos(turns), np.sin(turns)], axis=1) @ across
    if model.geom_type[geom] == int(mujoco.mjtGeom.mjGEOM_CYLINDER):
        radius, half = model.geom_size[geom][:2]
        reach = radius * np.hypot(directions[:, 0], directions[:, 1]) + half * np.abs(directions[:, 2])
        reach, rims = reach - directions @ centre, np.array([-half, half])
    else:
        surface = _surface(model, geom) - centre
        reach, away = (surface @ directions.T).max(axis=0), np.linalg.norm(surface @ across.T, axis=1)
        rims = (surface @ axis)[away >= (1.0 - ROUND) * away.max()] + centre @ axis
    if np.ptp(reach) > ROUND * reach.max():
        return None
    middle = centre + axis * (0.5 * (rims.min() + rims.max()) - centre @ axis)
    return Wheel(axis, middle, float(reach.max()), float(0.5 * np.ptp(rims)))


def point_radius(model: Any, geom: int) -> float:
    """Radius of the spheres around a shape's points, m; 0 of those that are points."""
    if spheres := spheres_of(model, geom):
        return spheres[0].radius
    wheel = wheel_of(model, geom)
    return 0.0 if wheel is None else wheel.radius


def points_of(model: Any, geom: int) -> np.ndarray:
    """(P, 3) points of a shape in the geom's frame; of a sphere and a capsule, and of a wheel, the centres."""
    kinds, size = load_mujoco().mjtGeom, model.geom_size[geom]
    if spheres := spheres_of(model, geom):
        return np.array([sphere.centre for sphere in spheres])
    if (wheel := wheel_of(model, geom)) is not None:
        return wheel.centre + np.outer([-wheel.half_width, wheel.half_width], wheel.axis)
    if model.geom_type[geom] == int(kinds.mjGEOM_CYLINDER):
        angles = 2.0 * np.pi * np.arange(RIM) / RIM
        rim = np.stack([size[0] * np.cos(angles), size[0] * np.sin(angles), np.full(RIM, size[1])], axis=1)
        return np.concatenate([rim, rim * (1.0, 1.0, -1.0)])
    return _spanning(_surface(model, geom))


def add_points(
    element: ElementTree.Element, body: ElementTree.Element, model: Any, geom: int, margin: float = 0.0, before: int = 0
) -> list[str]:
    """Add the spheres of a geom, larger by a margin, to the body that has its element; returns their names.

    `before` tells how many sets of points there are: one shape may have several, of several margins.
    """
    names, T = [], pose(model.geom_pos[geom], model.geom_quat[geom])
    radius = margin + max(RADIUS, point_radius(model, geom))
    for k, point in enumerate(points_of(model, geom)):
        names.append(f"{element.attrib['name']} (point {100 * before + k + 1})")
        ElementTree.SubElement(body, "geom", {
            "name": names[-1], "type": "sphere", "size": written(radius), "pos": written(*(T @ [*point, 1.0])[:3]),
            "mass": "0", "contype": "0", "conaffinity": "0", "rgba": "0 0 0 0", "group": "5",
        })  # fmt: skip
    return names


def shape_of(name: str) -> str:
    """The name of the shape that a point stands for; any other name as it is."""
    match = _NAME.fullmatch(name)
    return match[1] if match else name


def sphere_of_directions() -> np.ndarray:
    """(D, 3) unit vectors spread evenly, the axes first."""
    return np.concatenate([np.eye(3), -np.eye(3), sphere(_DIRECTIONS)])


def _surface(model: Any, geom: int) -> np.ndarray:
    """(V, 3) the vertices of a mesh, or points all over an ellipsoid, in the geom's frame."""
    if model.geom_type[geom] == int(load_mujoco().mjtGeom.mjGEOM_ELLIPSOID):
        directions, size = sphere_of_directions(), model.geom_size[geom]
        scaled = directions * size
        return scaled * size / np.linalg.norm(scaled, axis=1, keepdims=True)
    return mesh_vertices(model, int(model.geom_dataid[geom]))


def _spanning(vertices: np.ndarray) -> np.ndarray:
    """Up to MOST of the vertices: each next one where most is missing, until little is."""
    reach = vertices @ sphere_of_directions().T  # (V, D)
    furthest, at = reach.max(axis=0), reach.argmax(axis=0)
    size = float(np.ptp(vertices, axis=0).max())
    kept = [int(at[int(np.argmax(furthest))])]
    while len(kept) < MAX_POINTS:
        missing = furthest - reach[kept].max(axis=0)
        worst = int(np.argmax(missing))
        if missing[worst] <= CLOSE * size:
            break
        kept.append(int(at[worst]))
    return vertices[kept]
