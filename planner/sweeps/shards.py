"""Shards: the plans of a sweep in a few archives, plans/000.zip with the plans of tasks 0 to 999, and so on.

The name of a plan follows from the number of its task, so no index is needed, and planner.load_plan reads
DIR/plans/000.zip/000017.npz. While a sweep runs its archives have no directory yet, which a zip file has at its end. A
killed process leaves them so: then whole entries are found again by their own headers, and the rest is cut off.
"""

from __future__ import annotations

import os
import struct
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path

from planner.base.files import write_atomically

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
            if _names(path) != sorted(names):
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


def _names(path: Path) -> list[str] | None:
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
