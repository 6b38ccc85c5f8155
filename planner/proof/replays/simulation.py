"""Simulate a MuJoCo model and store its states w = (qpos, qvel, act), with given controls or by feedback.

Also steps of the Rosenbrock method of a plan (kernels.tree.rosenbrock) with the forces and masses of MuJoCo. The
implicit methods of MuJoCo are of first order: where damping is as fast as the step, the error of the first step after a
control jump is a fifth of the jump. So accelerations are MuJoCo's for armatures increased by the damping of a step, and
the forces of the second stage are applied as qfrc_applied.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import numpy as np

from planner.base.gl import load_mujoco, load_rollout
from planner.dynamics.protocol import integrator_of
from planner.kernels.integrators import LEAPFROG
from planner.model.capabilities import capabilities_of
from planner.model.mjcf.model_index import named
from planner.model.passive_forces import implicit_damping
from planner.proof.replays.contact_history import ContactRecorder

MAX_STEPS = 5_000_000  # some minutes and 1 GB
RUNAWAY = 1e10  # threshold of MuJoCo's divergence check
_AT_ONCE = 50_000  # steps in C between checks for Ctrl-C


def set_state(model: Any, data: Any, w: np.ndarray) -> None:
    """Put a state (nw,) into MuJoCo's data."""
    nq, nv = model.nq, model.nv
    data.qpos[:], data.qvel[:], data.act[:] = w[:nq], w[nq : nq + nv], w[nq + nv :]


def state_of(data: Any) -> np.ndarray:
    """The state (nw,) of MuJoCo's data."""
    return np.concatenate([data.qpos, data.qvel, data.act])


def simulate(
    model: Any, w0: np.ndarray, ctrl: np.ndarray, *, control: Callable[[int, np.ndarray], np.ndarray] | None = None,
    held: int = 1, recorder: ContactRecorder | None = None, every: int = 1, start: float = 0.0,
    step: Step | None = None,
) -> tuple[np.ndarray, tuple[str, ...]]:  # fmt: skip
    """Step a model from w0 (nw,) under controls (M, nu); returns states (M+1, nw) and warnings, one sentence each.

    `control` is called every `held` steps with a step and its state, and returns the controls (nu,) or (held, nu) until
    the next call, which are written into ctrl. Every `every` steps the simulation ends if it has diverged, with NaN
    states from there. `start` is the time of w0 for sentences, s. `step` replaces MuJoCo's own step function.
    """
    recorder = recorder or ContactRecorder(model, 0, records=False)
    data, w = load_mujoco().MjData(model), np.full((len(ctrl) + 1, len(w0)), np.nan)
    w[0] = w0
    set_state(model, data, w0)
    held = _AT_ONCE if control is None else held
    with load_rollout().Rollout(nthread=0) as pool:
        in_c = step is None and not recorder.records and held > 1
        for i in range(0, len(ctrl), held):
            until = min(i + held, len(ctrl))
            if control is not None:
                ctrl[i:until] = control(i, w[i])
            if in_c and _advance(pool, model, data, w[i : until + 1], ctrl[i:until]):
                continue
            in_c = False  # the rest step by step, to say when it diverged
            if not _step_through(model, data, w, ctrl, range(i, until), recorder, step, every):
                break
    warnings = (*_unstable_at(model, w, start), *warnings_of(data))
    if np.isfinite(w[-1]).all():
        recorder.look(len(ctrl), data)
    return w, warnings


def _step_through(
    model: Any, data: Any, w: np.ndarray, ctrl: np.ndarray, steps: range, recorder: ContactRecorder, step: Step | None,
    every: int,
) -> bool:  # fmt: skip
    """Fill the rows of w (M+1, nw) after these steps, one by one; False where it has diverged."""
    nq, nv = model.nq, model.nv
    qpos, qvel, act, applied = data.qpos, data.qvel, data.act, data.ctrl  # views: to ask for them again takes time
    for i in steps:
        applied[:] = ctrl[i]
        if step is None:
            recorder.step(i, data)
        else:
            recorder.look(i, data)
            step(data)
        row = w[i + 1]
        row[:nq], row[nq : nq + nv], row[nq + nv :] = qpos, qvel, act
        if i % every == 0 and not np.all(np.abs(row) < RUNAWAY):
            return False
    return True


def _advance(pool: Any, model: Any, data: Any, w: np.ndarray, ctrl: np.ndarray) -> bool:
    """Fill w (n+1, nw) from its first row by mujoco.rollout, with equal bits; False, data restored, if it warns."""
    mujoco = load_mujoco()
    full = mujoco.mjtState.mjSTATE_FULLPHYSICS
    row, warm = np.empty((1, mujoco.mj_stateSize(model, full))), data.qacc_warmstart[None].copy()
    mujoco.mj_getState(model, data, row[0], full)
    states = np.empty((1, len(ctrl), row.shape[1]))
    pool.rollout(
        [model], [data], row, ctrl[None], nstep=len(ctrl), state=states, skip_checks=True, initial_warmstart=warm
    )  # fmt: skip
    w[1:] = states[0, :, 1 : 1 + w.shape[1]]
    if not data.warning.number.any() and bool(np.all(np.abs(w) < RUNAWAY)):
        return True
    w[1:] = np.nan
    mujoco.mj_resetData(model, data)
    mujoco.mj_setState(model, data, row[0], full)
    data.qacc_warmstart[:] = warm[0]
    return False


def _unstable_at(model: Any, w: np.ndarray, start: float) -> tuple[str, ...]:
    """Set diverged states of w (M+1, nw) to NaN, and report in a sentence where and when divergence began."""
    with np.errstate(invalid="ignore"):
        bad = ~(np.abs(w) < RUNAWAY)
    if not bad.any():
        return ()
    first = int(np.argmax(bad.any(axis=1)))
    w[first:] = np.nan
    dofs = np.flatnonzero(bad[first, model.nq : model.nq + model.nv])
    where = f" at {named(model, 'joint', int(model.dof_jntid[dofs[0]]))}" if len(dofs) else ""
    return (f"MuJoCo's simulation became unstable{where} at t = {start + first * model.opt.timestep:.4g} s.",)


def warnings_of(data: Any) -> tuple[str, ...]:
    """MuJoCo's own warnings, e.g. about an unstable simulation."""
    kinds = load_mujoco().mjtWarning
    numbers = {kinds(k).name[7:].lower(): data.warning[k].number for k in range(int(kinds.mjNWARNING))}
    return tuple(f"MuJoCo warned of {name} {number} times." for name, number in numbers.items() if number)


GAMMA = 1.0 - 0.5**0.5  # as in kernels.tree.rosenbrock
ROSENBROCK = "rosenbrock"
NATIVE_IMPLICIT = "IMPLICITFAST"  # MuJoCo's own, stable, of first order

Step = Callable[[Any], None]  # advances MuJoCo's data
Acceleration = Callable[[Any, Any], np.ndarray]  # (model, data) after mj_forward -> (nv,)


def damping_of(dynamics: Any) -> np.ndarray | None:
    """(nv,) damping that replays of a plan integrate implicitly, as its dynamics do; None for explicit integration."""
    return stage_damping(dynamics) if integrator_of(dynamics).implicit else None


def stage_damping(dynamics: Any) -> np.ndarray | None:
    """(nv,) damping that a plan's stages take implicitly, or as it is in the middle of a step; None for none."""
    mechanism, known = capabilities_of(dynamics).mechanism, integrator_of(dynamics)
    takes = mechanism is not None and (known.implicit or known.form == LEAPFROG)
    return implicit_damping(mechanism) if takes else None


def implicit_step(
    model: Any, h: float, damping: np.ndarray, parts: int = 1, acceleration: Acceleration | None = None
) -> Step:
    """A function that advances data of a model by h s in equal parts.

    Args:
        model: MuJoCo's; it is not changed.
        h: Step, s.
        damping: (nv,) of damping_of().
        parts: Number of equal steps.
        acceleration: Replaces MuJoCo's qacc.
    """
    mujoco, h = load_mujoco(), h / parts
    added, heavier = GAMMA * h * damping, copy.copy(model)
    heavier.dof_armature[:] += added
    heavier.dof_M0[:] += added  # used by MuJoCo in place of armatures for bodies with constant masses

    def forward(data: Any) -> tuple[np.ndarray, np.ndarray]:
        mujoco.mj_forward(heavier, data)
        a = data.qacc if acceleration is None else acceleration(heavier, data)
        return a.copy(), data.act_dot.copy()

    def step(data: Any) -> None:
        for _ in range(parts):
            q, v, act, applied = data.qpos.copy(), data.qvel.copy(), data.act.copy(), data.qfrc_applied.copy()
            a, rate = forward(data)
            data.qvel[:], data.act[:] = v + h * a, act + h * rate
            data.qfrc_applied[:] = applied + 2.0 * added * a
            mujoco.mj_integratePos(heavier, data.qpos, v + GAMMA * h * a, h)
            w, later = forward(data)
            data.qpos[:] = q
            mujoco.mj_integratePos(heavier, data.qpos, v + 0.5 * h * ((1.0 - GAMMA) * a + GAMMA * w), h)
            data.qvel[:], data.act[:] = v + 0.5 * h * (a + w), act + 0.5 * h * (rate + later)
            data.qfrc_applied[:] = applied
            data.time += h

    return step
