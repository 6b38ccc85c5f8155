"""Periodic motions by passes: a gait, a swing that goes on. The start is an unknown, and the end must meet it.

    repeat   solve from the start x0 with the final cost drawn to the goal r                          solvers.slq
             "newton": change x0 and r so that the gap closes and, where the gap leaves
                       freedom, the cost falls, as the LQ problem tells
                       solvers.periodic_boundary
             "follow": start from where the motion arrived, and have it arrive there again
    until    the end is within the tolerance of the start (and, for "newton", little is left to gain).

"newton" ends at the periodic motion of least cost, whatever the final weights are. "follow" ends at a motion whose end
is where it would go by itself, which is not that of least cost, and it creeps where the final weights are large; it
needs nothing but solves, and works with ranges of states too. Each pass starts from the motion of the last. What the
final cost 1/2 |x(N) - r|^2 adds to a plan's J is no part of the task: r is a multiplier.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from planner.base.arguments import choice, count, short_repr
from planner.base.errors import PlannerError
from planner.base.files import finite
from planner.problem.periodicity import STEPS
from planner.problem.plan import Plan, Status
from planner.problem.problem import Problem
from planner.solvers.options import single_start
from planner.solvers.periodic_boundary import (
    BoundaryStates,
    ends_of,
    improved_boundary,
    periodic_problem,
    response,
    terminal_goal_cost,
    tracking,
    with_ends,
)
from planner.solvers.slq import solve
from planner.solvers.warm_start import warm_start

LEFT = 1e-4
"""Newton passes end when the decrease that they promise is below this part of the cost, or the cost hardly changes."""
_TO_CLOSE = 2  # passes kept for the end, which only close the gap


class PeriodicPass(NamedTuple):
    """One solve of a periodic motion.

    Attributes:
        number: Counted from 0.
        cost: J of the pass without what draws the end to its goal.
        miss: The largest gap between end and start, as a multiple of its tolerance.
        left: Decrease of the cost that the next Newton step promises, undamped; nan where there is none.
        iterations: The solve took.
        status: How it ended.
    """

    number: int
    cost: float
    miss: float
    left: float
    iterations: int
    status: Status

    def __str__(self) -> str:
        row = (
            f"{self.number:5d}  {self.cost:15.8g}  {self.miss:14.3g}  {self.left:9.2e}  {self.iterations:10d}  "
            f"{self.status.name}"
        )
        return row if self.number else f"{self.header()}\n{row}"

    @staticmethod
    def header() -> str:
        """The heading over the lines that str() makes; it is above the first one."""
        return f"{'pass':>5}  {'cost':>15}  {'gap/tolerance':>14}  {'left':>9}  {'iterations':>10}  status"


def solve_periodic(
    problem: Problem, *, passes: int | None = None, step: str | None = None,
    callback: Callable[[PeriodicPass], object] | None = None, **options: Any,
) -> Plan:  # fmt: skip
    """Optimize a motion that ends where it began.

    Args:
        problem: With `periodic`, and a TrackingCost, alone or in a sum, whose final weight is above 0 on all that must
            come back. Its start and the last row of its x_ref are the first guess of where the motion begins.
        passes: Most solves; by default what `periodic` says.
        step: "newton" or "follow", see the module; by default what `periodic` says.
        callback: Called with each Pass; print makes a table. It may raise StopIteration to end.
        options: Of solve(); several starts are for the first pass alone.

    Returns:
        Of the plans that come back within the tolerance the one of least cost, else the one that comes nearest: its
        problem has the start and the goal that were found. CONVERGED when its solve was and it comes back, else
        NOT_PERIODIC or what the solve says.

    Raises:
        PlannerError: As solve; a problem without `periodic` or such a cost; "newton" with ranges of states.
    """
    if not isinstance(problem, Problem) or problem.periodic is None:
        raise PlannerError(f"problem is {short_repr(problem)}, expected a Problem with periodic=Periodic(tolerance).")
    passes = problem.periodic.passes if passes is None else count("passes", passes)
    step = problem.periodic.step if step is None else choice("step", step, STEPS)
    by_newton = step == "newton"
    if by_newton and problem.trajectory_constraints is not None:
        raise PlannerError(
            'ranges of states and constraints are no part of the step "newton", expected step="follow" with them.'
        )
    tracking(problem)
    search = _PeriodicSearch(problem, by_newton, passes, callback, options)
    try:
        while search.next is not None and len(search.lines) < search.passes:
            search.go(search.next)
    except (KeyboardInterrupt, StopIteration):
        search.interrupted = True
    return search.best_plan({"step": step, "passes": passes})


class _PeriodicSearch:
    """Passes, and the best of them.

    Args:
        problem: With `periodic`.
        by_newton: Which step.
        passes: Most.
        callback: Of each Pass.
        options: Of solve().
    """

    def __init__(
        self, problem: Problem, by_newton: bool, passes: int, callback: Callable[[PeriodicPass], object] | None,
        options: dict[str, Any],
    ) -> None:  # fmt: skip
        self.next: Problem | None = problem
        self.by_newton, self.passes, self.callback, self.options = by_newton, passes, callback, options
        self.lines: list[PeriodicPass] = []
        self.interrupted = False
        self.best: tuple[tuple[bool, float], Plan] | None = None  # how far it is from the wanted, and the plan

    def go(self, problem: Problem) -> None:
        """One pass, and the problem of the next: None when there is nothing to gain, or nowhere to go."""
        plan = solve(problem, **self.options)
        self.options = single_start(self.options)
        _, periodic = periodic_problem(plan)
        ran = bool(np.isfinite(plan.xs).all())
        miss = periodic.miss(plan.space, plan.xs) if ran else math.inf
        answer = response(plan) if self.by_newton and ran else None
        left = math.nan if answer is None else answer.step(0.0).decrease
        cost = plan.cost - terminal_goal_cost(plan)
        line = PeriodicPass(len(self.lines), cost, miss, left, plan.nit, plan.status)
        self.lines.append(line)
        open_ = plan.status is not Status.CONVERGED or miss > 1.0
        rank = open_, miss if open_ or not self.by_newton else cost
        if self.best is None or rank < self.best[0]:
            self.best = rank, plan
        if plan.status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        if self.callback is not None:
            self.callback(line)
        steady = len(self.lines) > 1 and abs(cost - self.lines[-2].cost) <= periodic.cost_tolerance * abs(cost)
        small_reduction = answer is None or steady or left <= LEFT * abs(cost)
        if not ran or (small_reduction and not open_):
            self.next = None
        else:
            self.next = (
                _followed(plan)
                if answer is None
                else improved_boundary(answer, close=steady or (open_ and self._is_late))
            )

    @property
    def _is_late(self) -> bool:
        """Whether the passes that are left are to bring back what is there."""
        return self.passes - len(self.lines) <= _TO_CLOSE

    def best_plan(self, options: dict[str, Any]) -> Plan:
        """The best plan, with how the passes went."""
        if self.best is None:
            raise KeyboardInterrupt  # before there was any plan
        plan, status = self.best[1], self.best[1].status
        _, periodic = periodic_problem(plan)
        if self.interrupted:
            status = Status.INTERRUPTED
        elif status is Status.CONVERGED and not periodic.miss(plan.space, plan.xs) <= 1.0:
            status = Status.NOT_PERIODIC
        told = [finite([line.cost, line.miss, line.left, line.iterations]) for line in self.lines]
        return replace(plan, status=status, options=plan.options | options | {"tried": told})


def _followed(plan: Plan) -> Problem:
    """The problem with start and goal where the motion arrived."""
    problem, periodic = periodic_problem(plan)
    ends = BoundaryStates(*(periodic.brought(plan.space, old, plan.xs[-1]) for old in ends_of(problem)))
    changed = with_ends(problem, ends, plan.us)
    return replace(changed, us=warm_start(plan, changed))
