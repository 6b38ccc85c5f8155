"""Diagnose standing machines: a goal pose that is not statically stable, and a fall along the trajectory."""

from __future__ import annotations

import numpy as np

from planner.base.errors import PlannerError
from planner.dynamics.statics import static_equilibrium
from planner.model.capabilities import capabilities_of, stands_on_ground
from planner.problem.costs.tracking import tracking_of
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.proof.diagnostics.suggested_fix import SuggestedFix, no_fix, of_file
from planner.proof.verdict import Proof

MAX_ERROR_GROWTH = 5.0  # exponent over a plan: an error grows by exp(5), 150 times


def standing_goal(plan: Plan, problem: Problem, proof: Proof | None) -> list[SuggestedFix]:
    """The reason why a machine that misses its goal, or does not converge, cannot stand at its goal."""
    asked, cost = problem.parameters, tracking_of(problem.cost)
    mechanism = capabilities_of(problem.dynamics).mechanism
    if not of_file(problem) or (proof is not None and proof.goal.passed and proof.your_file.passed):
        return []
    if asked["settle"] != "auto" or asked["contacts"] != "ground" or cost is None or problem.goal_specs is not None:
        return []
    goal = cost.x_ref[-1]
    if mechanism is None or not stands_on_ground(mechanism) or np.any(goal[mechanism.nq : mechanism.nq + mechanism.nv]):
        return []
    try:
        static_equilibrium(mechanism, goal)
    except PlannerError as error:
        return [no_fix("goal", "goal_unbalanced", cause=str(error))]
    return []


def loses_balance(proof: Proof) -> bool:
    """Whether a standing machine falls, with joint ranges respected under its gains: joint stops are then no cause."""
    problem = proof.replay.plan.problem
    mechanism = None if problem is None else capabilities_of(problem.dynamics).mechanism
    if mechanism is None or not stands_on_ground(mechanism) or proof.mode is not None or not proof.plan.passed:
        return False
    in_range = not any(one.name == "position_range_violation" for one in proof.refined_feedback.failures)
    return in_range and _growth_rate(proof) * proof.replay.plan.t[-1] > MAX_ERROR_GROWTH


def _growth_rate(proof: Proof) -> float:
    """Growth rate of errors without gains, 1/s; NaN if unknown."""
    return next((one.value for one in proof.growth.measured if one.name == "growth_rate_open_loop"), float("nan"))


def falling(plan: Plan, problem: Problem, proof: Proof | None) -> list[SuggestedFix]:
    """The finding that the machine loses its balance, by itself or where MuJoCo's ground differs; after its fixes."""
    if proof is None or not loses_balance(proof):
        return []
    share = float(proof.errors.measured["feedback"].max())
    return [no_fix("goal", "falls" if share > 1.0 else "ground_differs", rate=_growth_rate(proof), share=share)]
