"""Convert geoms of an MJCF to the shapes of contacts: planes, spheres and points that meet them, and capsules.

A capsule meets a plane with the spheres at its ends, a box with its corners, which are points; MuJoCo does the same (of
a box's corners it takes the lowest four at most). Of cylinders, meshes and ellipsoids MuJoCo finds up to four points,
which jump from edge to edge while the geom rolls. A plan wants points that stay on the body, so its text gets spheres
of POINT_RADIUS there, which touch planes and nothing else. MuJoCo replays the plan's text with the same spheres, and
"your file" judges the true shape. A cylinder has RIM of them at each rim, a mesh and an ellipsoid up to MAX_POINTS that
nearly span the hull. `shortfall` is the distance by which the shape reaches beyond its points.
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
from planner.model.contact.laws import ALONG, Plane
from planner.model.mjcf.model_index import ModelIndex, pose
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
_DIRECTIONS = 400
_NAME = re.compile(r"(.*) \(point \d+\)")


def points_of(model: Any, geom: int) -> np.ndarray:
    """(P, 3) points of a shape in the geom's frame; of a sphere and a capsule the centres."""
    kinds, size = load_mujoco().mjtGeom, model.geom_size[geom]
    if spheres := spheres_of(model, geom):
        return np.array([sphere.centre for sphere in spheres])
    if model.geom_type[geom] == int(kinds.mjGEOM_CYLINDER):
        angles = 2.0 * np.pi * np.arange(RIM) / RIM
        rim = np.stack([size[0] * np.cos(angles), size[0] * np.sin(angles), np.full(RIM, size[1])], axis=1)
        return np.concatenate([rim, rim * (1.0, 1.0, -1.0)])
    return _spanning(_surface(model, geom))


def shortfall(model: Any, geom: int) -> float:
    """How far the shape reaches beyond its points, in the direction where that is most, m."""
    directions = sphere_of_directions()
    kinds, size = load_mujoco().mjtGeom, model.geom_size[geom]
    if model.geom_type[geom] == int(kinds.mjGEOM_CYLINDER):
        reach = size[0] * np.hypot(directions[:, 0], directions[:, 1]) + size[1] * np.abs(directions[:, 2])
    else:
        reach = (_surface(model, geom) @ directions.T).max(axis=0)
    return float((reach - (points_of(model, geom) @ directions.T).max(axis=0)).max())


def add_points(
    element: ElementTree.Element, body: ElementTree.Element, model: Any, geom: int, margin: float = 0.0, before: int = 0
) -> list[str]:
    """Add the spheres of a geom, larger by a margin, to the body that has its element; returns their names.

    `before` tells how many sets of points there are: one shape may have several, of several margins.
    """
    names, T = [], pose(model.geom_pos[geom], model.geom_quat[geom])
    spheres = spheres_of(model, geom)
    radius = margin + max(RADIUS, spheres[0].radius if spheres else 0.0)
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
    """(D, 3) unit vectors spread evenly (a Fibonacci sphere), the axes first."""
    k = np.arange(_DIRECTIONS) + 0.5
    z, turn = 1.0 - 2.0 * k / _DIRECTIONS, np.pi * (1.0 + 5.0**0.5) * k
    r = np.sqrt(1.0 - z**2)
    return np.concatenate([np.eye(3), -np.eye(3), np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=1)])


def _surface(model: Any, geom: int) -> np.ndarray:
    """(V, 3) the vertices of a mesh, or points all over an ellipsoid, in the geom's frame."""
    if model.geom_type[geom] == int(load_mujoco().mjtGeom.mjGEOM_ELLIPSOID):
        directions, size = sphere_of_directions(), model.geom_size[geom]
        scaled = directions * size
        return scaled * size / np.linalg.norm(scaled, axis=1, keepdims=True)
    mesh = int(model.geom_dataid[geom])
    first = int(model.mesh_vertadr[mesh])
    return np.array(model.mesh_vert[first : first + int(model.mesh_vertnum[mesh])], dtype=float)


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
