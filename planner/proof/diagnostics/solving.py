"""Diagnose a solve that did not converge: diverging first guess, too few iterations, or no further progress."""

from __future__ import annotations

import math

import numpy as np

from planner.base.measured import Quantity
from planner.model.capabilities import capabilities_of
from planner.problem.plan import Iteration, Plan, Status
from planner.problem.problem import Problem
from planner.proof.diagnostics.stage import rates_at_start, rounded_step
from planner.proof.diagnostics.suggested_fix import (
    ITERATIONS,
    SuggestedFix,
    fix,
    has_searched_duration,
    no_fix,
    of_file,
    rounded_up,
)
from planner.proof.verdict import Proof
from planner.solvers.options import EXPECTED_REDUCTION_TOLERANCE

MAX_RATE_STEP = 1.0  # of the fastest eigenvalue times the stage: RK4 is stable up to 2.8 and exact to a percent at 1
MAX_TIMES = 30.0  # upper limit of the factor on the iterations
MAX_WORK_TIMES = 10.0  # of the work that a solve was given: what needs more is too large, not cut too early
MANY_SUBSTEPS = 8  # of RK4 in a stage: on a mobile arm of 15 joints 16 of them cost 4.5 times as much as Rosenbrock's
STARTS = 8
_FEW = 8  # number of iterations below which no trend is fitted
_GAINED = 1e-3  # of the cost: smallest reduction in the second half of a solve that justifies more iterations


def first_guess(plan: Plan, problem: Problem, proof: Proof | None) -> list[SuggestedFix]:
    """The stage length for the machine's fastest eigenvalue, or another first guess, for a diverging first guess."""
    if plan.status is not Status.NOT_FINITE:
        return []
    dt, found = problem.dynamics.dt, []
    rate = float(np.abs(rates_at_start(problem)).max())
    if rate * dt > MAX_RATE_STEP:
        value = rounded_step(problem.duration, MAX_RATE_STEP / rate)
        found.append(fix(problem, "dt", value, "rate_too_fast", rate=rate, per_stage=rate * dt))
    if of_file(problem):
        other = {"hold": "zero", "zero": "hold"}.get(problem.parameters.get("guess", "hold"), "zero")
        found.append(fix(problem, "guess", other, "guess_runs_away"))
    return found


def more_iterations(plan: Plan, problem: Problem, proof: Proof | None) -> list[SuggestedFix]:
    """Number of iterations, extrapolated from the trend of the decrease."""
    if plan.status not in (Status.MAX_ITERATIONS, Status.WORK_LIMIT):
        return []
    if has_searched_duration(plan):  # which the budget cut, or its last solve
        more = rounded_up(2.0 * plan.options["work"]) if plan.status is Status.WORK_LIMIT else None
        return [] if more is None else [fix(problem, "work", more, "search_cut", tried=len(plan.options["tried"]))]
    lines = [line for line in plan.history if line.step > 0.0]
    needed = iterations_needed(lines, plan.cost)
    if needed is None:
        return []
    left = lines[-1].expected / max(1.0, abs(plan.cost))
    key, value = ITERATIONS, needed
    if plan.status is Status.WORK_LIMIT:
        times = max(needed / max(plan.nit, 1), 2.0)
        if times > MAX_WORK_TIMES:
            return [_cheaper_stages(plan, problem)]
        key, value = "work", rounded_up(plan.options["work"] * times)
    return [fix(problem, key, value, "more_iterations", iterations=plan.nit, left=left)]


def _cheaper_stages(plan: Plan, problem: Problem) -> SuggestedFix:
    """The implicit method, whose stage is cheaper than many substeps of RK4; else no value."""
    substeps = getattr(problem.dynamics, "substeps", 1)
    values = {"work": plan.options["work"], "iterations": plan.nit, "stages": plan.N, "substeps": substeps}
    mechanism = capabilities_of(problem.dynamics).mechanism
    able = mechanism is not None and not mechanism.has_closed_chains  # which the Rosenbrock method does not keep
    if able and of_file(problem) and getattr(problem.dynamics, "integrator", "") == "rk4" and substeps >= MANY_SUBSTEPS:
        return fix(problem, "integrator", "rosenbrock", "stages_cost_too_much", **values)
    return no_fix("work", "stages_cost_too_much", **values)


def other_guesses(plan: Plan, problem: Problem, proof: Proof | None) -> list[SuggestedFix]:
    """Several first guesses, for a solve that did not converge from one."""
    stalls = plan.status in (Status.MAX_ITERATIONS, Status.NO_DESCENT)  # what its work cut has none for several
    if not stalls or has_searched_duration(plan) or problem.parameters.get("starts", 1) != 1 or len(plan.starts) > 1:
        return []
    return [fix(problem, "starts", STARTS, "stalled", cost=plan.cost, gradient=plan.gradient_norm)]


def iterations_needed(lines: list[Iteration], cost: float) -> int | None:
    """Iterations until the expected decrease is below the tolerance, by its trend; None if it does not fall."""
    if not lines:
        return None
    half = lines[len(lines) // 2 :]
    gained = half[0].cost - cost
    expected = np.array([line.expected for line in half])
    if len(lines) < _FEW:  # stopped early
        return 1000 if len(lines) < 1000 else None
    if np.any(expected <= 0.0) or not np.isfinite(expected).all():
        return None
    slope = float(np.polyfit(np.arange(len(half)), np.log(expected), 1)[0])
    enough = EXPECTED_REDUCTION_TOLERANCE * max(1.0, abs(cost))
    if slope >= 0.0:
        return 10 * len(lines) if gained > _GAINED * abs(cost) else None
    more = max(0.0, math.log(expected[-1] / enough) / -slope)
    if more > MAX_TIMES * len(lines):
        return 10 * len(lines) if gained > _GAINED * abs(cost) else None
    return int(rounded_up(1.5 * more + len(lines)))


def not_a_minimum(plan: Plan, problem: Problem, proof: Proof | None) -> list[SuggestedFix]:
    """For a solve that converged though its cost may still fall: how to go on, or to skip the optimality check."""
    if not plan.converged and plan.status not in (Status.INTERRUPTED, Status.NO_DESCENT):
        return []  # what kept it from converging is the cause
    if proof is not None and not proof.asked.get("optimal", True):
        return []  # feasibility alone is judged
    failures = {} if proof is None else {one.name: one.value for one in proof.optimality.failures}
    if "decrease_left" in failures:
        return [no_fix("optimal", "not_a_minimum", left=failures["decrease_left"])]
    if "negative_curvature" in failures:
        return [no_fix("optimal", "saddle", curvature=failures["negative_curvature"])]
    return []


def other_model(plan: Plan, problem: Problem, proof: Proof | None) -> list[SuggestedFix]:
    """The model that is replayed, where its numbers are not the plan's."""
    wrong: set[str] = set() if proof is None else {one.name for one in proof.parity.failures}
    numbers = {"mass_matrix_error", "bias_force_error", "actuator_force_error", "acceleration_error"}
    numbers |= {"driven_acceleration_error", "rate_error"}
    return [no_fix("model", "other_model")] if wrong & numbers and "unmodelled_elements" not in wrong else []


def nothing_known(plan: Plan, problem: Problem, proof: Proof | None) -> SuggestedFix:
    """The finding without a known cause: the first that failed, but of the replay that was judged."""
    failed = []
    if proof is not None:
        other = ("refined_open_loop", "order") if proof.replay.feedback else ("refined_feedback",)
        sections = [section for name, section in proof.sections.items() if name not in other]
        failed = [one for section in sections for one in section.failures]
    what = failed[0].name.replace("_", " ") if failed else "the end of the solve"
    code = "unknown_of_time" if has_searched_duration(plan) else "unknown"  # whose problem has no duration of its own
    code = "unknown_of_recording" if plan.status is Status.GIVEN else code
    return no_fix("", code, failed=what, duration=Quantity(problem.duration, "s"))
