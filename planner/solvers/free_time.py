"""Time as an unknown: how long a motion should take, and how long it must.

The number of stages stays and their length is the unknown, T = N dt. For every T there is a least J*(T), which SLQ
finds; so what is left is a function of one variable:

    minimize  time_weight T + J*(T)                                    over shortest <= T <= longest.

With time alone there is no J: the least T is wanted at which the bounds of the controls allow the goal to be met
exactly. It is found by bisection, and of all motions that take so long the plan is the one with the least effort. Each
solve starts from the plan of the nearest duration that succeeded.

Every J*(T) is that of a local minimum, and a duration counts as too short when SLQ finds no motion from there. So the
duration found is an upper bound of the true least one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from planner.base.arguments import number, short_repr
from planner.base.errors import PlannerError
from planner.model.capabilities import capabilities_of
from planner.problem.limits import EXACT, Limits
from planner.problem.objective import checked_durations, weights_of
from planner.problem.objective_problem import base_problem, with_objective
from planner.problem.plan import Plan, Status
from planner.problem.problem import Problem
from planner.problem.rediscretize import retimed
from planner.problem.trajectory import Trajectory
from planner.solvers.options import single_start, with_overrides
from planner.solvers.slq import as_user_plan, solve
from planner.solvers.warm_start import warm_start

TOLERANCE = 1e-3
"""Of a duration, relative."""
LOOK = 60  # iterations of a duration near one whose motion is known, after which it is told what is too short
MAX_VIOLATION_RATIO = 1000.0  # tolerances outside: at 100 a duration of two-link was called too short that is not
_SHRINK = 0.85  # from one duration to the next on the way down: a motion changes little, and fifteen span a decade


class DurationTrial(NamedTuple):
    """A duration that was tried.

    Attributes:
        number: Counted from 0.
        duration: T, s.
        cost: J*(T) without the time's own part.
        violation: Of the limits: the largest, rad, m, rad/s, m/s.
        iterations: The solve took.
        status: How it ended.
    """

    number: int
    duration: float
    cost: float
    violation: float
    iterations: int
    status: Status

    def __str__(self) -> str:
        row = (
            f"{self.number:5d}  {self.duration:12.6g}  {self.cost:15.8g}  {self.violation:9.2e}  "
            f"{self.iterations:10d}  {self.status.name}"
        )
        return row if self.number else f"{self.header()}\n{row}"

    @staticmethod
    def header() -> str:
        """The heading over the lines that str() makes; it is above the first one."""
        return f"{'tried':>5}  {'duration, s':>12}  {'cost':>15}  {'outside':>9}  {'iterations':>10}  status"


def solve_for(
    problem: Problem, objective: str | Mapping[str, float] = "effort", *, durations: Sequence[float] | None = None,
    tolerance: float = TOLERANCE, callback: Callable[[Any], object] | None = None, **options: Any,
) -> Plan:  # fmt: skip
    """Optimize a motion by another criterion than its problem's own, and with time its duration as well.

    What is not effort alone starts from the controls of least effort.

    Args:
        problem: The problem to solve; see with_objective.
        objective: "effort", "energy", "jerk", "time", or weights by these names, e.g. {"effort": 1, "time": 2}. Time
            alone needs limits of the controls, and meets the goal exactly.
        durations: The shortest and the longest that time may choose, s; needed with time, and only then.
        tolerance: Of the duration, relative.
        callback: As of solve; with time it is called with each Tried duration.
        options: Of solve().

    Returns:
        A Plan of the problem with that objective, at the duration found.

    Raises:
        PlannerError: As with_objective and solve; durations that are missing, not needed or not two that rise; time
            alone without bounds of the controls.
    """
    weights = weights_of(objective)
    if not isinstance(problem, Problem):
        raise PlannerError(f"problem is {short_repr(problem)}, expected a Problem.")
    between = checked_durations(durations, weights)
    if between is None:
        wanted = with_objective(problem, weights)
        if set(weights) != {"effort"}:
            wanted = replace(wanted, us=solve(base_problem(problem), **single_start(options)).us)
        return solve(wanted, callback=callback, **options)
    shortest, longest = between
    number("tolerance", tolerance, greater_than=0.0)
    alone = set(weights) == {"time"}
    if alone:
        problem = _exact(problem)
    search = _DurationSearch(problem, weights, options, callback)
    if alone:
        _least(search, shortest, longest, tolerance)
    else:
        _cheapest(search, shortest, longest, tolerance)
    return search.best_plan({"durations": [shortest, longest], "tolerance": tolerance})


def _exact(problem: Problem) -> Problem:
    """The problem with its goal to be met exactly: without that, no time at all would be the least."""
    if problem.bounds is None:
        raise PlannerError(
            "time alone needs bounds of the controls, expected limits=Limits(control=...), or effort beside time."
        )
    assert problem.limits is not None  # there are bounds
    return problem if problem.limits.final else replace(problem, limits=replace(problem.limits, final=EXACT))


class _DurationSearch:
    """Solves at several durations, each from the nearest that succeeded, and the best of them.

    Args:
        problem: The task.
        weights: Of the objective, time among them.
        options: Of solve(); several starts are for the first duration alone.
        callback: Of each Tried.
    """

    def __init__(
        self, problem: Problem, weights: dict[str, float], options: dict[str, Any],
        callback: Callable[[DurationTrial], object] | None,
    ) -> None:  # fmt: skip
        self.problem, self.weights, self.options, self.callback = problem, weights, options, callback
        rest = {name: weight for name, weight in weights.items() if name != "time"}
        self.rest, self.alone = rest or {"effort": 1.0}, not rest
        self.tried: list[DurationTrial] = []
        self.plans: dict[float, Plan] = {}  # those that succeeded, by duration
        self.last: Plan | None = None
        self.best: tuple[float, float] | None = None  # the value, and its duration

    def at(self, duration: float, value: Callable[[DurationTrial], float]) -> float:
        """Solve at a duration; its value, infinite where the limits are not met."""
        duration = float(duration)
        problem = with_objective(retimed(base_problem(self.problem), duration), self.rest)
        options = single_start(self.options) if self.tried else self.options
        plan = None
        if self.plans:
            nearest_duration = min(self.plans, key=lambda T: abs(math.log(T / duration)))
            if self.alone:
                plan = self._first_look(problem, self.plans[nearest_duration].stretched(duration), options)
            if plan is None:
                problem = replace(
                    problem, us=warm_start(_at_pace(self.plans[nearest_duration], nearest_duration / duration), problem)
                )
        elif problem.bounds is not None or set(self.rest) != {"effort"}:
            free = solve(replace(base_problem(problem), limits=None, constraints=()), **single_start(options))
            problem = replace(problem, us=warm_start(free, problem))
        plan = self.last = solve(problem, **options) if plan is None else plan
        outside = _outside(problem, plan)
        line = DurationTrial(len(self.tried), duration, plan.cost, outside, plan.nit, plan.status)
        self.tried.append(line)
        if self.callback is not None:
            self.callback(line)
        if plan.status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        allowed = Limits.tolerance if problem.limits is None else problem.limits.tolerance
        if not (np.isfinite(plan.xs).all() and outside <= allowed):
            return math.inf
        self.plans[duration] = plan
        worth = value(line)
        if self.best is None or worth < self.best[0]:
            self.best = worth, duration
        return worth

    def _first_look(self, problem: Problem, motion: Trajectory, options: dict[str, Any]) -> Plan | None:
        """A solve from a motion of another duration with its multipliers; None for one that is not found, but near.

        From nearby a motion is found in some dozens of iterations, if there is one. What is then FAR outside is too
        short.
        """
        assert problem.limits is not None  # time alone has bounds
        limit = with_overrides(options.get("options"), max_iterations=options.get("max_iterations")).max_iterations
        most = min(LOOK, limit)
        plan = solve(problem, **options | {"warm_start": motion, "max_iterations": most})
        ended = plan.status in (Status.CONVERGED, Status.INTERRUPTED)
        return plan if ended or not _outside(problem, plan) <= MAX_VIOLATION_RATIO * problem.limits.tolerance else None

    def best_plan(self, options: dict[str, Any]) -> Plan:
        """The best plan as one of the problem with its whole objective; the last where none met the limits."""
        assert self.last is not None  # at() came first
        plan = self.last if self.best is None else self.plans[self.best[1]]
        assert plan.problem is not None
        wanted = with_objective(plan.problem, self.weights | {"effort": self.rest.get("effort", 0.0)})
        told = options | {"tried": [[line.duration, line.cost, line.violation] for line in self.tried]}
        return replace(as_user_plan(wanted, plan), options=plan.options | told)


def _outside(problem: Problem, plan: Plan) -> float:
    """How far a plan is outside of its limits and constraints: the largest, rad, m, rad/s, m/s."""
    return (
        0.0
        if problem.trajectory_constraints is None
        else float(np.max(problem.trajectory_constraints.violation(plan.xs, plan.us), initial=0.0))
    )


def _least(search: _DurationSearch, shortest: float, longest: float, tolerance: float) -> None:
    """The least duration at which the limits can be met: down in steps until they cannot, then bisection."""

    def misses(duration: float) -> bool:
        return math.isinf(search.at(duration, lambda line: line.duration))

    high = low = float(np.clip(search.problem.duration, shortest, longest))
    if misses(high):
        if high == longest or misses(longest):
            return
        low, high = high, longest
    while low == high:
        if high == shortest:
            return
        low = max(shortest, _SHRINK * high)
        high = high if misses(low) else low
    while high - low > tolerance * high:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if misses(middle) else (low, middle)


def _cheapest(search: _DurationSearch, shortest: float, longest: float, tolerance: float) -> None:
    """The duration of the least sum: the best of a ladder of durations, then Brent's search between its neighbours."""
    own = float(np.clip(search.problem.duration, shortest, longest))
    down, up = [own], [own]
    while down[-1] > shortest:
        down.append(max(shortest, _SHRINK * down[-1]))
    while up[-1] < longest:
        up.append(min(longest, up[-1] / _SHRINK))

    def total(duration: float) -> float:
        return search.at(duration, lambda line: search.weights["time"] * line.duration + line.cost)

    values = {duration: total(duration) for duration in (*down, *up[1:])}
    ladder = sorted(values)
    i = min(range(len(ladder)), key=lambda i: values[ladder[i]])
    if math.isinf(values[ladder[i]]):
        return
    ends = ladder[max(i - 1, 0)], ladder[min(i + 1, len(ladder) - 1)]
    # A large number in place of infinity: the parabolas of Brent's search know no infinity.
    most = 10.0 * max(abs(value) for value in values.values() if math.isfinite(value))
    from scipy.optimize import minimize_scalar  # half a second that only free times need

    minimize_scalar(
        lambda T: min(total(T), most), bounds=ends, method="bounded", options={"xatol": tolerance * ladder[i]}
    )


def _at_pace(plan: Plan, pace: float) -> Plan:
    """The plan's states run through `pace` times as fast, its controls as they are: what a warm start follows."""
    assert plan.problem is not None
    mechanism, xs = capabilities_of(plan.problem.dynamics).mechanism, plan.xs.copy()
    if mechanism is not None:
        xs[:, mechanism.nq : mechanism.nq + mechanism.nv] *= pace
    return replace(plan, xs=xs)
