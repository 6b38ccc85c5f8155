"""Local processes: an executor whose workers may be ended one by one, and are replaced.

Python's own pool of processes gives up all its work when one of them is killed. Here each worker is a pool of one, so a
kill breaks one future, which is known. Each works with one thread: see planner.base.processors.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor
from contextlib import contextmanager, suppress
from multiprocessing import connection
from typing import Any

from planner.base.errors import PlannerError
from planner.base.processors import VARIABLE

ONE_THREAD = (VARIABLE, "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
_environment = threading.Lock()


class LocalProcesses(Executor):
    """Some processes on this machine.

    Args:
        width: How many.
        first: Called in each before any work, to load what it needs.

    Attributes:
        width: How many calls may be submitted before one has ended.
        one_each: Each call begins at once.

    Raises:
        PlannerError: No process can be started.
    """

    one_each = True

    def __init__(self, width: int, first: Callable[[], object]) -> None:
        self.width = width
        self._first = first
        self._workers: list[_Worker] = []
        try:
            self._workers += [_Worker(first) for _ in range(width)]
            for worker in self._workers:
                worker.started()
        except BaseException:
            self.shutdown(cancel_futures=True)
            raise

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Call a function in an idle process; there must be one."""
        k = next(k for k, worker in enumerate(self._workers) if worker.future is None or worker.future.done())
        worker = self._workers[k]
        if worker.broken():
            worker.end()
            worker = self._workers[k] = _Worker(self._first)
            worker.started()
        worker.future = worker.pool.submit(fn, *args, **kwargs)
        return worker.future

    def end(self, future: Future[Any]) -> None:
        """Kill the process that works on a call; its future raises BrokenExecutor."""
        for worker in self._workers:
            if worker.future is future:
                worker.end()

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End all processes, with cancel_futures in the middle of their work."""
        for worker in self._workers:
            if cancel_futures:
                worker.end()
            worker.pool.shutdown(wait=wait and not cancel_futures, cancel_futures=cancel_futures)


class _Worker:
    """A pool of one process."""

    def __init__(self, first: Callable[[], object]) -> None:
        self.pool = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), _prepared)
        with _one_thread():
            self._ready = self.pool.submit(_began, first)
        self.pid = 0
        self.future: Future[Any] | None = None

    def started(self) -> None:
        """Wait until it has loaded what it needs."""
        try:
            self.pid = self._ready.result()
        except BrokenExecutor:
            raise PlannerError(
                "the processes of the sweep do not start, expected a script that sweeps only under "
                "if __name__ == '__main__', and memory for a process more."
            ) from None

    def broken(self) -> bool:
        """Whether its process has ended."""
        if self.future is not None and self.future.done() and not self.future.cancelled():
            return isinstance(self.future.exception(), BrokenExecutor) or not _alive(self.pid)
        return not _alive(self.pid)

    def end(self) -> None:
        """Kill its process, if it has begun."""
        for process in list((getattr(self.pool, "_processes", None) or {}).values()):  # one that still loads, too
            with suppress(OSError, ValueError):
                process.kill()


def _began(first: Callable[[], object]) -> int:
    first()
    return os.getpid()


def _prepared() -> None:
    """Ctrl-C goes to all processes of a terminal: the first one ends the others, and these end with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        os._exit(1)


def _alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except OSError:
        return False
    return True


@contextmanager
def _one_thread() -> Iterator[None]:
    """Processes that start here work with one thread each."""
    with _environment:
        before = {name: os.environ.get(name) for name in ONE_THREAD}
        os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
        try:
            yield
        finally:
            for name, value in before.items():
                if value is None:
                    del os.environ[name]
                else:
                    os.environ[name] = value
