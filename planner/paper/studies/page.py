"""The page: all studies, and one table of what the paper says, what we get and why it differs.

Where a study raises PlannerError its row says so. Finished studies of a page that was stopped are kept in a Store.
"""

from __future__ import annotations

import base64
import json
import re
import shutil
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import planner
from planner.base.arguments import choice
from planner.base.data_files import json_text, write_json
from planner.base.errors import PlannerError
from planner.base.executors import ordered_map
from planner.base.files import digest_of
from planner.paper.studies import (
    dive,
    elbow,
    extremals,
    gradient,
    hopper,
    hopper_splines,
    masses,
    motion,
    objective,
    puma,
    shooting,
    step_page,
    step_splines,
    table_1,
    theorem,
)
from planner.paper.studies.study import Row, Study, row_of

_FIRST_TABLE = re.compile(r"(?:(?!\|).*\n)*(?:\|.*\n)*")  # all lines before a table, and the table

HEADS = ("where", "the paper says", "we get", "why it differs")

STUDIES: tuple[Study, ...] = tuple(
    module.STUDY
    for module in (
        motion, masses, shooting, elbow, step_page, step_splines, hopper_splines, table_1, gradient, extremals, theorem,
        hopper, objective, puma, dive,
    )
)  # fmt: skip


def chosen(names: Sequence[str]) -> list[Study]:
    """Studies by name, each once, in the order they are named; all of them where none is.

    Raises:
        PlannerError: No such study.
    """
    known = {study.name: study for study in STUDIES}
    return [known[choice("study", name, known)] for name in dict.fromkeys(names)] or list(STUDIES)


@dataclass(frozen=True)
class Finished:
    """A study that was run."""

    study: Study
    seconds: float  # of processor time that it took, pictures included
    results: dict[str, Any] | None = None  # None where it failed
    problem: str = ""  # why it failed
    pictures: dict[str, bytes] = field(default_factory=dict)  # contents of their files by name

    @property
    def rows(self) -> list[Row]:
        """Its rows of the table."""
        if self.results is None:
            return [Row(self.study.name, self.study.title, "failed", self.problem)]
        return self.study.rows(self.results)


class Store:
    """Finished studies of an unfinished page, by the code that computed them; in a folder, which drop() removes."""

    def __init__(self, folder: Path, full: bool) -> None:
        code = sorted(Path(planner.__file__).parent.rglob("*.py"))
        self._root, self._folder = (
            folder,
            folder / digest_of(b"".join(path.read_bytes() for path in code) + b"%d" % full),
        )

    def load(self, study: Study) -> Finished | None:
        """What was kept of a study, if anything."""
        path = self._folder / f"{study.name}.json"
        if not path.is_file():
            return None
        kept = json.loads(path.read_text(encoding="utf-8"))
        pictures = {name: base64.b64decode(content) for name, content in kept["pictures"].items()}
        return Finished(study, kept["seconds"], kept["results"], "", pictures)

    def save(self, one: Finished) -> None:
        """Keep a study that succeeded."""
        if one.results is not None:
            self._folder.mkdir(parents=True, exist_ok=True)
            pictures = {name: base64.b64encode(content).decode() for name, content in one.pictures.items()}
            content = {"seconds": one.seconds, "results": one.results, "pictures": pictures}
            write_json(self._folder / f"{one.study.name}.json", content)

    def drop(self) -> None:
        """Forget all."""
        shutil.rmtree(self._root, ignore_errors=True)


def run_studies(
    studies: Sequence[Study], pictures: Path, note: Callable[[str], object] = lambda _: None,
    executor: Executor | None = None, *, full: bool = False, store: Store | None = None,
) -> list[Finished]:  # fmt: skip
    """Run studies, here or on an executor, and write their pictures into a folder; the longest begin first.

    `note` is called with a line for each study that is done. With `full` the numbers are those of the documents. What
    a store has is not run again; it is given all that succeeds.
    """
    kept = [one for study in studies if store is not None and (one := store.load(study)) is not None]
    known = {one.study.name for one in kept}
    left = sorted((study for study in studies if study.name not in known), key=lambda study: -study.seconds)
    done: dict[str, Finished] = {}
    for results in (kept, ordered_map(executor, partial(run_study, full=full), left)):
        for one in results:
            for name, content in one.pictures.items():
                (pictures / name).write_bytes(content)
            if store is not None and one.study.name not in known:
                store.save(one)
            done[one.study.name] = one
            result = f"{one.seconds:.1f} s{f': {one.problem}' if one.problem else ''}"
            note(f"{len(done)}/{len(studies)} {one.study.name}: {one.study.title}: {result}")
    return [done[study.name] for study in studies]


def run_study(study: Study, full: bool = False) -> Finished:
    """Run one study and draw its pictures; `seconds` are of its processor time."""
    began, pictures = time.process_time(), {}
    results, problem = None, ""
    try:
        results = study.full() if full and study.full is not None else study.run()
        results = json.loads(json_text(results))  # the same whether it was kept or not
        with tempfile.TemporaryDirectory() as folder:
            for name, draw in study.pictures.items():
                draw(results, Path(folder, name))
                pictures[name] = Path(folder, name).read_bytes()
    except PlannerError as error:
        results, problem = None, str(error)
    return Finished(study, time.process_time() - began, results, problem, pictures)


def table_rows(done: Sequence[Finished]) -> list[Row]:
    """All rows by section of the paper."""
    return sorted((row for one in done for row in one.rows), key=_section)


def complete(done: Sequence[Finished], rows: Sequence[Row]) -> bool:
    """Whether every study ran and no cell of the table is empty."""
    return not any(one.problem for one in done) and all(cell.strip() for row in rows for cell in row)


def page(done: Sequence[Finished], rows: Sequence[Row], pictures: str, full: bool) -> str:
    """The whole page of studies and rows.

    `pictures` is the folder of their pictures, seen from the page: "" or a path with "/" at its end.
    """
    lines = [
        "# The paper beside ours", "",
        'Bobrow, Park, Sideris, "Recent Advances on the Algorithmic Optimization of Robot Motion". Made by',
        f"`planner paper{' --full' if full else ''}` in {sum(one.seconds for one in done):.0f} s of processor time. "
        "Here is the first table of every study; all of it, with its seconds: "
        + ", ".join(f"[{one.study.name}]({pictures}{one.study.name}.md) {one.seconds:.0f}" for one in done) + ".",
        "Where the paper names a computer, it is a Pentium III at 800 MHz. Failures that it reports are results here",
        "too.", "",
        row_of(HEADS), "|---|---|---|---|", *(row_of(map(_cell, row)) for row in rows), "",
    ]  # fmt: skip
    for one in done:
        lines += [_section_of(one, pictures), ""]
    return "\n".join(lines).rstrip("\n") + "\n"


def _cell(text: str) -> str:
    """The text for a cell of a Markdown table: one line, with escaped bars."""
    return " ".join(text.split()).replace("|", "\\|")


def _section(row: Row) -> tuple[int, int]:
    """The key that sorts rows by the section of the paper that they begin with; others come last."""
    match = re.match(r"(\d+)(?:\.(\d+))?", row.where)
    return (int(match[1]), int(match[2] or 0)) if match else (99, 0)


def _section_of(one: Finished, pictures: str) -> str:
    """A study's page as a section of the whole one: to the end of its first table, and its pictures.

    Headings begin at the second level.
    """
    if one.results is None:
        return f"## {one.study.name}\n\nFailed: {one.problem}"
    text = one.study.page(one.results).strip()
    levels = [len(marks) for marks in re.findall(r"^(#+) ", text, re.M)]
    if levels:
        text = re.sub(r"^(#+) ", lambda marks: "#" * (len(marks[1]) - min(levels) + 2) + " ", text, flags=re.M)
    else:
        text = f"## {one.study.title}\n\n{text}"
    text = _FIRST_TABLE.match(text + "\n")[0].strip()  # type: ignore[index]
    for name in one.study.pictures:
        if f"]({name})" not in text:
            text += f"\n\n![{one.study.title}]({name})"
        text = text.replace(f"]({name})", f"]({pictures}{name})")
    return text
