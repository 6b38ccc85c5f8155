"""Go on with a solve that its share of the work has cut, from where it ended, while its cost is falling."""

from __future__ import annotations

from typing import Any, NamedTuple

from planner.problem.plan import Plan, Status
from planner.problem.problem import Problem
from planner.proof.diagnostics.solving import iterations_needed
from planner.proof.diagnostics.suggested_fix import has_searched_duration
from planner.solvers.slq import solve
from planner.solvers.work import WorkBudget

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
