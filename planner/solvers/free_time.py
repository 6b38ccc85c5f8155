"""Free final time: optimal and minimum duration T = N dt, with a fixed number N of stages.

SLQ minimizes J at each T; this leaves a problem in one variable:

    minimize  time_weight T + J*(T)                                    over shortest <= T <= longest.

With time alone there is no J: T is the minimum duration at which the exact goal is feasible within the bounds of the
controls, by bisection; the plan minimizes the effort at that T. Each solve starts from the successful plan of the
closest duration.

Each J*(T) is a local minimum, and T counts as too short if SLQ finds no feasible plan. So the result is an upper bound
of the global minimum duration.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from planner.base.arguments import number, short_repr
from planner.base.errors import PlannerError
from planner.problem.limits import EXACT, Limits
from planner.problem.objective import (
    base_problem,
    smoothing_of,
    with_found_duration,
    with_objective,
    with_smoothing,
    without_objective,
)
from planner.problem.plan import Plan, Status
from planner.problem.problem import Problem
from planner.problem.problem_parts import checked_durations, durations_or_default, weights_of
from planner.problem.rediscretize import retimed
from planner.solvers.gains import at_pace, warm_start
from planner.solvers.options import single_start, with_overrides
from planner.solvers.slq import as_user_plan, solve
from planner.solvers.trapped import largest_violation
from planner.solvers.waypoints import best_waypoints, free_waypoints
from planner.solvers.work import WorkBudget, budget_of, record_of_cut

TOLERANCE = 1e-3
"""Default tolerance of the duration, relative."""
LOOK = 60  # iteration limit of a warm-started solve, after which a large violation means that T is too short
SECOND_LOOK = 300  # of one that goes on from there
MAX_VIOLATION_RATIO = 1000.0  # violation / tolerance above which T is too short; 100 rejects a feasible T of two-link
AFRESH_WORK = 5.0  # limit of the work of such a solve, which is relaxed: most that fail take all of it
NEAREST, FREE, AFRESH = "the nearest plan", "its free plan", "its free plan, relaxed"  # with what a solve begins
_SHORTER = 0.95  # times the least duration found, at which a solve begins afresh
_SHRINK = 0.85  # ratio of successive durations: 15 per decade
_MOST_SHRUNK = 0.5  # the same at the least, after several that were long enough


class DurationTrial(NamedTuple):
    """One solve at a trial duration."""

    number: int  # Counted from 0
    duration: float  # T, s
    cost: float  # J*(T) without the time term
    violation: float  # Largest violation of limits and constraints, rad, m, rad/s, m/s
    iterations: int  # Number of iterations of the solve
    status: Status  # Status of the solve

    def __str__(self) -> str:
        row = (
            f"{self.number:5d}  {self.duration:12.6g}  {self.cost:15.8g}  {self.violation:9.2e}  "
            f"{self.iterations:10d}  {self.status.name}"
        )
        return row if self.number else f"{self.header()}\n{row}"

    @staticmethod
    def header() -> str:
        """The heading of the table of str(); part of the first row."""
        return f"{'tried':>5}  {'duration, s':>12}  {'cost':>15}  {'outside':>9}  {'iterations':>10}  status"


def solve_for(
    problem: Problem, objective: str | Mapping[str, float] | None = None, *, durations: Sequence[float] | None = None,
    tolerance: float = TOLERANCE, callback: Callable[[Any], object] | None = None, **options: Any,
) -> Plan:  # fmt: skip
    """Optimize a problem for an objective, its own or another; with time in it also the duration.

    Objectives other than effort start from the controls of minimum effort; those of a problem file from the plan that
    it has without an objective, whose weights of velocities keep joints from swinging.

    Args:
        problem: The problem to solve; see with_objective.
        objective: "effort", "energy", "jerk", "time", or weights by these names, e.g. {"effort": 1, "time": 2}; by
            default the problem's own, else effort. Time alone needs limits of the controls and meets the goal exactly.
        durations: Lower and upper bound of the duration, s, with time only; by default those of the problem's file or
            task(), else a fifth and twice the problem's.
        tolerance: Of the duration, relative.
        callback: As of solve; with time it is called with each DurationTrial.
        options: Of solve().

    Returns:
        A Plan of the problem with that objective, at the best duration.

    Raises:
        PlannerError: As with_objective and solve; durations not allowed or not two increasing ones; time alone
            without bounds of the controls.
    """
    if not isinstance(problem, Problem):
        raise PlannerError(f"problem is {short_repr(problem)}, expected a Problem.")
    if objective is None:
        objective = "effort" if problem.objective is None else problem.objective.weights
    else:
        problem = base_problem(problem)  # of its own objective nothing stays
    weights = weights_of(objective)
    own = problem.parameters.get("durations") if durations is None and "time" in weights else durations
    between = checked_durations(durations_or_default(own, weights, problem.duration), weights)
    options["budget"] = budget_of(options.get("budget"))  # one for all solves
    number("tolerance", tolerance, greater_than=0.0)
    alone = set(weights) == {"time"}
    problem = _exact(problem) if alone else problem

    def solved(problem: Problem, before: Plan | None = None) -> Plan | None:
        if between is None:
            return _in_its_duration(problem, weights, before, callback, options)
        return _over_durations(problem, weights, between, tolerance, before, callback, options)

    def value(plan: Plan) -> float:
        return np.inf if not plan.converged else float(plan.t[-1]) if alone else plan.cost

    if free_waypoints(problem):
        return best_waypoints(problem, solved, value, options["budget"])
    plan = solved(problem)
    assert plan is not None  # the first is always returned
    return plan


def _in_its_duration(
    problem: Problem, weights: dict[str, float], before: Plan | None, callback: Callable[[Any], object] | None,
    options: dict[str, Any],
) -> Plan:  # fmt: skip
    """A plan of the objective in the problem's own duration, from that of a similar problem where there is one."""
    wanted = with_objective(problem, weights)
    if before is not None:
        assert before.problem is not None
        assert before.problem.objective is not None  # it is of this objective
        wanted = with_objective(problem, before.problem.objective.stored)
        again: dict[str, Any] = single_start(options) | {"warm_start": before}
        return solve(wanted, callback=callback, **again)
    default = without_objective(problem)
    if set(weights) != {"effort"} or default.cost is not base_problem(problem).cost:
        usual = solve(default, **single_start(options))
        wanted = with_smoothing(with_objective(problem, weights | smoothing_of(problem)), usual.xs, usual.us)
        wanted = replace(wanted, us=usual.us)
    return solve(wanted, callback=callback, **options)


def _over_durations(
    problem: Problem, weights: dict[str, float], between: tuple[float, float], tolerance: float, before: Plan | None,
    callback: Callable[[Any], object] | None, options: dict[str, Any],
) -> Plan | None:  # fmt: skip
    """The plan of the best duration; None where a similar problem has one (`before`), and no better one is found."""
    (shortest, longest), alone, own = between, set(weights) == {"time"}, 0.0
    search = _DurationSearch(problem, weights, options, callback)
    if before is not None:
        search.plans[own := float(before.t[-1])] = before
        search.smoothing = smoothing_of(before.problem)
        longest = min(longest, own * (1.0 - 2.0 * tolerance) if alone else own / _SHRINK)
        shortest = max(shortest, 0.0 if alone else _SHRINK * own)
        search.problem = retimed(problem, float(np.clip(own, shortest, longest)))
        if shortest >= longest:
            return None
    try:
        # At the best duration the objective does not change with it, so what is not better there is no better near it.
        if before is not None and not alone and search.at(own, search.total) >= before.cost:
            return None
        (_least if alone else _cheapest)(search, shortest, longest, tolerance)
    except _Cut:
        pass
    except (KeyboardInterrupt, StopIteration):
        if before is not None or search.last is None:
            raise  # best_waypoints has the plan before
        search.interrupted = True
    if before is not None and search.best is None:
        return None
    return search.best_plan({"durations": list(between), "tolerance": tolerance})


def _exact(problem: Problem) -> Problem:
    """The problem with an exact goal: with a weighted one the minimum duration would be zero."""
    if problem.bounds is None:
        raise PlannerError(
            "time alone needs bounds of the controls, expected `control` in [limits] of a problem file, "
            "--control-limit of a case, or limits=Limits(control=...); or effort beside time."
        )
    assert problem.limits is not None  # bounds exist
    return problem if problem.limits.final else replace(problem, limits=replace(problem.limits, final=EXACT))


class _Cut(Exception):
    """The budget of the search is exhausted."""


class _DurationSearch:
    """Solves at several durations, each from the successful plan of the closest duration, and the best plan.

    Args:
        problem: The task.
        weights: Of the objective, by name, including time.
        options: Of solve(); several starts apply to the first duration only.
        callback: Called with each DurationTrial.
    """

    def __init__(
        self, problem: Problem, weights: dict[str, float], options: dict[str, Any],
        callback: Callable[[DurationTrial], object] | None,
    ) -> None:  # fmt: skip
        self.problem, self.weights, self.callback = problem, weights, callback
        # The search itself finds the durations that are long enough, and starts each from a free plan.
        self.options: dict[str, Any] = options | {"options": with_overrides(options.get("options"), homotopy=False)}
        self.relaxed = options
        rest = {name: weight for name, weight in weights.items() if name != "time"}
        self.rest, self.alone = rest or {"effort": 1.0}, not rest
        self.smoothing = smoothing_of(problem)  # of energy: else that of the first duration
        self.tried: list[DurationTrial] = []
        self.plans: dict[float, Plan] = {}  # feasible plans by duration
        self.last: Plan | None = None
        self.best: tuple[float, float] | None = None  # lowest value, and its duration
        self.budget, self.is_cut, self.interrupted = options.get("budget"), False, False

    def at(self, duration: float, value: Callable[[DurationTrial], float], begin: str = NEAREST) -> float:
        """Solve at a duration, s; the value of its trial, infinite if the limits are violated.

        It begins with the plan of the nearest duration, or with the free plan of its own; AFRESH is relaxed from there
        as any solve, as if no other duration were known.
        """
        duration = float(duration)
        if self.last is not None and self.budget is not None and self.budget.exhausted:
            self.is_cut = True
            raise _Cut
        problem = with_objective(retimed(base_problem(self.problem), duration), self.rest | self.smoothing)
        options: dict[str, Any] = single_start(self.options) if self.tried else self.options
        if begin == AFRESH:
            left = WorkBudget(AFRESH_WORK) if self.budget is None else self.budget.part("afresh")
            left.limit = min(left.limit, AFRESH_WORK)
            options = single_start(self.relaxed) | {"budget": left}
        if self.budget is not None and self.tried:
            self.budget.charge_warm_start(problem)
        if self.plans and begin == NEAREST:
            nearest = min(self.plans, key=lambda T: abs(math.log(T / duration)))
            if self.alone:
                options = options | {"warm_start": self.plans[nearest].stretched(duration)}
            else:
                problem = replace(problem, us=warm_start(at_pace(self.plans[nearest], nearest / duration), problem))
        elif problem.bounds is not None or set(self.rest) != {"effort"}:
            free = retimed(without_objective(self.problem), duration)
            if not free.constraints:  # else a path through an obstacle is a bad guess
                free = replace(free, limits=None)
            usual = solve(free, **single_start(options))
            problem = with_smoothing(problem, usual.xs, usual.us)
            self.smoothing = smoothing_of(problem)
            problem = replace(problem, us=warm_start(usual, problem))
            if usual.status is Status.INTERRUPTED:
                self.last = self.last or as_user_plan(
                    problem, replace(usual, us=problem.us, history=(), bound_penalties=None)
                )
                raise KeyboardInterrupt
        looks = self.alone and bool(self.plans) and begin != AFRESH
        plan, iterations = self._by_looks(problem, options) if looks else (solve(problem, **options), None)
        self.last, outside = plan, largest_violation(problem, plan)
        iterations = plan.nit if iterations is None else iterations
        line = DurationTrial(len(self.tried), duration, plan.cost, outside, iterations, plan.status)
        self.tried.append(line)
        if self.callback is not None:
            self.callback(line)
        if plan.status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        allowed = Limits.tolerance if problem.limits is None else problem.limits.tolerance
        goal_missed = self.alone and problem.goal_specs is not None and bool(plan.missed_goals)  # which nothing keeps
        left = plan.status is Status.OUTSIDE_LIMITS  # also between the knots
        left = left or (begin == AFRESH and not plan.converged)  # of a share of the work
        if not (np.isfinite(plan.xs).all() and outside <= allowed) or left or goal_missed:
            return math.inf
        self.plans[duration] = plan
        worth = value(line)
        if self.best is None or worth < self.best[0]:
            self.best = worth, duration
        return worth

    def total(self, trial: DurationTrial) -> float:
        """The objective of a trial, time included."""
        return self.weights["time"] * trial.duration + trial.cost

    def _by_looks(self, problem: Problem, options: dict[str, Any]) -> tuple[Plan, int]:
        """A solve that goes on only where it is undecided whether the duration is too short, and its iterations.

        From a similar duration a feasible plan usually takes some dozens of iterations. A violation above
        MAX_VIOLATION_RATIO tolerances then means that the duration is too short, and any after SECOND_LOOK more.
        """
        assert problem.limits is not None  # set by _exact
        left = with_overrides(options.get("options"), max_iterations=options.get("max_iterations")).max_iterations
        tolerance, iterations, given = problem.limits.tolerance, 0, options
        for limit, largest in ((LOOK, MAX_VIOLATION_RATIO * tolerance), (SECOND_LOOK, tolerance), (left, 0.0)):
            part: dict[str, Any] = given | {"max_iterations": min(limit, left)}
            plan = solve(problem, **part)
            iterations, left = iterations + plan.nit, left - min(limit, left)
            if plan.status is not Status.MAX_ITERATIONS or left == 0 or not largest_violation(problem, plan) <= largest:
                break
            given = options | {"warm_start": plan}
        return plan, iterations

    def best_plan(self, options: dict[str, Any]) -> Plan:
        """The best plan with the whole objective, time included; the last plan if none satisfies the limits."""
        assert self.last is not None  # set by at()
        plan = self.last if self.best is None else self.plans[self.best[1]]
        assert plan.problem is not None
        wanted = with_found_duration(with_objective(plan.problem, self.weights | self.smoothing))
        tried = [[line.duration, line.cost, line.violation] for line in self.tried]
        plan = replace(as_user_plan(wanted, plan), options=plan.options | options | {"tried": tried})
        if self.interrupted:
            return replace(plan, status=Status.INTERRUPTED)
        budget = self.budget if self.is_cut and plan.converged else None
        if budget is None:
            return plan
        return replace(plan, status=budget.end, options=plan.options | record_of_cut(budget.end, budget))


def _least(search: _DurationSearch, shortest: float, longest: float, tolerance: float) -> None:
    """Minimum feasible duration: reduced by _SHRINK, then faster, until infeasible; then bisection.

    There may be other ways, with one swing less, in durations to which none leads from the longer plan. So each that is
    too short for its neighbour's plan is also tried from its own free plan, and after the bisection one a
    little below the least that was found afresh.
    """

    def misses(duration: float, begin: str = NEAREST) -> bool:
        return math.isinf(search.at(duration, lambda line: line.duration, begin))

    high = low = float(np.clip(search.problem.duration, shortest, longest))
    if misses(high):
        if high == longest or misses(longest):
            return
        low, high = high, longest
    ratio, too_short = _SHRINK, 0.0
    while True:
        while low == high:
            if high == shortest:
                return
            trial = max(shortest, ratio * high)
            if trial <= too_short:
                low = too_short
            elif not (misses(trial) and misses(trial, FREE)):
                low, high, ratio = trial, trial, max(_MOST_SHRUNK, ratio**2)
            elif ratio == _SHRINK:
                low = trial
            else:
                too_short, ratio = trial, _SHRINK
        while high - low > tolerance * high:
            middle = 0.5 * (low + high)
            low, high = (middle, high) if misses(middle) else (low, middle)
        shorter, spent = _SHORTER * high, search.budget is not None and search.budget.exhausted
        if spent or shorter < shortest or misses(shorter, AFRESH):
            return
        low, high, ratio, too_short = shorter, shorter, _SHRINK, 0.0


def _cheapest(search: _DurationSearch, shortest: float, longest: float, tolerance: float) -> None:
    """Duration of minimum objective: best of a geometric grid, then Brent's method between its neighbors."""
    own = float(np.clip(search.problem.duration, shortest, longest))
    down, up = [own], [own]
    while down[-1] > shortest:
        down.append(max(shortest, _SHRINK * down[-1]))
    while up[-1] < longest:
        up.append(min(longest, up[-1] / _SHRINK))

    def total(duration: float) -> float:
        return search.at(duration, search.total)

    values = {duration: total(duration) for duration in (*down, *up[1:])}
    ladder = sorted(values)
    i = min(range(len(ladder)), key=lambda i: values[ladder[i]])
    if math.isinf(values[ladder[i]]):
        return
    ends = ladder[max(i - 1, 0)], ladder[min(i + 1, len(ladder) - 1)]
    # A large number in place of infinity, which Brent's parabolic interpolation does not support.
    largest = 10.0 * max(abs(value) for value in values.values() if math.isfinite(value))
    from scipy.optimize import minimize_scalar  # half a second of import, for free times only

    minimize_scalar(
        lambda T: min(total(T), largest), bounds=ends, method="bounded", options={"xatol": tolerance * ladder[i]}
    )
