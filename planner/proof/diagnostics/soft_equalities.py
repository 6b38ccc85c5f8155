"""Diagnose equalities that give in the user's file: there they are springs, and the plan keeps them exactly."""

from __future__ import annotations

import math

from planner.model.capabilities import capabilities_of, constrained_dofs
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.proof.diagnostics.suggested_fix import SuggestedFix, no_fix
from planner.proof.original_model import EQUALITY_RATE
from planner.proof.verdict import Proof

SPARE = 2.0  # of what passes, by which the stiffer equality is to give less


def soft_equalities(plan: Plan, problem: Problem, proof: Proof | None) -> list[SuggestedFix]:
    """The time constant with which the file's equalities give as much as passes.

    A force deflects a spring by the inverse square of its natural frequency, as long as it changes slowly. Where a
    contact, a stop or a clamp of the file is unknown to the plan, that is the cause.
    """
    mechanism = capabilities_of(problem.dynamics).mechanism
    if proof is None or mechanism is None or not constrained_dofs(mechanism).any():
        return []
    failures = proof.your_file.failures
    of_path = all(one.name.startswith(("largest_", "replayed_")) for one in failures)
    if not failures or not of_path or not (proof.refined_open_loop.passed or proof.refined_feedback.passed):
        return []
    rate = next((one.value for one in proof.your_file.measured if one.name == EQUALITY_RATE), 0.0)
    share = max(one.value / one.bound if one.bound else math.inf for one in failures)
    if rate == 0.0 or not math.isfinite(share):
        return []
    return [no_fix("model", "equality_gives", rate=rate, time=1.0 / (rate * math.sqrt(SPARE * share)))]
