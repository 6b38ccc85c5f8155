"""Find the lowest feedback rate of a plan's gains: replay at 500 Hz, half of that, and so on, until one fails."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from planner.base.measured import Measurement, Section
from planner.problem.plan import Plan
from planner.proof.error_scales import worst_by_unit
from planner.proof.replays.compiled_twin import CompiledTwin
from planner.proof.replays.replaying import Replay, problem_of, replay_in
from planner.proof.replays.sampled_gains import Sampling, sampling_of

_LEVELS = 10  # 500 Hz to 1 Hz


@dataclass(frozen=True, eq=False)
class FeedbackRateTrial:
    """A replay with the gains at one rate."""

    sampling: Sampling  # When the gains were applied
    passed: bool  # Whether the replay passed


@dataclass(frozen=True, eq=False)
class FeedbackRates:
    """Trials at decreasing feedback rates, each half of the previous one, and at one update per stage."""

    tried: tuple[FeedbackRateTrial, ...]  # Only the last one may have failed
    once_a_stage: FeedbackRateTrial

    @property
    def slowest(self) -> Sampling | None:
        """The lowest of the consecutive rates in `tried` that pass; None where the first fails."""
        passed = [one.sampling for one in self.tried if one.passed]
        return passed[-1] if passed else None


def controller_section(rates: FeedbackRates, encoded: Replay) -> Section:
    """The rates that pass and the errors with encoders; shown, not judged."""
    slowest = rates.slowest
    tried = ", ".join(f"{one.sampling.rate:.4g} Hz {'passes' if one.passed else 'fails'}" for one in rates.tried)
    measured = [
        Measurement("slowest_rate", slowest.rate if slowest else math.inf, "Hz", None, f"one period late; {tried}"),
        Measurement(
            f"once_a_stage_{'passes' if rates.once_a_stage.passed else 'fails'}", rates.once_a_stage.sampling.rate,
            "Hz", None, "gains once a stage, one stage late",
        ),
    ]  # fmt: skip
    for part, along in (("end", encoded.error[-1:]), ("path", encoded.error)):
        for one in worst_by_unit(encoded.plan, along):
            note = f"of {one.name}, with encoders of 17 bits and 1 um, velocities by difference, not filtered"
            measured.append(Measurement(f"encoders_{part}_{one.word}_error", one.value, one.unit, None, note))
    return Section("feedback rate", tuple(measured))


def slowest_rate(
    plan: Plan, compiled: CompiledTwin, passes: Callable[[Replay], bool], planned: np.ndarray | None = None
) -> FeedbackRates:
    """Replay a plan at half the feedback rate again and again, from a proof's rate on, until a replay fails.

    Ends after ten rates, or where the period would exceed half of the duration. `passes` judges a replay, which has no
    contacts; `planned` is as of replay_in().

    Raises:
        PlannerError: The plan cannot be simulated.
    """
    problem, sampling = problem_of(plan), sampling_of(plan)

    def at(sampling: Sampling) -> FeedbackRateTrial:
        run = replay_in(compiled, plan, feedback=True, sampling=sampling, planned=planned, contacts=False)
        return FeedbackRateTrial(sampling, bool(passes(run)))

    tried = [at(sampling)]
    while tried[-1].passed and len(tried) < _LEVELS and 4.0 * sampling.period <= problem.duration:
        sampling = replace(sampling, period=2.0 * sampling.period)
        tried.append(at(sampling))
    known = [one for one in tried if np.isclose(one.sampling.period, problem.dynamics.dt, rtol=1e-9)]
    return FeedbackRates(tuple(tried), known[0] if known else at(Sampling(problem.dynamics.dt)))
