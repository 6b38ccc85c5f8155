"""Find how slowly a plan's gains may act: its replay at 500 Hz, at half of that, and so on, until one does not pass."""

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

    sampling: Sampling  # When the gains acted
    passed: bool  # Whether the replay passed
    largest_error: np.ndarray  # (ndx,) the largest deviation from the plan over the path; NaN after a runaway


@dataclass(frozen=True, eq=False)
class FeedbackRates:
    """The rates that were tried, each half of the one before, and once a stage."""

    tried: tuple[FeedbackRateTrial, ...]  # The last one may be one that did not pass
    once_a_stage: FeedbackRateTrial

    @property
    def slowest(self) -> Sampling | None:
        """The slowest of `tried` that passes, as all faster ones do; None where the first does not."""
        passed = [one.sampling for one in self.tried if one.passed]
        return passed[-1] if passed else None


def controller_section(rates: FeedbackRates, encoded: Replay) -> Section:
    """The rates that pass and the errors with encoders, shown."""
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


def slowest_rate(plan: Plan, compiled: CompiledTwin, passes: Callable[[Replay], bool]) -> FeedbackRates:
    """Replay a plan at half the rate again and again, from that of a proof on, until a replay does not pass.

    It ends after ten rates, or where the period is half of the motion. `passes` judges a replay.

    Raises:
        PlannerError: The plan cannot be simulated.
    """
    problem, sampling = problem_of(plan), sampling_of(plan)

    def at(sampling: Sampling) -> FeedbackRateTrial:
        run = replay_in(compiled, plan, feedback=True, sampling=sampling)
        return FeedbackRateTrial(sampling, bool(passes(run)), np.abs(run.error).max(axis=0))

    tried = [at(sampling)]
    while tried[-1].passed and len(tried) < _LEVELS and 4.0 * sampling.period <= problem.duration:
        sampling = replace(sampling, period=2.0 * sampling.period)
        tried.append(at(sampling))
    known = [one for one in tried if np.isclose(one.sampling.period, problem.dynamics.dt, rtol=1e-9)]
    return FeedbackRates(tuple(tried), known[0] if known else at(Sampling(problem.dynamics.dt)))
