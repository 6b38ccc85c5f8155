"""Convert geoms of a survey to solids: spheres, capsules, boxes and planes as they are, others as what is fitted."""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.base.gl import load_mujoco
from planner.model.contact.bounding_fit import BoundingFit, fit_bounding_shape, rim_points, round_points
from planner.model.contact.collision_shapes import CollisionShape
from planner.model.mjcf.model_index import ModelIndex

NO_SOLID = ("hfield", "sdf")


def shape_name(model: Any, geom: int) -> str:
    """A geom for a sentence, by its own name or its body's: "geom 'tip'" or "link 'forearm'"."""
    if name := model.geom(geom).name:
        return f"geom {name!r}"
    body = model.body(int(model.geom_bodyid[geom])).name
    return f"body {body!r}" if body else f"geom number {geom}"


def has_solid(model: Any, geom: int) -> bool:
    """Whether a geom is of a kind that solids stand for."""
    kinds = load_mujoco().mjtGeom
    return model.geom_type[geom] not in [int(getattr(kinds, f"mjGEOM_{kind.upper()}")) for kind in NO_SOLID]


def solids_of(survey: ModelIndex, geoms: list[int]) -> dict[int, CollisionShape]:
    """The solids of geoms, by their numbers; each mesh is fitted once."""
    model, kinds = survey.model, load_mujoco().mjtGeom
    links, fits, found = survey.carriers[0], {}, {}
    for geom in geoms:
        kind, size = int(model.geom_type[geom]), np.array(model.geom_size[geom])
        given = shape_name(model, geom), geom, int(links[model.geom_bodyid[geom]])
        T, none = survey.geoms[geom], np.zeros(3)
        if kind == int(kinds.mjGEOM_PLANE):
            found[geom] = CollisionShape(*given, T, none, 0.0, plane=True)
        elif kind == int(kinds.mjGEOM_SPHERE):
            found[geom] = CollisionShape(*given, T, none, float(size[0]))
        elif kind == int(kinds.mjGEOM_CAPSULE):
            found[geom] = CollisionShape(*given, T, np.array([0.0, 0.0, size[1]]), float(size[0]))
        elif kind == int(kinds.mjGEOM_BOX):
            found[geom] = CollisionShape(*given, T, size, 0.0)
        else:
            key = (kind, int(model.geom_dataid[geom]), size.tobytes() if kind != int(kinds.mjGEOM_MESH) else b"")
            fit = fits.setdefault(key, None) or fit_bounding_shape(_points(model, geom))
            fits[key] = fit
            found[geom] = _fit_at(given, T, fit)
    return found


def _fit_at(given: tuple[str, int, int], T: np.ndarray, fit: BoundingFit) -> CollisionShape:
    return CollisionShape(*given, T @ fit.T, fit.half, fit.radius, overestimate=fit.overestimate)


def _points(model: Any, geom: int) -> np.ndarray:
    """Points (n, 3) in a geom's frame whose hull holds it."""
    kinds, size = load_mujoco().mjtGeom, model.geom_size[geom]
    if model.geom_type[geom] == int(kinds.mjGEOM_CYLINDER):
        return rim_points(float(size[0]), float(size[1]))
    if model.geom_type[geom] == int(kinds.mjGEOM_ELLIPSOID):
        return round_points(size)
    mesh = int(model.geom_dataid[geom])
    first = int(model.mesh_vertadr[mesh])
    return np.array(model.mesh_vert[first : first + int(model.mesh_vertnum[mesh])], dtype=float)
