"""Executors that a command or a benchmark may name: processes of this machine, or the workers of Dask.

Dask needs the extra slq-planner[dask]. Results come back to this process, which alone writes: workers need no disk of
its. They must have the same planner, and reach a problem file by its path. Each task has one thread; a worker with
several threads does several at once.
"""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Executor, Future
from contextlib import contextmanager
from typing import Any

from planner.base.arguments import count
from planner.base.environment import processors
from planner.base.errors import PlannerError
from planner.sweeps.processes import ONE_THREAD, LocalProcesses

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
