"""The order in which the rollouts of a Monte Carlo are run, and what is known after each.

    1  with gains, until the rate of success is settled (planner.proof.robustness.success_rate)
    2  open loop, the same machines
    3  the mass margins, by bisection over the levels

So the word about robustness comes first. Whatever is finished is in the store, and is not run again.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import Executor
from pathlib import Path

import numpy as np

from planner.proof.robustness.batches import Batches
from planner.proof.robustness.levels import largest_survived
from planner.proof.robustness.perturbation import Perturbation, PerturbationSample, draw, draw_masses
from planner.proof.robustness.rollout_checkpoint import RolloutCheckpoint, fingerprint
from planner.proof.robustness.rollouts import MODES, Rollouts
from planner.proof.robustness.success_rate import LOOKS, enough, next_look
from planner.proof.robustness.success_rule import SuccessRule

ENOUGH = 0.95  # of the rollouts must succeed for a mass error to be within the margin
LEVELS = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5)  # mass errors, relative
_PER_LEVEL = 20  # the fewest of which 95 % is a number other than all
_QUICK = 5  # rollouts of a level where not even the first look is asked for
_MAX_LEVELS = 4  # that a bisection of nine asks for


class MonteCarlo:
    """The rollouts of one plan, with one perturbation and seed."""

    def __init__(
        self, simulator: Rollouts, rule: SuccessRule, perturbation: Perturbation, seed: int, asked: int, *,
        partial: Path | None = None, most_at_once: int | None = None, deadline: float = math.inf,
        progress: Callable[[int, int], object] | None = None, executor: Executor | None = None,
    ) -> None:  # fmt: skip
        self.simulator, self.rule, self.asked = simulator, rule, asked
        self.per_level = _PER_LEVEL if asked >= LOOKS[0] else _QUICK
        self.margin = dict.fromkeys(MODES, math.nan)  # see Perturbed
        self._perturbation, self._seed, self._deadline, self._progress = perturbation, seed, deadline, progress
        self._batches = Batches(simulator, min(simulator.batch_size, most_at_once or simulator.batch_size), executor)
        self._store = RolloutCheckpoint(partial, fingerprint(simulator, perturbation, seed))
        self._finished = self._total = 0  # simulations run here, and how many these and those to come are at most

    def run(self) -> None:
        """Run what is missing; OutOfTime after the deadline."""
        margins = len(MODES) * _MAX_LEVELS * self.per_level
        while (look := next_look(won := self._won("cases", "feedback"), self.asked)) is not None:
            look = max(look, min(len(won) + self._batches.together, self.asked))  # those beyond a look may not count
            self._extend("cases", "feedback", look, self._case, to_come=2 * self.asked - look + margins)
        self._extend("cases", "open-loop", self.done, self._case, to_come=margins)
        for mode in MODES[::-1]:
            margins -= _MAX_LEVELS * self.per_level
            self.margin[mode] = self._margin(mode, margins)
        if self._progress is not None and self._finished < self._total:  # bisections took less than was expected
            self._progress(self._finished, self._finished)

    @property
    def done(self) -> int:
        """Number of machines that were run with gains, and count."""
        return enough(self._won("cases", "feedback"), self.asked)

    def ends(self, mode: str) -> np.ndarray:
        """(K, nx) the ends that count."""
        found = self._store.arrays.get(f"cases {mode} end", np.empty((0, self.simulator.plan.xs.shape[1])))
        return found[: self.done]

    def won(self, mode: str) -> np.ndarray:
        """(K,) which of these succeed."""
        return self._won("cases", mode)[: self.done]

    def deviations(self, mode: str) -> np.ndarray:
        """(K, T, ndx) deviations from the plan at the kept knots."""
        nothing = np.empty((0, len(self.simulator.knots), self.simulator.plan.space.ndx))
        return self._store.arrays.get(f"cases {mode} deviation", nothing)[: self.done]

    def _case(self, k: int) -> PerturbationSample:
        return draw(self._perturbation, self._seed, k, self.simulator.nominal.sizes)

    def _margin(self, mode: str, others: int) -> float:
        """The largest level at which enough succeed, as if they did at all below; `others` are still to come."""
        sizes, left = self.simulator.nominal.sizes, _MAX_LEVELS * self.per_level

        def survives(level: int) -> bool:
            nonlocal left
            left -= self.per_level
            part, least = f"level {level}", self.per_level
            self._extend(
                part, mode, least, lambda k: draw_masses(LEVELS[level], self._seed, level, k, sizes), left + others
            )
            return bool(self._won(part, mode)[:least].mean() >= ENOUGH)

        most = largest_survived(len(LEVELS), survives)
        return LEVELS[most] if most >= 0 else 0.0

    def _won(self, part: str, mode: str) -> np.ndarray:
        """(K,) the successes among all the store has of a part."""
        if self.rule.follows is not None:
            return self._store.arrays.get(f"{part} {mode} won", np.empty(0, dtype=bool))
        ends = self._store.arrays.get(f"{part} {mode} end")
        return np.empty(0, dtype=bool) if ends is None else self.rule.succeeded(ends)

    def _extend(
        self, part: str, mode: str, wanted: int, draw_one: Callable[[int], PerturbationSample], to_come: int
    ) -> None:
        """Run the rollouts of a part that the store does not have, in batches; at most `to_come` are left after it."""
        simulator, plan = self.simulator, self.simulator.plan
        done = len(self._store.arrays.get(f"{part} {mode} end", ()))
        draws = [draw_one(k) for k in range(done, wanted)]
        for xs in self._batches.run(draws, mode, self._deadline):
            more = {"end": xs[:, -1]}
            if self.rule.follows is not None:
                more["won"] = self.rule.followed(xs, plan.xs[simulator.knots], simulator.knots)
            if part == "cases":  # in single precision: for plots
                with np.errstate(all="ignore"):  # of what has exploded
                    more["deviation"] = plan.space.difference(xs, plan.xs[simulator.knots]).astype(np.float32)
            self._store.add(**{f"{part} {mode} {name}": values for name, values in more.items()})
            done += len(xs)
            self._finished += len(xs)
            self._total = self._finished + wanted - done + to_come
            if self._progress is not None:
                self._progress(self._finished, self._total)
