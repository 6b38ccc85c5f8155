"""hessian="exact" beside "gauss-newton": iterations, time and final cost of whole solves.

python benchmarks/exact_hessian.py

Then the time until the acrobot by RK4 first costs 6.617 or less, where fatrop with exact Hessians takes 98 iterations
and 317 ms (benchmarks/rigid_body.py poses the same problem to both). One thread, minima of many solves, ms.
"""

from __future__ import annotations

import math
import time
from typing import Any

import rigid_body_problems as problems
from planner_worker import posed
from rigid_body_problems import COST_SLACK, EULER, RK4, SOLVE_TARGETS

import planner

SECONDS = 3.0  # of repetitions of one solve


def shortest(problem: Any, **options: Any) -> tuple[float, planner.Plan]:
    """Least time of a solve, ms, and its plan."""
    plan = planner.solve(problem, **options)
    best, until = math.inf, time.perf_counter() + SECONDS
    while time.perf_counter() < until:
        began = time.perf_counter()
        plan = planner.solve(problem, **options)
        best = min(best, time.perf_counter() - began)
    return 1e3 * best, plan


def steps(plan: planner.Plan, lines: int) -> int:
    """Accepted steps among so many lines of the history; the others are sweeps that were not definite."""
    return sum(line.step > 0.0 for line in plan.history[:lines])


def main() -> None:
    """One line per problem and Hessian, then the acrobot's way to its target."""
    tasks = {f"{name}, {integrator}": posed(problems.solve_problem(name, integrator)) for name, integrator in (
        ("2r_guess", EULER), ("2r_guess", RK4), ("acrobot", RK4), ("arm6", EULER), ("arm6", RK4))}  # fmt: skip
    tasks |= {f"case {name}": planner.cases.build(name) for name in ("hopper", "two-link", "acrobot")}
    print(f"{'':32s}{'hessian':14s}{'lines':>6s}{'steps':>6s}{'ms':>9s}  cost")
    for name, task in tasks.items():
        for hessian in ("gauss-newton", "exact"):
            ms, plan = shortest(task, hessian=hessian)
            lines = len(plan.history)
            print(
                f"{name:32s}{hessian:14s}{lines:6d}{steps(plan, lines):6d}{ms:9.2f}  {plan.cost:.8g} {plan.status.name}"
            )
    target = SOLVE_TARGETS["acrobot", RK4].cost + COST_SLACK
    task = tasks[f"acrobot, {RK4}"]
    for hessian in ("gauss-newton", "exact"):
        plan = planner.solve(task, hessian=hessian)
        lines = next(i for i, line in enumerate(plan.history) if line.cost <= target)
        ms, reached = shortest(task, hessian=hessian, max_iterations=lines)
        print(f"acrobot to {target:.4f}, {hessian}: {steps(plan, lines)} steps, {ms:.0f} ms, cost {reached.cost:.5f}")


if __name__ == "__main__":
    main()
