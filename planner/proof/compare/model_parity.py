"""Step 1 of a proof: the plan's dynamics and MuJoCo's, at random states where the two models are the same."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from planner.base.arguments import short_repr
from planner.base.errors import PlannerError
from planner.base.gl import load_mujoco
from planner.base.measured import Measurement, Section
from planner.model.mechanism import Mechanism
from planner.model.twin import Twin
from planner.problem.problem import Problem, Requirements
from planner.proof.compare.contact_parity import contact_parity
from planner.proof.compare.driven_parity import driven_parity
from planner.proof.compare.friction_parity import friction_parity
from planner.proof.compare.rigid_parity import rigid_parity
from planner.proof.replays.compiled_twin import CompiledTwin, another_model, with_model
from planner.proof.replays.passive_torque_callback import curves_acting
from planner.proof.replays.simulation import set_state

STATES = 256
BOUND = 1e-10  # relative; rounding is 1e-13

# Of each problem the last comparison: the twin, the seed and what came of it.
_last: WeakKeyDictionary[Problem, tuple[Twin, int, Section]] = WeakKeyDictionary()

_NOTHING = Section("parity", not_applicable="the problem names no states at which the two models are the same")


def parity(
    machine: Problem | Mechanism, mjcf: str | Path | None = None, *, twin: Twin | None = None, seed: int = 0
) -> Section:
    """Compare a machine's dynamics with MuJoCo's at random states, before or after planning.

    A mechanism is compared term by term (mass matrix, bias force, actuator force, acceleration), and a term that
    differs names its joint; where joints are prescribed, see driven_parity. Other dynamics are compared by dx/dt where
    the problem's requirements say so.

    Args:
        machine: A mechanism, or a problem.
        mjcf: Compare with this MJCF, a path or the XML text, instead of the machine's own.
        twin: Compare with this model instead of the problem's own.
        seed: Seed of the random states.

    Raises:
        PlannerError: There is no MuJoCo model to compare with.
        ModelError: MuJoCo refuses the model, or it has other joints, actuators or states.
    """
    if isinstance(machine, Mechanism):
        return _of_mechanism(machine, None, CompiledTwin(with_model(twin or Twin.of(machine), mjcf)), seed)
    if not isinstance(machine, Problem):
        raise PlannerError(f"parity() was given {short_repr(machine)}, expected a Mechanism or a Problem.")
    twin = twin or machine.twin
    if twin is None:
        if _nothing_to_compare(machine):
            return _NOTHING
        raise PlannerError("the problem has no MuJoCo model to be compared with, expected a twin.")
    prescribed = getattr(machine.dynamics, "prescribed", ())
    compiled = another_model(machine, twin, mjcf) if prescribed else CompiledTwin(with_model(twin, mjcf))
    return parity_in(compiled, machine, seed)


def parity_in(compiled: CompiledTwin, problem: Problem, seed: int = 0) -> Section:
    """parity() of a problem in a model that is compiled already; what was compared last is not compared again.

    `planner run` compares before it plans, and the proof asks for the same.
    """
    if _nothing_to_compare(problem):
        return _NOTHING
    last = _last.get(problem)
    if last is not None and last[0] is compiled.twin and last[1] == seed and not compiled.is_changed:
        return last[2]
    smooth = _smooth_parity(compiled, problem, seed)
    section = replace(smooth, measured=(*smooth.measured, *contact_parity(problem, compiled, seed)))
    if not compiled.is_changed:
        _last[problem] = compiled.twin, seed, section
    return section


def _smooth_parity(compiled: CompiledTwin, problem: Problem, seed: int) -> Section:
    """Parity of everything but contacts and stops."""
    requirements, dynamics = problem.requirements, problem.dynamics
    mechanism, prescribed = getattr(dynamics, "mechanism", None), getattr(dynamics, "prescribed", ())
    if requirements is not None and requirements.rates is not None:
        return _of_rates(problem, requirements, compiled, seed)
    assert isinstance(mechanism, Mechanism)  # else there is nothing to compare
    if not prescribed:
        return _of_mechanism(mechanism, dynamics, compiled, seed)
    model = compiled.copy()
    with curves_acting(compiled.twin, model):
        return driven_parity(mechanism, prescribed, model, STATES, BOUND, seed)


def _nothing_to_compare(problem: Problem) -> bool:
    mechanism, requirements = getattr(problem.dynamics, "mechanism", None), problem.requirements
    return not isinstance(mechanism, Mechanism) and (requirements is None or requirements.rates is None)


def _of_mechanism(mechanism: Mechanism, dynamics: Any, compiled: CompiledTwin, seed: int) -> Section:
    model = compiled.copy()
    with curves_acting(compiled.twin, model):
        smooth = rigid_parity(mechanism, model, dynamics, STATES, BOUND, seed)
    friction = friction_parity(mechanism, compiled.copy(), STATES, BOUND, seed)
    return replace(smooth, measured=(*smooth.measured, *friction))


def _of_rates(problem: Problem, requirements: Requirements, compiled: CompiledTwin, seed: int) -> Section:
    """Parity of dx/dt at the states that the problem's requirements name."""
    mujoco = load_mujoco()
    compiled.check(problem.dynamics.nu)
    twin, model = compiled.twin, compiled.model
    data = mujoco.MjData(model)
    assert requirements.equal_states is not None  # a case gives both
    assert requirements.rates is not None
    rng = np.random.default_rng(seed)
    ws = requirements.equal_states(rng, STATES)
    us = rng.normal(size=(STATES, problem.dynamics.nu))
    ours = requirements.rates(twin.x_of(ws), us)
    theirs = np.empty_like(ours)
    for i, w in enumerate(ws):
        set_state(model, data, w)
        data.ctrl[:] = us[i]
        with curves_acting(twin, model):
            mujoco.mj_forward(model, data)
        theirs[i] = twin.to_x @ np.concatenate([data.qvel, data.qacc, data.act_dot])
    error = np.abs(theirs - ours).max(axis=0) / np.maximum(np.abs(ours).max(axis=0), 1e-300)
    note = f"dx/dt at {STATES} random states (seed {seed}), relative to the largest"
    measured = (Measurement("rate_error", float(error.max()), "", BOUND, note),)
    start = (_start(problem, twin, model, requirements.start),) if requirements.start else ()
    return Section("parity", (*measured, *start))


def _start(problem: Problem, twin: Twin, model: Any, name: str) -> Measurement:
    """Whether a keyframe of the model is the plan's own start."""
    note = f"keyframe {name!r} of the model against the plan's start, largest component"
    key = next((k for k in range(model.nkey) if model.key(k).name == name), None)
    if key is None:
        return Measurement("start_error", np.inf, "", BOUND, note)
    w = np.concatenate([model.key_qpos[key], model.key_qvel[key], model.key_act[key]])
    error = float(np.max(np.abs(w - twin.sim_of(problem.x0))))
    return Measurement("start_error", error, "", BOUND, note)
