"""The page: studies run in turn, and one table of what the paper says, what we get and why it differs.

Where a study raises PlannerError its row says so.
"""

from __future__ import annotations

import multiprocessing
import re
import signal
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from planner.base.errors import PlannerError
from planner.paper.studies.records import row_of
from planner.paper.studies.study import Row, Study, timed

HEADS = ("where", "the paper says", "we get", "why it differs")


@dataclass(frozen=True)
class Finished:
    """A study that was run."""

    study: Study
    seconds: float  # it took, pictures included
    results: dict[str, Any] | None = None  # None where it failed
    problem: str = ""  # why it failed

    @property
    def rows(self) -> list[Row]:
        """Its rows of the table."""
        if self.results is None:
            return [Row(self.study.name, self.study.title, "failed", self.problem)]
        return self.study.rows(self.results)


def run_studies(
    studies: Sequence[Study], pictures: Path, note: Callable[[str], object] = lambda _: None, processes: int = 1
) -> list[Finished]:
    """Run studies, so many processes at a time, and draw their pictures into a folder; the longest begin first.

    `note` is called with a line before and after each study, or only after each where several run at once.
    """
    if processes > 1 and len(studies) > 1:
        return _run_together(studies, pictures, note, min(processes, len(studies)))
    done = []
    for number, study in enumerate(studies, 1):
        note(f"{number}/{len(studies)} {study.name}: {study.title}")
        done.append(run_study(study, pictures))
        note(f"    {_told(done[-1])}")
    return done


def run_study(study: Study, pictures: Path) -> Finished:
    """Run one study and draw its pictures."""

    def work() -> tuple[dict[str, Any] | None, str]:
        try:
            results = study.run()
            for name, draw in study.pictures.items():
                draw(results, pictures / name)
        except PlannerError as error:
            return None, str(error)
        return results, ""

    (results, problem), seconds = timed(work)
    return Finished(study, seconds, results, problem)


def _run_together(
    studies: Sequence[Study], pictures: Path, note: Callable[[str], object], processes: int
) -> list[Finished]:
    """Studies in processes of their own, which an interrupt ends with this one."""
    note(f"{len(studies)} studies, {processes} at a time: {', '.join(study.name for study in studies)}")
    done: dict[str, Finished] = {}
    with multiprocessing.get_context("spawn").Pool(processes, _ignore_interrupts) as pool:
        longest_first = sorted(studies, key=lambda study: -study.seconds)
        for one in pool.imap_unordered(partial(run_study, pictures=pictures), longest_first):
            done[one.study.name] = one
            note(f"{len(done)}/{len(studies)} {one.study.name}: {one.study.title}: {_told(one)}")
    return [done[study.name] for study in studies]


def _ignore_interrupts() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent's business: it ends its children


def _told(one: Finished) -> str:
    return f"{one.seconds:.1f} s{f': {one.problem}' if one.problem else ''}"


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
    """Text that a cell can hold."""
    return " ".join(text.split()).replace("|", "\\|")


def _section(row: Row) -> tuple[int, int]:
    """The section of the paper that a row begins with; others come last."""
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
