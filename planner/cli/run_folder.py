"""The folder of a run: every file appears when it is finished, and an interrupted run can be continued.

A hidden file, the mark, names the run that the files belong to. It is written with the first file and removed after
the last one. A later run with the same identity that finds the mark makes only the missing files.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from planner.base.files import (
    PathLike,
    file_error,
    finite,
    folder_lock,
    json_text,
    open_folder,
    remove_empty,
    write_atomically,
)

MARK = ".planner-unfinished.json"
ROLLOUTS = ".planner-rollouts.npz"  # finished rollouts of a Monte Carlo


@dataclass
class RunFolder:
    """A folder that a run writes into."""

    path: Path
    outputs: tuple[str, ...]  # names of all files that a run may have
    run: str  # digest of the run's identity
    notes: dict[str, Any] = field(default_factory=dict)  # for the run that continues this one
    began: bool = False  # files of this run exist

    @property
    def finished(self) -> frozenset[str]:
        """Names of the finished files of this run."""
        return frozenset(name for name in self.outputs if self.began and (self.path / name).is_file())

    def begin(self, first: str, write: Callable[[Path], object], **notes: Any) -> None:
        """Write the first file of a run, then its mark, and remove the files of older runs."""
        with write_atomically(self.path / first) as unfinished:
            write(unfinished)  # a failure here, e.g. a full disk, leaves the older files as they are
            with write_atomically(self.path / MARK) as mark:
                mark.write_text(json_text({"run": self.run, "notes": notes}), encoding="utf-8")
            for name in {*self.outputs, ROLLOUTS} - {first}:
                (self.path / name).unlink(missing_ok=True)
        self.notes, self.began = notes, True

    def end(self) -> None:
        """Remove the mark of an unfinished run."""
        for name in (MARK, ROLLOUTS):
            (self.path / name).unlink(missing_ok=True)


@contextmanager
def run_folder(path: PathLike, outputs: Iterable[str], asked: dict[str, Any]) -> Iterator[RunFolder]:
    """Open the folder of a run, created with its parents if missing; `asked` holds the run's identity as JSON values.

    An exception leaves finished files; without any, created folders are removed again.

    Raises:
        FileError: The folder cannot be written, or another run is writing into it.
    """
    place = Path(path)
    run = hashlib.sha256(json.dumps(finite(asked), sort_keys=True).encode()).hexdigest()
    folder = RunFolder(place, tuple(outputs), run)
    probe, created = open_folder(place, folder.outputs)
    try:
        probe.rmdir()
        with folder_lock(place):
            mark = _mark(place / MARK)
            if mark.get("run") == run and (place / folder.outputs[0]).is_file():
                folder.began, folder.notes = True, mark.get("notes", {})
            yield folder
    except OSError as error:
        if error.filename is None or Path(error.filename).parent != place:
            raise
        raise file_error(error, place, expected="folder") from error
    finally:
        if not folder.began:
            remove_empty(created)


def _mark(path: Path) -> dict[str, Any]:
    """The mark of an unfinished run; empty where there is none or it cannot be read."""
    with suppress(OSError, ValueError, RecursionError):
        mark = json.loads(path.read_text(encoding="utf-8"))
        if isinstance(mark, dict) and isinstance(mark.get("notes"), dict):
            return mark
    return {}
