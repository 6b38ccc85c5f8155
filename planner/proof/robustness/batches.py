"""Batches of rollouts, here or on an executor. Its workers keep the simulator of a plan from one batch to the next."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from functools import partial
from uuid import uuid4

import numpy as np

from planner.base.executors import ordered_map, width_of
from planner.problem.plan import Plan
from planner.proof.replays.compiled_twin import CompiledTwin
from planner.proof.robustness.perturbation import PerturbationSample
from planner.proof.robustness.rollouts import Rollouts

_FEWEST = 8  # rollouts of a batch on an executor: what NumPy does for one batch takes as long for a few
_kept = threading.local()  # of a worker: its simulator, and whose it is


class Batches:
    """Runs the rollouts of one plan.

    Args:
        simulator: Of this process.
        size: Most rollouts of a batch.
        executor: Where they run; None for this process, with MuJoCo's threads.
    """

    def __init__(self, simulator: Rollouts, size: int, executor: Executor | None) -> None:
        self.simulator, self.size, self.executor = simulator, size, executor
        self.together = 0 if executor is None else _FEWEST * width_of(executor)  # rollouts that keep all workers busy
        self._mark = uuid4().hex

    def run(self, draws: Sequence[PerturbationSample], mode: str, deadline: float = math.inf) -> Iterator[np.ndarray]:
        """The states (K, T, nx) of each batch at the kept knots, in the order of the draws.

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
        ends = time.time() + deadline - time.monotonic()  # as other machines have it
        yield from ordered_map(
            executor, partial(_run, self._mark, simulator.plan, simulator.compiled, mode, ends), batches
        )  # fmt: skip


def _run(
    mark: str, plan: Plan, compiled: CompiledTwin, mode: str, ends: float, draws: Sequence[PerturbationSample]
) -> np.ndarray:  # fmt: skip
    """The states of one batch, by the simulator that this worker has of the plan."""
    if getattr(_kept, "mark", None) != mark:
        _kept.mark, _kept.simulator = mark, Rollouts(plan, compiled, threads=1)
    simulator: Rollouts = _kept.simulator
    return simulator.run(simulator.batch(draws), mode, time.monotonic() + ends - time.time())
