"""Points that stand for cylinders, meshes and ellipsoids where they meet a plane: small spheres in the plan's text.

MuJoCo finds up to four points of such a shape, at places that jump from edge to edge while it rolls. A plan wants
places that stay on the body, so its text gets spheres of RADIUS there, which touch planes and nothing else; MuJoCo
replays the plan's text with the same spheres, and "your file" judges the true shape. A cylinder has RIM of them at each
rim, a mesh and an ellipsoid up to MOST that span nearly the hull. What is missing of the shape is its `shortfall`.
"""

from __future__ import annotations

import re
from typing import Any
from xml.etree import ElementTree

import numpy as np

from planner.base.gl import load_mujoco
from planner.model.contact.shapes import spheres_of
from planner.model.mjcf.model_index import pose
from planner.model.mjcf.text import written

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
