"""Bounded controls against Crocoddyl's box-FDDP in one run: `python benchmarks/bounds.py --crocoddyl ITS_PYTHON`.

The six-joint arm of rigid_body_problems.py, whose motors may do a part of what the unbounded plan asks for, and no less
than holds the arm. Both solve it from the same controls with the same stop, in processes of one thread that are asked
in turn. One JSON line: medians per iteration and per solve, costs, how many controls are at a bound.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys

import numpy as np
from problems import SINGLE_THREAD
from rigid_body_problems import EULER, RK4, solve_problem
from serving import Worker

SHARE = 0.6  # of the largest torque of the unbounded plan that a motor may do
HOLDING = 1.1  # of what holds the arm at rest, at least
TURNS = 12


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--crocoddyl", required=True, help="its Python")
    parser.add_argument("--integrator", default=EULER, choices=(EULER, RK4))
    options = parser.parse_args()
    problem = solve_problem("arm6", options.integrator)
    workers = {
        "ours": Worker(sys.executable, "bounds_worker.py", SINGLE_THREAD, "ours"),
        "crocoddyl": Worker(options.crocoddyl, "bounds_worker.py", SINGLE_THREAD, "Crocoddyl box-FDDP"),
    }
    free = workers["ours"].ask("load", problem=problem, bounds=None)
    most = np.maximum(SHARE * np.abs(free["us"]).max(axis=0), HOLDING * np.abs(problem["us"]).max(axis=0))
    bounds = [(-most).tolist(), most.tolist()]
    line = {"kind": "bounds", "problem": "arm6", "integrator": options.integrator, "bounds": most.round(4).tolist()}
    line["unbounded_cost"] = free["cost"]
    for name, worker in workers.items():
        answer = worker.ask("load", problem=problem, bounds=bounds)
        if "failed" in answer:
            sys.exit(f"{name}: {answer['failed']}")
        us = np.array(answer.pop("us"))
        line[name] = {**worker.hello, **answer, "outside": float(np.maximum(np.abs(us) - most, 0.0).max())}
        line[name]["at_bound"] = int(np.sum(np.abs(us) >= most * (1.0 - 1e-12)))
    times: dict[str, list[float]] = {name: [] for name in workers}
    for _ in range(TURNS):
        for name, worker in workers.items():
            times[name] += worker.ask("solve", repeats=5, seconds=2.0)["times"]
    for name, seconds in times.items():
        line[name]["ms"] = 1e3 * statistics.median(seconds)
        line[name]["ms_per_iteration"] = line[name]["ms"] / max(line[name]["iterations"], 1)
    line["per_iteration"] = line["crocoddyl"]["ms_per_iteration"] / line["ours"]["ms_per_iteration"]
    line["per_solve"] = line["crocoddyl"]["ms"] / line["ours"]["ms"]
    print(json.dumps(line))


if __name__ == "__main__":
    main()
