"""The only file that prints: results to stdout, progress to stderr; with --json stdout holds one JSON document."""

from __future__ import annotations

import json
import os
import shutil
import sys
import textwrap
import time
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any

from planner.base.data_files import finite
from planner.base.measured import aligned

if TYPE_CHECKING:
    from planner.problem.plan import Iteration, Start
    from planner.solvers.continuation import RelaxationStep
    from planner.solvers.free_time import DurationTrial
    from planner.solvers.periodic import PeriodicPass

_LONGEST = 1000  # characters of a sentence that quotes what it was given


def shown(value: object) -> str:
    """A value for a table: numbers in five digits, lists as words, "" for None."""
    if isinstance(value, list):
        return " ".join(map(str, value))
    return "" if value is None else f"{value:.5g}" if isinstance(value, float) else str(value)


def _escaped(one: str) -> str:
    return one.encode("unicode_escape").decode()


class Console:
    """Output of a command: text, or one JSON document at the end (`as_json`).

    `quiet` prints no progress; `verbose` every line of it, and tables whole.

    Characters that a terminal does not print are escaped here: names in a file must not move its cursor.
    """

    def __init__(self, as_json: bool = False, quiet: bool = False, verbose: bool = False) -> None:
        self.as_json, self.quiet, self.verbose = as_json, quiet, verbose
        self.lost = ""  # why results could not be printed
        self.live = sys.stderr is not None and sys.stderr.isatty()
        self._drawn = 0.0
        self._passing = 0  # characters of the line on the terminal that the next one of its kind takes the place of

    def _print(self, text: str, *, result: bool, end: str = "\n") -> None:
        """Print, or remember why not: a closed pipe must not undo finished work."""
        stream = sys.stdout if result else sys.stderr
        if stream is None or (result and self.lost):
            return
        if self._passing and not text.startswith("\r"):
            self._passing = 0
            self._print("", result=False)
        try:
            text = "".join(one if one.isprintable() or one in "\n\r\t" else _escaped(one) for one in text)
            print(text, file=stream, end=end, flush=True)
        except OSError as error:
            # The buffered rest would fail again at exit.
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
            if result:
                self.lost = "" if isinstance(error, BrokenPipeError) else str(error.strerror)

    def write_result(self, text: str = "") -> None:
        """Print a line of the result; with --json it goes to stderr."""
        self._print(text, result=not self.as_json)

    def write_progress(self, text: str) -> None:
        """Print a line about the work in progress."""
        if not self.quiet:
            self._print(text, result=False)

    def write_passing(self, text: str, ended: bool = False) -> None:
        """Print lines of progress; on a terminal the next such line takes the place of the last one, unless `ended`."""
        if self.quiet or self.verbose or not self.live:
            self.write_progress(text)
            return
        *before, last = text.split("\n")
        for line in before:
            self.write_progress(line)
        last = last[: shutil.get_terminal_size().columns - 1]
        self._print(f"\r{last:<{self._passing}}", result=False, end="\n" if ended else "")
        self._passing = 0 if ended else len(last)

    def write_error(self, text: str) -> None:
        """Print an error, one sentence."""
        if len(text) > _LONGEST:
            text = f"{text[: _LONGEST // 2]} ... {text[-_LONGEST // 2 :]}"
        line = "".join(_escaped(one) if one in "\n\r" else one for one in text)
        self._print(f"planner: {line}", result=False)

    def document(self, content: dict[str, Any]) -> None:
        """Print the JSON document, only with --json."""
        if self.as_json:
            self._print(json.dumps(finite(content), indent=2, allow_nan=False), result=True)

    def finish(self, command: str, code: int, **content: Any) -> int:
        """Print the JSON document of a command and return its exit code."""
        self.document({"command": command, **content, "exit_code": code})
        return code

    def table(self, heads: Sequence[str], rows: Iterable[Sequence[str]], columns: int | None = None) -> None:
        """Print a table with aligned columns; the last one is wrapped where the lines are to have so many `columns`."""
        cells = [list(map(str, row)) for row in rows]
        if columns is not None:
            before = sum(2 + max(map(len, column)) for column in list(zip(heads, *cells, strict=True))[:-1])
            cells = [
                [*(row[:-1] if i == 0 else [""] * (len(row) - 1)), part]
                for row in cells
                for i, part in enumerate(textwrap.wrap(row[-1], max(20, columns - before)) or [""])
            ]
        widths = [max(map(len, column)) for column in zip(heads, *cells, strict=True)]
        for line in aligned([heads, ["-" * width for width in widths], *cells]):
            self.write_result(line)

    def iteration(self, line: Iteration | RelaxationStep) -> None:
        """Print a line of the table of iterations: on a terminal the last one, in a log some; all of a relaxation."""
        i = getattr(line, "iteration", None)
        if i is None:
            self.write_progress(str(line))
        elif self.live or self.verbose or i < 10 or (i < 100 and i % 10 == 0) or i % 100 == 0:
            self.write_passing(str(line))

    def row(self, line: Start | DurationTrial | PeriodicPass) -> None:
        """Print a line of the table of starts, of durations or of passes."""
        self.write_progress(str(line))

    def progress(self, work: str) -> Callable[[int, int], None]:
        """A callback (done, total) that prints a counter: updated on a terminal, a line at the end elsewhere."""

        def show(done: int, total: int) -> None:
            now, ended = time.monotonic(), done == total
            if self.quiet or not (ended or (self.live and now - self._drawn > 0.1)):
                return
            self._drawn = now
            self.write_passing(f"{work}: {done}/{total}", ended)

        return show
