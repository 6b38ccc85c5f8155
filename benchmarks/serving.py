"""A solver in a process of its own, asked over its standard input. Standard library only.

One JSON object a line each way. The first line a process writes says what it is: {"version": ...} or {"missing": ...}.
Then each {"do": name, **arguments} is answered by what the function of that name returns, or by {"failed": why}.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

Answer = dict[str, Any]


def serve(hello: Callable[[], Answer], functions: dict[str, Callable[..., Answer]]) -> None:
    """The child's side: answer until the input ends."""
    # Some solvers print: what they write goes to standard error, the answers to the real standard output.
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    try:
        print(json.dumps(hello()), file=answers, flush=True)
    except ImportError as error:
        print(json.dumps({"missing": str(error)}), file=answers, flush=True)
        return
    for line in sys.stdin:
        asked = json.loads(line)
        try:
            answer = functions[asked.pop("do")](**asked)
        except Exception as error:
            answer = {"failed": f"{type(error).__name__}: {error}".splitlines()[0]}
        print(json.dumps(answer), file=answers, flush=True)


def timed(
    call: Callable[[], Any], prepare: Callable[[], Any], repeats: int, seconds: float,
    clock: Callable[[], float] = time.perf_counter,
) -> list[float]:  # fmt: skip
    """Seconds of each call by a clock, `prepare` before each untimed; fewer than `repeats` once `seconds` are over."""
    times: list[float] = []
    while len(times) < repeats and sum(times) < seconds:
        prepare()
        started = clock()
        call()
        times.append(clock() - started)
    return times


class Worker:
    """The parent's side: one solver's process.

    Args:
        python: Interpreter.
        script: File of this folder.
        environment: Added to ours.
        label: For tables.
        arguments: Of the script.
    """

    def __init__(self, python: str, script: str, environment: dict[str, str], label: str, *arguments: str) -> None:
        self.label = label
        self._errors = tempfile.TemporaryFile("w+", errors="replace")  # noqa: SIM115 (it lives as long as the process)
        try:
            command = [python, str(Path(__file__).with_name(script)), *arguments]
            self._process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._errors, text=True,
                env={**os.environ, **environment},
            )  # fmt: skip
        except OSError as error:
            sys.exit(f"cannot run {python} for {label}: {error.strerror}")
        self.hello = self._read()

    def _read(self) -> Answer:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if line:
            return json.loads(line)
        self._errors.seek(0)
        lines = self._errors.read().strip().splitlines()
        return {"failed": lines[-1] if lines else f"its process ended with {self._process.wait()}"}

    def ask(self, do: str, **arguments: Any) -> Answer:
        """One question."""
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # the reason is in its standard error
            print(json.dumps({"do": do, **arguments}), file=self._process.stdin, flush=True)
        return self._read()

    def close(self) -> None:
        """End the process."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()
