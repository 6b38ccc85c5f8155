"""Theorem 2 in numbers: solves from random controls with every update and line search, and what they end at.

A solve that stops has promised little decrease by the LQ model, which leaves out the curvature of the dynamics. So
each end is followed on to the stationary point beside it, and that counts as a local minimum where the exact Hessian
of J over all controls has no negative eigenvalue, and the cost is still the same. All else is a saddle or a plateau.
"""

from __future__ import annotations

import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np

from planner.base.processors import processors
from planner.paper.methods.curvature import minimum_near
from planner.paper.studies.study import timed
from planner.problem.plan import Plan, Status
from planner.problem.problem import Problem
from planner.solvers.multistart import smooth
from planner.solvers.slq import solve

LIMIT = 2000  # iterations of every solve, after which it counts as not converged
SAME_COST_TOLERANCE = 1e-3  # costs that differ by less, relatively, count as one local minimum
TOLERANCE = 1e-6  # of a solve: the decrease promised, relative to J; three digits below SAME
LAST = 20  # iterations of a solve that failed, whose steps say why


def from_many(
    problem: Problem, size: float, starts: int, update: str, search: str, seconds: float = np.inf
) -> dict[str, Any]:
    """Solve from random controls of an RMS, each for so long at most, and record how each solve ends."""

    def run(number: int) -> Plan:
        end = time.monotonic() + seconds

        def heed(_: Any) -> None:
            if time.monotonic() > end:
                raise StopIteration

        us = size * smooth(np.random.default_rng([0, number]), problem.first_guess.shape)
        return solve(
            replace(problem, us=us), update=update, line_search=search, max_iterations=LIMIT,
            expected_reduction_tolerance=TOLERANCE, actual_reduction_tolerance=0.0, callback=heed,
        )  # fmt: skip

    pool = ThreadPoolExecutor(processors())
    try:
        plans, took = timed(lambda: list(pool.map(run, range(starts))))
        done = [plan for plan in plans if plan.status is Status.CONVERGED]
        judged = list(pool.map(lambda plan: is_minimum(problem, plan), done))
    finally:
        pool.shutdown(cancel_futures=True)
    failed = [plan for plan in plans if plan.status is not Status.CONVERGED]
    steps = [step for plan in failed if (step := _last_step(plan)) is not None]
    return {
        "update": update, "search": search, "starts": starts, "seconds": took,
        "converged": len(done), "statuses": dict(Counter(plan.status.name for plan in plans)),
        "iterations": [plan.nit for plan in done], "costs": [plan.cost for plan in done],
        "minima": local_minima([plan.cost for plan, good in zip(done, judged, strict=True) if good]),
        "no_minima": sorted(plan.cost for plan, good in zip(done, judged, strict=True) if not good),
        "failed_costs": [plan.cost for plan in failed if np.isfinite(plan.cost)],
        "failed_iterations": [plan.nit for plan in failed],
        "failed_step": float(np.median(steps)) if steps else None,
    }  # fmt: skip


def is_minimum(problem: Problem, plan: Plan) -> bool:
    """Whether the end of a solve is a local minimum to SAME of its cost."""
    near, hessian = minimum_near(problem, plan.us)
    least = SAME_COST_TOLERANCE * abs(plan.cost)
    return hessian.negative == 0 and hessian.promised <= least and abs(near.cost - plan.cost) <= least


def _last_step(plan: Plan) -> float | None:
    """The median of the last step lengths."""
    steps = [line.step for line in plan.history[-LAST - 1 : -1] if line.step > 0.0]
    return float(np.median(steps)) if steps else None


def local_minima(costs: list[float]) -> list[dict[str, float]]:
    """Costs that differ by less than SAME of themselves, as one; how many ended there, the lowest first."""
    found: list[dict[str, float]] = []
    for cost in sorted(costs):
        if found and cost - found[-1]["highest"] <= SAME_COST_TOLERANCE * abs(cost):
            found[-1]["count"] += 1
            found[-1]["highest"] = cost
        else:
            found.append({"cost": cost, "highest": cost, "count": 1})
    return [{"cost": one["cost"], "count": one["count"]} for one in found]
