"""Success of perturbed rollouts: the rule, the success rate with its confidence interval, and the resulting word.

The machine's own rule where its requirements have one, else the problem's goals, else the end of the plan:

    goals       every goal is missed by at most five times its tolerance: a machine that differs from the planned one
                cannot meet the tolerance of the planned one
    periodic    every position, and every velocity that no actuator drives, is off the plan's end by at most five times
                the least default tolerance of a goal: a leg that lands a little early has another velocity
    no goal     every coordinate ends within 10 % of its own range of motion of the plan's end; a coordinate that moves
                little, within 10 % of the largest range of its unit.

The rate is evaluated at fixed numbers of rollouts (LOOKS), so that their number depends on no computer and no batch.
Rollouts end when the interval is tight, or all of it is below the rate required of a robust plan.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from planner.model.capabilities import capabilities_of
from planner.model.coordinates import coordinates_of
from planner.problem.goals import MIN_TOLERANCES, GoalCheck, between, goals_of
from planner.problem.plan import Plan
from planner.proof.error_scales import ranges_of_motion

ROBUST = 0.8  # the lower end of the interval that makes a plan robust
TIGHT = 0.07  # half the width of an interval that is tight enough
# Numbers of rollouts at which the rate is evaluated: 16 successes of 16 are the fewest that are robust, and 160
# rollouts decide every rate.
LOOKS = (16, 32, 64, 96, 128, 160)
_Z = 1.959963984540054  # standard deviations: 95 % of a normal distribution lie within


@dataclass(frozen=True)
class SuccessRate:
    """Successes among rollouts."""

    successes: int  # Number of successes
    of: int  # Number of rollouts

    @property
    def value(self) -> float:
        """The rate, 0 to 1; NaN of nothing."""
        return self.successes / self.of if self.of else math.nan

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson's 95 % interval of the true rate, from 0 to 1 (Wilson 1927)."""
        if self.of == 0:
            return 0.0, 1.0
        p, n, z2 = self.value, self.of, _Z**2
        middle = (p + z2 / (2.0 * n)) / (1.0 + z2 / n)
        half = _Z / (1.0 + z2 / n) * math.sqrt(p * (1.0 - p) / n + z2 / (4.0 * n * n))
        # At the ends the formula is exact, its rounding is not.
        low = 0.0 if self.successes == 0 else middle - half
        return low, 1.0 if self.successes == n else middle + half

    @property
    def is_decided(self) -> bool:
        """Whether more rollouts are unnecessary: the interval is tight, or all of it is below ROBUST."""
        low, high = self.interval
        return 0.5 * (high - low) <= TIGHT or high < ROBUST

    @property
    def word(self) -> str:
        """The word "robust" for a lower end of at least ROBUST; else "fragile" where decided; else "undecided"."""
        if self.interval[0] >= ROBUST:
            return "robust"
        return "fragile" if self.is_decided else "undecided"

    def to_dict(self) -> dict[str, float | int]:
        """As JSON values."""
        low, high = self.interval
        return {"successes": self.successes, "of": self.of, "low": low, "high": high}

    def __str__(self) -> str:
        low, high = self.interval
        return f"{self.successes} of {self.of}, 95 % interval {100.0 * low:.1f} to {100.0 * high:.1f} %"


def next_look(succeeded: np.ndarray, most: int) -> int | None:
    """The next number of rollouts to evaluate, given successes (K,); None if decided, or `most` reached."""
    return next((look for look, decided in _looks(succeeded, most) if not decided), None)


def enough(succeeded: np.ndarray, most: int) -> int:
    """How many of successes (K,) count: up to the look that decided them, at most `most`."""
    return next((look for look, decided in _looks(succeeded, most) if decided), min(len(succeeded), most))


def _looks(succeeded: np.ndarray, most: int) -> Iterator[tuple[int, bool]]:
    """Each evaluated number of rollouts, up to the first that is decided or not reached, and whether it is decided."""
    for look in (*(look for look in LOOKS if look < most), most):
        decided = len(succeeded) >= look and SuccessRate(int(succeeded[:look].sum()), look).is_decided
        if decided or len(succeeded) < look:
            yield look, decided
            return


GOAL_TOLERANCES = 5.0  # multiple of its tolerance by which a perturbed machine may miss a goal
OF_RANGE = 0.1  # of a coordinate's range of motion, where there is no goal
_MIN_RANGE = 0.1  # rad, m, rad/s, m/s: smallest range, of a machine that hardly moves


@dataclass(frozen=True)
class SuccessRule:
    """Which rollouts succeed."""

    words: str
    succeeds: Callable[[np.ndarray], np.ndarray]  # end states (K, nx), all finite -> (K,) bool
    # Used instead where the whole trajectory counts: see planner.problem.problem.Requirements.
    follows: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray] | None = None
    most: float = math.nan  # Largest of end_errors() that succeeds; NaN where another rule decides

    def succeeded(self, ends: np.ndarray) -> np.ndarray:
        """(K,) successes of end states (K, nx); False for diverged ones."""
        sound, succeeded = np.isfinite(ends).all(axis=1), np.zeros(len(ends), dtype=bool)
        if sound.any():
            succeeded[sound] = self.succeeds(ends[sound])
        return succeeded

    def followed(self, xs: np.ndarray, plan_xs: np.ndarray, stages: np.ndarray) -> np.ndarray:
        """(K,) successes of states (K, T, nx) at stages (T,), by the whole trajectory; False for diverged ones."""
        assert self.follows is not None
        succeeded, sound = np.zeros(len(xs), dtype=bool), np.isfinite(xs).all(axis=(1, 2))
        if sound.any():
            succeeded[sound] = self.follows(xs[sound], plan_xs, stages)
        return succeeded


def rule_of(plan: Plan, tolerances: float = GOAL_TOLERANCES) -> SuccessRule:
    """The rule for a plan with its problem, by which a goal may be missed by so many tolerances."""
    own, goals = (None, ()) if plan.problem is None else (plan.problem.requirements, goals_of(plan.problem, plan.xs))
    near = SuccessRule(
        f"ends within {100.0 * OF_RANGE:g} % of each coordinate's range of motion from the plan's end",
        lambda ends: end_errors(plan, ends) <= OF_RANGE, most=OF_RANGE,
    )  # fmt: skip
    if own is not None and own.follows is not None:
        return replace(near, words="by its own rule", follows=own.follows, most=math.nan)
    if own is not None and own.success is not None:
        return SuccessRule("by its own rule", own.success)
    if any(one.times is not None for one in goals):
        return replace(_on_the_way(plan, goals, tolerances), most=math.nan)
    if goals:
        return within_goals(goals, tolerances)
    mechanism = None if plan.problem is None else capabilities_of(plan.problem.dynamics).mechanism
    return near if mechanism is None or plan.problem.periodic is None else _goes_on(plan, tolerances)  # pyright: ignore


def _goes_on(plan: Plan, tolerances: float) -> SuccessRule:
    """The rule of a cycle of a gait, which ends such that it can go on."""
    assert plan.problem is not None  # its caller has asked
    able = capabilities_of(plan.problem.dynamics)
    names = coordinates_of(plan.problem.dynamics)
    nv = len(able.unactuated)
    most, periodic = np.full(len(names), np.inf), plan.problem.periodic
    for i in (*range(nv), *(nv + np.flatnonzero(able.unactuated))):
        if periodic is None or periodic.periodic_mask[i]:
            most[i] = tolerances * MIN_TOLERANCES[names[i].unit]

    def succeeds(ends: np.ndarray) -> np.ndarray:
        return np.all(np.abs(plan.space.difference(ends, plan.xs[-1])) <= most, axis=1)

    return SuccessRule(f"ends within {tolerances:g} tolerances of where the cycle goes on", succeeds)


def _on_the_way(plan: Plan, goals: Sequence[GoalCheck], tolerances: float) -> SuccessRule:
    """The rule of goals at their times; between the stored knots deviations from the plan are interpolated linearly."""
    t, planned = plan.judged_motion

    def follows(xs: np.ndarray, _: np.ndarray, stages: np.ndarray) -> np.ndarray:
        away = plan.space.difference(xs, np.broadcast_to(plan.xs[stages], xs.shape))
        paths = (plan.space.integrate(planned, between(plan.t[stages], one, t)) for one in away)
        return np.array([all(one.miss(t, x) <= tolerances * one.tolerance for one in goals) for x in paths])

    words = f"is within {tolerances:g} tolerances of every goal at its time"
    ends = [one for one in goals if one.times is None]
    return replace(within_goals(ends, tolerances), words=words, follows=follows)


def within_goals(goals: Sequence[GoalCheck], tolerances: float = GOAL_TOLERANCES) -> SuccessRule:
    """Succeed by missing every goal by at most so many times its tolerance."""

    def succeeds(ends: np.ndarray) -> np.ndarray:
        succeeded = np.ones(len(ends), dtype=bool)
        for goal in goals:
            succeeded &= goal.error(ends) <= tolerances * goal.tolerance
        return succeeded

    return SuccessRule(f"ends within {tolerances:g} tolerances of every goal", succeeds)


def end_errors(plan: Plan, ends: np.ndarray) -> np.ndarray:
    """(K,) the largest component of deviations of ends (K, nx) from the plan's, each over its range of motion.

    Infinite for a simulation that exploded.
    """
    sound, errors = np.isfinite(ends).all(axis=1), np.full(len(ends), np.inf)
    ranges = np.maximum(ranges_of_motion(plan), _MIN_RANGE)
    away = np.abs(plan.space.difference(ends[sound], plan.xs[-1])) / ranges
    errors[sound] = away.max(axis=1, initial=0.0)
    return errors
