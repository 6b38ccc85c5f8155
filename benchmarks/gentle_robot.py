"""What makes the robot of the human step a gentler one: `python benchmarks/gentle_robot.py`.

It makes the tables of docs/human-step.md. Each way of sparing it, on swing and cycle, with the default cost: how far
the legs are from the normal gait, jerk of the pelvis, force and moment of the robot, MuJoCo's distance from the plan.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

import planner
from planner.cases.human_step.case import Phase, human_step
from planner.cases.human_step.gait import NORMAL_GAIT
from planner.cases.human_step.measures import judge_tracking, measures, robot
from planner.cases.human_step.walker import SIDES, SWING, GaitPhase, Walker

WAYS: dict[str, dict[str, Any]] = {
    "`--effort 1`, the default": {},
    "`--effort 10`": {"effort": 10.0},
    "`--jerk .1`": {"jerk": 0.1},
    "`--jerk 1`": {"jerk": 1.0},
    "`--jerk 10`": {"jerk": 10.0},
    "`--force 1`": {"force": 1.0},
    "`--force 10`": {"force": 10.0},
    "`--pelvis force`": {"pelvis": "force"},
    "`--pelvis force --effort 10`": {"pelvis": "force", "effort": 10.0},
}
MOST = 200
COLUMNS = (
    "iterations", "s", "joints, deg RMS", "clear, mm", "jerk, m/s^3", "force, N", "moment, N m",
    "MuJoCo, deg: open, gains",
)  # fmt: skip


def row(phase: Phase, given: dict[str, Any]) -> list[str]:
    """The table's, of one way."""
    problem = human_step(phase=phase, **given)
    planner.solve(problem, max_iterations=1)  # compiles
    began = time.perf_counter()
    plan = planner.solve(problem, max_iterations=MOST)
    seconds = time.perf_counter() - began
    cycle = phase == "cycle"
    walker = Walker(
        legs=SIDES if cycle else ("right",), belt=cycle, motors="pelvis" in given, jerked=given.get("jerk", 0.0) > 0.0
    )
    step = GaitPhase(walker, NORMAL_GAIT, 1.2, 0.0 if cycle else SWING[0], plan.N, problem.dynamics.dt)
    found, does = measures(step, plan.xs), robot(problem.dynamics, plan.xs, plan.us)  # type: ignore[arg-type]
    errors = [judge_tracking(step, planner.replay(plan, feedback=feedback)).measured[0].value for feedback in (0, 1)]  # type: ignore[arg-type]
    return [
        f"{plan.nit}" if plan.success else f"{plan.nit}, {plan.status.name}", f"{seconds:.2f}",
        f"{np.sqrt(np.mean(np.square(list(found.rms.values())))):.2f}", f"{1e3 * min(found.clearance.values()):.0f}",
        *(f"{rms:.0f}, {most:.0f}" for rms, most in (does.jerk, does.force, does.moment)),
        ", ".join(f"{error:.2g}" for error in errors),
    ]  # fmt: skip


def main() -> None:
    """Both tables, in Markdown."""
    phases: tuple[Phase, ...] = ("swing", "cycle")
    for phase in phases:
        print(f"\n| {phase} | {' | '.join(COLUMNS)} |\n|{'---|' * (1 + len(COLUMNS))}")
        for name, given in WAYS.items():
            print(f"| {name} | {' | '.join(row(phase, given))} |", flush=True)


if __name__ == "__main__":
    main()
