"""Links of a URDF whose shapes overlap with all joints at zero do not touch each other.

A URDF cannot say which links never touch, so collections leave hulls that run into each other, and planners of arms
take such pairs out. Here the verdict names them. Shapes that only lie flush, as closed fingers do, stay; so do links
at rest that the arm meets farther out than its base: a table may be one.
"""

from __future__ import annotations

from typing import Any
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from planner.base.gl import load_mujoco
from planner.model.mjcf.model_index import NEVER_REPLAYED, body_chain, compile_model

DEEP = 1e-3  # m: less is how the shapes were rounded
NEAR_BASE = 3  # joints that part a link from the base, at most
_NAMED = 3  # pairs


def exclude_overlaps(root: Element, files: dict[str, bytes], name: str) -> None:
    """Take contacts out of an MJCF tree between bodies that overlap by more than DEEP in its pose, put into its ranges.

    Raises:
        ModelError: MuJoCo refuses the model.
    """
    mujoco, model = load_mujoco(), compile_model(root, files, name)
    data = mujoco.MjData(model)
    for j in np.flatnonzero(model.jnt_limited):
        if model.jnt_type[j] >= int(mujoco.mjtJoint.mjJNT_SLIDE):
            i = int(model.jnt_qposadr[j])
            data.qpos[i] = np.clip(data.qpos[i], *model.jnt_range[j])
    mujoco.mj_fwdPosition(model, data)
    deep = data.contact.geom[data.contact.dist < -DEEP]
    solid = np.all(model.geom_type[deep] != int(mujoco.mjtGeom.mjGEOM_PLANE), axis=1)
    found = {(min(pair), max(pair)) for pair in map(tuple, model.geom_bodyid[deep[solid]].tolist())}
    pairs = sorted(pair for pair in found if pair[0] > 0 and _are_near(model, *pair))
    if not pairs:
        return
    names = [(model.body(a).name, model.body(b).name) for a, b in pairs]
    contact, texts = SubElement(root, "contact"), SubElement(root, "custom")
    for first, second in names:
        SubElement(contact, "exclude", {"body1": first, "body2": second})
    told = [f"{first} and {second}" for first, second in names[:_NAMED]]
    more = [f"{len(names) - _NAMED} more pairs"] if len(names) > _NAMED else []
    phrase = f"contact of {'; '.join([*told, *more])}, whose shapes overlap with all joints at zero"
    SubElement(texts, "text", {"name": f"{NEVER_REPLAYED}overlaps", "data": phrase})


def _are_near(model: Any, first: int, second: int) -> bool:
    """Whether both bodies move, or the one that does is at most NEAR_BASE joints from what does not."""
    joints = [int(model.body_jntnum[body_chain(model, body)].sum()) for body in (first, second)]
    return min(joints) > 0 or max(joints) <= NEAR_BASE
