"""Random people of the box that the human step is made for: `python benchmarks/people.py --phase cycle`.

One JSON line each, then a summary; on the workers that are asked for, `--workers 8` or `--scheduler tcp://HOST:8786`. A
person succeeds when the solve has converged within MOST iterations and heel and toe of every swinging foot clear the
belt in the middle of the swing (planner.cases.human_step.measures.CLEAR); MuJoCo's distance from the plan is reported
beside it. SEED is not the one that the default cost was tuned on.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from functools import partial
from typing import Any

import numpy as np

import planner
from planner.base.executors import ordered_map
from planner.cases.human_step.case import human_step
from planner.cases.human_step.gait import NORMAL_GAIT
from planner.cases.human_step.measures import CLEAR, judge_tracking, measures
from planner.cases.human_step.walker import SIDES, SWING, GaitPhase, Walker
from planner.proof.replays.replaying import replay
from planner.sweeps.processes import executor_of

BOX = {"mass": (45.0, 110.0), "height": (1.50, 1.95), "cycle_time": (1.0, 1.8)}  # kg, m, s
SEED, MOST = 2026, 60


def people(count: int, seed: int) -> list[dict[str, float]]:
    """Uniform in the box, each: mass, height, cycle_time."""
    rng = np.random.default_rng(seed)
    return [{name: float(rng.uniform(*limits)) for name, limits in BOX.items()} for _ in range(count)]


def attempt(person: dict[str, float], phase: str, proof: bool = True) -> dict[str, Any]:
    """What became of one person's step."""
    cadence = 120.0 / person["cycle_time"]
    problem = human_step(phase=phase, mass=person["mass"], height=person["height"], cadence=cadence)
    began = time.perf_counter()
    plan = planner.solve(problem, max_iterations=MOST)
    seconds = time.perf_counter() - began
    cycle = phase == "cycle"
    walker = Walker(person["mass"], person["height"], legs=SIDES if cycle else ("right",), belt=cycle)
    begin = 0.0 if cycle else SWING[0]
    step = GaitPhase(walker, NORMAL_GAIT, person["cycle_time"], begin, plan.N, problem.dynamics.dt)
    clear = {side: 1e3 * least for side, least in measures(step, plan.xs).clearance.items()}
    reasons = [] if plan.success else [plan.status.name]
    reasons += [f"{side} foot clears the belt by {mm:.1f} mm" for side, mm in clear.items() if mm < 1e3 * CLEAR]
    row = {**person, "phase": phase, "iterations": plan.nit, "cost": plan.cost, "clear_mm": clear, "seconds": seconds}
    if proof:
        for name, feedback in (("open_loop_deg", False), ("gains_deg", True)):
            row[name] = judge_tracking(step, replay(plan, feedback=feedback)).measured[0].value
    return {**row, "success": not reasons, "reasons": reasons}


def interval(successes: int, count: int, z: float = 1.96) -> tuple[float, float]:
    """Of the share, with 95 % (Wilson)."""
    share, spread = successes / count, z * z / count
    centre = (share + 0.5 * spread) / (1.0 + spread)
    half = z * math.sqrt(share * (1.0 - share) / count + 0.25 * spread / count) / (1.0 + spread)
    return centre - half, centre + half


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Of all of them: quantiles are at 0, 50, 90 and 100 %."""
    good = sum(row["success"] for row in rows)

    def quantiles(values: list[float]) -> list[float]:
        return [round(float(value), 3) for value in np.quantile(values, [0.0, 0.5, 0.9, 1.0])]

    found = {
        "people": len(rows), "successes": good,
        "interval": [round(end, 3) for end in interval(good, len(rows))],
        "iterations": quantiles([row["iterations"] for row in rows]),
        "least_clearance_mm": quantiles([min(row["clear_mm"].values()) for row in rows]),
        "seconds": quantiles([row["seconds"] for row in rows]),
    }  # fmt: skip
    for name in ("open_loop_deg", "gains_deg"):
        if name in rows[0]:
            found[name] = quantiles([row[name] for row in rows])
    return found


def main() -> None:
    """Everybody, on the workers that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--phase", choices=("swing", "cycle"), default="cycle")
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--no-proof", action="store_true")
    parser.add_argument("--workers", type=int)
    parser.add_argument("--scheduler")
    given = parser.parse_args()
    rows = []
    work = partial(attempt, phase=given.phase, proof=not given.no_proof)
    with executor_of(given.workers, given.scheduler) as executor:
        for row in ordered_map(executor, work, people(given.count, given.seed)):
            rows.append(row)
            print(json.dumps(row), flush=True)
    print(json.dumps(summary(rows)), flush=True)


if __name__ == "__main__":
    main()
