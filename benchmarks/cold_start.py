"""How long a fresh process needs to its first plan: `python benchmarks/cold_start.py`.

Every measurement is a process of its own. "warm cache" finds the compiled kernels on disk, as every run but a
machine's first does; "cold compile" gets an empty cache directory.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time

from problems import SINGLE_THREAD

TARGET = 1.0  # s from `import planner` to the first plan, on a warm cache

# The wall clock, which the parent reads too: from there to the first line is the interpreter's own start.
CHILD = """
import time
entered = time.time()
import planner
imported = time.time()
problem = {problem}
posed = time.time()
plan = planner.solve(problem)
planned = time.time()
import json, resource, sys
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)
times = [entered, imported, posed, planned]
print(json.dumps({{"times": times, "peak_mib": peak, "success": plan.success}}))
"""

PROBLEMS = {
    "paper's hopper": "planner.cases.hopper(**__import__('planner.cases.hopper', fromlist='PAPER').PAPER)",
    "default hopper": "planner.cases.hopper()",
}
COLUMNS = ("interpreter", "import", "build", "solve", "from_import", "from_start", "peak_mib")


def first_plan(problem: str, cache: str | None = None) -> dict[str, float]:
    """Run one fresh process: seconds by phase, and peak memory in MiB."""
    environment = {**os.environ, **SINGLE_THREAD, **({} if cache is None else {"NUMBA_CACHE_DIR": cache})}
    started = time.time()
    done = subprocess.run(
        [sys.executable, "-c", CHILD.format(problem=problem)], env=environment, capture_output=True, text=True
    )
    if done.returncode:
        sys.exit(f"the fresh process failed:\n{done.stderr}")
    answer = json.loads(done.stdout.splitlines()[-1])
    if not answer["success"]:
        sys.exit("the first plan did not converge")
    entered, imported, posed, planned = answer["times"]
    return {
        "interpreter": entered - started, "import": imported - entered, "build": posed - imported,
        "solve": planned - posed, "from_import": planned - entered, "from_start": planned - started,
        "peak_mib": answer["peak_mib"],
    }  # fmt: skip


def warm(problem: str, repeats: int) -> list[dict[str, float]]:
    """Repeated on a warm cache; the first process, which may have to compile, is not counted."""
    first_plan(problem)
    return [first_plan(problem) for _ in range(repeats)]


def cold(problem: str, repeats: int) -> list[dict[str, float]]:
    """Repeated with an empty cache each time."""
    runs = []
    for _ in range(repeats):
        with tempfile.TemporaryDirectory() as cache:
            runs.append(first_plan(problem, cache))
    return runs


def lines_of(cache: str, problem: str, runs: list[dict[str, float]]) -> list[dict[str, object]]:
    """The least and the median of every column."""
    return [
        {"cache": cache, "problem": problem, "of": word, **{c: of(run[c] for run in runs) for c in COLUMNS}}
        for word, of in (("min", min), ("median", statistics.median))
    ]


def text(line: dict[str, object]) -> str:
    """A record as a row of the table."""
    start = f"{line['cache']:<12} {line['problem']:<15} {line['of']:<6}"
    return start + "".join(f" {line[c]:11.3f}" for c in COLUMNS[:-1]) + f" {line['peak_mib']:8.0f}"


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="Time from a fresh process to its first plan.")
    parser.add_argument("--json", action="store_true", help="one JSON object a line, no table")
    parser.add_argument("--repeats", type=int, default=5, help="processes per problem on a warm cache (5)")
    parser.add_argument("--cold", type=int, default=1, help="processes with an empty cache; 0 for none (1)")
    arguments = parser.parse_args()
    if arguments.repeats < 1 or arguments.cold < 0:
        parser.error("--repeats must be at least 1 and --cold at least 0")

    if not arguments.json:
        titles = "".join(f" {c.replace('_', ' '):>11}" for c in COLUMNS[:-1])
        print(f"{'s':<12} {'':<15} {'':<6}{titles} peak MiB")
    best = {}
    for name, problem in PROBLEMS.items():
        lines = lines_of("warm cache", name, warm(problem, arguments.repeats))
        best[name] = lines[0]["from_import"]
        # Both problems run the same kernels: one of them shows what compiling takes.
        if arguments.cold and problem == PROBLEMS["paper's hopper"]:
            lines += lines_of("cold compile", name, cold(problem, arguments.cold))
        for line in lines:
            print(json.dumps(line) if arguments.json else text(line), flush=True)
    if not arguments.json:
        print()
        for name, seconds in best.items():
            word = "met" if seconds <= TARGET else "MISSED"
            print(f"{name}: first plan {seconds:.3f} s after `import planner` <= {TARGET} s: {word}")


if __name__ == "__main__":
    main()
