"""Find the ranges that a replay reached. A plan models stops only: other active ranges make its model differ."""

from __future__ import annotations

import copy
from collections.abc import Collection, Iterator
from typing import Any, NamedTuple

import numpy as np

from planner.base.gl import load_mujoco
from planner.model.mjcf.equalities import fixed, row_of
from planner.model.mjcf.model_index import disabled, field, named
from planner.model.space import log_quaternion
from planner.proof.replays.simulation import set_state

_ROUNDING = 1e-9  # relative tolerance of a range


class Excess(NamedTuple):
    """Violation of the range of one quantity along a trajectory."""

    name: str  # of the joint, actuator or tendon
    what: str  # the quantity with the range, for a sentence
    unit: str
    values: np.ndarray  # (S,)
    range: np.ndarray  # (2,)

    @property
    def beyond(self) -> np.ndarray:
        """(S,) the violation; 0 within the range, and for NaN."""
        beyond = np.maximum(self.range[0] - self.values, self.values - self.range[1])
        return np.where(beyond > _ROUNDING, beyond, 0.0)

    def sentence(self, t: np.ndarray, least: float = 0.0) -> str:
        """Onset and size of a violation larger than `least`, at the times t (S,); "" if there is none."""
        beyond = self.beyond
        if not np.any(beyond > least):
            return ""
        since = t[np.argmax(beyond > least)]
        return f"{self.name} {self.what} from t = {since:.4g} s, by up to {beyond.max():.3g} {self.unit}".rstrip() + "."


REACHED = 1e-6  # of a range, at most rad, m, N or N m: a stop that is passed by less has no force to speak of


def ranges_reached(
    model: Any, t: np.ndarray, w: np.ndarray, ctrl: np.ndarray, stopped: Collection[int] = ()
) -> tuple[str, ...]:
    """Report where a simulated trajectory left a model's ranges, one sentence per joint, tendon or actuator.

    Times t (M+1,), states w (M+1, nw), controls (M, nu). `stopped` degrees of freedom have joint stops in the plan's
    model, and are excluded.
    """
    found = (*joints_in(model, w, stopped), *tendons_in(model, w), *efforts_in(model, w, ctrl))
    return tuple(filter(None, (one.sentence(t, REACHED * min(1.0, float(np.ptp(one.range)))) for one in found)))


def joints_in(model: Any, w: np.ndarray, stopped: Collection[int] = ()) -> Iterator[Excess]:
    """The joints with a range along the states w (M+1, nw), except `stopped` degrees of freedom."""
    w = w[: _until_it_runs_away(w)]
    for joint in () if disabled(model, "constraint", "limit") else np.flatnonzero(model.jnt_limited):
        if int(model.jnt_dofadr[joint]) not in stopped:
            value, limits, unit = _joint(model, joint, w)
            within = limits - np.array([-1.0, 1.0]) * model.jnt_margin[joint]
            yield Excess(named(model, "joint", int(joint)), "is outside its range", unit, value, within)


def tendons_in(model: Any, w: np.ndarray) -> Iterator[Excess]:
    """The fixed tendons with a range along the states w (M+1, nw)."""
    w = w[: _until_it_runs_away(w)]
    address = model.jnt_qposadr[model.dof_jntid]
    for tendon in () if disabled(model, "constraint", "limit") else map(int, np.flatnonzero(model.tendon_limited)):
        if fixed(model, tendon):
            row = row_of(model, tendon)
            dofs = np.flatnonzero(row)
            within = model.tendon_range[tendon] - np.array([-1.0, 1.0]) * model.tendon_margin[tendon]
            length = w[:, address[dofs]] @ row[dofs]
            yield Excess(named(model, "tendon", tendon), "is outside its range", "", length, within)


def efforts_in(model: Any, w: np.ndarray, ctrl: np.ndarray) -> Iterator[Excess]:
    """Requested actuator efforts with a clamp, along the states w (M+1, nw) and controls (M, nu)."""
    steps = _until_it_runs_away(w)
    w, ctrl = w[:steps], ctrl[: min(steps, len(ctrl))]

    def asked(kind: str, index: Any, limit: str, values: np.ndarray, limits: np.ndarray) -> Excess:
        return Excess(named(model, kind, int(index)), f"is asked for more than its {limit}", "", values, limits)

    for actuator in () if disabled(model, "clampctrl") else np.flatnonzero(model.actuator_ctrllimited):
        yield asked("actuator", actuator, "ctrlrange", ctrl[:, actuator], model.actuator_ctrlrange[actuator])
    for actuator in np.flatnonzero(model.actuator_actlimited):
        act = w[:, model.nq + model.nv + model.actuator_actadr[actuator]]
        yield asked("actuator", actuator, "actrange", act, model.actuator_actrange[actuator])
    if np.any(model.actuator_forcelimited):
        forces, _ = _forces(model, w, ctrl, "actuator_forcelimited")
        for actuator in np.flatnonzero(model.actuator_forcelimited):
            yield asked("actuator", actuator, "forcerange", forces[:, actuator], model.actuator_forcerange[actuator])
    tendons = field(model, "tendon_actfrclimited", model.ntendon)
    if np.any(tendons):
        forces, _ = _forces(model, w, ctrl, "tendon_actfrclimited")
        pulls = model.actuator_trntype == int(load_mujoco().mjtTrn.mjTRN_TENDON)
        for tendon in np.flatnonzero(tendons):
            total = forces[:, pulls & (model.actuator_trnid[:, 0] == tendon)].sum(axis=1)
            yield asked("tendon", tendon, "actuatorfrcrange", total, model.tendon_actfrcrange[tendon])
    if np.any(model.jnt_actfrclimited):
        _, sums = _forces(model, w, ctrl, "jnt_actfrclimited")
        for joint in np.flatnonzero(model.jnt_actfrclimited):
            dof = model.jnt_dofadr[joint]
            yield asked("joint", joint, "actuatorfrcrange", sums[:, dof], model.jnt_actfrcrange[joint])


def _until_it_runs_away(w: np.ndarray) -> int:
    return int(np.isfinite(w).all(axis=1).cumprod().sum())


def _joint(model: Any, joint: Any, w: np.ndarray) -> tuple[np.ndarray, np.ndarray, str]:
    """A joint's coordinate along the trajectory, its range and the unit; of a ball, the angle from its reference."""
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
    free.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)  # no force of an actuator depends on contacts
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
