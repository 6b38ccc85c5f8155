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
    """One part of the paper beside ours.

    Attributes:
        name: In the command and in file names.
        title: One line about it.
        run: Computes the results, as JSON values.
        page: A page of Markdown from the results.
        rows: Rows of the table from the results.
        pictures: For each file name a function that draws it, given the results and a path.
        seconds: Rough duration; the longest studies start first.
    """

    name: str
    title: str
    run: Callable[..., dict[str, Any]]
    page: Callable[[dict[str, Any]], str]
    rows: Callable[[dict[str, Any]], list[Row]]
    pictures: Mapping[str, Callable[[dict[str, Any], Path], None]] = field(default_factory=dict)
    seconds: float = 10.0


def timed(work: Callable[[], Result]) -> tuple[Result, float]:
    """The result of some work, and the seconds that it took."""
    began = time.perf_counter()
    return work(), time.perf_counter() - began
