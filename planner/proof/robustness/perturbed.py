"""Step 5 of a proof: how often a plan still succeeds on a machine that differs from the planned one.

Seeded Monte Carlo in MuJoCo, with the plan's gains and open loop: masses, friction, start, controls and their delay are
wrong by what a Perturbation says. Besides, masses alone, wrong by more and more, tell the margin. The rate with gains
becomes a word, "robust" or "fragile"; no verdict depends on it.
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
from planner.base.files import finite
from planner.base.measured import Measurement, Section
from planner.problem.plan import Plan
from planner.proof.replays.compiled_twin import CompiledTwin
from planner.proof.robustness.monte_carlo import MonteCarlo
from planner.proof.robustness.perturbation import Perturbation
from planner.proof.robustness.rollouts import MODES, OutOfTime, Rollouts
from planner.proof.robustness.success_rate import SuccessRate
from planner.proof.robustness.success_rule import SuccessRule, end_errors, rule_of

PERCENTILES = (5, 25, 50, 75, 95)
JUDGED = " with its gains"  # a plan may be robust with them and succeed open loop in no rollout
_WORST = 5
_PIECES = 6  # batches that a budget has time for, if the estimate of their time is right


@dataclass(frozen=True, eq=False)
class RobustnessResult:
    """The findings of a Monte Carlo. Modes are "open-loop" and "feedback"."""

    perturbation: Perturbation  # The errors that were drawn
    seed: int  # Of the random numbers
    asked: int  # Most rollouts in each mode
    done: int  # Rollouts with gains: so many that their rate is settled; open loop as many, but for a budget
    step: float  # The simulator's step, s
    control_step: float  # How often the gains act, s
    tolerance: float  # Largest end error that succeeds; NaN where something else decides
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
    rule: str = ""  # What a rollout does that succeeds
    notes: tuple[str, ...] = ()  # Remarks on how the rollouts were run, one sentence each

    @property
    def rates(self) -> dict[str, SuccessRate]:
        """Per mode, how many succeeded of how many."""
        return {mode: SuccessRate(int(won.sum()), len(won)) for mode, won in self.success.items()}

    @property
    def robustness(self) -> str:
        """The word "robust", "fragile" or, of too few rollouts to know, "counting": see success_rate.

        Of the rate with gains; where other errors than the standard ones were drawn, it is about those.
        """
        return self.rates["feedback"].word

    @property
    def worst(self) -> dict[str, tuple[int, ...]]:
        """Per mode, the numbers of the rollouts that ended farthest off, the worst first: see replay_rollout."""
        order = {mode: np.argsort(-error, kind="stable") for mode, error in self.end_error.items()}
        return {mode: tuple(map(int, ks[:_WORST])) for mode, ks in order.items()}

    @property
    def section(self) -> Section:
        """The measured, without bounds."""
        if not self.done:
            return Section("perturbed", not_applicable=" ".join(self.notes) or "no rollout was run")
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
            if math.isfinite(self.margin[mode]):
                note = f"largest error of every body's mass at which 95 % of {self.per_level} succeed, by bisection"
                measured.append(Measurement(f"{name}_mass_margin", 100.0 * self.margin[mode], "%", None, note))
        return Section("perturbed", tuple(measured))

    def lines(self) -> list[str]:
        """The rates with their intervals, and which rollouts ended farthest off."""
        lines = [f"perturbed: {note}" for note in self.notes]
        word = self.robustness
        lines += [f"robustness: {word}{'' if word == 'counting' else JUDGED}"] if self.done else []
        for mode, rate in self.rates.items() if self.done else ():
            worst = ", ".join(map(str, self.worst[mode]))
            how = "open loop" if mode == "open-loop" else "with gains"
            lines.append(f"perturbed, {how}: {rate} succeed; farthest off (--replay-rollout): {worst}")
        return lines

    def to_dict(self) -> dict[str, Any]:
        """All but the fans as JSON values; what is not finite becomes null."""
        return {
            "perturbation": self.perturbation.to_dict(), "seed": self.seed,
            "rollouts": {"asked": self.asked, "done": self.done}, "timestep": self.step,
            "control_step": self.control_step, "tolerance": finite(self.tolerance), "rule": self.rule,
            "robustness": self.robustness, "notes": list(self.notes),
            "modes": {
                mode: {
                    "success": rate.to_dict(), "worst": list(self.worst[mode]),
                    "mass_margin": finite(self.margin[mode]),
                    "end_error": finite([float(error) for error in self.end_error[mode]]),
                }
                for mode, rate in self.rates.items()
            },
        }  # fmt: skip


@dataclass(frozen=True)
class MonteCarloSettings:
    """The random machines of a Monte Carlo, and which of their motions count as successes."""

    rollouts: int = 512  # Most machines in each mode; the k-th is the same whatever their number
    seed: int = 0  # Of the random numbers, at least 0
    perturbation: Perturbation | None = None  # The errors drawn; None for Perturbation.usual() of the plan's problem
    rule: SuccessRule | None = None  # Which succeed; None for planner.proof.robustness.success_rule.rule_of() the plan

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
        campaign = MonteCarlo(
            simulator, trials.rule or rule_of(plan), perturbation, trials.seed, trials.rollouts,
            partial=None if partial is None else Path(partial), deadline=deadline, progress=progress, executor=executor,
            most_at_once=None if budget is None else max(4, int(budget / _PIECES / simulator.seconds)),
        )  # fmt: skip
        try:
            campaign.run()
            if campaign.done < trials.rollouts:
                asked = f"{trials.rollouts} rollouts were asked for"
                notes.append(f"{asked}, {campaign.done} were run: by then the rate with gains is settled.")
        except OutOfTime:
            notes.append(f"Stopped after {budget:g} s: how many rollouts there are depends on this computer.")
        return _result(campaign, trials, perturbation, tuple(notes))


def _result(
    campaign: MonteCarlo, trials: MonteCarloSettings, perturbation: Perturbation, notes: tuple[str, ...]
) -> RobustnessResult:
    """What is known of the rollouts that count."""
    simulator, rule = campaign.simulator, campaign.rule
    return RobustnessResult(
        perturbation=perturbation, seed=trials.seed, asked=trials.rollouts, done=campaign.done, step=simulator.step,
        control_step=simulator.control_step, tolerance=rule.most,
        end_error={mode: end_errors(simulator.plan, campaign.ends(mode)) for mode in MODES},
        success={mode: campaign.won(mode) for mode in MODES}, margin={mode: campaign.margin[mode] for mode in MODES},
        per_level=campaign.per_level, t=simulator.plan.t[simulator.knots],
        fans={mode: _percentiles(campaign.deviations(mode)) for mode in MODES}, rule=rule.words, notes=notes,
    )  # fmt: skip


def _percentiles(deviations: np.ndarray) -> np.ndarray:
    """(5, T, ndx) of (K, T, ndx); NaN where nothing is left."""
    alive = np.logical_and.reduce(np.isfinite(deviations), axis=2)
    if alive.size and alive.all():
        return np.percentile(deviations, PERCENTILES, axis=0)
    result = np.full((len(PERCENTILES), *deviations.shape[1:]), np.nan)
    for t in np.flatnonzero(alive.any(axis=0)):
        result[:, t] = np.percentile(deviations[alive[:, t], t], PERCENTILES, axis=0)
    return result
