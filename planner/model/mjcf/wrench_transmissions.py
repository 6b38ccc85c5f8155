"""Read the transmissions of actuators whose moment depends on the pose, as MuJoCo's mj_transmission has them.

At a site the gear is a force there and a torque, along the site's axes. With a refsite both are along the refsite's
axes and act between the two: opposite on what carries the refsite, and on nothing that carries both. At a ball or free
joint "in parent" they are along the axes of what carries the joint.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.base.gl import load_mujoco
from planner.model.actuators import ActuatorWrench
from planner.model.mjcf.model_index import ModelIndex, gear_of, pose


def has_wrenches(model: Any, actuator: int) -> bool:
    """Whether the moment of an actuator depends on the pose."""
    kinds, joints, kind = load_mujoco().mjtTrn, load_mujoco().mjtJoint, model.actuator_trntype[actuator]
    if kind == int(kinds.mjTRN_JOINTINPARENT):
        target = model.jnt_type[model.actuator_trnid[actuator, 0]]
        return bool(target == int(joints.mjJNT_BALL) or target == int(joints.mjJNT_FREE))
    return bool(kind == int(kinds.mjTRN_SITE))


def wrenches_of(survey: ModelIndex, actuator: int) -> list[ActuatorWrench]:
    """The wrenches of an actuator that has_wrenches."""
    model, links = survey.model, survey.carriers[0]
    gear, none = gear_of(model, actuator), np.zeros(0, dtype=np.int64)
    if model.actuator_trntype[actuator] != int(load_mujoco().mjtTrn.mjTRN_SITE):
        return [_in_parent(survey, actuator, gear)]
    site, refsite = map(int, model.actuator_trnid[actuator])
    at, its_chain = _place(survey, site), _chain(model, links, site)
    if refsite < 0:
        R = at[1][:3, :3]
        return [_wrench(actuator, at, at[0], R @ gear[:3], R @ gear[3:], its_chain, none)]
    origin, other_chain = _place(survey, refsite), _chain(model, links, refsite)
    own, other = np.setdiff1d(its_chain, other_chain), np.setdiff1d(other_chain, its_chain)
    R = origin[1][:3, :3]
    force, torque = R @ gear[:3], R @ gear[3:]
    found = [_wrench(actuator, at, origin[0], force, torque, own, other)] if len(own) else []
    return found + ([_wrench(actuator, origin, origin[0], -force, -torque, other, none)] if len(other) else [])


def _in_parent(survey: ModelIndex, actuator: int, gear: np.ndarray) -> ActuatorWrench:
    """Of a ball a torque, of a free joint a force and a torque in the world's axes."""
    model = survey.model
    joint = int(model.actuator_trnid[actuator, 0])
    body, dofs = int(model.jnt_bodyid[joint]), np.flatnonzero(model.dof_jntid == joint)
    if len(dofs) == 6:
        return _wrench(actuator, (int(dofs[-1]), np.eye(4)), -1, gear[:3], gear[3:], dofs, dofs[:0])
    before = int(model.dof_parentid[dofs[0]])
    R = pose(model.body_pos[body], model.body_quat[body])[:3, :3]
    if before < 0 or model.dof_bodyid[before] != body:  # the first joint of its body
        parent = int(model.body_parentid[body])
        R = survey.carriers[1][parent][:3, :3] @ R
    else:
        R = np.eye(3)
    return _wrench(actuator, (int(dofs[-1]), np.eye(4)), before, np.zeros(3), R @ gear[:3], dofs, dofs[:0])


def _wrench(
    actuator: int, at: tuple[int, np.ndarray], frame: int, force: np.ndarray, torque: np.ndarray, dofs: np.ndarray,
    frame_dofs: np.ndarray,
) -> ActuatorWrench:  # fmt: skip
    link, T = at
    return ActuatorWrench(actuator, link, T[:3, 3].copy(), frame, force, torque, dofs, frame_dofs)


def _place(survey: ModelIndex, site: int) -> tuple[int, np.ndarray]:
    """The link that carries a site, -1 for the world, and its pose (4, 4) there."""
    model, (links, poses) = survey.model, survey.carriers
    body = int(model.site_bodyid[site])
    return int(links[body]), poses[body] @ pose(model.site_pos[site], model.site_quat[site])


def _chain(model: Any, links: np.ndarray, site: int) -> np.ndarray:
    """The degrees of freedom that move a site, ascending."""
    dof, found = int(links[model.site_bodyid[site]]), []
    while dof >= 0:
        found.append(dof)
        dof = int(model.dof_parentid[dof])
    return np.array(found[::-1], dtype=np.int64)
