"""Times of phases that a problem file leaves free within bounds: those at which the plan costs least.

At given times a solve finds the cost J. Its derivative by a time is that of the cost of the same states and controls
(envelope theorem: at a minimum their own change does not count), here a difference of problems whose references have
phases that end a little earlier and later. L-BFGS-B takes it from there (N&W 7.2; scipy), for a few solves.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from planner.base.data_files import finite
from planner.base.errors import PlannerError
from planner.problem.objective import rebuilt, with_objective
from planner.problem.plan import Plan, Status
from planner.problem.problem import Problem
from planner.solvers.periodic_boundary import PARAMETER, terminal_goal_cost
from planner.solvers.work import WorkBudget

PHASE = "phase"  # parameter of a problem's recipe
TRIED = "phase_times"  # option of a plan: a row of times, cost and iterations for each solve
MAX_SOLVES = 10
STAGES = 2.0  # on either side of a difference: feet stand or swing at a whole stage
GAIN = 1e-3  # of the cost: what a solve has to gain
MAX_IDLE = 2  # solves that gain less, after which there are no more: differences are rough where feet switch
SHARES = (0.5, 0.25, 0.75)  # of the ranges, from where to go on: the first one whose solve converges
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
        problem: Of a file, whose recipe has tables of phases.
        bounds: s, by the number of a phase, from 0, when it may end.
        solved: Solves a problem, within the same budget.
        callback: Called with each PhaseTimes; print makes a table. It may raise StopIteration to end.
        budget: Of all solves together.
    """
    search = _TimesSearch(problem, list(bounds), solved, callback, budget)
    from scipy.optimize import minimize  # 0.4 s that `planner run` need not pay

    low, high = np.array(list(bounds.values())).T
    try:
        for share in SHARES:
            first = low + share * (high - low)
            search(first)
            if search.tried[-1].status.converged:
                minimize(search, first, jac=True, method="L-BFGS-B", bounds=list(bounds.values()))
                break
    except _Ended:
        pass
    except (KeyboardInterrupt, StopIteration):
        search.interrupted = True
    return search.plan()


class _Ended(Exception):
    """No work is left, or nothing is gained."""


def _with_times(problem: Problem, numbers: list[int], times: np.ndarray, **changes: Any) -> Problem:
    """A problem whose phases of some numbers end at times (K,), s."""
    phases = [dict(phase) for phase in problem.parameters[PHASE]]
    for k, time in zip(numbers, times.tolist(), strict=True):
        phases[k]["until"] = time
    return rebuilt(problem, **{PHASE: phases}, **changes)


class _TimesSearch:
    """J and its derivatives by the free times, and the best plan."""

    def __init__(
        self, problem: Problem, free: list[int], solved: Callable[[Problem], Plan],
        callback: Callable[[PhaseTimes], object] | None, budget: WorkBudget | None,
    ) -> None:  # fmt: skip
        self.problem, self.solved, self.callback, self.budget = problem, solved, callback, budget
        self.numbers, self.step = free, STAGES * problem.dynamics.dt
        self.fresh = {} if problem.periodic is None else {PARAMETER: None}  # ends of other times are none of these
        self.known: dict[tuple[float, ...], tuple[float, np.ndarray]] = {}
        self.tried: list[PhaseTimes] = []
        self.best: Plan | None = None
        self.idle = 0  # solves since one that gained
        self.interrupted = False

    def __call__(self, times: np.ndarray) -> tuple[float, np.ndarray]:
        """J and dJ / dtimes (K,)."""
        key = tuple(times.tolist())
        if key not in self.known:
            self.known[key] = self._solved_at(times)
        return self.known[key]

    def _solved_at(self, times: np.ndarray) -> tuple[float, np.ndarray]:
        spent = self.budget is not None and self.budget.exhausted
        if self.best is not None and (spent or self.idle == MAX_IDLE or len(self.tried) == MAX_SOLVES):
            raise _Ended
        none = np.zeros(len(times))
        try:
            plan = self.solved(_with_times(self.problem, self.numbers, times, **self.fresh))
        except PlannerError:
            if self.best is None:
                raise
            self.idle += 1
            return REFUSED * self.tried[0].cost, none
        if plan.problem is not None and plan.problem.objective is not None:  # the smoothing of its energy stays
            self.problem = with_objective(self.problem, plan.problem.objective.stored)
        cost = _task_cost(plan)
        line = PhaseTimes(len(self.tried), tuple(times.tolist()), cost, plan.total_iterations, plan.status)
        self.tried.append(line)
        before = None if self.best is None else (not self.best.converged, _task_cost(self.best))
        gains = before is None or (not plan.converged, cost) < (before[0], before[1] * (1.0 - GAIN))
        self.idle = 0 if gains else self.idle + 1
        if before is None or (not plan.converged, cost) < before:
            self.best = plan
        if self.callback is not None:
            self.callback(line)
        if plan.status is Status.INTERRUPTED:
            raise StopIteration
        return (cost, self._slopes(times, plan)) if plan.converged else (REFUSED * self.tried[0].cost, none)

    def _slopes(self, times: np.ndarray, plan: Plan) -> np.ndarray:
        """(K,) dJ / dtimes at the plan's states and controls; 0 where a time beside is refused."""
        slopes = np.zeros(len(times))
        assert plan.problem is not None  # it was solved
        for k in range(len(times)):
            away = self.step * np.eye(len(times))[k]
            try:  # without a first guess, which takes most of the time of building it
                times_beside = (times + away, times - away)
                later, sooner = (_with_times(plan.problem, self.numbers, at, guess="zero") for at in times_beside)
            except PlannerError:
                continue
            slopes[k] = (later.cost.value(plan.xs, plan.us) - sooner.cost.value(plan.xs, plan.us)) / (2.0 * self.step)
        return slopes

    def plan(self) -> Plan:
        """The best plan, with the record of the solves in its options."""
        if self.best is None:
            raise KeyboardInterrupt  # before the first plan
        rows = [finite([*line.times, line.cost, line.iterations]) for line in self.tried]
        plan = replace(self.best, options=self.best.options | {TRIED: rows})
        return replace(plan, status=Status.INTERRUPTED) if self.interrupted else plan


def _task_cost(plan: Plan) -> float:
    """The cost of the task: of a periodic motion without the term of its end, which is a multiplier."""
    periodic = plan.problem is not None and plan.problem.periodic is not None
    return plan.cost - terminal_goal_cost(plan) if periodic else plan.cost
