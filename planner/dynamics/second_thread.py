"""A second thread for the stages of a linearization, where two are faster than one.

No stage reads what is written for another, and a group of four is computed by the same instructions whoever does it:
the bits do not depend on the number of threads. How many are faster is measured in each solve, so only its duration
depends on the computer. A solve in a thread of its own, a controller, and a process of one thread (PLANNER_THREADS)
use one.
"""

from __future__ import annotations

import math
import os
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from typing import Any

import numpy as np

from planner.base.environment import processors
from planner.kernels.integrators import Integrator
from planner.kernels.numba.lanes import WIDTH
from planner.kernels.tree.memory import MEMORY, TreeMemory

TRIALS = 3  # calls with one thread and with two, alternating, before the faster is known
WORTH = 1e-4  # s: a shorter call is not tried with two, since to wake a thread takes longer
FASTER = 0.9  # of the duration on one thread, at most, with which the second one is used

_solving = threading.local()


@contextmanager
def second_thread() -> Iterator[None]:
    """Context, or decorator, of a solve whose linearizations may use a second thread."""
    before = getattr(_solving, "allowed", False)
    _solving.allowed = threading.current_thread() is threading.main_thread()
    try:
        yield
    finally:
        _solving.allowed = before


@cache
def _worker() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(1, "planner-stages")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_worker.cache_clear)  # a forked process has no thread of its parent's


def _submitted(part: Callable[[int, int], None], first: int, end: int) -> Future[None] | None:
    """A part in the other thread; None where no thread can begin, as when the interpreter ends."""
    try:
        return _worker().submit(part, first, end)
    except RuntimeError:
        _worker.cache_clear()  # what it has queued must not run later
        return None


def _finished(other: Future[None]) -> None:
    """Wait for a part, after Ctrl-C too: its memory is used again."""
    interrupted = False
    while True:
        try:
            other.exception()
            break
        except KeyboardInterrupt:
            interrupted = True
    if interrupted:
        raise KeyboardInterrupt
    other.result()


class Trials:
    """Durations of calls of one kind and size, on one thread and on two."""

    def __init__(self) -> None:
        self._fastest = [math.inf, math.inf]  # s
        self._calls = 0

    def two_are_faster(self) -> bool:
        """Whether the next call is with two threads, which are tried at first."""
        if self._calls == 0 or self._fastest[0] < WORTH or processors() < 2:
            return False
        if self._calls < 2 * TRIALS:
            return self._calls % 2 == 1
        return self._fastest[1] < FASTER * self._fastest[0]

    def add(self, two: bool, seconds: float) -> None:
        """The duration of a call."""
        self._fastest[two] = min(self._fastest[two], seconds)
        self._calls += 1


class SolveMemory(TreeMemory):
    """Scratch memory of a solve of N stages, whose stages may be done in two halves at once.

    Arguments as of TreeMemory.
    """

    def __init__(self, model: Any, integrator: Integrator, N: int, substeps: int = 1, appended: int = 0) -> None:
        super().__init__(model, integrator, N, substeps=substeps, appended=appended)
        # Of the second half; made where it is tried.
        self._make_other = lambda: TreeMemory(model, integrator, 0, substeps=substeps, appended=appended)
        self._other: TreeMemory | None = None
        self._trials: dict[str, Trials] = {}

    def table_of(self, first: int) -> np.ndarray:
        """The table for stages from `first` on: this memory's for 0, else one with a scratch of its own."""
        if first == 0:
            return self.table
        if self._other is None:
            self._other = self._make_other()
        kept = self._arrays["accelerations"][first * int(self.table[MEMORY.kept]) :]
        self._other.table[MEMORY.accelerations] = kept.ctypes.data
        return self._other.table

    def in_halves(self, kind: str, part: Callable[[int, int], None], N: int) -> None:
        """Call part(0, N), or at once part(0, middle) and part(middle, N); `middle` is a multiple of WIDTH.

        Calls of one `kind` take as long as each other.
        """
        middle = N // 2 + -(N // 2) % WIDTH
        if not (0 < middle < N and getattr(_solving, "allowed", False)):
            part(0, N)
            return
        trials = self._trials.get(kind)
        if trials is None:
            trials = self._trials[kind] = Trials()
        two = trials.two_are_faster()
        began = time.perf_counter()
        other = _submitted(part, middle, N) if two else None
        if other is None:
            part(0, N)
        else:
            try:
                part(0, middle)
            finally:
                _finished(other)
        trials.add(two, time.perf_counter() - began)
