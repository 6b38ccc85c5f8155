"""An iteration for jerk and for energy beside one for effort: `python benchmarks/objectives.py`.

The difference of two solves of few and of more iterations leaves out what a solve takes once; the last column has it.
Processor time of one thread, least of several; the same machine, start and goal for each objective.
"""

from __future__ import annotations

import os
import time

from problems import SINGLE_THREAD

os.environ.update(SINGLE_THREAD)

import mechanisms
import numpy as np

import planner
from planner.problem.objective import with_objective

FEW, MORE, REPEATS, STAGES = 2, 8, 60, 200
OBJECTIVES = {"effort": "effort", "energy": {"effort": 1.0, "energy": 0.1, "smoothing": 1.0}, "jerk": "jerk"}


def problem(chain: mechanisms.Chain, integrator: str) -> planner.Problem:
    """From rest to 0.7 rad at every joint in 2 s."""
    mechanism = planner.Mechanism.from_mjcf(mechanisms.mjcf(chain))
    dynamics = planner.RigidBodyDynamics(mechanism, dt=2.0 / STAGES, integrator=integrator)
    goal = np.concatenate([np.full(mechanism.nv, 0.7), np.zeros(mechanism.nv)])
    cost = planner.TrackingCost.joints(
        dynamics, goal, STAGES, effort=1.0, final_position=1e4, final_velocity=1e3
    )  # fmt: skip
    return planner.Problem(dynamics, cost, x0=np.zeros(2 * mechanism.nv))


def seconds(problems: dict[str, planner.Problem], iterations: int) -> dict[str, tuple[float, int]]:
    """The least processor time of a solve of each that is cut after some iterations, and how many it took."""
    found = dict.fromkeys(problems, (np.inf, 0))
    for _ in range(REPEATS):  # in turn, so that other work on the computer is beside all of them
        for label, of in problems.items():
            began = time.process_time()
            taken = planner.solve(of, max_iterations=iterations).nit
            found[label] = min(found[label], (time.process_time() - began, taken))
    return found


def main() -> None:
    """Print the table."""
    print("machine, integrator, objective: ms an iteration, times effort's, ms once")
    for name in ("two_rods", "puma", "arm7"):
        for integrator in ("rk4", "semi-implicit-euler"):
            own = problem(getattr(mechanisms, name)(), integrator)
            problems = {label: with_objective(own, objective) for label, objective in OBJECTIVES.items()}
            few, more, effort = seconds(problems, FEW), seconds(problems, MORE), 0.0
            for label in problems:
                (short, n), (long, m) = few[label], more[label]
                if m == n:
                    print(f"{name}, {integrator}, {label}: converged after {n} iterations")
                    continue
                each = 1e3 * (long - short) / (m - n)
                effort = each if label == "effort" else effort
                print(
                    f"{name}, {integrator}, {label}: {each:.3f}, {each / effort:.2f}, {1e3 * short - n * each:.2f}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
