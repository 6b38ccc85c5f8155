"""A study of one part of the paper: it computes, writes a page, fills rows of the table and draws pictures."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

Result = TypeVar("Result")


class Row(NamedTuple):
    """A row of the table: section of the paper, what the paper says, what we get, and why it differs."""

    where: str
    paper: str
    ours: str
    why: str


@dataclass(frozen=True)
class Study:
    """One part of the paper beside ours."""

    name: str  # in the command and in file names
    title: str  # one line about it
    run: Callable[..., dict[str, Any]]  # computes the results, as JSON values
    lines: Callable[[dict[str, Any]], list[str]]  # of a page of Markdown, from the results
    rows: Callable[[dict[str, Any]], list[Row]]  # of the table, from the results
    pictures: Mapping[str, Callable[[dict[str, Any], Path], None]] = field(default_factory=dict)
    """For each file name a function that draws it, given the results and a path."""
    seconds: float = 10.0  # rough duration; the longest studies start first

    def page(self, results: dict[str, Any]) -> str:
        """The page of Markdown."""
        return "\n".join(self.lines(results)).rstrip("\n") + "\n"


def timed(work: Callable[[], Result]) -> tuple[Result, float]:
    """The result of some work, and the seconds that it took."""
    began = time.perf_counter()
    return work(), time.perf_counter() - began
