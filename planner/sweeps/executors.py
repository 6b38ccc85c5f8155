"""The executor that a command or a benchmark is asked for: processes of this machine, or the workers of Dask."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager

from planner.base.arguments import count
from planner.base.errors import PlannerError
from planner.sweeps.dask import dask_executor
from planner.sweeps.processes import LocalProcesses

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
