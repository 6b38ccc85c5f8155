"""Run a sweep: batches of tasks to an executor, results to disk at once.

Tasks are independent, or chains of neighbours in which each task waits for the one before it. Batches take about half a
second, so that scheduling costs little, and no more are submitted than the executor has workers: memory does not grow
with the sweep. A batch whose worker ended is done again one task at a time: the task that ends workers costs no other,
and none is blamed for a worker that another's end or a stranger took from it.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Executor, Future, wait
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from typing import Any, NamedTuple

import numpy as np

from planner.base.errors import PlannerError
from planner.base.executors import width_of
from planner.sweeps.store import Store
from planner.sweeps.work import LOST, TIMEOUT, BatchResult, Work, failed, reason_of, run_batch


class QueuedBatch(NamedTuple):
    """Tasks to do together, in this order.

    Attributes:
        tasks: Their numbers.
        controls: (N, nu) of the neighbour before the first of them, or None.
        alone: Whether it was lost with a worker before. It is then one task, worked on while no other batch is.
        ends: Workers that have ended while it was alone.
    """

    tasks: list[int]
    controls: np.ndarray | None = None
    alone: bool = False
    ends: int = 0


class IndependentTasks:
    """Tasks that do not depend on each other."""

    continued = False

    def __init__(self, tasks: Iterable[int]) -> None:
        self._tasks = iter(tasks)
        self._alone: deque[QueuedBatch] = deque()

    def take(self, size: int) -> QueuedBatch | None:
        """At most so many tasks, those that are to be done alone first."""
        if self._alone:
            return self._alone.popleft()
        tasks = list(islice(self._tasks, size))
        return QueuedBatch(tasks) if tasks else None

    def ended(self, batch: QueuedBatch, controls: np.ndarray | None) -> None:
        """Nothing to do: no task waits for a batch."""

    def lost(self, batch: QueuedBatch) -> None:
        """Each task of it alone."""
        self._alone.extend(QueuedBatch([task], None, True, batch.ends + batch.alone) for task in batch.tasks)


class ContinuationChains:
    """Chains of neighbours.

    Args:
        chains: Tasks in order.
        finished: Whether a task has a row already.
        controls_of: The controls of a finished task that converged, else None.
    """

    continued = True

    def __init__(
        self, chains: Iterable[list[int]], finished: Callable[[int], bool],
        controls_of: Callable[[int], np.ndarray | None],
    ) -> None:  # fmt: skip
        self._fresh = self._started(chains, finished, controls_of)
        # Rest, controls, how many of it alone, and workers that ended with the first.
        self._ready: deque[tuple[list[int], np.ndarray | None, int, int]] = deque()
        self._running: dict[int, tuple[list[int], int]] = {}  # by the first task of its batch

    @staticmethod
    def _started(
        chains: Iterable[list[int]], finished: Callable[[int], bool], controls_of: Callable[[int], np.ndarray | None]
    ) -> Iterator[tuple[list[int], np.ndarray | None, int, int]]:
        for chain in chains:
            done = next((k for k, task in enumerate(chain) if not finished(task)), len(chain))
            if done < len(chain):
                yield chain[done:], None if done == 0 else controls_of(chain[done - 1]), 0, 0

    def take(self, size: int) -> QueuedBatch | None:
        """The next tasks of a chain that waits for no other."""
        following = self._ready.popleft() if self._ready else next(self._fresh, None)
        if following is None:
            return None
        tasks, controls, alone, ends = following
        count = 1 if alone else size
        self._running[tasks[0]] = tasks[count:], max(alone - 1, 0)
        return QueuedBatch(tasks[:count], controls, alone > 0, ends)

    def ended(self, batch: QueuedBatch, controls: np.ndarray | None) -> None:
        """The rest of its chain may go on."""
        rest, alone = self._running.pop(batch.tasks[0])
        if rest:
            self._ready.append((rest, controls, alone, 0))

    def lost(self, batch: QueuedBatch) -> None:
        """The chain begins again at the batch, one task at a time."""
        rest, alone = self._running.pop(batch.tasks[0])
        ends = batch.ends + batch.alone
        self._ready.appendleft((batch.tasks + rest, batch.controls, len(batch.tasks) + alone, ends))


Queue = IndependentTasks | ContinuationChains
"""The order of a sweep; `continued` says whether each task starts from the one before it in its batch."""

SECONDS = 0.5  # that a batch should take
MAX_BATCH = 500  # tasks of a batch
GRACE = 5.0  # s beyond its timeout after which a task's worker is ended
_LATEST = 0.3  # weight of the last batch in the mean time of a task
_LOOK = 0.2  # s between looks for tasks that take too long


@dataclass
class _PendingBatch:
    """A submitted batch."""

    batch: QueuedBatch
    mean: float | None  # s of a task, as was known when it was sent
    latest: float = math.inf  # time.monotonic() after which its worker is ended
    ended: bool = False  # whether that was done

    def late(self, work: Work, future: Future[BatchResult]) -> bool:
        """Whether it takes longer than it may. A wrong guess for several tasks does no harm: they are done again."""
        if work.timeout is None:
            return False
        if self.latest == math.inf and future.running():
            usual = 0.0 if len(self.batch.tasks) == 1 or self.mean is None else 4.0 * self.mean * len(self.batch.tasks)
            self.latest = time.monotonic() + work.timeout + GRACE + usual
        self.ended |= time.monotonic() > self.latest
        return self.ended


def run(
    work: Work, queue: Queue, executor: Executor, store: Store, progress: Callable[[int, int], object] | None = None
) -> None:
    """Do all tasks of a queue and store what they give.

    Args:
        work: How a task is done.
        queue: The tasks.
        executor: Where they are done. One with `end(future)`, as those of planner, loses no more than a batch with a
            worker; another is given up when it is broken. With `tells_begin` a future is running() from the moment
            when a worker begins with it.
        store: Where rows and plans go.
        progress: Called with the tasks done and their number.

    Raises:
        PlannerError: The executor takes no more work.
        FileError: The store cannot be written.
        KeyboardInterrupt: Ctrl-C; what had ended by then is stored.
    """
    width = width_of(executor)
    if work.timeout is None or hasattr(executor, "tells_begin"):
        width *= 2  # a second batch per worker waits; with a timeout its time would run while it waits
    flights: dict[Future[BatchResult], _PendingBatch] = {}
    waiting: QueuedBatch | None = None  # a batch that must run alone
    mean = None  # s of a task
    try:
        while True:
            size = 1 if mean is None else max(1, min(MAX_BATCH, int(SECONDS / mean)))
            while len(flights) < width and not any(flight.batch.alone for flight in flights.values()):
                batch, waiting = waiting or queue.take(size), None
                if batch is None:
                    break
                if batch.alone and flights:  # with others running it could be lost with another's worker
                    waiting = batch
                    break
                flights[_submitted(executor, work, queue, batch)] = _PendingBatch(batch, mean)
            if not flights:
                return
            done, _ = wait(flights, _LOOK if work.timeout is not None else None, FIRST_COMPLETED)
            for future in done:
                flight = flights.pop(future)
                seconds = _taken(work, future, flight, queue, store, executor)
                if seconds is not None:
                    mean = seconds if mean is None else (1.0 - _LATEST) * mean + _LATEST * seconds
            if done and progress is not None:
                progress(store.finished, len(store.places))
            for future, flight in flights.items():
                if flight.late(work, future) and hasattr(executor, "end"):
                    executor.end(future)  # type: ignore[attr-defined]
    except KeyboardInterrupt:
        _store_what_ended(flights, store)
        raise
    finally:
        for future in flights:
            future.cancel()


def _submitted(executor: Executor, work: Work, queue: Queue, batch: QueuedBatch) -> Future[BatchResult]:
    try:
        return executor.submit(run_batch, work, batch.tasks, queue.continued, batch.controls)
    except (BrokenExecutor, RuntimeError) as error:
        raise PlannerError(f"the executor takes no more work ({reason_of(error)}); resume goes on.") from None


def _taken(
    work: Work, future: Future[BatchResult], flight: _PendingBatch, queue: Queue, store: Store, executor: Executor
) -> float | None:
    """Store the result of a batch, or its failure; returns the mean time of its tasks, s, or None."""
    batch = flight.batch
    try:
        found = future.result()
    except (BrokenExecutor, CancelledError) as error:
        if not hasattr(executor, "end"):
            raise PlannerError("a worker of the executor ended, which takes no more work; resume goes on.") from error
        late = flight.ended
        blamed = batch.alone or hasattr(executor, "tells_begin") if late else batch.ends > 0
        if len(batch.tasks) > 1 or not blamed:
            queue.lost(batch)
            return None
        found = BatchResult([failed(work, batch.tasks[0], *_why(work, late))], None)
    except Exception as error:  # e.g. a problem that cannot be pickled
        found = BatchResult([failed(work, task, "FAILED", reason_of(error)) for task in batch.tasks], None)
    store.append(found.done)
    queue.ended(batch, found.controls)
    seconds = [sum(one.row.get(name, 0.0) for name in ("solve_seconds", "prove_seconds")) for one in found.done]
    return max(sum(seconds) / len(seconds), 1e-4)


def _why(work: Work, late: bool) -> tuple[str, str]:
    """The status and the reason of a task whose worker ended."""
    if late:
        return TIMEOUT, f"It was not done after {work.timeout:g} s and did not stop by itself; its worker was ended."
    return LOST, "Its worker ended in the middle, twice: killed, or out of memory."


def _store_what_ended(flights: dict[Future[Any], _PendingBatch], store: Store) -> None:
    for future in list(flights):
        if future.done() and not future.cancelled() and future.exception() is None:
            with suppress(PlannerError):
                store.append(future.result().done)
