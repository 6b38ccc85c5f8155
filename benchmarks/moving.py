"""Machines that hop, crawl, fly and roll: problem files of at most ten lines without weights, solved and proved.

    python benchmarks/moving.py [--only monopod] [--rollouts 96]

One line per file of benchmarks/moving: iterations, processor time of the solve, time with every foot off the ground,
and the verdict's first line. One thread, the defaults of `planner run` without its repairs and rollouts. With rollouts
also how many of them, with the plan's gains on machines with ERRORS, end within three tolerances of every goal.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

import planner
from planner.cases.problem_file import load
from planner.dynamics.contacts import contact_forces
from planner.model.capabilities import capabilities_of, stands_on_ground
from planner.proof.replays.compiled_twin import CompiledTwin
from planner.proof.robustness.perturbation import Perturbation, draw
from planner.proof.robustness.rollouts import Rollouts
from planner.proof.robustness.success import ROBUST, rule_of

FILES = Path(__file__).parent / "moving"
WORK = 60.0  # of a solve, as of planner run
ERRORS = Perturbation(damping=0.0, drag=0.0, friction=0.0, start=0.0, noise=0.0, delay=0.0)  # masses, friction, floor
TOLERANCES = 3.0


def main() -> None:
    """One line per problem file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="", help="the beginning of the files' names")
    parser.add_argument("--rollouts", type=int, default=0, help="of machines with errors, for each plan")
    arguments = parser.parse_args()
    passed, firm, files = 0, 0, sorted(FILES.glob(f"{arguments.only}*.toml"))
    for file in files:
        try:
            asked = load(file)
        except planner.PlannerError as error:
            print(f"{file.stem}: refused: {error}", flush=True)
            continue
        planner.solve(asked.problem, max_iterations=1)  # compiled
        began = time.process_time()
        plan = asked.solved(_silent, budget=WORK)
        seconds = time.process_time() - began
        proof = planner.prove(plan, rollouts=0)
        passed += proof.passed
        print(
            f"{file.stem}: {plan.total_iterations} iterations, {seconds:.1f} s, {_air_time(plan):.2f} s in the air, "
            f"{plan.status.name}: {proof.headline}", flush=True,
        )  # fmt: skip
        if arguments.rollouts:
            share = _success_rate(plan, arguments.rollouts)
            firm += proof.passed and share >= ROBUST
            print(f"    {share:.0%} of {arguments.rollouts} rollouts with errors", flush=True)
    print(f"{passed} of {len(files)} PASS" + f", {firm} of them with errors" * bool(arguments.rollouts))


def _silent(_: object) -> None:
    """No progress."""


def _success_rate(plan: planner.Plan, rollouts: int) -> float:
    """The share of perturbed rollouts with gains that end within TOLERANCES."""
    assert plan.twin is not None
    rule = rule_of(plan, TOLERANCES)
    with Rollouts(plan, CompiledTwin(plan.twin)) as simulator:
        draws = [draw(ERRORS, 0, k, simulator.nominal.sizes) for k in range(rollouts)]
        xs = simulator.run(simulator.batch(draws), "feedback")
        if rule.follows is not None:
            return float(rule.followed(xs, plan.xs[simulator.knots], simulator.knots).mean())
        return float(rule.succeeded(xs[:, -1]).mean())


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
