"""Inertials of links from their shapes and a density, for files that leave <inertial> out.

MuJoCo's compiler integrates them: of the collision shapes, of a link without any of the visual ones, and of a mesh the
convex hull.
"""

from __future__ import annotations

from dataclasses import replace
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from planner.model.mjcf.model_index import compile_model, pose
from planner.model.mjcf.text import written
from planner.model.urdf.masses import listed
from planner.model.urdf.robot import Inertial, Robot
from planner.model.urdf.shapes import GeomWriter, Packages

WATER = 1000.0
"""kg/m^3, of inertia = "from shapes"."""


def with_shape_inertias(
    robot: Robot, anchored: set[str], packages: Packages, density: float, name: str
) -> tuple[Robot, list[str]]:  # fmt: skip
    """The robot with an inertial for each link that moves and has none but has shapes, and a phrase about them."""
    root, links = Element("mujoco"), dict(robot.links)
    SubElement(root, "compiler", {"angle": "radian", "eulerseq": "XYZ", "inertiafromgeom": "true"})
    SubElement(SubElement(root, "default"), "geom", {"density": written(density)})
    world, shapes = SubElement(root, "worldbody"), GeomWriter(root, packages)
    for link in (one for one in links.values() if one.inertial is None and one.name not in anchored):
        visuals = () if link.collisions else link.visuals
        shapes.add(SubElement(world, "body", {"name": link.name}), replace(link, visuals=visuals))
    for mesh in root.iter("mesh"):
        mesh.set("inertia", "convex")
    model, given = compile_model(root, shapes.files, name), list[str]()
    for i in np.flatnonzero(model.body_mass):
        link, R = model.body(i).name, pose(np.zeros(3), model.body_iquat[i])[:3, :3]
        own = Inertial(float(model.body_mass[i]), model.body_ipos[i].copy(), R @ np.diag(model.body_inertia[i]) @ R.T)
        links[link] = replace(links[link], inertial=own)
        given.append(link)
    phrase = f"the inertia of {listed(given)} (the file has none: that of the shapes at {density:g} kg/m^3)"
    return replace(robot, links=links), [phrase] if given else []
