"""One solver in one process: `python worker.py NAME`, asked over its standard input, one JSON object a line.

The first line it writes says what it is: {"version": ...} or {"missing": ...}. Then each {"problem", "solves",
"seconds"} is answered by that many timed solves, or fewer once the seconds are over.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
import time
from importlib import metadata
from typing import Any

import numpy as np
from problems import PROBLEMS
from solvers import SOLVERS, Result, Solve


def timed(solve: Solve, solves: int, seconds: float) -> tuple[Result, dict[str, Any]]:
    """The last result and the times of each solve, ms."""
    wall, cpu, spent = [], [], 0.0
    while True:
        cpu_started, started = time.process_time(), time.perf_counter()
        result = solve()
        wall.append(time.perf_counter() - started)
        # Processor time above wall time would mean a second thread.
        cpu.append(time.process_time() - cpu_started)
        spent += wall[-1]
        if len(wall) >= solves or spent >= seconds:
            return result, {"ms": [1e3 * t for t in wall], "cpu_ms": 1e3 * sum(cpu)}


def main() -> None:
    """Serve until the input ends."""
    # Some solvers print: what they write goes to standard error, the answers to the real standard output.
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)

    def answer(message: dict[str, Any]) -> None:
        print(json.dumps(message), file=answers, flush=True)

    solver = SOLVERS[sys.argv[1]]
    try:
        module = importlib.import_module(solver.module)
    except ImportError as error:
        answer({"missing": str(error)})
        return
    version = getattr(module, "__version__", None) or metadata.version(solver.module)
    answer({"version": version, "python": sys.version.split()[0]})

    ready: dict[str, Solve] = {}
    for line in sys.stdin:
        asked = json.loads(line)
        name, setup = asked["problem"], None
        if name not in ready:
            started = time.perf_counter()
            ready[name] = solver.make(PROBLEMS[name])
            ready[name]()  # compile, build derivatives, fill caches
            setup = time.perf_counter() - started
        result, times = timed(ready[name], asked["solves"], asked["seconds"])
        answer(
            {
                "us": np.asarray(result.us).tolist(), "cost": result.cost, "iterations": result.iterations,
                "converged": result.converged, "setup_s": setup, **times,
            }
        )  # fmt: skip


if __name__ == "__main__":
    main()
