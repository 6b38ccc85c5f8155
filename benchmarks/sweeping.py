"""Sweeps of hopper plans: what two processes do in the time of one, memory, and what handing out by Dask costs.

    python benchmarks/sweeping.py [--plans 1000] [--workers 1 2] [--dask] [--threads]
    python benchmarks/sweeping.py --bars [--plans 2000]       what docs/scale.md promises, each met or not

Walls say little on a machine that others use as well, so a run also measures what does not depend on them: processor
time of a plan in the workers and in this process, which hands out and writes, and the share of their time in which
workers had nothing to do. From these follows what two workers would do on two cores of their own, where this process
takes its time from theirs. The first batch of each worker, which loads the planner, does not count.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import threading
import time
from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import planner
from planner.base.executors import width_of
from planner.sweeps.processes import executor_of

TWICE, QUIET = 1.7, 0.5  # times one; the load above which walls say little


class Run(NamedTuple):
    """What a sweep took."""

    rate: float  # plans/s from the first row to the last
    worker: float  # s of processor time a plan, in its worker
    own: float  # s of processor time a plan, here: handing out, unpickling, writing, and Dask's scheduler
    idle: float  # share of the workers' time in which they had no batch


class Watched(Executor):
    """An executor whose workers write down when each batch began and ended, and its processor time."""

    def __init__(self, executor: Any, folder: str) -> None:
        self.executor, self.folder, self.width = executor, folder, width_of(executor)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.executor, name)

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Call and write down."""
        return self.executor.submit(_timed, self.folder, partial(fn, *args, **kwargs))


def _timed(folder: str, call: Callable[[], Any]) -> Any:
    began, processor = time.perf_counter(), time.process_time()
    found = call()
    with open(Path(folder, f"{os.getpid()}.batches"), "a", encoding="utf-8") as file:
        print(began, time.perf_counter(), time.process_time() - processor, len(found.done), file=file)
    return found


def main() -> None:
    """A line a run, then what follows from them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--plans", type=int, default=1000)
    parser.add_argument("--workers", type=int, nargs="*", default=[1, 2])
    parser.add_argument("--dask", action="store_true", help="also on a local Dask cluster of so many workers")
    parser.add_argument("--bars", action="store_true", help="instead: whether the bars are met, on a quiet machine")
    parser.add_argument("--threads", action="store_true", help="instead: solves in two threads beside one")
    options = parser.parse_args()
    if options.bars:
        _bars(options.plans)
        return
    if options.threads:
        _threads()
        return
    ways = [(workers, dask) for dask in (False, True)[: 1 + options.dask] for workers in options.workers]
    print(f"{'':16} plans/s  worker, ms/plan  here, ms/plan  idle, %  load    memory, MB, at 20, 40 ... 100 %")
    runs = {(workers, dask): _run(options.plans, workers, dask) for workers, dask in ways}
    (one, _), base = next(iter(runs.items()))
    for (workers, dask), run in runs.items():
        # Cores of their own: as many as workers, and what this process takes comes off them where there is one each.
        busy = run.worker / (1.0 - run.idle) + (run.own if workers > one else 0.0)
        alone = workers / one * base.worker / (1.0 - base.idle) / busy
        name = f"{workers} {'Dask workers' if dask else 'processes'}"
        print(f"{name}: {run.rate / base.rate:.2f} times the first by the wall, {alone:.2f} on cores of their own")


def _bars(plans: int) -> None:
    """Two processes and two threads at least TWICE times one by the wall, and Dask's scheduling within its share."""
    load = os.getloadavg()[0]
    if load > QUIET:
        print(f"the load is {load:.1f}: walls say little, wait until it is below {QUIET:g}")
    one, two = (_run(plans, workers, False) for workers in (1, 2))
    dask = _run(plans, 2, True)
    more = (dask.own - two.own) / two.worker
    bars = {
        f"two processes, {two.rate / one.rate:.2f} times one, at least {TWICE}": two.rate / one.rate >= TWICE,
        f"Dask's scheduling, {100 * more:.1f} % of a plan's processor time, at most 5": more <= 0.05,
    }
    bars |= {f"two threads, {case}, {times:.2f} times one": times >= TWICE for case, times in _threads().items()}
    for words, met in bars.items():
        print(f"{'met    ' if met else 'NOT MET'}  {words}")


def _run(plans: int, workers: int, dask: bool) -> Run:
    """One sweep."""
    times: list[tuple[float, int, float]] = []
    memory: list[tuple[int, float, float]] = []

    def progress(finished: int, of: int) -> None:
        times.append((time.perf_counter(), finished, time.process_time()))
        if len(memory) < 5 * finished // of:
            memory.append((finished, _resident(os.getpid()), max(map(_resident, _children()), default=0.0)))

    # A cluster on this machine has its scheduler in this process: its time is in that of this process.
    with tempfile.TemporaryDirectory() as folder, _executor(workers, dask) as executor:
        planner.sweep(
            "hopper", {"height": [1.0 + 59.0 * k / max(1, plans - 1) for k in range(plans)]},
            out=Path(folder) / "out", executor=Watched(executor, folder), progress=progress,
        )  # fmt: skip
        lines = [[line.split() for line in file.read_text().splitlines()] for file in Path(folder).glob("*.batches")]
    batches = [[(*map(float, line[:3]), int(line[3])) for line in worker] for worker in lines]
    later = [batch for worker in batches for batch in worker[1:]]
    gaps = sum(after[0] - before[1] for worker in batches for before, after in pairwise(worker[1:]))
    busy = sum(ended - began for began, ended, _, _ in later)
    half = next(k for k, (_, finished, _) in enumerate(times) if finished > 0.1 * plans)  # everything is loaded
    (first, before, cpu), (last, after, cpu_after) = times[half], times[-1]
    run = Run(
        (after - before) / (last - first), sum(batch[2] for batch in later) / sum(batch[3] for batch in later),
        (cpu_after - cpu) / (after - before), gaps / (gaps + busy),
    )  # fmt: skip
    name = f"{workers} {'Dask workers' if dask else 'processes'}"
    resident = ", ".join(f"{here:.0f} + {worker:.0f}" for _, here, worker in memory)
    print(
        f"{name:16} {run.rate:7.1f}  {1e3 * run.worker:15.2f}  {1e3 * run.own:13.3f}  {100 * run.idle:7.2f}  "
        f"{os.getloadavg()[0]:4.1f}    {resident}",
        flush=True,
    )
    return run


def _executor(workers: int, dask: bool) -> Any:
    if not dask:
        return executor_of(workers, None)
    from planner.sweeps.processes import dask_executor

    return dask_executor("local", workers)


def _resident(process: int) -> float:
    """MB of memory of a process."""
    for line in Path(f"/proc/{process}/status").read_text().splitlines():
        if line.startswith("VmRSS"):
            return int(line.split()[1]) / 1024.0
    return 0.0


def _children() -> list[int]:
    """The processes that any thread of this one has started."""
    found = (Path(f"/proc/{os.getpid()}/task/{thread.native_id}/children") for thread in threading.enumerate())
    return [int(word) for file in found if file.exists() for word in file.read_text().split()]


def _threads() -> dict[str, float]:
    """How many solves a second two threads make, relative to one, by case; prints the processor time, too."""
    found = {}
    for case, parameters in {"two-link": {"horizon": 1000}, "puma": {}, "hopper": {"horizon": 2000}}.items():
        problems = [planner.cases.build(case, **parameters) for _ in range(8)]
        for problem in problems:
            planner.solve(problem)
        walls, processor = [], []
        for threads in (1, 2):
            best = []
            for _ in range(5):
                with ThreadPoolExecutor(threads) as pool:
                    began, cpu = time.perf_counter(), time.process_time()
                    list(pool.map(planner.solve, problems))
                    best.append((time.perf_counter() - began, time.process_time() - cpu))
            walls.append(min(best)[0])
            processor.append(min(best)[1])
        found[case] = walls[0] / walls[1]
        print(
            f"{case}: two threads {walls[0] / walls[1]:.2f} times one by the least wall of 5, in "
            f"{processor[1] / processor[0]:.2f} of the processor time, load {os.getloadavg()[0]:.1f}",
            flush=True,
        )
    return found


if __name__ == "__main__":
    main()
