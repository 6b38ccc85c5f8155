"""Convergence from anywhere: how many of many random starts converge, in how many iterations, and to which minima.

    python benchmarks/starts.py [--starts 200] [--only two-link] [--way exact]

The starts are multistart's (seed 0, spread 1): the case's own first controls and smooth random changes of their size.
All but the first begin with the straight line to the goal as a first guess of the states, which the cases' costs give.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from typing import Any

import planner
from planner.problem.plan import Status

LIMITS = {"two-link": 300, "acrobot": 600}
WAYS: dict[str, dict[str, Any]] = {"gauss-newton": {}, "exact": {"hessian": "exact"}}


def main() -> None:
    """One line per case and way, then its minima with how often each was reached."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--starts", type=int, default=200)
    parser.add_argument("--only", choices=tuple(LIMITS))
    parser.add_argument("--way", choices=tuple(WAYS))
    options = parser.parse_args()
    for case, limit in LIMITS.items():
        if options.only not in (None, case):
            continue
        problem = planner.cases.build(case)
        for way, arguments in WAYS.items():
            if options.way in (None, way):
                _measure(case, problem, way, arguments, limit, options.starts)


def _measure(case: str, problem: planner.Problem, way: str, arguments: dict[str, Any], limit: int, starts: int) -> None:
    """Solve from all starts and print."""
    began = time.perf_counter()
    ended = planner.solve(problem, starts=starts, seed=0, max_iterations=limit, **arguments).starts
    seconds = time.perf_counter() - began
    done = [start for start in ended if start.status is Status.CONVERGED]
    lines = sorted(start.iterations for start in done) or [0]
    print(
        f"{case}, {way}: {len(done)} of {len(ended)} converged within {limit} iterations, "
        f"median {lines[len(lines) // 2]}, most {lines[-1]}, {seconds:.0f} s"
    )
    minima = Counter(round(start.cost, 2) for start in done)
    print("  " + ", ".join(f"{cost:.2f} x{count}" for cost, count in sorted(minima.items())), flush=True)


if __name__ == "__main__":
    main()
