"""One rollout of the Monte Carlo step by step, to be inspected and rendered."""

from __future__ import annotations

import numpy as np

from planner.base.arguments import count
from planner.base.gl import load_mujoco
from planner.problem.plan import Plan
from planner.proof.replays.compiled_twin import CompiledTwin
from planner.proof.replays.contact_history import ContactRecorder
from planner.proof.replays.ranges import ranges_reached
from planner.proof.replays.replaying import Replay
from planner.proof.replays.simulation import RUNAWAY, set_state, state_of, warnings_of
from planner.proof.robustness.perturbation import Perturbation, draw
from planner.proof.robustness.rollouts import MODES, Rollouts


def replay_rollout(
    plan: Plan, compiled: CompiledTwin, k: int, *, seed: int = 0, perturbation: Perturbation | None = None,
    feedback: bool = True,
) -> Replay:  # fmt: skip
    """Rollout k of perturbed() with this seed, by plain mj_step: the same states to the last bit, NaN once it exploded.

    The replay keeps the compiled model, with the errors in its motion alone. The perturbation is by default
    Perturbation.usual(plan.problem).
    """
    k, seed = count("k", k, minimum=0), count("seed", seed, minimum=0)
    mujoco = load_mujoco()
    with Rollouts(plan, compiled, threads=1) as rollouts:
        errors = draw(perturbation or Perturbation.usual(plan.problem), seed, k, rollouts.nominal.sizes)
        batch, M = rollouts.batch([errors]), rollouts.steps
        piece, commands = rollouts.pieces(batch, MODES[feedback])
        model = batch.models[0]
        data, complaints = mujoco.MjData(model), []
        w, ctrl = np.full((M + 1, batch.start.shape[1]), np.nan), np.zeros((M, model.nu))
        recorder = ContactRecorder(model, M)
        w[0] = batch.start[0]
        set_state(model, data, w[0])
        with rollouts.curves(batch, [data]):
            for i in range(M):
                if i % piece == 0:
                    n, complaints = min(piece, M - i), [warning.number for warning in data.warning]
                    with np.errstate(all="ignore"):  # of one about to explode
                        ctrl[i : i + n] = commands(i, n, w[i : i + 1])[0]
                    data.qacc_warmstart[:] = 0.0  # as every segment of the Monte Carlo begins
                elif complaints != [warning.number for warning in data.warning]:  # as mujoco.rollout gives it up
                    w[i] = np.nan
                    break
                data.ctrl[:] = ctrl[i]
                recorder.step(i, data)
                w[i + 1] = state_of(data)
                if not np.all(np.abs(w[i + 1]) < RUNAWAY):
                    w[i + 1] = np.nan
                    break
            warnings = warnings_of(data)
            if np.isfinite(w[M]).all():
                recorder.look(M, data)
        t = rollouts.step * np.arange(M + 1)
        qpos, qvel, act = np.split(w, [model.nq, model.nq + model.nv], axis=1)
        substeps = rollouts.control_steps * rollouts.substeps
        return Replay(
            plan=plan, compiled=compiled, feedback=feedback, integrator=rollouts.integrator, t=t, qpos=qpos, qvel=qvel,
            act=act, ctrl=ctrl, xs=rollouts.x_of(w), plan_xs=plan.between_knots(substeps), contact_force=recorder.force,
            contact_point=recorder.point, substeps=substeps, warnings=warnings,
            reached=ranges_reached(model, t, w, ctrl), contacts=recorder.history(t),
        )  # fmt: skip
