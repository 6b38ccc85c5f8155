"""The page: all studies, and one table of what the paper says, what we get and why it differs.

Where a study raises PlannerError its row says so.
"""

from __future__ import annotations

import re
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from planner.base.arguments import choice
from planner.base.errors import PlannerError
from planner.base.executors import ordered_map
from planner.paper.studies import (
    dive,
    elbow,
    gradient,
    hopper,
    hopper_splines,
    masses,
    motion,
    objective,
    puma,
    shooting,
    step_page,
    table_1,
    theorem,
)
from planner.paper.studies.study import Row, Study, row_of

HEADS = ("where", "the paper says", "we get", "why it differs")

STUDIES: tuple[Study, ...] = tuple(
    module.STUDY
    for module in (
        motion, masses, shooting, elbow, hopper_splines, table_1, gradient, theorem, hopper, objective, puma, dive,
        step_page,
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
    seconds: float  # it took, pictures included
    results: dict[str, Any] | None = None  # None where it failed
    problem: str = ""  # why it failed
    pictures: dict[str, bytes] = field(default_factory=dict)  # contents of their files by name

    @property
    def rows(self) -> list[Row]:
        """Its rows of the table."""
        if self.results is None:
            return [Row(self.study.name, self.study.title, "failed", self.problem)]
        return self.study.rows(self.results)


def run_studies(
    studies: Sequence[Study], pictures: Path, note: Callable[[str], object] = lambda _: None,
    executor: Executor | None = None,
) -> list[Finished]:  # fmt: skip
    """Run studies, here or on an executor, and write their pictures into a folder; the longest begin first.

    `note` is called with a line for each study that is done.
    """
    done: dict[str, Finished] = {}
    for one in ordered_map(executor, run_study, sorted(studies, key=lambda study: -study.seconds)):
        for name, content in one.pictures.items():
            (pictures / name).write_bytes(content)
        done[one.study.name] = one
        result = f"{one.seconds:.1f} s{f': {one.problem}' if one.problem else ''}"
        note(f"{len(done)}/{len(studies)} {one.study.name}: {one.study.title}: {result}")
    return [done[study.name] for study in studies]


def run_study(study: Study) -> Finished:
    """Run one study and draw its pictures."""
    began, pictures = time.perf_counter(), {}
    results, problem = None, ""
    try:
        results = study.run()
        with tempfile.TemporaryDirectory() as folder:
            for name, draw in study.pictures.items():
                draw(results, Path(folder, name))
                pictures[name] = Path(folder, name).read_bytes()
    except PlannerError as error:
        results, problem = None, str(error)
    return Finished(study, time.perf_counter() - began, results, problem, pictures)


def table_rows(done: Sequence[Finished]) -> list[Row]:
    """All rows by section of the paper."""
    return sorted((row for one in done for row in one.rows), key=_section)


def complete(done: Sequence[Finished], rows: Sequence[Row]) -> bool:
    """Whether every study ran and no cell of the table is empty."""
    return not any(one.problem for one in done) and all(cell.strip() for row in rows for cell in row)


def page(done: Sequence[Finished], rows: Sequence[Row], pictures: str, seconds: float) -> str:
    """The whole page of studies and rows that took so many seconds together.

    `pictures` is the folder of their pictures, seen from the page: "" or a path with "/" at its end.
    """
    lines = [
        "# The paper beside ours", "",
        'Bobrow, Park, Sideris, "Recent Advances on the Algorithmic Optimization of Robot Motion". Made by',
        f"`planner paper` in {seconds:.0f} s; the paper's times are those of a Pentium III at 800 MHz. Failures that",
        "the paper reports are results here too.", "",
        row_of(HEADS), "|---|---|---|---|", *(row_of(map(_cell, row)) for row in rows), "",
    ]  # fmt: skip
    for one in done:
        lines += [_section_of(one, pictures), ""]
    lines += ["## Seconds", "", "| study | s |", "|---|---:|"]
    lines += [f"| {one.study.name} | {one.seconds:.1f} |" for one in done]
    return "\n".join(lines) + "\n"


def _cell(text: str) -> str:
    """The text for a cell of a Markdown table: one line, with escaped bars."""
    return " ".join(text.split()).replace("|", "\\|")


def _section(row: Row) -> tuple[int, int]:
    """The key that sorts rows by the section of the paper that they begin with; others come last."""
    match = re.match(r"(\d+)(?:\.(\d+))?", row.where)
    return (int(match[1]), int(match[2] or 0)) if match else (99, 0)


def _section_of(one: Finished, pictures: str) -> str:
    """A study's page as a section of the whole one: headings from the second level on, pictures where they are."""
    if one.results is None:
        return f"## {one.study.name}\n\nFailed: {one.problem}"
    text = one.study.page(one.results).strip()
    levels = [len(marks) for marks in re.findall(r"^(#+) ", text, re.M)]
    if levels:
        text = re.sub(r"^(#+) ", lambda marks: "#" * (len(marks[1]) - min(levels) + 2) + " ", text, flags=re.M)
    else:
        text = f"## {one.study.title}\n\n{text}"
    for name in one.study.pictures:
        if f"]({name})" not in text:
            text += f"\n\n![{one.study.title}]({name})"
        text = text.replace(f"]({name})", f"]({pictures}{name})")
    return text
