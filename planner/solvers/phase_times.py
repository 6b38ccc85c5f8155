"""Times of phases that a problem file leaves free within bounds: those at which the plan costs least.

At given times a solve finds the cost J. Its derivative by a time is that of the cost of the same states and controls
(envelope theorem: at a minimum their own change does not count), here a difference of problems whose references have
phases that end a little earlier and later. L-BFGS-B takes it from there (N&W 7.2; scipy), for a few solves.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from planner.base.data_files import finite
from planner.base.errors import PlannerError
from planner.problem.plan import Plan, Status
from planner.problem.problem import Problem
from planner.problem.problem_parts import Recipe
from planner.solvers.periodic_boundary import PARAMETER
from planner.solvers.work import WorkBudget

PHASE = "phase"  # parameter of a problem's recipe
TRIED = "phase_times"  # option of a plan: a row of times, cost and iterations for each solve
MAX_SOLVES = 10
STAGES = 2.0  # on either side of a difference: feet stand or swing at a whole stage
GAIN = 1e-3  # of the cost: what a solve has to gain
MAX_IDLE = 2  # solves that gain less, after which there are no more: differences are rough where feet switch
REFUSED = 10.0  # times the first cost, of times at which no motion is known


class PhaseTimes(NamedTuple):
    """One solve with given times."""

    number: int  # Counted from 0
    times: tuple[float, ...]  # s, of the phases whose times are free
    cost: float
    iterations: int
    status: Status

    def __str__(self) -> str:
        told = ", ".join(f"{time:.4g}" for time in self.times)
        row = f"{self.number:5d}  {told:>24}  {self.cost:15.8g}  {self.iterations:10d}  {self.status.name}"
        return row if self.number else f"{self.header()}\n{row}"

    @staticmethod
    def header() -> str:
        """The heading of the table of str(); part of the first row."""
        return f"{'solve':>5}  {'phases end at, s':>24}  {'cost':>15}  {'iterations':>10}  status"


def solve_phase_times(
    problem: Problem, bounds: Mapping[int, tuple[float, float]], solved: Callable[[Problem], Plan],
    callback: Callable[[PhaseTimes], object] | None = None, budget: WorkBudget | None = None,
) -> Plan:  # fmt: skip
    """The plan of least cost among those that were solved; its problem has their times.

    Args:
        problem: Of a file, whose recipe has tables of phases; their times are the first to be tried.
        bounds: s, by the number of a phase, from 0, when it may end.
        solved: Solves a problem, within the same budget.
        callback: Called with each PhaseTimes; print makes a table. It may raise StopIteration to end.
        budget: Of all solves together.
    """
    search = _TimesSearch(problem, list(bounds), solved, callback, budget)
    from scipy.optimize import minimize  # 0.4 s that `planner run` need not pay

    first = np.array([problem.parameters[PHASE][k]["until"] for k in bounds], dtype=float)
    options = {"maxfun": MAX_SOLVES}
    with contextlib.suppress(StopIteration):  # interrupted, no work is left, or nothing is gained
        minimize(search, first, jac=True, method="L-BFGS-B", bounds=list(bounds.values()), options=options)
    return search.plan()


def _with_times(recipe: Recipe, numbers: list[int], times: np.ndarray, **changes: Any) -> Problem:
    """The problem of a recipe whose phases of some numbers end at times (K,), s."""
    phases = [dict(phase) for phase in recipe.parameters[PHASE]]
    for k, time in zip(numbers, times.tolist(), strict=True):
        phases[k]["until"] = time
    return recipe.rebuilt(**{PHASE: phases}, **changes)


class _TimesSearch:
    """J and its derivatives by the free times, and the best plan."""

    def __init__(
        self, problem: Problem, free: list[int], solved: Callable[[Problem], Plan],
        callback: Callable[[PhaseTimes], object] | None, budget: WorkBudget | None,
    ) -> None:  # fmt: skip
        assert problem.recipe is not None  # of a file
        self.recipe, self.solved, self.callback, self.budget = problem.recipe, solved, callback, budget
        self.numbers = free
        self.step = STAGES * problem.dynamics.dt
        self.fresh = {} if problem.periodic is None else {PARAMETER: None}  # ends of other times are none of these
        self.tried: list[PhaseTimes] = []
        self.best: Plan | None = None
        self.idle = 0  # solves since one that gained

    def __call__(self, times: np.ndarray) -> tuple[float, np.ndarray]:
        """J and dJ / dtimes (K,)."""
        if self.best is not None and self.budget is not None and self.budget.exhausted:
            raise StopIteration
        try:
            plan = self.solved(_with_times(self.recipe, self.numbers, times, **self.fresh))
            slopes = self._slopes(times, plan) if plan.converged else np.zeros(len(times))
        except PlannerError:
            if self.best is None:
                raise
            return REFUSED * self.tried[0].cost, np.zeros(len(times))
        line = PhaseTimes(len(self.tried), tuple(times.tolist()), plan.cost, plan.total_iterations, plan.status)
        self.tried.append(line)
        before = self.best
        self.idle += 1
        if before is None or (not plan.converged, plan.cost) < (not before.converged, before.cost * (1.0 - GAIN)):
            self.idle = 0
        if before is None or (not plan.converged, plan.cost) < (not before.converged, before.cost):
            self.best = plan
        if self.callback is not None:
            self.callback(line)
        if plan.status is Status.INTERRUPTED or self.idle == MAX_IDLE:
            raise StopIteration
        return (plan.cost if plan.converged else REFUSED * self.tried[0].cost), slopes

    def _slopes(self, times: np.ndarray, plan: Plan) -> np.ndarray:
        """(K,) dJ / dtimes at the plan's states and controls; 0 where a time beside is refused."""
        slopes = np.zeros(len(times))
        assert plan.problem is not None  # it was solved
        assert plan.problem.recipe is not None  # of a file
        for k in range(len(times)):
            away = self.step * np.eye(len(times))[k]
            try:  # without a first guess, which takes most of the time of building it
                beside = [
                    _with_times(plan.problem.recipe, self.numbers, times + sign * away, guess="zero")
                    for sign in (1.0, -1.0)
                ]
            except PlannerError:
                continue
            later, sooner = (one.cost.value(plan.xs, plan.us) for one in beside)
            slopes[k] = (later - sooner) / (2.0 * self.step)
        return slopes

    def plan(self) -> Plan:
        """The best plan, with the record of the solves in its options."""
        if self.best is None:
            raise KeyboardInterrupt  # before the first plan
        rows = [finite([*line.times, line.cost, line.iterations]) for line in self.tried]
        return replace(self.best, options=self.best.options | {TRIED: rows})
