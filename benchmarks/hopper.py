"""Warm whole solves of the paper's hopper, ours beside its peers, in one run: `python benchmarks/hopper.py`.

Each solver is a process of one thread. They are asked in turn, a few solves at a time, and only the asked one
works: whatever else this machine does meanwhile falls on all of them. Peers that are not installed are named.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from problems import PROBLEMS, SINGLE_THREAD, TARGETS, judge, remarks
from solvers import SOLVERS

BURST = 5  # solves per turn: the first wakes the caches up, the others are what "warm" means
TURN = 0.25  # s, the longest a turn goes on


class Worker:
    """One solver's process."""

    def __init__(self, name: str, python: str) -> None:
        self.solver = SOLVERS[name]
        self.name, self.python = name, python
        self._errors = tempfile.TemporaryFile("w+", errors="replace")  # noqa: SIM115 (it lives as long as the process)
        command = [python, str(Path(__file__).with_name("worker.py")), name]
        try:
            self._process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._errors, text=True,
                env={**os.environ, **SINGLE_THREAD},
            )  # fmt: skip
        except OSError as error:
            sys.exit(f"cannot run {python} for {name}: {error.strerror}")
        self.hello = self._read()

    def _read(self) -> dict[str, Any]:
        line = self._process.stdout.readline()
        if line:
            return json.loads(line)
        self._errors.seek(0)
        lines = self._errors.read().strip().splitlines()
        return {"failed": lines[-1] if lines else f"its process ended with {self._process.wait()}"}

    def ask(self, problem: str, solves: int) -> dict[str, Any]:
        """A turn of at most that many timed solves."""
        turn = json.dumps({"problem": problem, "solves": solves, "seconds": TURN})
        with contextlib.suppress(BrokenPipeError):  # the reason is in its standard error
            print(turn, file=self._process.stdin, flush=True)
        return self._read()

    def close(self) -> None:
        """End the process."""
        self._process.stdin.close()
        self._process.wait()


def measure(workers: list[Worker], problem: str, repeats: int, seconds: float) -> dict[str, dict[str, Any]]:
    """Per solver: the times of all its solves, and its last result."""
    rows = {worker.name: {**worker.ask(problem, 1), "ms": [], "cpu_ms": 0.0} for worker in workers}
    asking = list(workers)
    while asking:
        for worker in list(asking):
            row = rows[worker.name]
            if "failed" not in row:
                turn = worker.ask(problem, min(BURST, repeats - len(row["ms"])))
                row["ms"] += turn.pop("ms", [])
                row["cpu_ms"] += turn.pop("cpu_ms", 0.0)
                row.update({key: value for key, value in turn.items() if key != "setup_s"})
            if "failed" in row or len(row["ms"]) >= repeats or sum(row["ms"]) >= 1e3 * seconds:
                asking.remove(worker)
    return rows


def lines_of(problem: str, workers: list[Worker], rows: dict[str, dict[str, Any]]) -> list[dict[str, Any]]:
    """One flat record per solver."""
    failed = {name for name, row in rows.items() if "failed" in row}
    true = {name: judge(PROBLEMS[problem], row["us"]) for name, row in rows.items() if name not in failed}
    # NaN compares false with everything: it must not become the best.
    best = min((J for J in true.values() if J == J), default=float("nan"))
    ours = min(rows["ours"]["ms"]) if "ours" in true else float("nan")
    lines = []
    for worker in workers:
        row = rows[worker.name]
        line: dict[str, Any] = {
            "problem": problem, "solver": worker.name, "label": worker.solver.label,
            "version": worker.hello["version"],
        }  # fmt: skip
        if worker.name in failed:
            lines.append({**line, "failed": row["failed"]})
            continue
        J, ms = true[worker.name], row["ms"]
        line.update(
            cost=J, own_cost=row["cost"], iterations=row["iterations"], converged=row["converged"], solves=len(ms),
            min_ms=min(ms), median_ms=statistics.median(ms), ratio=min(ms) / ours, setup_s=row["setup_s"],
            cpu_per_wall=row["cpu_ms"] / sum(ms), remarks=remarks(row["converged"], row["cost"], J, best),
        )  # fmt: skip
        if worker.name == "ours":
            target = TARGETS[problem]
            line.update(
                target_ms=target.ms, target_cost=target.cost,
                time_met=min(ms) <= target.ms, cost_met=bool(target.cost >= J),
            )  # fmt: skip
        lines.append(line)
    return lines


HEADER = (
    f"{'problem':<10} {'solver':<30} {'true cost':>10} {'iter':>5} {'min ms':>8} {'median':>8} {'ratio':>7}  remarks"
)


def text(line: dict[str, Any]) -> str:
    """A record as a row of the table."""
    start = f"{line['problem']:<10} {line['label']:<30} "
    if "failed" in line:
        return start + f"failed: {line['failed']}"
    return (
        start
        + (
            f"{line['cost']:10.3f} {line['iterations']:5d} {line['min_ms']:8.3f} {line['median_ms']:8.3f} "
            f"{line['ratio']:7.2f}  {'; '.join(line['remarks'])}"
        ).rstrip()
    )


def finite(line: dict[str, Any]) -> dict[str, Any]:
    """JSON has no NaN and no infinity: null."""
    return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in line.items()}


def verdict(line: dict[str, Any]) -> str:
    """A record of ours against its target."""
    if "failed" in line:
        return f"{line['problem']:<10} missed: failed"
    word = {True: "met", False: "MISSED"}
    return (
        f"{line['problem']:<10} {line['min_ms']:.3f} ms <= {line['target_ms']} ms: {word[line['time_met']]};  "
        f"cost {line['cost']:.4f} <= {line['target_cost']}: {word[line['cost_met']]}"
    )


def started(peer_python: list[str]) -> tuple[list[Worker], list[str]]:
    """The workers that are ready, ours first, and a sentence about each that is not."""
    pythons = dict.fromkeys(SOLVERS, sys.executable)
    for item in peer_python:
        name, _, path = item.partition("=")
        if name not in SOLVERS or not path:
            sys.exit(f"--peer-python {item!r}: expected NAME=PATH with NAME one of {', '.join(SOLVERS)}")
        pythons[name] = path
    ready, absent = [], []
    for name, solver in SOLVERS.items():
        worker = Worker(name, pythons[name])
        if "version" in worker.hello:
            ready.append(worker)
            continue
        worker.close()
        absent.append(
            f"{solver.label}: {worker.hello.get('failed', 'not installed')}; pip install {solver.pip}"
            f"  (into another environment: --peer-python {name}=ITS_PYTHON)"
        )
    return ready, absent


def main() -> None:
    """Run the comparison."""
    parser = argparse.ArgumentParser(description="Warm whole solves of the paper's hopper, ours beside its peers.")
    parser.add_argument("--json", action="store_true", help="one JSON object per problem and solver, no table")
    parser.add_argument("--repeats", type=int, default=200, help="solves per problem and solver (200)")
    parser.add_argument("--seconds", type=float, default=5.0, help="longest time per problem and solver (5)")
    parser.add_argument(
        "--peer-python", action="append", default=[], metavar="NAME=PATH",
        help=f"interpreter that has a peer installed; NAME is one of {', '.join(SOLVERS)}; repeatable",
    )  # fmt: skip
    arguments = parser.parse_args()
    if arguments.repeats < 1:
        parser.error("--repeats must be at least 1")

    workers, absent = started(arguments.peer_python)
    ours = []
    if not arguments.json:
        print("versions: " + ", ".join(f"{w.solver.module} {w.hello['version']}" for w in workers) + "\n" + HEADER)
    for problem in PROBLEMS:
        for line in lines_of(problem, workers, measure(workers, problem, arguments.repeats, arguments.seconds)):
            print(json.dumps(finite(line)) if arguments.json else text(line), flush=True)
            if line["solver"] == "ours":
                ours.append(line)
    for worker in workers:
        worker.close()
    if arguments.json:
        for sentence in absent:
            print(sentence, file=sys.stderr)
        return
    print("\ntargets of ours\n" + "\n".join(verdict(line) for line in ours))
    if absent:
        print("\nabsent\n" + "\n".join(absent))


if __name__ == "__main__":
    main()
