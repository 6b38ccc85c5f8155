"""Inertials of links from their shapes and a density, for files that leave <inertial> out.

The collision shapes count, of a link without any the visual ones; a mesh counts as its convex hull. With the second
moment C = int x x' dV about a shape's centre, its inertia is density (tr(C) 1 - C).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from planner.base.errors import ModelError
from planner.model.urdf.masses import listed, total_inertial
from planner.model.urdf.meshes import mesh_triangles
from planner.model.urdf.robot import Inertial, Robot, Shape
from planner.model.urdf.shapes import Packages

WATER = 1000.0
"""kg/m^3, of inertia = "from shapes"."""


def with_shape_inertias(
    robot: Robot, anchored: set[str], packages: Packages, density: float
) -> tuple[Robot, list[str]]:  # fmt: skip
    """The robot with an inertial for each link that moves and has none but has shapes, and a phrase about them."""
    links, given = dict(robot.links), list[str]()
    for name, link in robot.links.items():
        if link.inertial is None and name not in anchored:
            bodies = [one for s in link.collisions or link.visuals if (one := _inertial(s, packages, density))]
            if bodies:
                links[name] = replace(link, inertial=total_inertial([(body, np.eye(4)) for body in bodies]))
                given.append(name)
    phrase = f"the inertia of {listed(given)} (the file has none: that of the shapes at {density:g} kg/m^3)"
    return replace(robot, links=links), [phrase] if given else []


def _inertial(shape: Shape, packages: Packages, density: float) -> Inertial | None:
    """A shape's inertial in the link's frame; None where it has no volume or its mesh cannot be read."""
    found = _mesh_moments(shape, packages) if shape.kind == "mesh" else (*_moments(shape), np.zeros(3))
    if found is None or not found[0] > 0.0:
        return None
    volume, second, centre = found
    R = shape.pose.rotation
    inertia = density * R @ (np.trace(second) * np.eye(3) - second) @ R.T
    return Inertial(density * volume, R @ centre + np.array(shape.pose.xyz), inertia)


def _moments(shape: Shape) -> tuple[float, np.ndarray]:
    """Volume, m^3, and second moment (3, 3), m^5, of a primitive about its centre."""
    if shape.kind == "box":
        half = np.array(shape.size)
        volume = 8.0 * float(half.prod())
        return volume, volume / 3.0 * np.diag(half**2)
    r, h = (*shape.size, 0.0)[:2]
    ball, tube = 4.0 / 3.0 * np.pi * r**3, 2.0 * np.pi * r**2 * h
    second = tube * np.array([r**2 / 4.0, r**2 / 4.0, h**2 / 3.0])
    if shape.kind == "cylinder":
        return tube, np.diag(second)
    caps = ball * (r**2 / 5.0 + np.array([0.0, 0.0, h**2 + 0.75 * h * r]))  # two half balls, their flat sides at +-h
    return ball + tube, np.diag(second + caps)


def _mesh_moments(shape: Shape, packages: Packages) -> tuple[float, np.ndarray, np.ndarray] | None:
    """Volume, second moment about the centre, and centre (3,) of a mesh's convex hull: sums over tetrahedra."""
    from scipy.spatial import ConvexHull, QhullError  # half a second that other models need not wait

    path = packages.find(shape.file)
    try:
        if path is None:
            return None
        points = np.unique((mesh_triangles(path) * shape.scale).reshape(-1, 3), axis=0)
        faces = ConvexHull(points).simplices
    except (ModelError, QhullError, ValueError):  # unreadable, or flat
        return None
    inside = points.mean(axis=0)
    corners = points[faces] - inside  # the fourth corner of each tetrahedron is `inside`
    volumes = np.abs(np.linalg.det(corners)) / 6.0
    sums, volume = corners.sum(axis=1), float(volumes.sum())
    centre = volumes @ sums / (4.0 * volume)
    second = np.einsum("t,tki,tkj->ij", volumes, corners, corners) + np.einsum("t,ti,tj->ij", volumes, sums, sums)
    return volume, second / 20.0 - volume * np.outer(centre, centre), centre + inside
