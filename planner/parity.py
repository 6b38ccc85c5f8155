"""Step 1 of a proof: the plan's dynamics and MuJoCo's, at random states where the two models are the same."""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.errors import PlannerError
from planner.figures import Figure, Section
from planner.gl import load_mujoco
from planner.problem import Problem
from planner.replay import matching_model
from planner.twin import Twin

STATES = 256
BOUND = 1e-10  # relative; rounding is 1e-13


def parity(problem: Problem, twin: Twin | None = None, seed: int = 0) -> Section:
    """Compare dx/dt of the plan's dynamics with MuJoCo's at random states.

    Args:
        problem: Its requirements name the states; without them the step does not apply.
        twin: Another MuJoCo model in place of the problem's own.
        seed: Of the random states.

    Raises:
        PlannerError: There is no MuJoCo model, or it does not fit.
    """
    requirements = problem.requirements
    if requirements is None:
        return Section("parity", not_applicable="the problem names no states at which the two models are the same")
    mujoco = load_mujoco()
    twin = twin or problem.twin
    if twin is None:
        raise PlannerError("the problem has no MuJoCo model to be compared with, expected a twin.")
    model = matching_model(twin, problem.dynamics.nu)
    data = mujoco.MjData(model)
    nq, nv = model.nq, model.nv
    rng = np.random.default_rng(seed)
    ws = requirements.equal_states(rng, STATES)
    us = rng.normal(size=(STATES, problem.dynamics.nu))
    ours = requirements.rates(twin.x_of(ws), us)
    theirs = np.empty_like(ours)
    for i, w in enumerate(ws):
        data.qpos[:], data.qvel[:], data.act[:] = np.split(w, [nq, nq + nv])
        data.ctrl[:] = us[i]
        mujoco.mj_forward(model, data)
        theirs[i] = twin.to_x @ np.concatenate([data.qvel, data.qacc, data.act_dot])
    error = np.abs(theirs - ours).max(axis=0) / np.maximum(np.abs(ours).max(axis=0), 1e-300)
    note = f"dx/dt at {STATES} random states (seed {seed}), relative to the largest"
    figures = (Figure("rate_error", float(error.max()), "", BOUND, note),)
    return Section("parity", (*figures, _start(problem, twin, model, requirements.start)))


def _start(problem: Problem, twin: Twin, model: Any, name: str) -> Figure:
    """Whether a keyframe of the model is the plan's own start."""
    note = f"keyframe {name!r} of the model against the plan's start, largest component"
    key = next((k for k in range(model.nkey) if model.key(k).name == name), None)
    if key is None:
        return Figure("start_error", np.inf, "", BOUND, note)
    w = np.concatenate([model.key_qpos[key], model.key_qvel[key], model.key_act[key]])
    error = float(np.max(np.abs(w - twin.sim_of(problem.x0))))
    return Figure("start_error", error, "", BOUND, note)
