"""Read actuators, armature, damping and friction loss of the joints of a compiled model.

MuJoCo's constraint of friction loss has the regularization R = (1 - d) w / d, with d the impedance of `solimpfriction`
at 0 and w the inverse inertia of the joint at qpos0, and the damping beta of `solreffriction`: 2 / (dmax timeconst), or
-damping / dmax in the direct format. So planner.dynamics.joint_forces has the inertia D = 1 / R, and a joint that
slides alone decays at d beta per s, 95 by default.

Moments of actuators that depend on the pose are MuJoCo's (mj_transmission). At a site the gear is a force there and a
torque, along the site's axes. With a refsite both are along the refsite's axes and act between the two: opposite on
what carries the refsite, and on nothing that carries both. At a ball or free joint "in parent" they are along the axes
of what carries the joint. What an actuator exerts beside gain and affine bias is a law of kernels.force_laws.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from planner.base.gl import load_mujoco
from planner.model.actuators import DIRECT, FILTER, INTEGRATOR, Actuators, ActuatorWrench, ForceLaw
from planner.model.mjcf.equalities import row_of
from planner.model.mjcf.file_law import MAX_IMPEDANCE, MIN_IMPEDANCE
from planner.model.mjcf.model_index import ModelIndex, disabled, field, gear_of, kind_word, names_of, pose, ranges_of


def actuators_of(survey: ModelIndex) -> Actuators:
    """The actuators; one that is disabled, or that adheres to nothing, pushes with nothing."""
    mujoco, model = load_mujoco(), survey.model
    nu, wrenches, laws = int(model.nu), [], []
    moment, gain, bias = np.zeros((nu, model.nv)), np.zeros(nu), np.zeros((nu, 3))
    dynamics, time_constant = np.full(nu, DIRECT, dtype=np.int64), np.ones(nu)
    force_range = ranges_of(model.actuator_forcelimited, model.actuator_forcerange)
    for i in range(nu):
        off = actuator_disabled(model, i)
        if model.actuator_dyntype[i] == mujoco.mjtDyn.mjDYN_INTEGRATOR:
            dynamics[i] = INTEGRATOR
        elif model.actuator_actadr[i] >= 0:
            dynamics[i], time_constant[i] = FILTER, max(model.actuator_dynprm[i, 0], mujoco.mjMINVAL)
        if off and dynamics[i] != DIRECT:  # MuJoCo leaves the activation where it is
            dynamics[i], time_constant[i] = FILTER, np.inf
        if off or adheres_to_nothing(model, i):
            continue
        (gain[i], bias[i]), law = affine_force(model, i), law_of(model, i)
        laws += [law] if law else []
        target = model.actuator_trnid[i, 0]
        if has_wrenches(model, i):
            wrenches += wrenches_of(survey, i)
            continue
        moment[i] = _moment(model, i)
        if model.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_TENDON:
            if field(model, "tendon_actfrclimited", model.ntendon)[target]:
                low, high = model.tendon_actfrcrange[target]
                force_range[i] = max(low, force_range[i, 0]), min(high, force_range[i, 1])
        elif model.jnt_type[target] == mujoco.mjtJoint.mjJNT_FREE:
            bias[i, 1] = 0.0  # a free joint has no length
    clamped = not disabled(model, "clampctrl")
    return Actuators(
        names=names_of(model, "actuator", nu), moment=moment, gain=gain, bias=bias, dynamics=dynamics,
        activation=np.array(model.actuator_actadr, dtype=np.int64), time_constant=time_constant,
        control_range=ranges_of(model.actuator_ctrllimited * clamped, model.actuator_ctrlrange),
        force_range=force_range,
        activation_range=ranges_of(model.actuator_actlimited, model.actuator_actrange),
        wrenches=tuple(wrenches), laws=tuple(laws),
    )  # fmt: skip


def _moment(model: Any, actuator: int) -> np.ndarray:
    """(nv,) the generalized force per force of an actuator on a joint or fixed tendon."""
    mujoco = load_mujoco()
    gear, target = gear_of(model, actuator), model.actuator_trnid[actuator, 0]
    if model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_TENDON:
        return gear[0] * row_of(model, target)
    row, dofs = np.zeros(model.nv), np.flatnonzero(model.dof_jntid == target)
    row[dofs] = gear[: len(dofs)]
    return row


def armature_and_damping(model: Any) -> tuple[np.ndarray, np.ndarray]:
    """Armature and damping (nv,) of the joints, with that of their actuators where this MuJoCo has it."""
    armature, damping = np.array(model.dof_armature), np.array(model.dof_damping)
    n = len(model.actuator_trntype)
    for own, total in (("armature", armature), ("damping", damping)):
        values = field(model, f"actuator_{own}", n)
        for i in map(int, np.flatnonzero(values)):
            joint = model.actuator_trnid[i, 0]
            scalar = np.count_nonzero(model.dof_jntid == joint) == 1
            total[model.dof_jntid == joint] += values[i] * (gear_of(model, i)[0] ** 2 if scalar else 1.0)
    return armature, damping * (not disabled(model, "damper", "passive"))


_MUJOCO_MIN_VALUE = 1e-15  # MuJoCo's mjMINVAL
_DEFAULT = 0.02  # s, MuJoCo's time constant where solref has numbers of both formats


def joint_friction(model: Any) -> dict[str, Any]:
    """Loss (nv,), N m or N, inertia (nv,), kg m^2 or kg, and rate (nv,), 1/s, of friction; zeros for none."""
    ends = np.clip(model.dof_solimp[:, :2], MIN_IMPEDANCE, MAX_IMPEDANCE)
    flat = (ends[:, 0] == ends[:, 1]) | (model.dof_solimp[:, 2] <= _MUJOCO_MIN_VALUE)
    d = np.where(flat, ends.mean(axis=1), ends[:, 0])
    positive = model.dof_solref > 0.0
    direct = ~positive.any(axis=1)
    constant = np.where(positive.all(axis=1), model.dof_solref[:, 0], _DEFAULT)
    rate = np.where(direct, -model.dof_solref[:, 1], 2.0 / constant) / ends[:, 1]
    loss = model.dof_frictionloss * (not disabled(model, "constraint", "frictionloss"))
    inertia = d / np.maximum((1.0 - d) * model.dof_invweight0, _MUJOCO_MIN_VALUE)
    return {
        "friction_loss": np.array(loss, dtype=float), "friction_inertia": np.where(loss > 0.0, inertia, 0.0),
        "friction_rate": np.where(loss > 0.0, rate, 0.0),
    }  # fmt: skip


def actuator_disabled(model: Any, i: int) -> bool:
    """Whether a flag or its group keeps an actuator from acting."""
    group = int(model.actuator_group[i])
    return disabled(model, "actuation") or bool(0 <= group <= 30 and model.opt.disableactuator & (1 << group))


def adheres_to_nothing(model: Any, i: int) -> bool:
    """Whether it is an adhesion actuator, which acts through contacts, of a model that has none."""
    return model.actuator_trntype[i] == load_mujoco().mjtTrn.mjTRN_BODY and disabled(model, "contact", "constraint")


def affine_force(model: Any, i: int) -> tuple[float, np.ndarray]:
    """Gain, and bias (3,) by 1, length and length rate, of an actuator whose force is known."""
    affine = model.actuator_biastype[i] == int(load_mujoco().mjtBias.mjBIAS_AFFINE)
    return float(model.actuator_gainprm[i, 0]), model.actuator_biasprm[i, :3] * affine


def law_of(model: Any, i: int) -> ForceLaw | None:
    """What an actuator exerts beside that; None for nothing."""
    by_state = model.actuator_gainprm[i, 1:3]
    if model.actuator_gaintype[i] == int(load_mujoco().mjtGain.mjGAIN_AFFINE) and np.any(by_state):
        return ForceLaw(i, "affine gain", tuple(by_state.tolist()))
    return None


def unknown_force(model: Any, i: int) -> Iterator[str]:
    """What of an actuator's force is not modelled."""
    gains, biases = load_mujoco().mjtGain, load_mujoco().mjtBias
    for kinds, kind, known in (
        (gains, model.actuator_gaintype[i], (gains.mjGAIN_FIXED, gains.mjGAIN_AFFINE)),
        (biases, model.actuator_biastype[i], (biases.mjBIAS_NONE, biases.mjBIAS_AFFINE)),
    ):
        if int(kind) not in map(int, known):
            yield f"{kind_word(kinds, kind)} {'gain' if kinds is gains else 'bias'}"


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
