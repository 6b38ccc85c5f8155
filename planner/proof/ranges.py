"""Find the ranges that a replay reached. A plan knows only stops: where MuJoCo held a range, the machines differ."""

from __future__ import annotations

import copy
from collections.abc import Collection
from typing import Any

import numpy as np

from planner.base.gl import load_mujoco
from planner.model.mjcf.survey import named
from planner.model.space import log_quaternion
from planner.proof.simulation import set_state

_ROUNDING = 1e-9  # as far beyond a range is still on it


def ranges_reached(
    model: Any, t: np.ndarray, w: np.ndarray, ctrl: np.ndarray, stopped: Collection[int] = ()
) -> tuple[str, ...]:
    """Say where a simulated motion went beyond a model's ranges, one sentence per joint or actuator and kind.

    Times t (M+1,), states w (M+1, nw), controls (M, nu). A plan knows the ranges of `stopped` degrees of freedom, since
    it has their stops.
    """
    steps = int(np.isfinite(w).all(axis=1).cumprod().sum())  # until it runs away, if it does
    t, w, ctrl = t[:steps], w[:steps], ctrl[: min(steps, len(ctrl))]
    found = []
    for joint in np.flatnonzero(model.jnt_limited):
        if int(model.jnt_dofadr[joint]) in stopped:
            continue
        value, limits, unit = _joint(model, joint, w)
        beyond = _beyond(value, limits - np.array([-1.0, 1.0]) * model.jnt_margin[joint])
        found += _sentence(named(model, "joint", int(joint)), "is outside its range", t, beyond, unit)
    clamps = not model.opt.disableflags & load_mujoco().mjtDisableBit.mjDSBL_CLAMPCTRL
    for actuator in np.flatnonzero(model.actuator_ctrllimited) if clamps else ():
        beyond = _beyond(ctrl[:, actuator], model.actuator_ctrlrange[actuator])
        found += _asked(model, "actuator", actuator, "ctrlrange", t, beyond)
    if np.any(model.actuator_forcelimited):
        forces, _ = _forces(model, w, ctrl, "actuator_forcelimited")
        for actuator in np.flatnonzero(model.actuator_forcelimited):
            beyond = _beyond(forces[:, actuator], model.actuator_forcerange[actuator])
            found += _asked(model, "actuator", actuator, "forcerange", t, beyond)
    if np.any(model.jnt_actfrclimited):
        _, sums = _forces(model, w, ctrl, "jnt_actfrclimited")
        for joint in np.flatnonzero(model.jnt_actfrclimited):
            beyond = _beyond(sums[:, model.jnt_dofadr[joint]], model.jnt_actfrcrange[joint])
            found += _asked(model, "joint", joint, "actuatorfrcrange", t, beyond)
    return tuple(found)


def _joint(model: Any, joint: Any, w: np.ndarray) -> tuple[np.ndarray, np.ndarray, str]:
    """A joint's coordinate over the motion, its range and the unit; of a ball, the angle from its reference."""
    kinds, address = load_mujoco().mjtJoint, model.jnt_qposadr[joint]
    if model.jnt_type[joint] == kinds.mjJNT_BALL:
        angle = np.linalg.norm(log_quaternion(w[:, address : address + 4]), axis=1)
        return angle, np.array([-np.inf, model.jnt_range[joint].max()]), "rad"
    unit = "m" if model.jnt_type[joint] == kinds.mjJNT_SLIDE else "rad"
    return w[:, address], model.jnt_range[joint], unit


def _forces(model: Any, w: np.ndarray, ctrl: np.ndarray, limits: str) -> tuple[np.ndarray, np.ndarray]:
    """Actuator forces (M, nu) and their sums on the degrees of freedom (M, nv), without one kind of limits."""
    mujoco = load_mujoco()
    free = copy.copy(model)
    getattr(free, limits)[:] = 0
    data = mujoco.MjData(free)
    forces, sums = np.empty((len(ctrl), model.nu)), np.empty((len(ctrl), model.nv))
    for i, u in enumerate(ctrl):
        set_state(model, data, w[i])
        data.ctrl[:] = u
        mujoco.mj_fwdPosition(free, data)
        mujoco.mj_fwdVelocity(free, data)
        mujoco.mj_fwdActuation(free, data)
        forces[i], sums[i] = data.actuator_force, data.qfrc_actuator
    return forces, sums


def _beyond(value: np.ndarray, limits: np.ndarray) -> np.ndarray:
    """The excess of a value over its limits; 0 within, and where it is not a number."""
    beyond = np.maximum(limits[0] - value, value - limits[1])
    return np.where(beyond > _ROUNDING, beyond, 0.0)


def _asked(model: Any, kind: str, index: Any, limit: str, t: np.ndarray, beyond: np.ndarray) -> list[str]:
    return _sentence(named(model, kind, int(index)), f"is asked for more than its {limit}", t, beyond)


def _sentence(name: str, what: str, t: np.ndarray, beyond: np.ndarray, unit: str = "") -> list[str]:
    if not np.any(beyond):
        return []
    return [
        f"{name} {what} from t = {t[np.argmax(beyond > 0.0)]:.4g} s, by up to {beyond.max():.3g} {unit}".rstrip() + "."
    ]
