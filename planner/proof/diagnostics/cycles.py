"""Diagnose a gait that should go on: stages too long, no cycle that returns, or one that MuJoCo does not follow."""

from __future__ import annotations

import numpy as np

from planner.base.measured import Quantity
from planner.problem.plan import Plan, Status
from planner.problem.problem import Problem
from planner.proof.diagnostics.stage import rounded_step
from planner.proof.diagnostics.suggested_fix import SuggestedFix, fix, no_fix, of_file
from planner.proof.verdict import Proof


def cycle_not_found(plan: Plan, problem: Problem, proof: Proof | None) -> list[SuggestedFix]:
    """Of a solve that ended without a cycle what may be asked for instead: what its plan touches is no cause."""
    ended = not plan.converged and not plan.status.cut
    return failing_cycle(plan, problem, proof) if ended else []


def failing_cycle(plan: Plan, problem: Problem, proof: Proof | None) -> list[SuggestedFix]:
    """Half the stage for a cycle that stages do not resolve; else what may be asked for instead."""
    if not of_file(problem) or problem.periodic is None:
        return []
    dt, table = problem.dynamics.dt, problem.parameters["periodic"]
    if plan.status is Status.UNRESOLVED:
        return [fix(problem, "dt", rounded_step(problem.duration, 0.5 * dt), "cycle_unresolved", dt=Quantity(dt, "s"))]
    travel = Quantity(float(np.linalg.norm(table.get("travel", 0.0))), "m")
    code = "cycle_not_followed" if plan.converged else "cycle_not_found"
    return [no_fix("periodic", code, travel=travel, duration=Quantity(problem.parameters["duration"], "s"))]
