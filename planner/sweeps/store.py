"""Store: the folder of a sweep, to which finished tasks are appended. What is in it survives a kill at any moment.

    sweep.json     what is swept: the grid and how its tasks are done
    rows.jsonl     a line a finished task, in the order in which they ended
    plans/         the plans in shards, a few archives: 000.zip has those of tasks 0 to 999, and so on

A plan is written before its row, and a row counts when its line is complete. So a task has a row and its plan, or
neither; where the disk is full, the unfinished line is cut off.

The name of a plan follows from the number of its task, so no index is needed, and planner.load_plan reads
DIR/plans/000.zip/000017.npz. While a sweep runs its archives have no directory yet, which a zip file has at its end. A
killed process leaves them so: then whole entries are found again by their own headers, and the rest is cut off.
"""

from __future__ import annotations

import json
import os
import struct
import zipfile
import zlib
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import IO, Any

import numpy as np

from planner.base.errors import FileError
from planner.base.files import file_error, read_text, write_atomically
from planner.cases.plan_file import load_plan
from planner.problem.plan import Plan, Status
from planner.sweeps.work import Done

PER_SHARD = 1000
_OPEN = 8  # archives open at the same time
_HEADER = struct.Struct("<4s5H3I2H")  # of an entry of a zip file
_EPOCH = (1980, 1, 1, 0, 0, 0)  # the same content gives the same bytes


def plan_place(task: int) -> str:
    """Where the plan of a task is, relative to the sweep's folder."""
    return f"plans/{task // PER_SHARD:03d}.zip/{_name(task)}"


def _name(task: int) -> str:
    return f"{task:06d}.npz"


class Shards:
    """Archives of plans that grow.

    Args:
        folder: Theirs, which exists.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._open: dict[int, zipfile.ZipFile] = {}

    def add(self, task: int, content: bytes) -> None:
        """Append a plan; OSError where it cannot be written."""
        self._archive(task // PER_SHARD).writestr(_entry(task), content)

    def flush(self) -> None:
        """Give what was added to the system, so that it outlives this process."""
        for archive in self._open.values():
            assert archive.fp is not None  # it is open
            archive.fp.flush()

    def close(self) -> None:
        """Write the directories of all archives; OSError where one cannot be written."""
        while self._open:
            self._open.pop(next(iter(self._open))).close()

    def retain(self, tasks: set[int]) -> None:
        """Remove plans of other tasks from the archives, and repair archives that a killed process left."""
        for path in sorted(self._folder.glob("*.zip")):
            names = {_name(task) for task in tasks if task // PER_SHARD == int(path.stem)}
            if _plan_names(path) != sorted(names):
                entries = {name: content for name, content in _entries(path) if name in names}
                with write_atomically(path) as hidden, zipfile.ZipFile(hidden, "w") as archive:
                    for name, content in entries.items():
                        archive.writestr(_entry(int(name[:-4])), content)

    def _archive(self, number: int) -> zipfile.ZipFile:
        if number not in self._open:
            if len(self._open) >= _OPEN:
                self._open.pop(next(iter(self._open))).close()
            self._open[number] = zipfile.ZipFile(self._folder / f"{number:03d}.zip", "a")
        return self._open[number]


def _entry(task: int) -> zipfile.ZipInfo:
    """The name of a plan; what it holds is compressed already."""
    return zipfile.ZipInfo(_name(task), _EPOCH)


def _plan_names(path: Path) -> list[str] | None:
    """Sorted names in an archive; None where it has no directory."""
    try:
        with zipfile.ZipFile(path) as archive:
            return sorted(archive.namelist())
    except (zipfile.BadZipFile, ValueError, OSError):
        return None


def _entries(path: Path) -> Iterator[tuple[str, bytes]]:
    """Whole entries of an archive, by their own headers, up to the first that is not whole."""
    size = os.path.getsize(path)
    with open(path, "rb") as file:
        while len(head := file.read(_HEADER.size)) == _HEADER.size:
            mark, _, _, method, _, _, crc, packed, unpacked, name, extra = _HEADER.unpack(head)
            if mark != b"PK\3\4" or method != zipfile.ZIP_STORED or packed != unpacked or packed > size:
                return
            named = file.read(name).decode("ascii", errors="replace")
            file.seek(extra, os.SEEK_CUR)
            content = file.read(packed)
            if len(content) < packed or zlib.crc32(content) != crc:
                return
            yield named, content


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
                self._count(row, line)

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
            self._count(row, line)

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
        converged = row is not None and row["status"] in {one.name for one in Status if one.converged}
        return self.plan(task).us if converged else None

    def _begin(self) -> None:
        """Reset to an empty table."""
        self.places[:] = -1
        self.kinds: dict[str, set[str]] = {}  # names of the types in each column
        self.statuses: dict[str, int] = {}
        self._end = 0

    def _count(self, row: dict[str, Any], line: bytes) -> None:
        """Note a row and where its line is, unless its task has one."""
        if self.places[row["task"]] < 0:
            self.statuses[row["status"]] = self.statuses.get(row["status"], 0) + 1
            for name, value in row.items():
                self.kinds.setdefault(name, set()).add(type(value).__name__)
            self.places[row["task"]] = self._end
        self._end += len(line)


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
