"""Step 1 of a proof: the plan's dynamics and MuJoCo's, at random states where the two models are the same."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from planner.base.arguments import shown
from planner.base.errors import PlannerError
from planner.base.gl import load_mujoco
from planner.base.measured import Measured, Section
from planner.model.mechanism import Mechanism
from planner.model.twin import Twin
from planner.problem.problem import Problem, Requirements
from planner.proof.another_model import another_model
from planner.proof.curve_callback import curves_acting
from planner.proof.driven_parity import driven_parity
from planner.proof.replaying import compile_model, matching_model, with_model
from planner.proof.rigid_parity import rigid_parity

STATES = 256
BOUND = 1e-10  # relative; rounding is 1e-13


def parity(
    machine: Problem | Mechanism, mjcf: str | Path | None = None, *, twin: Twin | None = None, seed: int = 0
) -> Section:
    """Compare a machine's dynamics with MuJoCo's at random states, before or after planning.

    A mechanism is compared term by term (mass matrix, bias force, actuator force, acceleration), and a term that
    differs names its joint; where joints are prescribed, see planner.proof.driven_parity. Other dynamics are compared
    by dx/dt where the problem's requirements say so.

    Args:
        machine: A mechanism, or a problem.
        mjcf: Another MJCF, a path or the XML text, in place of the machine's own.
        twin: Another MuJoCo model in place of the problem's own.
        seed: Of the random states.

    Raises:
        PlannerError: There is no MuJoCo model to compare with.
        ModelError: MuJoCo refuses the model, or it has other joints, actuators or states.
    """
    if isinstance(machine, Mechanism):
        return _of_mechanism(machine, None, with_model(twin or Twin.of(machine), mjcf), seed)
    if not isinstance(machine, Problem):
        raise PlannerError(f"parity() was given {shown(machine)}, expected a Mechanism or a Problem.")
    requirements = machine.requirements or Requirements()
    mechanism = getattr(machine.dynamics, "mechanism", None)
    if requirements.rates is None and not isinstance(mechanism, Mechanism):
        return Section("parity", not_applicable="the problem names no states at which the two models are the same")
    twin = twin or machine.twin
    if twin is None:
        raise PlannerError("the problem has no MuJoCo model to be compared with, expected a twin.")
    prescribed = getattr(machine.dynamics, "prescribed", ())
    twin = another_model(machine, twin, mjcf) if prescribed else with_model(twin, mjcf)
    if requirements.rates is None and isinstance(mechanism, Mechanism):
        if prescribed:
            model = compile_model(twin.mjcf, twin.assets)
            with curves_acting(twin, model):
                return driven_parity(mechanism, prescribed, model, STATES, BOUND, seed)
        return _of_mechanism(mechanism, machine.dynamics, twin, seed)
    return _of_rates(machine, requirements, twin, seed)


def _of_mechanism(mechanism: Mechanism, dynamics: Any, twin: Twin, seed: int) -> Section:
    model = compile_model(twin.mjcf, twin.assets)
    with curves_acting(twin, model):
        return rigid_parity(mechanism, model, dynamics, STATES, BOUND, seed)


def _of_rates(problem: Problem, requirements: Requirements, twin: Twin, seed: int) -> Section:
    """Parity of dx/dt at the states that the problem's requirements name."""
    mujoco = load_mujoco()
    model = matching_model(twin, problem.dynamics.nu)
    data = mujoco.MjData(model)
    nq, nv = model.nq, model.nv
    assert requirements.equal_states is not None  # a case gives both
    assert requirements.rates is not None
    rng = np.random.default_rng(seed)
    ws = requirements.equal_states(rng, STATES)
    us = rng.normal(size=(STATES, problem.dynamics.nu))
    ours = requirements.rates(twin.x_of(ws), us)
    theirs = np.empty_like(ours)
    for i, w in enumerate(ws):
        data.qpos[:], data.qvel[:], data.act[:] = np.split(w, [nq, nq + nv])
        data.ctrl[:] = us[i]
        with curves_acting(twin, model):
            mujoco.mj_forward(model, data)
        theirs[i] = twin.to_x @ np.concatenate([data.qvel, data.qacc, data.act_dot])
    error = np.abs(theirs - ours).max(axis=0) / np.maximum(np.abs(ours).max(axis=0), 1e-300)
    note = f"dx/dt at {STATES} random states (seed {seed}), relative to the largest"
    measured = (Measured("rate_error", float(error.max()), "", BOUND, note),)
    start = (_start(problem, twin, model, requirements.start),) if requirements.start else ()
    return Section("parity", (*measured, *start))


def _start(problem: Problem, twin: Twin, model: Any, name: str) -> Measured:
    """Whether a keyframe of the model is the plan's own start."""
    note = f"keyframe {name!r} of the model against the plan's start, largest component"
    key = next((k for k in range(model.nkey) if model.key(k).name == name), None)
    if key is None:
        return Measured("start_error", np.inf, "", BOUND, note)
    w = np.concatenate([model.key_qpos[key], model.key_qvel[key], model.key_act[key]])
    error = float(np.max(np.abs(w - twin.sim_of(problem.x0))))
    return Measured("start_error", error, "", BOUND, note)
