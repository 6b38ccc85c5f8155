"""From a fresh process to a rigid body's first plan, for `rigid_body.py --part start`; the hopper: cold_start.py."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from cold_start import first_plan, warm
from problems import SINGLE_THREAD
from rigid_body_problems import EULER

NAME = "2r_guess"
TARGETS = {"warm start": 1.5, "cold compile": 20.0, "planner warmup": 60.0}  # s

# What a fresh process builds: the import of this folder's files, NumPy only, is in the time.
PROBLEM = (
    f"(__import__('sys').path.insert(0, {str(Path(__file__).parent)!r}), __import__('planner_worker').posed("
    f"__import__('rigid_body_problems').solve_problem({NAME!r}, {EULER!r})))[1]"
)


def warm_start(repeats: int) -> float:
    """Seconds from `import planner` to the first plan, everything compiled before; the least of several processes."""
    return min(run["from_import"] for run in warm(PROBLEM, repeats))


def cold_compile() -> float:
    """Seconds that a first problem and its plan take with nothing compiled."""
    with tempfile.TemporaryDirectory() as cache:
        cold = first_plan(PROBLEM, cache)
    return cold["build"] + cold["solve"]


def warmup() -> float:
    """Seconds of `planner warmup` with nothing compiled."""
    with tempfile.TemporaryDirectory() as cache:
        started = time.perf_counter()
        done = subprocess.run(
            [sys.executable, "-m", "planner", "warmup"], capture_output=True, text=True,
            env={**os.environ, **SINGLE_THREAD, "NUMBA_CACHE_DIR": cache},
        )  # fmt: skip
        if done.returncode:
            sys.exit(f"planner warmup failed:\n{done.stderr}")
        return time.perf_counter() - started


def start_lines(repeats: int = 5) -> list[dict[str, Any]]:
    """One record per target, s."""
    measures = {"warm start": lambda: warm_start(repeats), "cold compile": cold_compile, "planner warmup": warmup}
    lines = []
    for what, measure in measures.items():
        line: dict[str, Any] = {"kind": "start", "problem": NAME, "integrator": EULER, "what": what}
        try:
            seconds = measure()
        except SystemExit as error:  # what a fresh process died of is a row, not the end of the run
            lines.append({**line, "failed": str(error.code).strip().splitlines()[-1]})
            continue
        lines.append({**line, "seconds": seconds, "target": TARGETS[what], "met": seconds <= TARGETS[what]})
    return lines
