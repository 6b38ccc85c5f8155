"""sweep(): one problem at many parameters, on any executor, into one folder.

DIR/table.csv, table.parquet    a row a task
DIR/plans/000.zip               the plans, a thousand an archive; load_plan reads DIR/plans/000.zip/000017.npz
DIR/sweep.json, rows.jsonl      what is swept and what is finished, for resume
"""

from __future__ import annotations

import csv
import importlib
import importlib.util
import inspect
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import ExitStack
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

from planner.base.arguments import choice, count, number
from planner.base.data_files import write_json
from planner.base.environment import installed_versions, processors
from planner.base.errors import FileError
from planner.base.executors import checked_executor
from planner.base.files import file_error, folder_lock, write_atomically
from planner.base.late_imports import Reportable
from planner.problem.limits import Limits
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.solvers.options import HESSIANS, LINE_SEARCHES, MAX_STARTS, UPDATES
from planner.sweeps.grid import Grid, check_names, grid_of
from planner.sweeps.processes import MAX_WORKERS, LocalProcesses
from planner.sweeps.running import ContinuationChains, IndependentTasks, Queue, run
from planner.sweeps.store import FORMAT, HEAD, TIMES, Store, read_head
from planner.sweeps.work import LOST, TIMEOUT, Work, check_buildable, known_parameters, source_of, warm

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

    @property
    def reasons(self) -> dict[str, str]:
        """By status, in the order of `statuses`, the reason of the first task that has one; "" where none has."""
        found = dict.fromkeys(self.statuses, "")
        for row in self.rows():
            found[row["status"]] = found[row["status"]] or row.get("reason", "")
        return found

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

    A task that raises, runs for too long or ends its worker is in the table with its reason; the others go on. Of a
    case or a file 32 evenly spaced tasks are tried first: where none can be built, nothing is written. Ctrl-C ends a
    sweep and keeps what is finished, as does a full disk; with `resume` the same call does the rest.

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
        PlannerError: A parameter that does not exist, no task that can be built, a folder with another sweep, workers
            that do not start.
        FileError: The folder cannot be written.
    """
    grid = grid_of(grid)
    work = Work(
        grid, source_of(build), dict(fixed or {}), _checked(options), objective, durations, limits,
        _proof_options(prove), None if timeout is None else number("timeout", timeout, greater_than=0.0),
    )  # fmt: skip
    check_names(grid, *known_parameters(work))
    if continued is not None:
        choice("the parameter to continue along", continued, tuple(grid.values))
    checked_executor(executor)
    width = processors() if workers is None else count("workers", workers, maximum=MAX_WORKERS)
    folder, head = Path(out), _head(work, continued)
    if read_head(folder) is None:  # nothing is written for wrong input
        check_buildable(work)
    before = _claim(folder, head, resume)
    with folder_lock(folder):
        if before != head:
            write_json(folder / HEAD, {"format_version": FORMAT, **head})
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


CSV, PARQUET = "table.csv", "table.parquet"
_FIRST = ("status", "cost", "iterations", "gradient_norm", "guess", "start")
_PROOF = ("verdict", "mode", "feasible", "optimal", "robustness")
_LAST = ("reason", "proof_reason", "plan")
_HIDDEN = {"print"}
_ROWS = 10_000  # of a part of the Parquet file


def columns_of(store: Store, parameters: Iterable[str]) -> list[str]:
    """The names of all columns, in order."""
    first = ["task", *parameters, *_FIRST]
    here = [name for name in _PROOF if name in store.kinds]
    last = [*(name for name in _LAST if name in store.kinds or name != "proof_reason"), *TIMES[: 1 + bool(here)]]
    figures = sorted(set(store.kinds) - set(first) - set(_PROOF) - set(_LAST) - set(TIMES) - _HIDDEN)
    return [*first, *here, *figures, *last]


def write_tables(store: Store, parameters: Iterable[str]) -> list[Path]:
    """Write the tables of what is finished; the files written.

    Raises:
        FileError: One cannot be written.
    """
    columns = columns_of(store, parameters)
    paths = [store.folder / CSV]
    with write_atomically(paths[0]) as hidden, open(hidden, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows([_text(row.get(name)) for name in columns] for row in store.rows())
    if importlib.util.find_spec("pyarrow") is not None:
        paths.append(store.folder / PARQUET)
        with write_atomically(paths[1]) as hidden:
            _write_parquet(hidden, store, columns)
    return paths


def _text(value: Any) -> Any:
    """A value of the CSV: numbers with all their digits."""
    return repr(value) if isinstance(value, float) else "" if value is None else value


def _write_parquet(path: Path, store: Store, columns: list[str]) -> None:
    arrow: Any = importlib.import_module("pyarrow")
    parquet: Any = importlib.import_module("pyarrow.parquet")
    types = {"bool": arrow.bool_(), "int": arrow.int64(), "float": arrow.float64()}
    kinds = {name: _kind(store.kinds.get(name, {"str"})) for name in columns}
    schema = arrow.schema([(name, types.get(kind, arrow.string())) for name, kind in kinds.items()])
    with parquet.ParquetWriter(path, schema) as writer:
        left = store.rows()
        while rows := list(islice(left, _ROWS)):
            cast = [{name: _cast(row.get(name), kind) for name, kind in kinds.items()} for row in rows]
            writer.write_table(arrow.Table.from_pylist(cast, schema=schema))


def _kind(names: set[str]) -> str:
    """The one type that holds values of some."""
    names = names - {"NoneType"}
    if len(names) == 1:
        return next(iter(names))
    return "float" if names == {"int", "float"} else "str"


def _cast(value: Any, kind: str) -> Any:
    return None if value is None else float(value) if kind == "float" else str(value) if kind == "str" else value
