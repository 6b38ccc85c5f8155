"""The plan that a loop amounts to: what was expected at each stage, and the controls that were applied."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from planner.base.errors import PlannerError
from planner.control.receding_horizon import RecedingHorizonProblem
from planner.problem.plan import Plan, Status


def executed_plan(plan: Plan, xs: np.ndarray, us: np.ndarray) -> Plan:
    """A plan of another length with these states (N+1, nx) and controls (N, nu), GIVEN, without gains.

    Its problem is that of the loop: the task, and the goal kept after its end. Where a problem of that length cannot be
    made it is that of the task.
    """
    problem, N = plan.problem, len(us)
    assert problem is not None
    longer = problem
    if N != problem.N:
        try:
            longer = replace(RecedingHorizonProblem(problem, N).problem, appearance=problem.appearance)
        except PlannerError:
            longer = problem
    K = np.zeros((*us.shape, plan.space.ndx))
    t = problem.dynamics.dt * np.arange(N + 1)
    return Plan(
        t, xs, us, K, 0.0, 0.0, Status.GIVEN, (), longer, None, plan.twin, options={"loop": True},
    )  # fmt: skip
