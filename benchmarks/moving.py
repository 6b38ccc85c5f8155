"""Machines that hop, crawl, fly and roll: problem files of at most ten lines without weights, solved and proved.

    python benchmarks/moving.py [--only monopod]

One line per file of benchmarks/moving: iterations, processor time of the solve, time with every foot off the ground,
and the verdict's first line. One thread, the defaults of `planner run` without its repairs and rollouts.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

import planner
from planner.dynamics.contacts import contact_forces
from planner.model.capabilities import capabilities_of, stands_on_ground

FILES = Path(__file__).parent / "moving"
WORK = 60.0  # of a solve, as of planner run


def main() -> None:
    """One line per problem file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="", help="the beginning of the files' names")
    passed, files = 0, sorted(FILES.glob(f"{parser.parse_args().only}*.toml"))
    for file in files:
        try:
            problem = planner.load_problem(file)
        except planner.PlannerError as error:
            print(f"{file.stem}: refused: {error}", flush=True)
            continue
        planner.solve(problem, max_iterations=1)  # compiled
        began = time.process_time()
        plan = planner.solve(problem, budget=WORK)
        seconds = time.process_time() - began
        proof = planner.prove(plan, rollouts=0)
        passed += proof.passed
        print(
            f"{file.stem}: {plan.nit} iterations, {seconds:.1f} s, {_air_time(plan):.2f} s in the air, "
            f"{plan.status.name}: {proof.headline}", flush=True,
        )  # fmt: skip
    print(f"{passed} of {len(files)} PASS")


def _air_time(plan: planner.Plan) -> float:
    """Time without load on any contact, s; 0 for machines that stand on none."""
    assert plan.problem is not None
    mechanism = capabilities_of(plan.problem.dynamics).mechanism
    if mechanism is None or not stands_on_ground(mechanism):
        return 0.0
    q, qd = np.split(plan.xs[:, : mechanism.nq + mechanism.nv], [mechanism.nq], axis=1)
    return plan.problem.dynamics.dt * float(np.sum(~contact_forces(mechanism, q, qd).forces.any(axis=(1, 2))))


if __name__ == "__main__":
    main()
