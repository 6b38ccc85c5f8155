"""A goal on which a machine cannot stand: no plan stays there, and no weight changes it."""

from __future__ import annotations

from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.proof.cures.cure import FILE, Cure, no_cure
from planner.proof.verdict import Proof

FALLS = "goal is put on the ground, where it does not balance by itself: "  # as cases.problem_file.on_ground says it


def standing_goal(plan: Plan, problem: Problem, proof: Proof | None) -> list[Cure]:
    """The reason why a machine that ends elsewhere, or does not end, cannot stand where it was asked to."""
    if problem.case != FILE or (proof is not None and proof.goal.passed and proof.your_file.passed):
        return []
    _, falls, why = problem.parameters["resolved"]["reasons"].get("settle", "").partition(FALLS)
    return [no_cure("goal", f"No plan stays at the goal: {why.split(' goal goes ')[0]}")] if falls else []
