"""Diagnose equalities that give in the user's file: there they are springs, and the plan keeps them exactly."""

from __future__ import annotations

import math

from planner.base.measured import Measurement, Quantity
from planner.model.capabilities import capabilities_of, constrained_dofs
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.proof.diagnostics.suggested_fix import SuggestedFix, no_fix
from planner.proof.error_scales import bounds_in_file
from planner.proof.original_model import EQUALITY_RATE, TIMESTEP
from planner.proof.verdict import Proof

SPARE = 2.0  # of what passes, by which the stiffer equality is to give less
STEPS = 2.0  # of the simulator: the shortest time constant that MuJoCo takes
PATH = "largest_"  # begins the name of an error along the path


def soft_equalities(plan: Plan, problem: Problem, proof: Proof | None) -> list[SuggestedFix]:
    """The time constant with which the file's equalities give as much as passes.

    A force that changes slowly deflects a spring by the inverse square of its natural frequency. The spring swings at
    that frequency, so its velocity falls as the inverse; where its bound rises with the frequency, the share falls as
    the inverse square again. Where a contact, a stop or a clamp of the file is unknown to the plan, that is the cause.
    So is something else where the springs are as fast as the simulator's step lets them be: those of a URDF's mimic.
    Where that step forbids springs as fast as needed, a slower motion is left.
    """
    mechanism = capabilities_of(problem.dynamics).mechanism
    if proof is None or mechanism is None or not constrained_dofs(mechanism).any():
        return []
    failures = proof.your_file.failures
    of_path = all(one.name.startswith((PATH, "replayed_")) for one in failures)
    if not failures or not of_path or not (proof.refined_open_loop.passed or proof.refined_feedback.passed):
        return []
    found = {one.name: one.value for one in proof.your_file.measured}
    rate, shortest = found.get(EQUALITY_RATE, 0.0), STEPS * found[TIMESTEP]
    times = max(_times_as_fast(plan, one, rate) for one in failures)
    if not 0.0 < rate * shortest < 1.0 or not math.isfinite(times):
        return []
    time = 1.0 / (rate * times)
    if time >= shortest:
        return [no_fix("model", "equality_gives", rate=rate, time=time)]
    return [no_fix("model", "equality_gives_too_much", rate=rate, time=shortest, step=Quantity(found[TIMESTEP], "s"))]


def _times_as_fast(plan: Plan, failed: Measurement, rate: float) -> float:
    """How many times as fast springs of a rate, rad/s, are to be for what failed to pass with some to spare."""
    if not failed.bound:
        return math.inf
    needed, falls = SPARE * failed.value / failed.bound, 2.0
    if failed.unit.endswith("/s"):
        bounds, faster = bounds_in_file(plan, rate), bounds_in_file(plan, 2.0 * rate)
        rises = (bounds == failed.bound) & (faster == 2.0 * bounds)
        falls = 2.0 if failed.name.startswith(PATH) and rises.any() else 1.0
    return needed ** (1.0 / falls)
