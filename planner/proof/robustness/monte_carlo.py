"""The rollouts of a Monte Carlo: their order, their batches here or on an executor, and a file of finished ones.

    1  with gains, until the success rate is decided (planner.proof.robustness.success)
    2  open loop, the same machines; some with gains by the clock alone, where the plan's stage waits for touch-downs
    3  the mass margins, by bisection over the levels

So the word about robustness is known first. Finished rollouts are stored, and not run again after an interruption.
"""

from __future__ import annotations

import hashlib
import math
import threading
import time
import zipfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from functools import partial
from pathlib import Path
from uuid import uuid4

import numpy as np

from planner.base.executors import ordered_map, width_of
from planner.base.files import file_error, write_atomically
from planner.base.gl import load_mujoco
from planner.problem.plan import Plan
from planner.proof.replays.compiled_twin import CompiledTwin
from planner.proof.robustness.perturbation import Perturbation, PerturbationSample, draw, draw_masses
from planner.proof.robustness.rollouts import CLOCK, MODES, Rollouts
from planner.proof.robustness.success import LOOKS, SuccessRule, enough, next_look

ENOUGH = 0.95  # success rate required at a mass error within the margin
LEVELS = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5)  # mass errors, relative
_PER_LEVEL = 20  # smallest number of rollouts with a 95 % rate below all
_QUICK = 5  # of these, first; all where fewer rollouts than the first look are requested
_BY_CLOCK = 16  # largest number of rollouts by the clock, which are only shown
_MAX_LEVELS = 4  # maximum number of bisection steps over nine levels


class MonteCarlo:
    """The rollouts of one plan, with one perturbation and seed."""

    def __init__(
        self, simulator: Rollouts, rule: SuccessRule, perturbation: Perturbation, seed: int, asked: int, *,
        partial: Path | None = None, most_at_once: int | None = None, deadline: float = math.inf,
        progress: Callable[[int, int], object] | None = None, executor: Executor | None = None,
    ) -> None:  # fmt: skip
        self.simulator, self.rule, self.asked = simulator, rule, asked
        self.per_level = _PER_LEVEL if asked >= LOOKS[0] else _QUICK
        self.margin = dict.fromkeys(MODES, math.nan)  # see RobustnessResult
        self._perturbation, self._seed, self._deadline, self._progress = perturbation, seed, deadline, progress
        self._batches = Batches(simulator, min(simulator.batch_size, most_at_once or simulator.batch_size), executor)
        self._store = RolloutCheckpoint(partial, fingerprint(simulator, perturbation, seed))
        self._finished = self._total = 0  # simulations run here; upper limit of these and the remaining ones

    def run(self) -> None:
        """Run the missing rollouts; OutOfTime after the deadline."""
        margins = len(MODES) * _MAX_LEVELS * self.per_level
        by_clock = min(self.asked, _BY_CLOCK) if self.simulator.plan.touch_downs else 0
        while (look := next_look(known := self._succeeded("cases", "feedback"), self.asked)) is not None:
            look = max(look, min(len(known) + self._batches.together, self.asked))  # those beyond a look may not count
            self._extend("cases", "feedback", look, self._case, to_come=2 * self.asked - look + by_clock + margins)
        self._extend("cases", "open-loop", self.done, self._case, to_come=by_clock + margins)
        self._extend("cases", CLOCK, min(self.done, by_clock), self._case, to_come=margins)
        for mode in MODES[::-1]:
            margins -= _MAX_LEVELS * self.per_level
            self.margin[mode] = self._margin(mode, margins)
        if self._progress is not None and self._finished < self._total:  # bisections took fewer than expected
            self._progress(self._finished, self._finished)

    @property
    def done(self) -> int:
        """Number of rollouts with gains that count."""
        return enough(self._succeeded("cases", "feedback"), self.asked)

    def ends(self, mode: str) -> np.ndarray:
        """(K, nx) end states of the rollouts that count."""
        found = self._store.arrays.get(f"cases {mode} end", np.empty((0, self.simulator.plan.xs.shape[1])))
        return found[: self.done]

    def succeeded(self, mode: str) -> np.ndarray:
        """(K,) whether each of these succeeds."""
        return self._succeeded("cases", mode)[: self.done]

    def deviations(self, mode: str) -> np.ndarray:
        """(K, T, ndx) deviations from the plan at the stored knots."""
        nothing = np.empty((0, len(self.simulator.knots), self.simulator.plan.space.ndx))
        return self._store.arrays.get(f"cases {mode} deviation", nothing)[: self.done]

    def _case(self, k: int) -> PerturbationSample:
        return draw(self._perturbation, self._seed, k, self.simulator.nominal.sizes)

    def _margin(self, mode: str, others: int) -> float:
        """The largest level with enough successes, assuming monotone rates; `others` simulations remain after it."""
        sizes, left = self.simulator.nominal.sizes, _MAX_LEVELS * self.per_level

        allowed = int(self.per_level * (1.0 - ENOUGH) + 1e-9)  # failures

        def survives(level: int) -> bool:
            nonlocal left
            left -= self.per_level
            part = f"level {level}"
            for count in (_QUICK, self.per_level):  # where most fail, a few tell
                draw_one = partial(draw_masses, LEVELS[level], self._seed, level, sizes=sizes)
                self._extend(part, mode, count, draw_one, left + others + self.per_level - count)
                if np.count_nonzero(~self._succeeded(part, mode)[:count]) > allowed:
                    return False
            return True

        most = largest_survived(len(LEVELS), survives)
        return LEVELS[most] if most >= 0 else 0.0

    def _succeeded(self, part: str, mode: str) -> np.ndarray:
        """(K,) successes of all stored rollouts of a part."""
        if self.rule.follows is not None:
            return self._store.arrays.get(f"{part} {mode} won", np.empty(0, dtype=bool))
        ends = self._store.arrays.get(f"{part} {mode} end")
        return np.empty(0, dtype=bool) if ends is None else self.rule.succeeded(ends)

    def _extend(
        self, part: str, mode: str, wanted: int, draw_one: Callable[[int], PerturbationSample], to_come: int
    ) -> None:
        """Run a part's rollouts that are not stored yet, in batches; at most `to_come` simulations remain after it."""
        simulator, plan = self.simulator, self.simulator.plan
        done = len(self._store.arrays.get(f"{part} {mode} end", ()))
        draws = [draw_one(k) for k in range(done, wanted)]
        for xs in self._batches.run(draws, mode, self._deadline):
            more = {"end": xs[:, -1]}
            if self.rule.follows is not None:
                more["won"] = self.rule.followed(xs, plan.xs[simulator.knots], simulator.knots)
            if part == "cases":  # in single precision: for plots
                with np.errstate(all="ignore"):  # of diverged rollouts
                    more["deviation"] = plan.space.difference(xs, plan.xs[simulator.knots]).astype(np.float32)
            self._store.add(**{f"{part} {mode} {name}": values for name, values in more.items()})
            done += len(xs)
            self._finished += len(xs)
            self._total = self._finished + wanted - done + to_come
            if self._progress is not None:
                self._progress(self._finished, self._total)


def largest_survived(count: int, survives: Callable[[int], bool], near: int | None = None) -> int:
    """Index of the largest level that survives, -1 for none.

    Args:
        count: Number of levels.
        survives: Whether a level, by its index, survives.
        near: Probable result, or -1: it and the next level are tested first, then levels at doubling distance, so two
            tests suffice if it is right. None bisects all of them.
    """
    low, high, reach = -1, count, 1
    while high - low > 1:
        if near is None or (low >= 0 and high < count):
            level = (low + high) // 2
        elif high == count:  # all tested levels survived
            level = min(max(near, 0) if low < 0 else low + reach, count - 1)
        else:
            level = max(high - reach, 0)
        reach = reach if near is None or level == near else 2 * reach
        low, high = (level, high) if survives(level) else (low, level)
    return low


_FEWEST = 8  # minimum batch size on an executor: NumPy's overhead per batch
_kept = threading.local()  # per worker: its simulator, and the plan's fingerprint


class Batches:
    """Runs the rollouts of one plan.

    Args:
        simulator: The simulator of this process.
        size: Maximum number of rollouts of a batch.
        executor: Runs the batches; None for this process, with MuJoCo's threads.
    """

    def __init__(self, simulator: Rollouts, size: int, executor: Executor | None) -> None:
        self.simulator, self.size, self.executor = simulator, size, executor
        self.together = 0 if executor is None else _FEWEST * width_of(executor)  # rollouts that occupy all workers
        self._mark = uuid4().hex

    def run(self, draws: Sequence[PerturbationSample], mode: str, deadline: float = math.inf) -> Iterator[np.ndarray]:
        """The states (K, T, nx) of each batch at the stored knots, in the order of the draws.

        Raises:
            OutOfTime: It is later than `deadline`, of time.monotonic().
        """
        simulator, executor, size = self.simulator, self.executor, self.size
        if executor is not None:
            size = min(size, max(_FEWEST, math.ceil(len(draws) / width_of(executor))))
        batches = [draws[k : k + size] for k in range(0, len(draws), size)]
        if executor is None:
            for batch in batches:
                yield simulator.run(simulator.batch(batch), mode, deadline)
            return
        ends = time.time() + deadline - time.monotonic()  # wall-clock time, valid on other machines
        yield from ordered_map(
            executor, partial(_run, self._mark, simulator.plan, simulator.compiled, mode, ends), batches
        )  # fmt: skip


def _run(
    mark: str, plan: Plan, compiled: CompiledTwin, mode: str, ends: float, draws: Sequence[PerturbationSample]
) -> np.ndarray:  # fmt: skip
    """The states of one batch, by this worker's cached simulator of the plan."""
    if getattr(_kept, "mark", None) != mark:
        _kept.mark, _kept.simulator = mark, Rollouts(plan, compiled, threads=1)
    simulator: Rollouts = _kept.simulator
    return simulator.run(simulator.batch(draws), mode, time.monotonic() + ends - time.time())


_FORMAT = "perturbed 3"


def fingerprint(rollouts: Rollouts, perturbation: Perturbation, seed: int) -> str:
    """Digest of all inputs of a rollout, independent of the number of rollouts."""
    plan, twin, problem = rollouts.plan, rollouts.twin, rollouts.plan.problem
    assert problem is not None  # checked by Rollouts
    version = load_mujoco().__version__
    words = (_FORMAT, version, twin.mjcf, sorted(twin.assets), perturbation, seed, rollouts.step, rollouts.integrator)
    words = (*words, plan.touch_downs)
    digest = hashlib.sha256(repr(words).encode())
    maps = (twin.to_x, twin.to_x_offset, twin.to_sim, twin.to_sim_offset)
    for array in (plan.t, plan.xs, plan.us, plan.K, problem.x0, *maps):
        digest.update(repr(array.shape).encode() + np.ascontiguousarray(array, dtype=float).tobytes())
    for name in sorted(twin.assets):
        digest.update(twin.assets[name])
    return digest.hexdigest()


class RolloutCheckpoint:
    """Arrays of finished rollouts by name, stored in an .npz if there is a path."""

    def __init__(self, path: Path | None, mark: str) -> None:
        """Read the file; ignored if it is of another plan or unreadable."""
        self._path, self._mark = path, mark
        self.arrays: dict[str, np.ndarray] = {}  # along the first axis, the rollouts in order
        if path is None:
            return
        try:
            with np.load(path, allow_pickle=False) as stored:
                if str(stored["fingerprint"]) == mark:
                    self.arrays = {name: stored[name] for name in stored.files if name != "fingerprint"}
        except FileNotFoundError:
            return
        except OSError as error:
            raise file_error(error, path, verb="read") from error
        except (ValueError, KeyError, EOFError, zipfile.BadZipFile):
            self.arrays = {}

    def add(self, **more: np.ndarray) -> None:
        """Append rollouts, and write all of them to the file."""
        have = self.arrays
        self.arrays = have | {n: np.concatenate([have[n], new]) if n in have else new for n, new in more.items()}
        if self._path is not None:
            with write_atomically(self._path) as hidden:
                np.savez(hidden, fingerprint=np.array(self._mark), **self.arrays)  # type: ignore[arg-type]
