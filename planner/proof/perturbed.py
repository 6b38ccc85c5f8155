"""Step 5 of a proof: how often a plan still succeeds on a machine that differs from the planned one.

Seeded Monte Carlo in MuJoCo, open loop and with the plan's gains: masses, friction, start, controls and their delay are
wrong by what a Perturbation says. Besides, masses alone, wrong by more and more, tell the margin. The measured are not
judged: what rate is enough is the user's to say.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from planner.base.arguments import count, number
from planner.base.jsonable import finite
from planner.base.measured import Measured, Section
from planner.problem.plan import Plan
from planner.proof.compiled_twin import CompiledTwin
from planner.proof.partial import Partial, fingerprint
from planner.proof.perturbation import Draw, Perturbation, draw, draw_masses
from planner.proof.rollouts import MODES, OutOfTime, Rollouts
from planner.proof.success_rate import Rate

TOLERANCE = 0.1  # of the end state, largest component: rad, m, rad/s, m/s
ENOUGH = 0.95  # of the rollouts must succeed for a mass error to be within the margin
LEVELS = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5)  # mass errors, relative
PERCENTILES = (5, 25, 50, 75, 95)
_WORST = 5
_PER_LEVEL = 20  # the fewest of which 95 % is a number other than all
_SHARE = 20  # rollouts for each of a level of mass errors
_FEWEST = 16  # rollouts, however short the budget
_PIECES = 6  # of which at least one shall be done before a budget ends, on the slowest computer
_USUAL = 0.3  # of the budget is what the estimate may fill, so that its error does not reach the rest


@dataclass(frozen=True, eq=False)
class Perturbed:
    """The findings of a Monte Carlo. Modes are "open-loop" and "feedback"."""

    perturbation: Perturbation  # The errors that were drawn
    seed: int  # Of the random numbers
    asked: int  # Rollouts that were asked for, in each mode
    done: int  # Rollouts that were run; with a budget it may be fewer
    step: float  # The simulator's step, s
    control_step: float  # How often the gains act, s
    tolerance: float  # On the end state, rad, m, rad/s, m/s; NaN where the machine has a rule of its own
    # Per mode (done,), the largest component of the end state's deviation from the plan's; infinite for a simulation
    # that exploded.
    end_error: dict[str, np.ndarray]
    success: dict[str, np.ndarray]  # Per mode (done,), whether the rollout counts as one
    # Per mode, the largest mass error, relative, at which and below which 95 % succeed; NaN if not known.
    margin: dict[str, float]
    per_level: int  # Rollouts of each mass error behind the margin
    t: np.ndarray  # (T,) s, all knots of the plan, of a long one at most 201
    # Per mode (5, T, ndx), percentiles 5, 25, 50, 75 and 95 of the deviations from the plan, over the rollouts that had
    # not exploded by then.
    fans: dict[str, np.ndarray]
    notes: tuple[str, ...] = ()  # Remarks on how the rollouts were run, one sentence each

    @property
    def rates(self) -> dict[str, Rate]:
        """Per mode, how many succeeded of how many."""
        return {mode: Rate(int(won.sum()), len(won)) for mode, won in self.success.items()}

    @property
    def worst(self) -> dict[str, tuple[int, ...]]:
        """Per mode, the numbers of the rollouts that ended farthest off, the worst first: see replay_case."""
        order = {mode: np.argsort(-error, kind="stable") for mode, error in self.end_error.items()}
        return {mode: tuple(map(int, ks[:_WORST])) for mode, ks in order.items()}

    @property
    def section(self) -> Section:
        """The measured, without bounds."""
        if not self.done:
            return Section("perturbed", not_applicable=" ".join(self.notes) or "no rollout was run")
        varied = " ".join((f"varied: {self.perturbation}.", *self.notes))
        rule = f"ends within {self.tolerance:g} of the plan's" if math.isfinite(self.tolerance) else "by its own rule"
        measured = [Measured("rollouts", float(self.done), "", None, varied)]
        for mode, rate in self.rates.items():
            name = mode.replace("-", "_")
            median = float(np.median(self.end_error[mode]))
            measured += [
                Measured(f"{name}_success_rate", 100.0 * rate.value, "%", None, f"{rate} (Wilson), {rule}"),
                Measured(f"{name}_median_end_error", median, "", None, "largest component, rad, m, rad/s, m/s"),
            ]
            if math.isfinite(self.margin[mode]):
                note = f"largest error of every body's mass at which, and below, 95 % of {self.per_level} succeed"
                measured.append(Measured(f"{name}_mass_margin", 100.0 * self.margin[mode], "%", None, note))
        return Section("perturbed", tuple(measured))

    def lines(self) -> list[str]:
        """The rates with their intervals, and which rollouts ended farthest off."""
        lines = [f"perturbed: {note}" for note in self.notes]
        for mode, rate in self.rates.items() if self.done else ():
            worst = ", ".join(map(str, self.worst[mode]))
            how = "open loop" if mode == "open-loop" else "with gains"
            lines.append(f"perturbed, {how}: {rate} succeed; farthest off (--replay-case): {worst}")
        return lines

    def to_dict(self) -> dict[str, Any]:
        """All but the fans as JSON values; what is not finite becomes null."""
        return {
            "perturbation": self.perturbation.to_dict(), "seed": self.seed,
            "rollouts": {"asked": self.asked, "done": self.done}, "timestep": self.step,
            "control_step": self.control_step, "tolerance": finite(self.tolerance), "notes": list(self.notes),
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
class Trials:
    """The random machines of a Monte Carlo, and which of their motions count as successes."""

    rollouts: int = 512  # How many machines, in each mode; the k-th is the same whatever their number
    seed: int = 0  # Of the random numbers, at least 0
    perturbation: Perturbation | None = None  # The errors drawn; None for Perturbation.usual() of the plan's problem
    tolerance: float = TOLERANCE  # Largest component of the end state's deviation from the plan's, rad, m, rad/s, m/s

    def __post_init__(self) -> None:
        count("rollouts", self.rollouts)
        count("seed", self.seed, least=0)
        number("tolerance", self.tolerance, above=0.0)


def perturbed(
    plan: Plan, compiled: CompiledTwin, trials: Trials | None = None, *, budget: float | None = None,
    partial: Path | None = None, progress: Callable[[int, int], object] | None = None, threads: int | None = None,
) -> Perturbed:  # fmt: skip
    """Simulate a plan many times with errors drawn at random, open loop and with its gains.

    A rollout succeeds when it ends near the plan's last state, or as the problem's requirements say. With a budget (s)
    there are fewer rollouts where they would take too long, and an end when it is used up. An .npz `partial` keeps
    finished rollouts: those of this plan, seed and perturbation are not run again. `progress` is called with the
    rollouts finished and all, those behind the margin included. No result depends on the number of threads.
    """
    trials = trials or Trials()
    asked, seed = trials.rollouts, trials.seed
    perturbation = trials.perturbation or Perturbation.usual(plan.problem)
    deadline = math.inf if budget is None else time.monotonic() + number("budget", budget, above=0.0)
    with Rollouts(plan, compiled, threads) as simulator:
        wanted = asked if budget is None else min(asked, _affordable(budget, simulator.seconds))
        per_level = int(np.clip(wanted // _SHARE, 5, _PER_LEVEL))
        notes = [] if wanted == asked else [f"{wanted} rollouts in place of {asked}, to keep within {budget:g} s."]
        if perturbation.friction and simulator.nominal.ignores_friction:
            notes.append("Dry friction does nothing here: the model's flags switch it off.")
        store = Partial(None if partial is None else Path(partial), fingerprint(simulator, perturbation, seed))
        sizes = simulator.nominal.sizes

        def level_draw(k: int) -> Draw:
            repeat, level = divmod(k, len(LEVELS))  # so that more rollouts per level continue the fewer
            return draw_masses(LEVELS[level], seed, level, repeat, sizes)

        parts = {
            "cases": (wanted, lambda k: draw(perturbation, seed, k, sizes)),
            "levels": (per_level * len(LEVELS), level_draw),
        }
        try:
            size = simulator.batch_size if budget is None else _affordable(budget / _PIECES, simulator.seconds, least=4)
            _run(simulator, parts, store, min(size, simulator.batch_size), deadline, progress)
        except OutOfTime:
            notes.append(f"Stopped after {budget:g} s: how many rollouts there are depends on this computer.")
        done = replace(trials, rollouts=wanted, perturbation=perturbation)
        return replace(_result(simulator, store, done, per_level), asked=asked, notes=tuple(notes))


def _affordable(budget: float, seconds: float, least: int = _FEWEST) -> int:
    """Number of rollouts, of `seconds` in each mode, that fit the budget together with those behind the margin."""
    return max(least, int(_USUAL * budget / (len(MODES) * seconds) / (1.0 + len(LEVELS) / _SHARE)))


def _run(
    simulator: Rollouts, parts: dict[str, tuple[int, Callable[[int], Draw]]], store: Partial, size: int,
    deadline: float, progress: Callable[[int, int], object] | None,
) -> None:  # fmt: skip
    """Run the rollouts that the store does not have, in batches of at most `size`, each in both modes."""
    total, before = sum(wanted for wanted, _ in parts.values()), 0
    for name, (wanted, draw_one) in parts.items():
        done = len(store.arrays.get(f"{name}_end", ()))
        while done < wanted:
            batch = simulator.batch([draw_one(k) for k in range(done, min(done + size, wanted))])
            runs = [simulator.run(batch, mode, deadline) for mode in MODES]
            more = {f"{name}_end": np.stack([xs[:, -1] for xs in runs], axis=1)}
            if (follows := _rule(simulator.plan, "follows")) is not None:
                more[f"{name}_won"] = np.stack([_following(simulator, follows, xs) for xs in runs], axis=1)
            if name == "cases":
                more["cases_deviation"] = np.stack([_deviations(simulator, xs) for xs in runs], axis=1)
            store.add(**more)
            done += len(batch.models)
            if progress is not None:
                progress(before + done, total)
        before += wanted


def _following(simulator: Rollouts, follows: Callable[..., np.ndarray], xs: np.ndarray) -> np.ndarray:
    """(K,) successes among states (K, T, nx) at the kept knots; none that has exploded is one."""
    won, sound = np.zeros(len(xs), dtype=bool), np.isfinite(xs).all(axis=(1, 2))
    if sound.any():
        won[sound] = follows(xs[sound], simulator.plan.xs[simulator.knots], simulator.knots)
    return won


def _deviations(simulator: Rollouts, xs: np.ndarray) -> np.ndarray:
    """Deviations (K, T, ndx) of states (K, T, nx) at the kept knots, in single precision: they are for plots."""
    with np.errstate(all="ignore"):  # of what has exploded
        return simulator.plan.space.difference(xs, simulator.plan.xs[simulator.knots]).astype(np.float32)


def _result(simulator: Rollouts, store: Partial, trials: Trials, per_level: int) -> Perturbed:
    """The successes and deviations of as many of the trials as the store has."""
    plan, wanted, tolerance = simulator.plan, trials.rollouts, trials.tolerance
    assert trials.perturbation is not None  # perturbed() has put the usual one there
    nothing = np.empty((0, len(MODES), plan.xs.shape[1]))
    ends = store.arrays.get("cases_end", nothing)[:wanted]
    levels = store.arrays.get("levels_end", nothing)
    per_level = min(per_level, len(levels) // len(LEVELS))
    levels = levels[: per_level * len(LEVELS)]
    deviations = store.arrays.get("cases_deviation", np.empty((0, len(MODES), len(simulator.knots), plan.space.ndx)))
    end_error, success, margin, fans = {}, {}, {}, {}
    for m, mode in enumerate(MODES):
        end_error[mode], success[mode] = _judged(plan, ends[:, m], tolerance)
        _, kept = _judged(plan, levels[:, m], tolerance)
        if _rule(plan, "follows") is not None and len(ends):
            success[mode] = store.arrays["cases_won"][:wanted, m]
            kept = store.arrays["levels_won"][: len(levels), m] if len(levels) else kept
        margin[mode] = _margin(kept.reshape(per_level, len(LEVELS)))
        fans[mode] = _percentiles(deviations[:wanted, m])
    if any(_rule(plan, name) is not None for name in ("success", "follows")):
        tolerance = math.nan
    return Perturbed(
        perturbation=trials.perturbation, seed=trials.seed, asked=wanted, done=len(ends), step=simulator.step,
        control_step=simulator.control_step, tolerance=tolerance, end_error=end_error, success=success, margin=margin,
        per_level=per_level, t=plan.t[simulator.knots], fans=fans,
    )  # fmt: skip


def _rule(plan: Plan, name: str) -> Callable[..., np.ndarray] | None:
    """The machine's own rule of success, by the "success" of ends or by what "follows" the plan; else None."""
    return None if plan.problem is None else getattr(plan.problem.requirements, name, None)


def _judged(plan: Plan, ends: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """End errors (K,) and successes (K,) of end states (K, nx)."""
    sound = np.isfinite(ends).all(axis=1)
    error, won = np.full(len(ends), np.inf), np.zeros(len(ends), dtype=bool)
    error[sound] = np.abs(plan.space.difference(ends[sound], plan.xs[-1])).max(axis=1, initial=0.0)
    own = _rule(plan, "success")
    won[sound] = error[sound] <= tolerance if own is None else own(ends[sound])
    return error, won


def _margin(kept: np.ndarray) -> float:
    """The largest level at which, and at all below, enough of the rollouts (repeats, levels) succeed."""
    if not len(kept):
        return math.nan
    enough = kept.mean(axis=0) >= ENOUGH
    below = int(np.argmin(enough)) if not enough.all() else len(LEVELS)
    return LEVELS[below - 1] if below else 0.0


def _percentiles(deviations: np.ndarray) -> np.ndarray:
    """(5, T, ndx) of (K, T, ndx); NaN where nothing is left."""
    alive = np.logical_and.reduce(np.isfinite(deviations), axis=2)
    if alive.size and alive.all():
        return np.percentile(deviations, PERCENTILES, axis=0)
    result = np.full((len(PERCENTILES), *deviations.shape[1:]), np.nan)
    for t in np.flatnonzero(alive.any(axis=0)):
        result[:, t] = np.percentile(deviations[alive[:, t], t], PERCENTILES, axis=0)
    return result
