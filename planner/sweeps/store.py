"""Store: the folder of a sweep, to which finished tasks are appended. What is in it survives a kill at any moment.

    sweep.json     what is swept: the grid and how its tasks are done
    rows.jsonl     a line a finished task, in the order in which they ended
    plans/         the plans, see shards
    table.csv      a row a task, by its number; table.parquet too, where pyarrow is installed

A plan is written before its row, and a row counts when its line is complete. So a task has a row and its plan, or
neither; where the disk is full, the unfinished line is cut off.
"""

from __future__ import annotations

import csv
import importlib
import importlib.util
import json
import os
from collections.abc import Collection, Iterable, Iterator
from itertools import islice
from pathlib import Path
from typing import IO, Any

import numpy as np

from planner.base.errors import FileError
from planner.base.files import file_error, read_text, write_atomically
from planner.base.json_files import write_json
from planner.cases.plan_file import load_plan
from planner.problem.plan import Plan, Status
from planner.sweeps.shards import Shards, plan_place
from planner.sweeps.work import Done

HEAD, ROWS, PLANS = "sweep.json", "rows.jsonl", "plans"
FORMAT = 1
TIMES = ("solve_seconds", "prove_seconds")
"""Columns that differ from one run to the next."""


class Store:
    """Rows and plans on disk. Memory holds the place of each row, not the rows.

    Args:
        folder: Of the sweep.
        tasks: How many it has.
    """

    def __init__(self, folder: Path, tasks: int) -> None:
        self.folder = folder
        self.places = np.empty(tasks, np.int64)  # bytes in rows.jsonl where a task's line begins, -1 for none
        self._shards = Shards(folder / PLANS)
        self._rows: IO[bytes] | None = None
        self._begin()

    @property
    def finished(self) -> int:
        """How many tasks have a row."""
        return int(np.count_nonzero(self.places >= 0))

    def read(self) -> None:
        """Read what is there; an unfinished line and what follows it do not count."""
        path = self.folder / ROWS
        if not path.exists():
            return
        with open(path, "rb") as file:
            for line in file:
                row = _row(line)
                if row is None or not 0 <= row["task"] < len(self.places):
                    break
                if self.places[row["task"]] < 0:
                    self._count(row)
                    self.places[row["task"]] = self._end
                self._end += len(line)

    def forget(self, tasks: Collection[int]) -> None:
        """Remove rows, so that their tasks are done again; open() removes the plans.

        Raises:
            FileError: The folder cannot be written.
        """
        remaining = np.sort([place for task, place in enumerate(self.places) if place >= 0 and task not in tasks])
        path = self.folder / ROWS
        with write_atomically(path) as hidden, open(hidden, "wb") as fewer, open(path, "rb") as file:
            for place in remaining:
                file.seek(int(place))
                fewer.write(file.readline())
        self._begin()
        self.read()

    def open(self) -> None:
        """Begin to append, after whatever read() found.

        Raises:
            FileError: The folder cannot be written.
        """
        try:
            (self.folder / PLANS).mkdir(parents=True, exist_ok=True)
            planned = {row["task"] for row in self.rows() if row.get("plan")}
            self._shards.retain(planned)
            handle = os.open(self.folder / ROWS, os.O_RDWR | os.O_CREAT, 0o666)
            self._rows = os.fdopen(handle, "r+b", buffering=0)
            self._rows.truncate(self._end)
            self._rows.seek(self._end)
        except OSError as error:
            raise file_error(error, self.folder, expected="folder") from error

    def append(self, done: Iterable[Done]) -> None:
        """Write finished tasks.

        Raises:
            FileError: The disk is full, say. What was written before stays.
        """
        assert self._rows is not None  # it is open
        lines: list[tuple[dict[str, Any], bytes]] = []
        try:
            for one in done:
                row = one.row
                if self.places[row["task"]] >= 0:
                    continue
                if one.plan is not None:
                    self._shards.add(row["task"], one.plan)
                    row = row | {"plan": plan_place(row["task"])}
                lines.append((row, (json.dumps(row) + "\n").encode()))
            self._shards.flush()
            written = 0
            text = b"".join(line for _, line in lines)
            while written < len(text):
                written += self._rows.write(text[written:])
        except OSError as error:
            self._rows.truncate(self._end)
            raise file_error(error, self.folder, expected="folder") from error
        for row, line in lines:
            self._count(row)
            self.places[row["task"]] = self._end
            self._end += len(line)

    def close(self) -> None:
        """Finish the archives.

        Raises:
            FileError: The disk is full, say; --resume makes them whole again.
        """
        try:
            if self._rows is not None:
                self._rows.close()
                self._rows = None
            self._shards.close()
        except OSError as error:
            raise file_error(error, self.folder, expected="folder") from error

    def rows(self) -> Iterator[dict[str, Any]]:
        """The rows by the numbers of their tasks, one at a time."""
        if self.finished:
            with open(self.folder / ROWS, "rb") as file:
                for place in self.places:
                    if place >= 0:
                        file.seek(int(place))
                        row = _row(file.readline())
                        assert row is not None  # it was whole when it was written
                        yield row

    def row(self, task: int) -> dict[str, Any] | None:
        """The row of a task, or None."""
        if self.places[task] < 0:
            return None
        with open(self.folder / ROWS, "rb") as file:
            file.seek(int(self.places[task]))
            return _row(file.readline())

    def plan(self, task: int) -> Plan:
        """The plan of a task.

        Raises:
            FileError: There is none.
        """
        return load_plan(self.folder / plan_place(task))

    def controls(self, task: int) -> np.ndarray | None:
        """The controls (N, nu) of a finished task that converged, else None."""
        row = self.row(task)
        return self.plan(task).us if row is not None and Status[row["status"]].converged else None

    def _begin(self) -> None:
        """Reset to an empty table."""
        self.places[:] = -1
        self.kinds: dict[str, set[str]] = {}  # names of the types in each column
        self.statuses: dict[str, int] = {}
        self._end = 0

    def _count(self, row: dict[str, Any]) -> None:
        self.statuses[row["status"]] = self.statuses.get(row["status"], 0) + 1
        for name, value in row.items():
            self.kinds.setdefault(name, set()).add(type(value).__name__)


def write_head(folder: Path, head: dict[str, Any]) -> None:
    """Write what is swept.

    Raises:
        FileError: It cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise file_error(error, folder, expected="folder") from error
    write_json(folder / HEAD, {"format_version": FORMAT, **head})


def read_head(folder: Path) -> dict[str, Any] | None:
    """What is swept in a folder; None where nothing is.

    Raises:
        FileError: Its sweep.json is none.
    """
    if not (folder / HEAD).exists():
        return None
    try:
        head = json.loads(read_text(folder / HEAD, "the sweep"))
        if head.pop("format_version") == FORMAT:
            return head
    except (ValueError, RecursionError, AttributeError, KeyError):
        pass
    raise FileError(f"{folder / HEAD} is not a sweep of this version, expected what planner sweep wrote.")


def _row(line: bytes) -> dict[str, Any] | None:
    """A row, or None for a line that is not whole."""
    if not line.endswith(b"\n"):
        return None
    try:
        row = json.loads(line)
    except ValueError:
        return None
    whole = isinstance(row, dict) and isinstance(row.get("task"), int) and isinstance(row.get("status"), str)
    return row if whole else None


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
    if has_parquet():
        paths.append(store.folder / PARQUET)
        with write_atomically(paths[1]) as hidden:
            _write_parquet(hidden, store, columns)
    return paths


def has_parquet() -> bool:
    """Whether pyarrow is installed."""
    return importlib.util.find_spec("pyarrow") is not None


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
        for rows in _parts(store.rows()):
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


def _parts(rows: Iterator[dict[str, Any]]) -> Iterator[list[dict[str, Any]]]:
    while part := list(islice(rows, _ROWS)):
        yield part
