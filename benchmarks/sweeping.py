"""Sweeps of hopper plans: how much faster two processes are than one, memory, and what handing out by Dask costs.

    python benchmarks/sweeping.py [--plans 1000] [--dask]

Wall time is measured from the first row on disk to the last, so that starting processes, which takes seconds whatever
the size of the sweep, is shown apart. Processor time is that of this process, which hands out and writes, and of its
workers: on a machine that others use as well it tells more than the wall does.
"""

from __future__ import annotations

import argparse
import os
import resource
import tempfile
import time
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import planner
from planner.sweeps.dask import dask_executor


def main() -> None:
    """A line a run, then the ratios."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--plans", type=int, default=1000)
    parser.add_argument("--workers", type=int, nargs="*", default=[1, 2])
    parser.add_argument("--dask", action="store_true", help="also on a local Dask cluster of so many workers")
    options = parser.parse_args()
    ways = [(workers, dask) for dask in (False, True)[: 1 + options.dask] for workers in options.workers]
    print(f"{'':24}  plans/s  first row, s  own CPU, ms/plan  solving, ms/plan  memory, MB  load")
    rates = {(workers, dask): _run(options.plans, workers, dask) for workers, dask in ways}
    for (workers, dask), rate in rates.items():
        base = rates[options.workers[0], False]
        print(f"{workers} {'Dask workers' if dask else 'processes'}: {rate / base:.2f} times the first")


def _run(plans: int, workers: int, dask: bool) -> float:
    """Plans a second of one run."""
    times: list[tuple[float, int]] = []
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        with dask_executor("local", workers) if dask else nullcontext() as executor:
            own = time.process_time()
            done = planner.sweep(
                "hopper", {"height": [1.0 + 59.0 * k / max(1, plans - 1) for k in range(plans)]},
                out=Path(folder) / "out", executor=executor, workers=workers,
                progress=lambda finished, _: times.append((time.perf_counter(), finished)),
            )  # fmt: skip
            own = time.process_time() - own
        rows: list[dict[str, Any]] = list(done.rows())
    (first, before), (last, after) = times[0], times[-1]
    rate = (after - before) / max(last - first, 1e-9)
    solving = sum(row["solve_seconds"] for row in rows) / plans
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    name = f"{workers} {'Dask workers' if dask else 'processes'}"
    print(
        f"{name:24}  {rate:7.1f}  {first - began:12.2f}  {1e3 * own / plans:16.2f}  {1e3 * solving:16.2f}  "
        f"{memory:10.0f}  {os.getloadavg()[0]:4.1f}",
        flush=True,
    )
    return rate


if __name__ == "__main__":
    main()
