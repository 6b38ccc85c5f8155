"""What MJCF has no element for, as its custom elements: velocity limits of joints, and phrases of what was left out.

<custom>
  <tuple name="velocity_limit"> <element objtype="joint" objname="elbow" prm="3.1"/> </tuple>
  <text name="left_out 1" data="the collision mesh 'hand.ply' of link 'hand' (.ply is not read)"/>
</custom>
"""

from __future__ import annotations

import math
from typing import Any
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from planner.base.errors import ModelError
from planner.base.gl import load_mujoco
from planner.model.mjcf.model_index import named
from planner.model.mjcf.text import written

VELOCITY_LIMIT = "velocity_limit"
_LEFT_OUT = "left_out "


def add_velocity_limits(root: Element, limits: dict[str, float]) -> None:
    """Add limits by joint, rad/s or m/s; infinite ones are none."""
    finite = {joint: limit for joint, limit in limits.items() if math.isfinite(limit)}
    if finite:
        section = SubElement(SubElement(root, "custom"), "tuple", {"name": VELOCITY_LIMIT})
        for joint, limit in finite.items():
            SubElement(section, "element", {"objtype": "joint", "objname": joint, "prm": written(limit)})


def velocity_limits(model: Any) -> np.ndarray:
    """(nv,) of a compiled model, infinite where it has none.

    Raises:
        ModelError: One is not above 0, or not of a hinge or slide.
    """
    mujoco, limits = load_mujoco(), np.full(model.nv, np.inf)
    for i in range(model.ntuple):
        if model.tuple(i).name != VELOCITY_LIMIT:
            continue
        for k in range(model.tuple_adr[i], model.tuple_adr[i] + model.tuple_size[i]):
            joint, limit = int(model.tuple_objid[k]), float(model.tuple_objprm[k])
            if model.tuple_objtype[k] != mujoco.mjtObj.mjOBJ_JOINT or model.jnt_type[joint] < 2:
                raise ModelError(f"the tuple {VELOCITY_LIMIT!r} names other things than hinge and slide joints.")
            if not limit > 0.0:
                raise ModelError(f"{named(model, 'joint', joint)} has the velocity limit {limit:g}, expected above 0.")
            limits[model.jnt_dofadr[joint]] = limit
    return limits


def add_left_out(root: Element, phrases: list[str]) -> None:
    """Add phrases of what a text lacks of the file that it was made of."""
    if phrases:
        section = SubElement(root, "custom")
        for k, phrase in enumerate(phrases):
            SubElement(section, "text", {"name": f"{_LEFT_OUT}{k + 1}", "data": phrase})


def phrases_left_out(model: Any) -> tuple[str, ...]:
    """The phrases that a compiled model carries."""
    mujoco, found = load_mujoco(), []
    for i in range(model.ntext):
        if (mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_TEXT, i) or "").startswith(_LEFT_OUT):
            at, size = model.text_adr[i], model.text_size[i]
            found.append(bytes(model.text_data[at : at + size]).split(b"\0")[0].decode(errors="replace"))
    return tuple(found)
