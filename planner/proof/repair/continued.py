"""Go on with a solve: from where its share of the work has cut it, or from beside a saddle, along the lowest curvature.

SLQ's model of the cost has no negative curvature (Gauss-Newton), so a solve may end where the gradient is small and the
cost still falls to both sides (N&W 3.4). The proof finds that direction; from the cheapest motion along it the solve
goes on.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

from planner.problem.plan import Plan, Status
from planner.problem.problem import Problem
from planner.proof.consistency import recomputed
from planner.proof.diagnostics.solving import iterations_needed
from planner.proof.diagnostics.suggested_fix import has_searched_duration
from planner.proof.stationarity import cheaper_along_lowest_curvature
from planner.proof.verdict import Proof
from planner.solvers.options import SolverOptions
from planner.solvers.slq import solve
from planner.solvers.work import WorkBudget

MAX_SADDLES = 6  # times: a swing-up has a few, one after another
SHARE_OF_FALL = 1e-4  # of what the direction gains: beside a saddle the gradient is small, and no reason to stop


class SaddleStep(NamedTuple):
    """A plan that was solved from beside a saddle, and its proof."""

    plan: Plan
    proof: Proof
    cost: float  # of the saddle

    def __str__(self) -> str:
        return f"solved again from beside a saddle: cost {self.cost:.6g} -> {self.plan.cost:.6g}, {self.proof.verdict}"


def leave_saddles(
    plan: Plan, proof: Proof, budget: WorkBudget, prove: Callable[[Plan], Proof], max_iterations: int,
    report: Callable[[SaddleStep], object], **options: Any,
) -> tuple[Plan, Proof]:  # fmt: skip
    """The last cheaper plan and its proof, of a plan that fails by negative curvature alone; else those given."""
    for _ in range(MAX_SADDLES):
        failures = [one.name for one in proof.sections["optimality"].failures]
        problem = plan.problem
        if problem is None or failures != ["negative_curvature"]:
            break
        allowed = budget.before_proof(problem)
        if allowed.exhausted:
            break
        sweep = recomputed(plan, problem, plan.xs, plan.us).sweep
        found = None if sweep is None else cheaper_along_lowest_curvature(plan, problem, sweep)
        if found is None:
            break
        us, fall = found
        asked = replace(SolverOptions(), **options).for_problem(problem).expected_reduction_tolerance or 0.0
        tolerance = min(asked, SHARE_OF_FALL * fall / max(1.0, abs(plan.cost)))
        better = solve(
            replace(problem, us=us), budget=allowed,
            **options | {"max_iterations": max_iterations, "expected_reduction_tolerance": tolerance,
                         "gradient_tolerance": 0.0},
        )  # fmt: skip
        if not (better.converged and better.cost < plan.cost):
            break
        budget.charge_proof(problem)
        step = SaddleStep(better, prove(better), plan.cost)
        report(step)
        plan, proof = step.plan, step.proof
    return plan, proof


SHARE = 0.7  # of the work that is left, at most: the rest is for fixes of the plan that comes of it
MIN_ITERATIONS = 20  # for which it goes on
_SEARCHES = {"phase_times", "passes"}  # in the options of a plan: of a search by many solves


class Resumption(NamedTuple):
    """A solve that went on, and the cost and iterations before it."""

    plan: Plan
    cost: float
    iterations: int

    def __str__(self) -> str:
        return (
            f"the solve went on after {self.iterations} iterations: {self.plan.nit} more, {self.plan.status.name}, "
            f"cost {self.cost:.6g} -> {self.plan.cost:.6g}"
        )


def resumed(
    problem: Problem, plan: Plan, budget: WorkBudget, max_iterations: int, **options: Any
) -> Resumption | None:  # fmt: skip
    """The plan of the solve that goes on; None where it is not worth it, or comes to nothing better."""
    cut = plan.status is Status.WORK_LIMIT and problem.periodic is None and not has_searched_duration(plan)
    if not cut or _SEARCHES & set(plan.options):
        return None
    if iterations_needed([line for line in plan.history if line.step > 0.0], plan.cost) is None:
        return None
    allowed = budget.part("going on", SHARE).before_proof(problem)
    if allowed.iterations(problem, MIN_ITERATIONS) < MIN_ITERATIONS:
        return None
    allowed.charge_warm_start(problem)
    better = solve(problem, warm_start=plan, budget=allowed, max_iterations=max_iterations, **options)
    if better.status is Status.INTERRUPTED:
        raise KeyboardInterrupt
    outside = better.status is Status.OUTSIDE_LIMITS
    if outside or not (better.converged or better.cost < plan.cost):
        return None
    return Resumption(better, plan.cost, plan.nit)
