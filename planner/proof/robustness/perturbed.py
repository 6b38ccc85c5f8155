"""Step 5 of a proof: the success rate of a plan on perturbed machines.

Seeded Monte Carlo in MuJoCo, with the plan's gains and open loop: masses, friction, start, controls and their delay
have the errors of a Perturbation. Increasing errors of the masses alone give the margin. The rate with gains becomes a
word, "robust" or "fragile"; no verdict depends on it. One rollout can be replayed step by step, to be rendered.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from planner.base.arguments import count, number
from planner.base.data_files import finite
from planner.base.gl import load_mujoco
from planner.base.measured import Measurement, Section
from planner.problem.plan import Plan
from planner.proof.replays.compiled_twin import CompiledTwin
from planner.proof.replays.contact_history import ContactRecorder
from planner.proof.replays.ranges import ranges_reached
from planner.proof.replays.replaying import Replay
from planner.proof.replays.simulation import RUNAWAY, set_state, state_of, warnings_of
from planner.proof.robustness.monte_carlo import MonteCarlo
from planner.proof.robustness.perturbation import Perturbation, draw
from planner.proof.robustness.rollouts import CLOCK, MODES, OutOfTime, Rollouts
from planner.proof.robustness.success import SuccessRate, SuccessRule, end_errors, rule_of

PERCENTILES = (5, 25, 50, 75, 95)
JUDGED = " with its gains"  # the rate with gains is judged: a plan may be robust with them and never succeed open loop
_HOW = {"open-loop": "open loop", "feedback": "with gains", CLOCK: "with gains by the clock alone"}
_WORST = 5
_PIECES = 6  # minimum number of batches within a budget, by the estimated time


@dataclass(frozen=True, eq=False)
class RobustnessResult:
    """Results of a Monte Carlo. Modes are "open-loop" and "feedback".

    Of a plan whose stage waits for touch-downs also "clock", fewer rollouts with gains whose stage does not.
    """

    perturbation: Perturbation  # The errors that were drawn
    seed: int  # Of the random numbers
    asked: int  # Maximum number of rollouts in each mode
    done: int  # Rollouts with gains: as many as decide their rate; open loop the same, unless the budget ends
    step: float  # The simulator's step, s
    control_step: float  # Period of the feedback, s
    tolerance: float  # Largest end error that succeeds; NaN where another rule decides
    # Per mode (done,), the largest component of the end state's deviation from the plan's, each over the coordinate's
    # range of motion; infinite for a simulation that exploded.
    end_error: dict[str, np.ndarray]
    success: dict[str, np.ndarray]  # Per mode (done,), whether the rollout counts as one
    # Per mode, the largest mass error, relative, at which and below which 95 % succeed; NaN if not known.
    margin: dict[str, float]
    per_level: int  # Rollouts of each mass error behind the margin
    t: np.ndarray  # (T,) s, all knots of the plan, of a long one at most 201
    # Per mode (5, T, ndx), percentiles 5, 25, 50, 75 and 95 of the deviations from the plan, over the rollouts that had
    # not exploded by then.
    fans: dict[str, np.ndarray]
    rule: str = ""  # The success rule, in words
    notes: tuple[str, ...] = ()  # Remarks on how the rollouts were run, one sentence each

    @property
    def rates(self) -> dict[str, SuccessRate]:
        """Per mode, how many succeeded of how many."""
        return {mode: SuccessRate(int(good.sum()), len(good)) for mode, good in self.success.items()}

    @property
    def robustness(self) -> str:
        """The word "robust", "fragile" or, with too few rollouts, "undecided": see robustness.success.

        Of the rate with gains and the perturbation that was drawn.
        """
        return self.rates["feedback"].word

    @property
    def worst(self) -> dict[str, tuple[int, ...]]:
        """Per mode, the numbers of the rollouts with the largest end errors, largest first: see replay_rollout."""
        worst_first = {mode: np.argsort(-error, kind="stable") for mode, error in self.end_error.items()}
        return {mode: tuple(map(int, ks[:_WORST])) for mode, ks in worst_first.items()}

    @property
    def section(self) -> Section:
        """The measured, without bounds."""
        if not self.done:
            return Section("robustness", not_applicable=" ".join(self.notes) or "no rollout was run")
        varied = " ".join((f"varied: {self.perturbation}.", *self.notes))
        measured = [Measurement("rollouts", float(self.done), "", None, varied)]
        for mode, rate in self.rates.items():
            name = mode.replace("-", "_")
            median = float(np.median(self.end_error[mode])) if rate.of else math.nan
            measured += [
                Measurement(f"{name}_success_rate", 100.0 * rate.value, "%", None, f"{rate} (Wilson), {self.rule}"),
                Measurement(
                    f"{name}_median_end_error", 100.0 * median, "%", None, "largest, of the coordinate's range"
                ),
            ]
            if math.isfinite(self.margin.get(mode, math.nan)):
                note = f"largest error of every body's mass at which 95 % of {self.per_level} succeed, by bisection"
                measured.append(Measurement(f"{name}_mass_margin", 100.0 * self.margin[mode], "%", None, note))
        return Section("robustness", tuple(measured))

    def lines(self) -> list[str]:
        """The rates with their intervals, and the rollouts with the largest end errors."""
        lines = [f"robustness: {note}" for note in self.notes]
        word = self.robustness
        lines += [f"robustness: {word}{'' if word == 'undecided' else JUDGED}"] if self.done else []
        for mode, rate in self.rates.items() if self.done else ():
            if mode == CLOCK and not rate.of:
                continue
            worst = ", ".join(map(str, self.worst[mode]))
            how = _HOW[mode]
            found = f"{rate} succeed" if rate.of else "not simulated"
            found += f"; farthest off (--replay-rollout): {worst}" if rate.of and mode != CLOCK else ""
            lines.append(f"robustness, {how}: {found}")
        return lines

    def to_dict(self) -> dict[str, Any]:
        """All but the percentiles over time as JSON values; non-finite values become null."""
        return {
            "perturbation": self.perturbation.to_dict(), "seed": self.seed,
            "rollouts": {"asked": self.asked, "done": self.done}, "timestep": self.step,
            "control_step": self.control_step, "tolerance": finite(self.tolerance), "rule": self.rule,
            "robustness": self.robustness, "notes": list(self.notes),
            "modes": {
                mode: {
                    "success": rate.to_dict(), "worst": list(self.worst[mode]),
                    "mass_margin": finite(self.margin.get(mode, math.nan)),
                    "end_error": finite([float(error) for error in self.end_error[mode]]),
                }
                for mode, rate in self.rates.items()
            },
        }  # fmt: skip


@dataclass(frozen=True)
class MonteCarloSettings:
    """Number, seed and perturbation of a Monte Carlo, and its success rule."""

    rollouts: int = 512  # Maximum number in each mode; rollout k is the same for any number
    seed: int = 0  # Of the random numbers, at least 0
    perturbation: Perturbation | None = None  # The errors drawn; None for Perturbation.usual() of the plan's problem
    rule: SuccessRule | None = None  # Success rule; None for planner.proof.robustness.success.rule_of() the plan

    def __post_init__(self) -> None:
        count("rollouts", self.rollouts)
        count("seed", self.seed, minimum=0)


def perturbed(
    plan: Plan, compiled: CompiledTwin, trials: MonteCarloSettings | None = None, *, budget: float | None = None,
    partial: Path | None = None, progress: Callable[[int, int], object] | None = None, threads: int | None = None,
    executor: Executor | None = None,
) -> RobustnessResult:  # fmt: skip
    """Simulate a plan many times with errors drawn at random, with its gains and open loop.

    Rollouts are drawn until the 95 % interval of their rate of success with gains is within 7 %, or below 80 %, at most
    as many as the trials say. After a budget (s) it ends with what is finished. An .npz `partial` keeps finished
    rollouts: those of this plan, seed and perturbation are not run again. `progress` is called with the simulations
    finished and the most that all may be, those behind the margin included. Without an executor they run on MuJoCo's
    threads. No result depends on the number of threads or workers.
    """
    trials = trials or MonteCarloSettings()
    perturbation = trials.perturbation or Perturbation.usual(plan.problem)
    deadline = math.inf if budget is None else time.monotonic() + number("budget", budget, greater_than=0.0)
    notes = []
    with Rollouts(plan, compiled, threads) as simulator:
        if perturbation.friction and simulator.nominal.ignores_friction:
            notes.append("Dry friction does nothing here: the model's flags switch it off.")
        monte_carlo = MonteCarlo(
            simulator, trials.rule or rule_of(plan), perturbation, trials.seed, trials.rollouts,
            partial=None if partial is None else Path(partial), deadline=deadline, progress=progress, executor=executor,
            most_at_once=None if budget is None else max(4, int(budget / _PIECES / simulator.seconds)),
        )  # fmt: skip
        try:
            monte_carlo.run()
            if monte_carlo.done < trials.rollouts:
                asked = f"{trials.rollouts} rollouts were asked for"
                notes.append(f"{asked}, {monte_carlo.done} were run: by then the rate with gains is decided.")
        except OutOfTime:
            notes.append(f"Stopped after {budget:g} s: how many rollouts there are depends on this computer.")
        return _result(monte_carlo, trials, perturbation, tuple(notes))


def _result(
    monte_carlo: MonteCarlo, trials: MonteCarloSettings, perturbation: Perturbation, notes: tuple[str, ...]
) -> RobustnessResult:
    """What is known of the rollouts that count."""
    simulator, rule = monte_carlo.simulator, monte_carlo.rule
    modes = (*MODES, CLOCK) if simulator.plan.touch_downs else MODES
    return RobustnessResult(
        perturbation=perturbation, seed=trials.seed, asked=trials.rollouts, done=monte_carlo.done, step=simulator.step,
        control_step=simulator.control_step, tolerance=rule.most,
        end_error={mode: end_errors(simulator.plan, monte_carlo.ends(mode)) for mode in modes},
        success={mode: monte_carlo.succeeded(mode) for mode in modes},
        margin={mode: monte_carlo.margin[mode] for mode in MODES},
        per_level=monte_carlo.per_level, t=simulator.plan.t[simulator.knots],
        fans={mode: _percentiles(monte_carlo.deviations(mode)) for mode in MODES}, rule=rule.words, notes=notes,
    )  # fmt: skip


def _percentiles(deviations: np.ndarray) -> np.ndarray:
    """(5, T, ndx) percentiles of deviations (K, T, ndx); NaN where no rollout is finite."""
    alive = np.logical_and.reduce(np.isfinite(deviations), axis=2)
    if alive.size and alive.all():
        return np.percentile(deviations, PERCENTILES, axis=0)
    result = np.full((len(PERCENTILES), *deviations.shape[1:]), np.nan)
    for t in np.flatnonzero(alive.any(axis=0)):
        result[:, t] = np.percentile(deviations[alive[:, t], t], PERCENTILES, axis=0)
    return result


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
        data = mujoco.MjData(model)
        complaints: np.ndarray = data.warning.number  # a view: to count warning by warning takes longer than a step
        before = complaints.tolist()
        w, ctrl = np.full((M + 1, batch.start.shape[1]), np.nan), np.zeros((M, model.nu))
        recorder = ContactRecorder(model, M)
        w[0] = batch.start[0]
        set_state(model, data, w[0])
        with rollouts.curves(batch, [data, rollouts.sensing]):
            for i in range(M):
                if i % piece == 0:
                    n, before = min(piece, M - i), complaints.tolist()
                    with np.errstate(all="ignore"):  # of a diverging rollout
                        ctrl[i : i + n] = commands(i, n, w[i : i + 1])[0]
                    data.qacc_warmstart[:] = 0.0  # as in every segment of the Monte Carlo
                    if not np.all(np.abs(ctrl[i : i + n]) < RUNAWAY):
                        break
                data.ctrl[:] = ctrl[i]
                recorder.step(i, data)
                w[i + 1] = state_of(data)
                stopped = before != complaints.tolist() and (i + 1) % piece and i + 1 < M  # by mujoco.rollout
                if stopped or not rollouts.in_time(data.time, i + 1) or not np.all(np.abs(w[i + 1]) < RUNAWAY):
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
