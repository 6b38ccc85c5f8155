"""The page: studies run in turn, and one table of what the paper says, what we get and why it differs.

A study is four functions: results() computes JSON values, markdown(results) is a page about them, rows(results) are its
rows of the table, and each picture is drawn from them. Where a study raises PlannerError its row says so.
"""

from __future__ import annotations

import multiprocessing
import re
import signal
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from planner.base.errors import PlannerError

COLUMNS = {"where": "where", "paper": "the paper says", "ours": "we get", "why": "why it differs"}
NOT_BUILT = "not built yet"

Row = dict[str, str]
"""Keys as in COLUMNS."""


@dataclass(frozen=True)
class Study:
    """One part of the paper beside ours.

    Attributes:
        name: In the command and in file names.
        about: What it shows, in some words.
        results: Computes everything, as JSON values.
        markdown: A page of Markdown from the results.
        rows: The rows of the table from the results.
        pictures: What draws each picture, by file name, given the results and a path.
        seconds: About what it takes, for beginning with the longest.
    """

    name: str
    about: str
    results: Callable[[], dict[str, Any]]
    markdown: Callable[[dict[str, Any]], str]
    rows: Callable[[dict[str, Any]], list[Row]]
    pictures: Mapping[str, Callable[[dict[str, Any], Path], None]] = field(default_factory=dict)
    seconds: float = 10.0


@dataclass(frozen=True)
class Finished:
    """A study that was run.

    Attributes:
        study: Which.
        seconds: It took, pictures included.
        results: What it computed; None where it failed.
        problem: Why it failed, "" where it did not.
    """

    study: Study
    seconds: float
    results: dict[str, Any] | None = None
    problem: str = ""

    @property
    def rows(self) -> list[Row]:
        """Its rows of the table."""
        if self.results is None:
            return [{"where": self.study.name, "paper": self.study.about, "ours": "failed", "why": self.problem}]
        return [{key: str(row.get(key, "")) for key in COLUMNS} for row in self.study.rows(self.results)]


def run_studies(
    studies: Sequence[Study], pictures: Path, note: Callable[[str], object] = lambda _: None, processes: int = 1
) -> list[Finished]:
    """Run studies and draw their pictures.

    Args:
        studies: In the order of the page.
        pictures: Folder that they are drawn into.
        note: Called with a line before and after each, or after each where several run at once.
        processes: How many run at the same time; those that take long begin first.
    """
    if processes > 1 and len(studies) > 1:
        return _run_together(studies, pictures, note, min(processes, len(studies)))
    done = []
    for number, study in enumerate(studies, 1):
        note(f"{number}/{len(studies)} {study.name}: {study.about}")
        done.append(run_study(study, pictures))
        note(f"    {_told(done[-1])}")
    return done


def run_study(study: Study, pictures: Path) -> Finished:
    """Run one study and draw its pictures."""
    began = time.perf_counter()
    try:
        results = study.results()
        for name, draw in study.pictures.items():
            draw(results, pictures / name)
        return Finished(study, time.perf_counter() - began, results)
    except PlannerError as error:
        return Finished(study, time.perf_counter() - began, problem=str(error))


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
            note(f"{len(done)}/{len(studies)} {one.study.name}: {one.study.about}: {_told(one)}")
    return [done[study.name] for study in studies]


def _ignore_interrupts() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent's business: it ends its children


def _told(one: Finished) -> str:
    return f"{one.seconds:.1f} s{f': {one.problem}' if one.problem else ''}"


def table_rows(done: Sequence[Finished], pending: Mapping[str, Sequence[Row]]) -> list[Row]:
    """All rows by section of the paper.

    Args:
        done: Studies that ran.
        pending: Rows of studies to come, by the study's name; they go where it ran.
    """
    ran = {one.study.name for one in done}
    rows = [row for one in done for row in one.rows]
    rows += [{"ours": NOT_BUILT, **row} for name, more in pending.items() if name not in ran for row in more]
    return sorted(rows, key=_section)


def complete(done: Sequence[Finished], rows: Sequence[Row]) -> bool:
    """Whether every study ran and no cell of the table is empty."""
    return not any(one.problem for one in done) and all(row.get(key, "").strip() for row in rows for key in COLUMNS)


def page(done: Sequence[Finished], rows: Sequence[Row], pictures: str, seconds: float) -> str:
    """The whole page.

    Args:
        done: Studies that ran.
        rows: Of the table.
        pictures: Where their pictures are, seen from the page: "" or a path with "/" at its end.
        seconds: That all took together.
    """
    lines = [
        "# The paper beside ours", "",
        'Bobrow, Park, Sideris, "Recent Advances on the Algorithmic Optimization of Robot Motion". Made by',
        f"`planner paper` in {seconds:.0f} s; the paper's times are those of a Pentium III at 800 MHz. Failures that",
        "the paper reports are results here too.", "",
        *_table(rows), "",
    ]  # fmt: skip
    for one in done:
        lines += [_section_of(one, pictures), ""]
    lines += ["## Seconds", "", "| study | s |", "|---|---:|"]
    lines += [f"| {one.study.name} | {one.seconds:.1f} |" for one in done]
    return "\n".join(lines) + "\n"


def _table(rows: Sequence[Row]) -> list[str]:
    """Rows as Markdown."""
    heads = f"| {' | '.join(COLUMNS.values())} |"
    return [heads, "|---|---|---|---|", *(f"| {' | '.join(_cell(row[key]) for key in COLUMNS)} |" for row in rows)]


def _cell(text: str) -> str:
    """Text that a cell can hold."""
    return " ".join(text.split()).replace("|", "\\|")


def _section(row: Row) -> tuple[int, int]:
    """The section of the paper that a row begins with; others come last."""
    match = re.match(r"(\d+)(?:\.(\d+))?", row["where"])
    return (int(match[1]), int(match[2] or 0)) if match else (99, 0)


def _section_of(one: Finished, pictures: str) -> str:
    """A study's page as a section of the whole one: headings from the second level on, pictures where they are."""
    if one.results is None:
        return f"## {one.study.name}\n\nFailed: {one.problem}"
    text = one.study.markdown(one.results).strip()
    levels = [len(marks) for marks in re.findall(r"^(#+) ", text, re.M)]
    if levels:
        text = re.sub(r"^(#+) ", lambda marks: "#" * (len(marks[1]) - min(levels) + 2) + " ", text, flags=re.M)
    else:
        text = f"## {one.study.about}\n\n{text}"
    for name in one.study.pictures:
        if f"]({name})" not in text:
            text += f"\n\n![{one.study.about}]({name})"
        text = text.replace(f"]({name})", f"]({pictures}{name})")
    return text
