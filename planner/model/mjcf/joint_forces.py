"""Read actuators, armature, damping and friction loss of the joints of a compiled model.

MuJoCo's constraint of friction loss has the regularization R = (1 - d) w / d, with d the impedance of `solimpfriction`
at 0 and w the inverse inertia of the joint at qpos0, and the damping beta of `solreffriction`: 2 / (dmax timeconst), or
-damping / dmax in the direct format. So planner.dynamics.joint_forces has the inertia D = 1 / R, and a joint that
slides alone decays at d beta per s, 95 by default.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.base.gl import load_mujoco
from planner.model.actuators import DIRECT, FILTER, INTEGRATOR, Actuators
from planner.model.mjcf.equalities import row_of
from planner.model.mjcf.force_laws import affine_force, law_of
from planner.model.mjcf.model_index import ModelIndex, disabled, field, gear_of, names_of, ranges_of
from planner.model.mjcf.unsupported import actuator_disabled, adheres_to_nothing
from planner.model.mjcf.wrench_transmissions import has_wrenches, wrenches_of


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


MIN_IMPEDANCE, MAX_IMPEDANCE = 1e-4, 0.9999  # MuJoCo's mjMINIMP, mjMAXIMP
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
