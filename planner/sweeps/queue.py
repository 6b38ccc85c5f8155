"""What is to be done next: tasks in any order, or chains of neighbours of which each task waits for the one before it.

A batch that a worker took with it when it ended is done again one task at a time: so the task that ends workers is
found and costs no other.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from typing import NamedTuple, Protocol

import numpy as np


class QueuedBatch(NamedTuple):
    """Tasks to do together, in this order.

    Attributes:
        tasks: Their numbers.
        controls: (N, nu) of the neighbour before the first of them, or None.
        alone: Whether a worker has ended with this one task before. It is then worked on while no other batch is.
    """

    tasks: list[int]
    controls: np.ndarray | None = None
    alone: bool = False


class Queue(Protocol):
    """The order of a sweep."""

    continued: bool  # whether each task starts from the one before it in its batch

    def take(self, size: int) -> QueuedBatch | None:
        """At most so many tasks; None where there are none at the moment."""
        ...

    def ended(self, batch: QueuedBatch, controls: np.ndarray | None) -> None:
        """A batch is done; `controls` are of its last task."""
        ...

    def lost(self, batch: QueuedBatch) -> None:
        """A batch is to be done again, one task at a time."""
        ...


class IndependentTasks:
    """Tasks that do not depend on each other."""

    continued = False

    def __init__(self, tasks: Iterable[int]) -> None:
        self._tasks = iter(tasks)
        self._alone: deque[int] = deque()

    def take(self, size: int) -> QueuedBatch | None:
        """At most so many tasks, those that are to be done alone first."""
        if self._alone:
            return QueuedBatch([self._alone.popleft()], alone=True)
        tasks = list(islice(self._tasks, size))
        return QueuedBatch(tasks) if tasks else None

    def ended(self, batch: QueuedBatch, controls: np.ndarray | None) -> None:
        """Nothing waits for a batch."""

    def lost(self, batch: QueuedBatch) -> None:
        """Each task of it alone."""
        self._alone.extend(batch.tasks)


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
        self._ready: deque[tuple[list[int], np.ndarray | None, int]] = deque()  # rest, controls, how many alone
        self._running: dict[int, tuple[list[int], int]] = {}  # by the first task of its batch

    @staticmethod
    def _started(
        chains: Iterable[list[int]], finished: Callable[[int], bool], controls_of: Callable[[int], np.ndarray | None]
    ) -> Iterator[tuple[list[int], np.ndarray | None, int]]:
        for chain in chains:
            done = next((k for k, task in enumerate(chain) if not finished(task)), len(chain))
            if done < len(chain):
                yield chain[done:], None if done == 0 else controls_of(chain[done - 1]), 0

    def take(self, size: int) -> QueuedBatch | None:
        """The next tasks of a chain that waits for no other."""
        following = self._ready.popleft() if self._ready else next(self._fresh, None)
        if following is None:
            return None
        tasks, controls, alone = following
        count = 1 if alone else size
        self._running[tasks[0]] = tasks[count:], max(alone - 1, 0)
        return QueuedBatch(tasks[:count], controls, alone > 0)

    def ended(self, batch: QueuedBatch, controls: np.ndarray | None) -> None:
        """The rest of its chain may go on."""
        rest, alone = self._running.pop(batch.tasks[0])
        if rest:
            self._ready.append((rest, controls, alone))

    def lost(self, batch: QueuedBatch) -> None:
        """The chain begins again at the batch, one task at a time."""
        rest, alone = self._running.pop(batch.tasks[0])
        self._ready.appendleft((batch.tasks + rest, batch.controls, len(batch.tasks) + alone))
