"""Console: the only place that prints. Results go to stdout, progress and tables of work to stderr.

With --json stdout carries one JSON document and nothing else.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Iterable, Sequence
from typing import Any

from planner.base.jsonable import finite
from planner.problem.plan import Iteration, Start
from planner.solvers.free_time import Tried
from planner.solvers.periodic import Pass


class Console:
    """What a command says.

    Args:
        as_json: Print one JSON document at the end instead of text.
        quiet: No progress.
    """

    def __init__(self, as_json: bool = False, quiet: bool = False) -> None:
        self.as_json = as_json
        self.quiet = quiet
        self.lost = ""  # why results could not be printed
        self._live = sys.stderr is not None and sys.stderr.isatty()
        self._drawn = 0.0

    def _print(self, text: str, *, result: bool, end: str = "\n") -> None:
        """Print, or remember why not: a reader that went away must not undo work that is done."""
        stream = sys.stdout if result else sys.stderr
        if stream is None or (result and self.lost):
            return
        try:
            print(text, file=stream, end=end, flush=True)
        except OSError as error:
            # What is still buffered would fail again at exit.
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
            if result:
                self.lost = "" if isinstance(error, BrokenPipeError) else str(error.strerror)

    def say(self, text: str = "") -> None:
        """A line of the result; with --json it goes to stderr."""
        self._print(text, result=not self.as_json)

    def note(self, text: str) -> None:
        """A line about the work in progress."""
        if not self.quiet:
            self._print(text, result=False)

    def complain(self, text: str) -> None:
        """What was wrong, in one sentence."""
        self._print(f"planner: {text}", result=False)

    def document(self, content: dict[str, Any]) -> None:
        """The result for machines; only with --json."""
        if self.as_json:
            self._print(json.dumps(finite(content), indent=2, allow_nan=False), result=True)

    def table(self, heads: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
        """A table with aligned columns: the first to the left, the others as their heads."""
        cells = [list(map(str, row)) for row in rows]
        widths = [max(map(len, column)) for column in zip(heads, *cells, strict=True)]
        for row in (list(heads), ["-" * width for width in widths], *cells):
            self.say("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())

    def iteration(self, line: Iteration) -> None:
        """One line of the live iteration table: all of them on a terminal, a thinned table in a log."""
        if self.quiet:
            return
        if line.iteration == 0:
            self.note(Iteration.header())
        i = line.iteration
        if self._live or i < 10 or (i < 100 and i % 10 == 0) or i % 100 == 0:
            self.note(str(line))

    def start(self, line: Start) -> None:
        """One line of the live table of starts."""
        if line.number == 0:
            self.note(Start.header())
        self.note(str(line))

    def tried(self, line: Tried) -> None:
        """One line of the live table of durations."""
        if line.number == 0:
            self.note(Tried.header())
        self.note(str(line))

    def passed(self, line: Pass) -> None:
        """One line of the live table of passes."""
        if line.number == 0:
            self.note(Pass.header())
        self.note(str(line))

    def progress(self, what: str, done: int, total: int) -> None:
        """A counter that overwrites itself on a terminal; a line at the end elsewhere."""
        if self.quiet:
            return
        now = time.monotonic()
        if self._live and (done == total or now - self._drawn > 0.1):
            self._drawn = now
            end = "\n" if done == total else ""
            self._print(f"\r{what}: {done}/{total}", result=False, end=end)
        elif not self._live and done == total:
            self.note(f"{what}: {done}/{total}")
