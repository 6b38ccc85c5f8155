"""The folder of a run: every file is there as soon as it is finished, and an interrupted run goes on from there.

A hidden mark says which run the files belong to. It is written when the first of them is, when the files of older runs
go, and removed when the last is. A later run of the same plan that finds it does only what is missing.
"""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from planner.base.errors import FileError
from planner.base.files import (
    PathLike,
    file_error,
    missing_folders,
    refuse_other_than_file,
    remove_empty,
    write_atomically,
)
from planner.base.jsonable import finite, json_text

MARK = ".planner-unfinished.json"
ROLLOUTS = ".planner-rollouts.npz"  # finished rollouts of a Monte Carlo


@dataclass
class RunFolder:
    """A folder that a run writes into.

    Attributes:
        path: The folder.
        outputs: Names of all files that a run may have.
        run: A digest of what was asked for.
        notes: What a run wrote down for the one that goes on with it.
        began: Whether files of this run are there.
    """

    path: Path
    outputs: tuple[str, ...]
    run: str
    notes: dict[str, Any] = field(default_factory=dict)
    began: bool = False

    @property
    def finished(self) -> frozenset[str]:
        """Names of the files of this run that are there."""
        return frozenset(name for name in self.outputs if self.began and (self.path / name).is_file())

    def begin(self, first: str, write: Callable[[Path], object], **notes: Any) -> None:
        """Write the first file of a run; those of older runs go first: they are of another plan."""
        with write_atomically(self.path / first) as unfinished:
            write(unfinished)  # what fails here, a full disk for one, leaves the older files as they are
            with write_atomically(self.path / MARK) as mark:
                mark.write_text(json_text({"run": self.run, "notes": notes}), encoding="utf-8")
            for name in {*self.outputs, ROLLOUTS} - {first}:
                (self.path / name).unlink(missing_ok=True)
        self.notes, self.began = notes, True

    def end(self) -> None:
        """All is there."""
        for name in (MARK, ROLLOUTS):
            (self.path / name).unlink(missing_ok=True)


@contextmanager
def run_folder(path: PathLike, outputs: Iterable[str], asked: dict[str, Any]) -> Iterator[RunFolder]:
    """The folder of a run; it and its missing parents are made, so that an unwritable one fails before any work.

    On an exception what was finished stays. A folder in which nothing was is removed again.

    Args:
        path: The folder.
        outputs: Names of all files that a run may have.
        asked: What makes two runs the same, JSON values.

    Raises:
        FileError: The folder cannot be written: what was wrong and what was expected.
    """
    place, created = Path(path), []
    run = hashlib.sha256(json.dumps(finite(asked), sort_keys=True).encode()).hexdigest()
    folder = RunFolder(place, tuple(outputs), run)
    try:
        created = missing_folders(place)
        place.mkdir(parents=True, exist_ok=True)
        for name in folder.outputs:
            refuse_other_than_file(place / name)
        handle, probe = tempfile.mkstemp(prefix=".planner-", dir=place)
        os.close(handle)
        os.unlink(probe)
    except FileError:
        remove_empty(created)
        raise
    except (OSError, ValueError) as error:
        remove_empty(created)
        raise file_error(error, place, expected="folder") from error
    mark = _mark(place / MARK)
    if mark.get("run") == run and (place / folder.outputs[0]).is_file():
        folder.began, folder.notes = True, mark.get("notes", {})
    try:
        yield folder
    except OSError as error:
        if error.filename is None or Path(error.filename).parent != place:
            raise
        raise file_error(error, place, expected="folder") from error
    finally:
        if not folder.began:
            remove_empty(created)


def _mark(path: Path) -> dict[str, Any]:
    """What an unfinished run left; empty when there is none, or nothing that can be used."""
    with suppress(OSError, ValueError, RecursionError):
        mark = json.loads(path.read_text(encoding="utf-8"))
        if isinstance(mark, dict) and isinstance(mark.get("notes"), dict):
            return mark
    return {}
