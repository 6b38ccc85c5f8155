"""Step 4 of a proof: whether the replay gets where the cost wanted it."""

from __future__ import annotations

import numpy as np

from planner.base.measured import Measured, Section
from planner.problem.costs.tracking import TrackingCost
from planner.problem.problem import Problem
from planner.proof.replaying import Replay


def costs_with_goals(problem: Problem) -> list[TrackingCost]:
    """The terms of a problem's cost with a final weight, and so with a goal state."""
    costs = getattr(problem.cost, "costs", (problem.cost,))
    return [cost for cost in costs if isinstance(cost, TrackingCost) and np.any(cost.Q[-1])]


def goal(run: Replay, problem: Problem) -> Section:
    """The machine's own judgement of one replay, or how far from its cost's final state it ends."""
    if problem.requirements is not None and problem.requirements.goal is not None:
        return problem.requirements.goal(run)
    wanted = costs_with_goals(problem)
    if not wanted:
        return Section("goal", not_applicable="the problem states no goal apart from its cost")

    def distance(x: np.ndarray) -> float:
        errors = (np.abs(run.plan.space.difference(x, c.x_ref[-1]))[np.any(c.Q[-1], axis=0)].max() for c in wanted)
        return float(max(errors))

    note = "largest component that the cost's final weight acts on, against its reference; shown, not judged"
    errors = {"planned_goal_error": run.plan.xs[-1], "replayed_goal_error": run.xs[-1]}
    return Section("goal", tuple(Measured(name, distance(x), "", None, note) for name, x in errors.items()))
