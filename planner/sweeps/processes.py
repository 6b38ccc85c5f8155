"""Executors that a command may name: processes of this machine, or the workers of Dask.

Python's own pool of processes gives up all its work when one of them is killed. Here each worker is a pool of one, so a
kill breaks one known future. Each works with one thread. Where calls are short, a process has the next one in advance,
so that it never waits for this process, which may be busy writing.

Dask needs the extra slq-planner[dask]. Results come back to this process, which alone writes: workers need no disk of
its. They must have the same planner, and reach a problem file by its path. Each task has one thread; a worker with
several threads does several at once.
"""

from __future__ import annotations

import importlib
import importlib.util
import multiprocessing
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing import connection
from queue import SimpleQueue
from typing import Any

from planner.base.arguments import count
from planner.base.environment import VARIABLE, processors, variables_set
from planner.base.errors import PlannerError

ONE_THREAD = (VARIABLE, "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
_GRACE = 5.0  # s, that processes have to end by themselves after the last call
_SHORT = 2.0  # s; a process that takes longer per call gets no second one in advance
_environment = threading.Lock()


class LocalProcesses(Executor):
    """Some processes on this machine. A context that is left by an error ends them in the middle of their work.

    Args:
        width: How many.
        first: Called in each before any work, to load what it needs.

    Attributes:
        width: How many calls are worked on at once.
        tells_begin: A future is running() from the moment when a process begins with its call.

    Raises:
        PlannerError: No process can be started.
    """

    tells_begin = True

    def __init__(self, width: int, first: Callable[[], object] = os.getpid) -> None:
        self.width = width
        self._first = first
        self._waiting: deque[_Call] = deque()
        self._workers: list[_Worker] = []
        self._ahead = 1  # calls that a process may have
        self._stopping = self._at_once = False
        # Pools call back in threads of their own, under locks: one thread schedules, with events from this queue.
        self._events: SimpleQueue[Callable[[], object]] = SimpleQueue()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        try:
            self._workers += [_Worker(first) for _ in range(width)]
            for worker in self._workers:
                worker.started()
        except BaseException:
            for worker in self._workers:
                worker.end()
            raise
        self._thread.start()

    def __exit__(self, kind: object, *_: object) -> None:
        """End the processes."""
        self.shutdown(cancel_futures=kind is not None)

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Call a function in a process, after those that were submitted before."""
        call = _Call(partial(fn, *args, **kwargs), Future())
        self._events.put(lambda: self._waiting.append(call))
        return call.future

    def end(self, future: Future[Any]) -> None:
        """Kill the process that works on a call; its future raises BrokenExecutor."""
        self._events.put(lambda: [one.end() for one in self._workers if one.calls and one.calls[0].future is future])

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End all processes, with cancel_futures in the middle of their work."""

        def stop() -> None:
            self._stopping, self._at_once = True, cancel_futures
            for worker in self._workers if cancel_futures else ():
                worker.end()

        self._events.put(stop)
        if wait:
            self._thread.join()

    def _serve(self) -> None:
        while not (self._stopping and not self._waiting and not any(worker.calls for worker in self._workers)):
            self._events.get()()
            while self._at_once and self._waiting:
                self._waiting.popleft().future.cancel()
            self._hand_out()
        processes = [process for worker in self._workers for process in worker.processes()]
        for worker in self._workers:
            worker.pool.shutdown(wait=False)
        ends = time.monotonic() + _GRACE
        for process in processes:
            process.join(max(ends - time.monotonic(), 0.0))
            if process.is_alive():  # e.g. a call left a thread in it, which it would wait for
                process.kill()
                process.join()

    def _hand_out(self) -> None:
        """Give waiting calls to the processes that have the fewest."""
        while self._waiting:
            k = min(range(self.width), key=lambda k: len(self._workers[k].calls))
            worker = self._workers[k]
            if len(worker.calls) >= self._ahead:
                return
            call = self._waiting.popleft()
            if call.future.cancelled():
                continue
            try:
                if not worker.calls and not worker.lives():
                    worker = self._workers[k] = _Worker(self._first)
                    worker.ready.add_done_callback(lambda _, worker=worker: self._events.put(worker.begins))
                done = worker.pool.submit(call.function)
            except (OSError, RuntimeError) as error:  # no process can be started, or it has just ended
                done = Future[Any]()
                done.set_exception(BrokenExecutor(str(error)))
            worker.calls.append(call)
            worker.begins()
            answered = partial(self._answered, worker, call, done)
            done.add_done_callback(lambda _, answered=answered: self._events.put(answered))

    def _answered(self, worker: _Worker, call: _Call, done: Future[Any]) -> None:
        """Pass on the result of a call; one that waited behind a call that ended its process goes to another."""
        worker.calls.remove(call)
        error = done.exception()
        if isinstance(error, BrokenExecutor):
            behind, worker.ended = worker.ended, True
            if behind:
                self._waiting.appendleft(call)
                return
        worker.begins()
        call.begins()  # unless it has, or was cancelled
        self._ahead = 2 if time.monotonic() - call.began < _SHORT else 1
        if call.future.cancelled():
            return
        if error is None:
            call.future.set_result(done.result())
        else:
            call.future.set_exception(error)


@dataclass(eq=False)
class _Call:
    """A call, and the future that its caller has."""

    function: Callable[[], Any]
    future: Future[Any]
    began: float = 0.0  # time.monotonic()

    def begins(self) -> None:
        """It is worked on."""
        if not self.began:
            self.began = time.monotonic()
        if not (self.future.running() or self.future.done()):
            self.future.set_running_or_notify_cancel()


class _Worker:
    """A pool of one process, and its calls in their order."""

    def __init__(self, first: Callable[[], object]) -> None:
        self.calls: deque[_Call] = deque()
        self.ended = False  # in the middle of a call
        self.pool = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), _prepared)
        with _environment, variables_set(dict.fromkeys(ONE_THREAD, "1")):  # it works with one thread
            self.ready = self.pool.submit(_began, first)
        self.ready.add_done_callback(self._close_writer)

    def _close_writer(self, _: Future[Any]) -> None:
        """Close this process's end of the pipe of results: else a worker killed in the middle of one is waited for."""
        with suppress(AttributeError, OSError):  # a private attribute of Python's pool
            self.pool._result_queue._writer.close()  # type: ignore[union-attr]

    def started(self) -> None:
        """Wait until it has loaded what it needs."""
        try:
            self.ready.result()
        except BrokenExecutor:
            raise PlannerError(
                "the processes of planner do not start, expected a script that starts them only under "
                "if __name__ == '__main__', and memory for a process more."
            ) from None

    def begins(self) -> None:
        """It works on its first call, once it has loaded what it needs."""
        if self.calls and self.ready.done():
            self.calls[0].begins()

    def lives(self) -> bool:
        """Whether its process has not ended."""
        return not self.ended and all(process.is_alive() for process in self.processes())

    def end(self) -> None:
        """Kill its process, if it has begun."""
        for process in self.processes():  # one that still loads, too
            with suppress(OSError, ValueError):
                process.kill()

    def processes(self) -> list[Any]:
        """The one that there is, if it has begun."""
        return list((getattr(self.pool, "_processes", None) or {}).values())


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


LOCAL = "local"
"""The address of a cluster on this machine."""

CONNECTING = 10.0  # s to wait for a scheduler
# Batches take half a second; Dask's own intervals of a few ms would take 4 % of a core all the time.
_SLOW_POLLING = {
    "distributed.admin.system-monitor.interval": "10s", "distributed.admin.tick.interval": "1s",
    "distributed.scheduler.work-stealing-interval": "1s", "distributed.worker.profile.enabled": False,
    "distributed.client.heartbeat": "10s",
}  # fmt: skip


class DaskExecutor(Executor):
    """The workers of a Dask client.

    Args:
        client: A distributed.Client.

    Attributes:
        width: How many calls it works on at once.
    """

    def __init__(self, client: Any) -> None:
        self._client = client
        self._futures: dict[Future[Any], Any] = {}
        threads = sum(worker["nthreads"] for worker in client.scheduler_info(n_workers=-1)["workers"].values())
        self.width = max(1, threads)

    def prepare(self, first: Callable[[], object]) -> None:
        """Call something on each worker, first on one of each machine, which compiles for the others."""
        workers = self._client.scheduler_info(n_workers=-1)["workers"]
        hosts = {worker["host"]: address for address, worker in workers.items()}
        self._client.run(first, workers=list(hosts.values()))
        self._client.run(first, workers=list(workers))

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Call a function on some worker."""
        answer: Future[Any] = Future()
        answer.set_running_or_notify_cancel()  # Dask does not report when a worker begins
        remote = self._client.submit(fn, *args, pure=False, retries=0, **kwargs)
        self._futures[answer] = remote
        remote.add_done_callback(lambda done: self._answer(answer, done))
        return answer

    def end(self, future: Future[Any]) -> None:
        """End the worker that a call is on; the call's future raises BrokenExecutor."""
        remote = self._futures.get(future)
        if remote is None:
            return
        working = [worker for worker, keys in self._client.processing().items() if remote.key in keys]
        remote.cancel(force=True)
        if working:
            self._client.restart_workers(working, timeout=CONNECTING, raise_for_error=False)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Cancel pending calls."""
        if cancel_futures:
            self._client.cancel(list(self._futures.values()), force=True)

    def _answer(self, answer: Future[Any], remote: Any) -> None:
        """Pass on the result of a call; runs in a thread of the client."""
        self._futures.pop(answer, None)
        if remote.status == "finished":
            try:
                answer.set_result(remote.result())
                return
            except Exception as error:  # it was lost on its way
                answer.set_exception(BrokenExecutor(str(error)))
                return
        error = None if remote.status == "cancelled" else remote.exception()
        lost = error is None or type(error).__name__ in ("KilledWorker", "CommClosedError", "FutureCancelledError")
        answer.set_exception(BrokenExecutor(f"the worker of a task ended ({error})") if lost else error)


@contextmanager
def dask_executor(address: str, workers: int | None = None) -> Iterator[DaskExecutor]:
    """An executor on a running scheduler, or with "local" on a cluster of this machine.

    Args:
        address: tcp://HOST:8786, or "local".
        workers: Processes of a local cluster; by default one a processor.

    Raises:
        PlannerError: Dask is not installed, or nobody answers at the address.
    """
    if importlib.util.find_spec("distributed") is None:
        raise PlannerError("Dask is not installed, expected: pip install 'slq-planner[dask]'.")
    distributed: Any = importlib.import_module("distributed")
    config: Any = importlib.import_module("dask").config
    names = dict.fromkeys(ONE_THREAD, "1")
    # A batch that ends its worker is done again by planner, a task at a time.
    own = {"distributed.scheduler.allowed-failures": 0, "distributed.nanny.pre-spawn-environ": names}
    with config.set(_SLOW_POLLING | own):
        if address == LOCAL:
            cluster = distributed.LocalCluster(
                n_workers=workers or processors(), threads_per_worker=1, processes=True, dashboard_address=":0"
            )
            with cluster, distributed.Client(cluster) as client:
                yield DaskExecutor(client)
            return
        try:
            client = distributed.Client(address, timeout=CONNECTING)
        except (OSError, ValueError, TypeError) as error:
            reason = " ".join(str(error).split()) or type(error).__name__
            raise PlannerError(
                f"no Dask scheduler answers at {address} ({reason}), expected tcp://HOST:PORT of a running one, "
                f"or {LOCAL} for a cluster on this machine."
            ) from None
        with client:
            if not client.scheduler_info(n_workers=-1)["workers"]:
                raise PlannerError(f"the Dask scheduler at {address} has no workers, expected at least one.")
            yield DaskExecutor(client)


MAX_WORKERS = 4096


@contextmanager
def executor_of(workers: int | None, scheduler: str | None) -> Iterator[Executor | None]:
    """So many processes, or the Dask scheduler at an address, or None where neither is given.

    Raises:
        PlannerError: Both are given, or too many processes, or nobody answers at the address.
    """
    if workers is not None and scheduler is not None:
        raise PlannerError("--workers and --scheduler are both given, expected one of them.")
    if scheduler is not None:
        with dask_executor(scheduler) as executor:
            yield executor
    elif workers is not None:
        with LocalProcesses(count("workers", workers, maximum=MAX_WORKERS)) as executor:
            yield executor
    else:
        yield None
