"""The plan in the user's file at the file's own timestep and integrator, as the user's own simulation would run it.

The other replays take RK4 at a refined step, so that they judge the plan and not a simulator's step. Here the controls
are those of the stage at each time, and the gains act on the exact state at 500 Hz, or at every step of a coarser file.
Shown, never judged: an error beyond the bounds of the path, or an unmet goal, is said in a line below the verdict.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from decimal import ROUND_CEILING, Context

import numpy as np

from planner.base.gl import load_mujoco
from planner.base.measured import Measurement
from planner.problem.goals import GoalCheck
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.proof.error_scales import is_path_judged, worst_by_unit
from planner.proof.replay_errors import misses
from planner.proof.replays.compiled_twin import CompiledTwin
from planner.proof.replays.passive_torque_callback import curves_acting
from planner.proof.replays.replaying import Replay
from planner.proof.replays.sampled_gains import PERIOD
from planner.proof.replays.simulation import MAX_STEPS, simulate

NAME = "own_step_errors"
_ROUNDING = 1e-9  # of a stage or step
_WRITTEN = {"EULER": "Euler", "RK4": "RK4", "IMPLICIT": "implicit", "IMPLICITFAST": "implicitfast"}  # in a file


def own_step(plan: Plan, problem: Problem, run: Replay, goals: Sequence[GoalCheck]) -> list[Measurement]:
    """Errors at the file's own step, open loop and with gains, where that is not the step of a replay `run` in it.

    The first measurement counts the modes in which something is beyond its bound; its note says so, and by which option
    the file repeats the replay `run`.
    """
    compiled, dt = run.compiled, problem.dynamics.dt
    h = float(compiled.model.opt.timestep)
    M = math.ceil(plan.N * dt / h - _ROUNDING)
    integrator = load_mujoco().mjtIntegrator(compiled.model.opt.integrator).name.removeprefix("mjINT_")
    step = f"{h:.3g} s {_WRITTEN[integrator]}"
    if integrator == run.integrator and abs(h - run.timestep) <= _ROUNDING * h:
        return [Measurement(NAME, 0.0, "", None, f"none beside the above: your file's own step is {step}, too")]
    if M > MAX_STEPS:
        return [Measurement(NAME, 0.0, "", None, f"not simulated: {M} steps of {step}")]
    t = h * np.arange(M + 1)
    stage = np.minimum(np.floor(t / dt + _ROUNDING).astype(int), plan.N - 1)
    planned = _planned(plan, problem, t, stage)
    with_gains, open_loop = (
        _errors(plan, problem, _states(plan, compiled, integrator, t, stage, planned, gains), planned, t, goals)
        for gains in (True, False)
    )
    how = {"with gains": with_gains, "open loop": open_loop}
    bad = {mode: text for mode, (_, text) in how.items() if text}
    said = " and ".join(f"{mode} {text}" for mode, text in bad.items())
    said += "".join(f", not {mode}" for mode in how if bad and mode not in bad)
    note = (
        f"at your file's own step {step}: {said}; {_judged_by(run)}" if bad else f"none, at your file's own step {step}"
    )
    return [
        Measurement(NAME, float(len(bad)), "", None, note),
        *(
            Measurement(f"own_step_{mode.replace(' ', '_')}_{one.word}_error", one.value, one.unit, None,
                        f"of {one.name} from the plan, at any step of {step}, {mode}")
            for mode, (errors, _) in how.items() for one in errors
        ),
    ]  # fmt: skip


def _judged_by(run: Replay) -> str:
    """How the replay that was judged was simulated; MuJoCo's integrators as the file has them."""
    if run.integrator not in _WRITTEN:
        return f"it was judged at a step of {run.timestep:.3g} s"
    # up: a replay's steps are at most as long as the file's, and a step shorter by a digit would take one step more
    written = float(Context(prec=12, rounding=ROUND_CEILING).create_decimal(f"{run.timestep:.15g}"))
    option = f'`<option timestep="{written:.12g}" integrator="{_WRITTEN[run.integrator]}"/>`'
    return f"your file repeats it with {option}, by which it was judged"


def _planned(plan: Plan, problem: Problem, t: np.ndarray, stage: np.ndarray) -> np.ndarray:
    """(M+1, nx) the plan's states at times t (M+1,), by its own integrator over a part of a stage."""
    dt, end = problem.dynamics.dt, plan.N * problem.dynamics.dt
    knot = np.minimum(np.round(t / dt).astype(int), plan.N)
    at_knot = (np.abs(t - knot * dt) <= _ROUNDING * dt) | (t >= end)
    states = plan.xs[knot].copy()
    if not np.all(at_knot):
        n = stage[~at_knot]
        states[~at_knot] = problem.dynamics.step(plan.xs[n], plan.us[n], t[~at_knot] - n * dt)
    return states


def _states(
    plan: Plan, compiled: CompiledTwin, integrator: str, t: np.ndarray, stage: np.ndarray, planned: np.ndarray,
    gains: bool,
) -> np.ndarray:  # fmt: skip
    """(M+1, nx) simulated states."""
    model, twin = compiled.stepping(float(t[1]), integrator), compiled.twin
    each = max(1, round(PERIOD / float(t[1])))

    def corrected(i: int, w: np.ndarray) -> np.ndarray:
        x, n = twin.x_of(w), stage[i : min(i + each, len(t) - 1)]
        correction = plan.K[n[0]] @ plan.space.single_difference(x, planned[i])
        return compiled.commands(plan.within_bounds(n, plan.us[n] + correction))

    ctrl = compiled.commands(plan.us[stage[:-1]])
    with curves_acting(twin, model):
        w, _ = simulate(
            model, twin.sim_of(planned[0]), ctrl, control=corrected if gains else None, held=each, every=50
        )  # fmt: skip
    return twin.x_of(w)


def _errors(
    plan: Plan, problem: Problem, xs: np.ndarray, planned: np.ndarray, t: np.ndarray, goals: Sequence[GoalCheck]
) -> tuple[list, str]:
    """The largest error of each unit along the path, and a phrase about what is beyond its bound; "" for nothing."""
    errors = list(worst_by_unit(plan, plan.space.difference(xs, planned)))
    if problem.requirements is not None:
        return errors, ""  # a rule of its own judges replays alone
    judged = [one for one in errors if is_path_judged(plan, one.unit)]
    unmet = [one for one in misses("replayed", t, xs, tuple(goals)) if not one.passed]
    worst = max(judged, key=lambda one: one.share)
    if worst.share > 1.0:
        far = np.isfinite(worst.value)
        return errors, f"{worst.value:.2g} {worst.unit or 'in its unit'} off" if far else "the motion runs away"
    return errors, f"{unmet[0].value:.2g} {unmet[0].unit or 'in its unit'} from a goal" if unmet else ""
