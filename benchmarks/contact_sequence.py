"""One iteration of a quadruped's trot: contacts found by the solver beside Crocoddyl's, which are given by sequence.

    python benchmarks/contact_sequence.py --crocoddyl PYTHON

Both have the weights of moving/quadruped-trot.toml, its 200 stages of 0.01 s, and the same machine. Ours has compliant
contacts, and finds when feet stand: in as many leapfrog steps a stage as the file gets by itself, and in one.
Crocoddyl's feet are points that do not move while our plan has them stand, with one semi-implicit Euler step a stage.
An iteration: linearize, sweep, try. Both of our plans are proved.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from problems import SINGLE_THREAD
from serving import Worker

TASK = Path(__file__).parent / "moving" / "quadruped-trot.toml"
ROUNDS, REPEATS = 4, 10
PINS = "crocoddyl==3.2.1 pin==4.0.0"


def iteration(problem: Any, plan: Any) -> Callable[[], float]:
    """Linearize along a plan, sweep, and a line search, which tries four steps at once; in s."""
    from planner.solvers.engine import acquire_engine

    engine = acquire_engine(problem)
    trajectory = plan.xs, plan.us, plan.K

    def once() -> float:
        cost = engine.start_from_trajectory(problem.x0, trajectory)
        began = time.process_time()
        direction = engine.compute_direction(0.0, True)
        engine.line_search(True, 0, cost, min(direction.slope, -math.ulp(1.0)))
        return time.process_time() - began

    once()
    return once


def main() -> int:
    """Print both times and their ratio; exit code 1 without the peer."""
    parser = argparse.ArgumentParser(description="A quadruped's trot beside Crocoddyl with a given contact sequence.")
    parser.add_argument("--crocoddyl", metavar="PYTHON", help=f"a Python with {PINS}")
    given = parser.parse_args()
    from planner import Problem, load_problem, prove, solve
    from planner.problem.costs.tracking import tracking_of
    from planner.problem.touch_downs import standing

    task = load_problem(TASK)
    dynamics: Any = task.dynamics
    tracking = tracking_of(task.cost)
    assert tracking is not None  # a task has weights on its states
    mechanism = dynamics.mechanism
    assert task.recipe is not None  # it is read from a file
    problems = task, task.recipe.rebuilt(substeps=1)
    plans = [solve(one) for one in problems]
    plan, ours = plans[0], []
    for problem, one in zip(problems, plans, strict=True):
        print(f"{problem.dynamics}: {one.total_iterations} iterations, cost {one.cost:.4g}, {one.status.name}: "
              f"{prove(one, rollouts=0).headline}")  # fmt: skip
        ours.append(iteration(Problem(problem.dynamics, tracking, task.x0, us=one.us), one))
    if given.crocoddyl is None:
        times = ", ".join(f"{1e3 * min(once() for _ in range(REPEATS)):.3g} ms" for once in ours)
        print(f"{times}; Crocoddyl left out: --crocoddyl PYTHON with {PINS}")
        return 1
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "quadruped.xml"
        root = ElementTree.fromstring(mechanism.mjcf)
        for keyframe in root.findall("keyframe"):
            root.remove(keyframe)  # Pinocchio reads it before it knows that the machine is not alone in the file
        first, *others = root.findall("worldbody")  # of several it reads all of them several times
        for other in others:
            first.extend(other)
            root.remove(other)
        for base in root.iter("freejoint"):
            base.set("name", "root_joint")  # by which Crocoddyl knows it
        path.write_text(ElementTree.tostring(root, encoding="unicode"), encoding="utf-8")
        worker = Worker(given.crocoddyl, "contact_sequence_crocoddyl.py", SINGLE_THREAD, "Crocoddyl")
        stands = standing(mechanism, plan.xs)
        feet = {name: one.centre.tolist() for one in mechanism.contacts for name in stands
                if mechanism.body_of(one.link) == name}  # fmt: skip
        weights = np.diagonal(tracking.Q, axis1=1, axis2=2)
        theirs = worker.ask(
            "load", model=str(path), x0=task.x0.tolist(), dt=dynamics.dt, feet=feet, N=task.N,
            stands={name: bears[:-1].tolist() for name, bears in stands.items()}, running=weights[1].tolist(),
            final=weights[-1].tolist(), effort=np.diagonal(tracking.R[0]).tolist(),
        )  # fmt: skip
        if "failed" in theirs:
            print(f"Crocoddyl: {theirs['failed']}")
            return 1
        best = [math.inf] * 3
        for _ in range(ROUNDS):
            for k, once in enumerate(ours):
                best[k] = min(best[k], 1e3 * min(once() for _ in range(REPEATS)))
            best[-1] = min(best[-1], 1e3 * min(worker.ask("iterate", repeats=REPEATS, seconds=5.0)["times"]))
    print(f"an iteration of {task.N} stages: {best[-1]:.3g} ms Crocoddyl's, one step a stage, sequence given")
    for k, steps in enumerate((dynamics.substeps, 1)):
        print(f"{best[k]:.3g} ms ours, {steps} steps a stage, no sequence: {best[-1] / best[k]:.2f} times less")
    return 0


if __name__ == "__main__":
    os.environ.update(SINGLE_THREAD)
    sys.exit(main())
