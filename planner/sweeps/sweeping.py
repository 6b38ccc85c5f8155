"""sweep(): one problem at many parameters, on any executor, into one folder.

DIR/table.csv, table.parquet    a row a task
DIR/plans/000.zip               the plans, a thousand an archive; load_plan reads DIR/plans/000.zip/000017.npz
DIR/sweep.json, rows.jsonl      what is swept and what is finished, for resume
"""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

from planner import cases
from planner.base.arguments import choice, count, number
from planner.base.display_mixins import Reportable
from planner.base.environment import installed_versions, processors
from planner.base.errors import FileError
from planner.base.executors import checked_executor
from planner.base.files import file_error, folder_lock
from planner.cases.problem_file import case_in
from planner.cases.problem_file.keys import KEYS
from planner.problem.limits import Limits
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.solvers.options import HESSIANS, LINE_SEARCHES, MAX_STARTS, UPDATES
from planner.sweeps.executors import MAX_WORKERS
from planner.sweeps.grid import Grid, check_names, grid_of
from planner.sweeps.processes import LocalProcesses
from planner.sweeps.running import ContinuationChains, IndependentTasks, Queue, run
from planner.sweeps.shards import plan_place
from planner.sweeps.store import HEAD, Store, read_head, write_head, write_tables
from planner.sweeps.work import LOST, TIMEOUT, Work, warm

_TOLERANCE = partial(number, minimum=0.0)
SOLVE: dict[str, Callable[[str, Any], Any]] = {
    "update": partial(choice, choices=UPDATES), "line_search": partial(choice, choices=LINE_SEARCHES),
    "hessian": partial(choice, choices=HESSIANS), "states": lambda _, value: value, "max_iterations": count,
    "gradient_tolerance": _TOLERANCE, "expected_reduction_tolerance": _TOLERANCE,
    "actual_reduction_tolerance": _TOLERANCE, "starts": partial(count, maximum=MAX_STARTS),
    "seed": partial(count, minimum=0), "spread": partial(number, greater_than=0.0),
}  # fmt: skip
"""Arguments of solve() that a sweep passes on, each with its check."""


class Sweep(Reportable):
    """What a sweep has written.

    Attributes:
        folder: Where it is.
        grid: Its parameters.
        statuses: How many tasks ended with each status: those of plans, FAILED, TIMEOUT, WORKER_LOST.
        interrupted: Whether Ctrl-C ended it.
    """

    def __init__(self, store: Store, grid: Grid, interrupted: bool = False) -> None:
        self.folder, self.grid, self.interrupted = store.folder, grid, interrupted
        self.statuses = dict(sorted(store.statuses.items()))
        self._store = store

    @property
    def finished(self) -> int:
        """How many tasks have a row."""
        return self._store.finished

    @property
    def complete(self) -> bool:
        """Whether all tasks have a row."""
        return self.finished == len(self.grid)

    def rows(self) -> Iterator[dict[str, Any]]:
        """The rows by the numbers of their tasks, read one at a time."""
        return self._store.rows()

    def plan(self, task: int) -> Plan:
        """The plan of a task.

        Raises:
            FileError: It has none.
        """
        return self._store.plan(task)

    def __str__(self) -> str:
        counts = ", ".join(f"{status} {number}" for status, number in self.statuses.items())
        return f"Sweep({self.finished} of {len(self.grid)} tasks: {counts or 'none'}, in {self.folder})"

    __repr__ = __str__


def sweep(
    build: str | Path | Callable[..., Problem], grid: Mapping[str, Any] | Sequence[str] | Grid, *, out: str | Path,
    executor: Executor | None = None, workers: int | None = None, fixed: Mapping[str, Any] | None = None,
    prove: Mapping[str, Any] | bool = False, continued: str | None = None, timeout: float | None = None,
    resume: bool = False, objective: dict[str, float] | None = None, durations: list[float] | None = None,
    limits: Limits | None = None, progress: Callable[[int, int], object] | None = None, **options: Any,
) -> Sweep:  # fmt: skip
    """Solve one problem at many parameters, and prove each plan where that is asked for.

    A task that raises, runs for too long or ends its worker is in the table with its reason; the others go on. Ctrl-C
    ends a sweep and keeps what is finished, as does a full disk; with `resume` the same call does the rest.

    Args:
        build: A case's name, the path of a problem file, or a function of the parameters that returns a Problem; for
            processes one that they can import.
        grid: Values by parameter, e.g. {"height": range(1, 61), "duration": [0.8, 1.0]}, or texts as
            "height=1:60:60". Of a problem file the parameters are its keys, "weights.effort" too.
        out: The folder.
        executor: Any concurrent.futures.Executor, one on Dask for example; by default processes on this machine, which
            work with one thread each.
        workers: Number of these processes; by default one a processor.
        fixed: Parameters that all tasks share.
        prove: True or arguments of prove(), {"rollouts": 128} say; rollouts are 0 unless they are given.
        continued: A parameter along which each task starts from the controls of the one before it, where that one
            converged. Which one that is depends on the grid alone.
        timeout: s for each solve. It ends between two iterations; a process that does not even come so far is ended 5 s
            later. Executors that are not planner's own end no process.
        resume: Go on with what is in the folder. Tasks that lost their worker are done again, and those that took too
            long where the timeout is longer now; all others that have a row are kept, FAILED ones too.
        objective: Weights of criteria, as of solve_for.
        durations: The shortest and the longest, s, as of solve_for.
        limits: In place of the problem's own.
        progress: Called with the tasks done and their number.
        options: Of solve(): starts, seed, hessian and so on.

    Returns:
        A Sweep: its table is table.csv in the folder.

    Raises:
        PlannerError: A parameter that does not exist, a folder with another sweep, workers that do not start.
        FileError: The folder cannot be written.
    """
    grid = grid_of(grid)
    work = Work(
        grid, _source(build), dict(fixed or {}), _checked(options), objective, durations, limits, _proof_options(prove),
        None if timeout is None else number("timeout", timeout, greater_than=0.0),
    )  # fmt: skip
    check_names(grid, *_known(work))
    if continued is not None:
        choice("the parameter to continue along", continued, tuple(grid.values))
    checked_executor(executor)
    width = processors() if workers is None else count("workers", workers, maximum=MAX_WORKERS)
    folder, head = Path(out), _head(work, continued)
    before = _claim(folder, head, resume)
    with folder_lock(folder):
        if before != head:
            write_head(folder, head)
        store = Store(folder, len(grid))
        store.read()
        if before is not None and (again := _again(store, grid, continued, _is_longer(timeout, before["timeout"]))):
            store.forget(again)
        interrupted = False
        with ExitStack() as stack:
            stack.callback(store.close)
            store.open()
            queue = _queue(store, grid, continued)
            try:
                if store.finished != len(grid):
                    warm(work)  # compiles, once on this machine
                    pool = executor or stack.enter_context(LocalProcesses(min(width, len(grid)), partial(warm, work)))
                    prepare = getattr(pool, "prepare", None)
                    if prepare is not None:
                        prepare(partial(warm, work))
                    run(work, queue, pool, store, progress)
            except KeyboardInterrupt:
                interrupted = True
        write_tables(store, grid.values)
    done = Sweep(store, grid, interrupted)
    done.page()
    return done


def read_sweep(folder: str | Path) -> Sweep:
    """What a sweep has written into a folder.

    Raises:
        FileError: There is none.
    """
    head = read_head(Path(folder))
    if head is None:
        raise FileError(f"{folder} holds no sweep, expected a folder that planner sweep wrote.")
    grid = grid_of(head["grid"])
    store = Store(Path(folder), len(grid))
    store.read()
    return Sweep(store, grid)


def _source(build: Any) -> Any:
    """What builds the problems: a case's name, a function, or the whole path of a problem file."""
    for name, case in cases.CASES.items():
        if case is build:
            return name
    if callable(build):
        return build
    if isinstance(build, Path) or (isinstance(build, str) and build.lower().endswith(".toml")):
        return Path(build).absolute()
    return choice("build", build, tuple(cases.CASES))


def _known(work: Work) -> tuple[list[str], str]:
    """The names of the parameters that exist, and whose they are."""
    source = work.source
    if isinstance(source, Path):
        named = case_in(source)
        if named is None:
            dotted = [name for name in work.grid.values if name.partition(".")[0] in KEYS]
            return [*KEYS, *dotted], source.name
        return list(inspect.signature(cases.CASES[named[0]]).parameters), named[0]
    if isinstance(source, str):
        return list(inspect.signature(cases.CASES[source]).parameters), source
    try:
        signature = inspect.signature(source).parameters
    except (TypeError, ValueError):
        return list(work.grid.values), ""
    if any(parameter.kind is parameter.VAR_KEYWORD for parameter in signature.values()):
        return list(work.grid.values), ""
    return list(signature), getattr(source, "__name__", "the function")


def _checked(options: dict[str, Any]) -> dict[str, Any]:
    for name in options:
        choice("an option", name, SOLVE)
    return {name: SOLVE[name](name, value) for name, value in options.items() if value is not None}


def _proof_options(given: Mapping[str, Any] | bool) -> dict[str, Any] | None:
    if given is False:
        return None
    return {"rollouts": 0} | ({} if given is True else dict(given))


def _head(work: Work, continued: str | None) -> dict[str, Any]:
    """Everything that determines the table, as JSON values."""
    source = work.source
    name = f"{source.__module__}.{source.__qualname__}" if inspect.isfunction(source) else str(source)
    return json.loads(json.dumps({
        "build": name, "grid": work.grid.values, "fixed": work.fixed, "options": work.options, "continued": continued,
        "objective": work.objective, "durations": work.durations, "prove": work.proved, "timeout": work.timeout,
        "limits": None if work.limits is None else work.limits.to_dict(), "versions": installed_versions(),
    }, default=str))  # fmt: skip


def _claim(folder: Path, head: dict[str, Any], resume: bool) -> dict[str, Any] | None:
    """Make the folder; returns the head of its sweep, or None. Only the timeout may differ from the new head's."""
    there = read_head(folder)
    if there is not None and not resume:
        raise FileError(f"{folder} holds a sweep already, expected --resume to go on with it or another folder.")
    if there is not None:
        other = [name for name in head if name != "timeout" and there.get(name) != head[name]]
        if other:
            raise FileError(f"{folder} holds another sweep (its {other[0]} differs), expected another folder.")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:
        raise file_error(error, folder, expected="folder") from error
    if there is None and any(folder.glob("*")):
        raise FileError(f"{folder} holds other files, expected an empty or a new folder ({HEAD} is missing).")
    return there


def _is_longer(timeout: float | None, before: float | None) -> bool:
    return before is not None and (timeout is None or timeout > before)


def _again(store: Store, grid: Grid, continued: str | None, longer: bool) -> set[int]:
    """Tasks to do again: those that lost their worker, or time out where it is longer now, and their successors."""
    outside = {LOST, TIMEOUT} if longer else {LOST}
    if outside.isdisjoint(store.statuses):
        return set()
    again = {row["task"] for row in store.rows() if row["status"] in outside}
    for chain in () if continued is None else grid.chains(continued):
        first = next((k for k, task in enumerate(chain) if task in again), len(chain))
        again.update(chain[first:])
    return again


def _queue(store: Store, grid: Grid, continued: str | None) -> Queue:
    def finished(task: int) -> bool:
        return bool(store.places[task] >= 0)

    if continued is None:
        return IndependentTasks(task for task in range(len(grid)) if not finished(task))
    return ContinuationChains(grid.chains(continued), finished, store.controls)


__all__ = ["SOLVE", "Sweep", "plan_place", "read_sweep", "sweep"]
