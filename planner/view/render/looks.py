"""Show one shape for each part of anybody's model, and paint what nobody painted.

A link is often given twice, by a mesh to be seen and by simpler shapes that collide; then only the first is drawn.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.base import gl

SHOWN_GROUPS = 3  # geom groups that MuJoCo draws unless told otherwise
FAINT = 0.1  # opacity below which a shape is not seen
_COVERS = 0.6  # of the colliding shapes' size: smaller visual shapes are an ornament, eyes for example
_UNPAINTED = (0.5, 0.5, 0.5, 1.0)  # MuJoCo's default
_PAINTS = ((0.80, 0.82, 0.85, 1.0), (0.36, 0.47, 0.62, 1.0))  # of links in turn, along the tree


def moving(model: Any) -> np.ndarray:
    """Mask (ngeom,) of the geoms that move."""
    return model.body_weldid[model.geom_bodyid] != 0


def drawn(model: Any) -> np.ndarray:
    """Mask (ngeom,) of the geoms that MuJoCo draws and that can be seen."""
    return (_opacity(model) > FAINT) & (model.geom_group < SHOWN_GROUPS)


def _opacity(model: Any) -> np.ndarray:
    materials = model.geom_matid
    own = model.geom_rgba[:, 3]
    if not model.nmat:
        return own
    return np.where((materials >= 0) & np.all(model.geom_rgba == _UNPAINTED, axis=1), model.mat_rgba[materials, 3], own)


def show_one_shape_for_each_part(model: Any) -> None:
    """Hide the colliding shapes of links that have others to be seen; show the hidden ones of a link without others.

    Groups say which are which by convention alone, so what collides decides: shapes of a link that do not collide, and
    that are about as large as those that do, are there to be seen. Where the colliding ones have a group of their own,
    no link that has anything else shows a shape of that group; nor is any shown that one can see through.
    """
    mujoco = gl.load_mujoco()
    parts = _parts(model)
    solid = (_opacity(model) > FAINT) & (parts >= 0)
    shown = solid & drawn(model)
    for part in set(map(int, parts[solid & moving(model)])) - set(map(int, parts[shown])):
        shown |= solid & (parts == part)
    collides = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    low, high = geom_boxes(model, data, np.arange(model.ngeom))
    hidden = np.zeros(model.ngeom, bool)
    for part in set(map(int, parts[shown])):
        seen, solids = (np.flatnonzero(shown & (parts == part) & (collides == on)) for on in (False, True))
        if len(seen) and len(solids):
            size = [np.linalg.norm(high[few].max(axis=0) - low[few].min(axis=0)) for few in (seen, solids)]
            hidden[solids] = size[0] >= _COVERS * size[1]
    proxies = set(model.geom_group[hidden]) - set(model.geom_group[shown & ~collides])
    for part in set(map(int, parts[shown & ~collides])):
        hidden |= shown & collides & (parts == part) & np.isin(model.geom_group, list(proxies))
    if np.any(hidden):  # a ball that one sees through, around what it guards
        hidden |= shown & collides & (_opacity(model) < 1.0)
    model.geom_group[shown] = 0
    gone = (parts >= 0) & (hidden | ~shown)
    model.geom_matid[gone], model.geom_rgba[gone, 3] = -1, 0.0


def _parts(model: Any) -> np.ndarray:
    """(ngeom,) the part of the machine that a geom belongs to: a link, or a body at rest; -1 for the world's own."""
    still = np.where(model.geom_bodyid == 0, -1, model.geom_bodyid)
    return np.where(moving(model), model.body_weldid[model.geom_bodyid], still)


def geom_boxes(model: Any, data: Any, geoms: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corners (G, 3), along the world's axes, of the boxes of some geoms where they are now."""
    R = data.geom_xmat[geoms].reshape(-1, 3, 3)
    centre = data.geom_xpos[geoms] + np.einsum("gij,gj->gi", R, model.geom_aabb[geoms, :3])
    half = np.einsum("gij,gj->gi", np.abs(R), model.geom_aabb[geoms, 3:])
    return centre - half, centre + half


def paint_links(model: Any) -> None:
    """Give links two colours in turn where no moving shape has a colour of its own."""
    shapes = np.flatnonzero(moving(model))
    if not np.all((model.geom_matid[shapes] < 0) & np.all(model.geom_rgba[shapes] == _UNPAINTED, axis=1)):
        return
    for geom in shapes:
        model.geom_rgba[geom] = _PAINTS[_depth(model, int(model.geom_bodyid[geom])) % 2]


def _depth(model: Any, body: int) -> int:
    """The number of moving links between a body and the world."""
    depth, link = 0, int(model.body_weldid[body])
    while link:
        depth, link = depth + 1, int(model.body_weldid[model.body_parentid[link]])
    return depth
