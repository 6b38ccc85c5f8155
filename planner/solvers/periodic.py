"""Periodic trajectories, as of a gait or a swing: the start x0 is unknown, and the end x(N) must equal it.

    repeat   solve from the start x0 with the terminal reference r                                    solvers.slq
             "newton": change x0 and r by Newton's method: closes the closure error and
                       lowers the cost in its null space
                       solvers.periodic_boundary
             "follow": x0 and r become the last end state
             a step after whose solve the merit, cost + penalty |closure error|, is larger is taken back, for a
             shorter one
    until    the end is within the tolerance of the start (and, for "newton", the expected reduction is small).

"newton" converges to a locally optimal periodic trajectory, whatever the final weights are. "follow" is a fixed-point
iteration: its trajectory is not optimal, and it converges slowly with large final weights; it also supports ranges of
states. Each pass starts from the trajectory of the last. The final cost 1/2 |x(N) - r|^2 is no part of the task's cost:
r acts as a multiplier.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from planner.base.arguments import choice, count, short_repr
from planner.base.data_files import finite
from planner.base.errors import PlannerError
from planner.problem.plan import Plan, Status
from planner.problem.problem import Problem
from planner.problem.problem_parts import STEPS as METHODS
from planner.solvers.gains import warm_start
from planner.solvers.options import single_start
from planner.solvers.periodic_boundary import (
    ONLY_CLOSING,
    BoundarySensitivity,
    BoundaryStates,
    BoundaryTrial,
    ends_of,
    improved_boundary,
    periodic_problem,
    response,
    terminal_goal_cost,
    tracking,
    with_ends,
)
from planner.solvers.slq import solve
from planner.solvers.work import budget_of

LEFT = 1e-4
"""Newton passes end when the expected reduction is below this share of the cost (or see Periodic.cost_tolerance)."""
FOLLOW_LEFT = 0.01
"""The same share of the cost up to which a motion of "follow" is CONVERGED: what a proof allows of it."""
_TO_CLOSE = 2  # last passes, which only close the closure error
MERIT_SLACK = 1e-3  # share of the merit that solves, which end within their tolerances, leave open
SHORTER = 3  # of the steps: by which one that made the merit worse is shortened


class PeriodicPass(NamedTuple):
    """One pass of solve_periodic."""

    number: int  # Counted from 0
    cost: float  # J without the terminal goal term
    miss: float  # Largest closure error between end and start, as a multiple of its tolerance
    # Reduction of the cost that the LQ problem expects of the first step that a rollout confirms, 0 where none does;
    # nan for "follow", after divergence, and for a pass that is taken back.
    left: float
    iterations: int  # Number of iterations of the solve
    status: Status  # Status of the solve

    def __str__(self) -> str:
        row = (
            f"{self.number:5d}  {self.cost:15.8g}  {self.miss:14.3g}  {self.left:9.2e}  {self.iterations:10d}  "
            f"{self.status.name}"
        )
        return row if self.number else f"{self.header()}\n{row}"

    @staticmethod
    def header() -> str:
        """The heading of the table of str(); part of the first row."""
        return f"{'pass':>5}  {'cost':>15}  {'gap/tolerance':>14}  {'left':>9}  {'iterations':>10}  status"


def solve_periodic(
    problem: Problem, *, passes: int | None = None, step: str | None = None,
    callback: Callable[[PeriodicPass], object] | None = None, **options: Any,
) -> Plan:  # fmt: skip
    """Optimize a periodic trajectory.

    Args:
        problem: With `periodic` and one TrackingCost, alone or in a sum, whose final weight is positive definite on the
            periodic components. Its start and last x_ref are the first guess of the boundary states.
        passes: Maximum number of solves; by default that of `periodic`.
        step: "newton" or "follow", see the module; by default that of `periodic`.
        callback: Called with each PeriodicPass; print makes a table. It may raise StopIteration to end.
        options: Of solve(); several starts apply to the first pass only.

    Returns:
        The plan of lowest cost ("follow": of smallest closure error) among those within the tolerance, else the one of
        smallest closure error; its problem has its start and reference. CONVERGED if its solve converged and it is
        periodic within the tolerance, else NOT_PERIODIC or the status of the solve.

    Raises:
        PlannerError: As solve; a problem without `periodic` or such a cost.
    """
    if not isinstance(problem, Problem) or problem.periodic is None:
        raise PlannerError(f"problem is {short_repr(problem)}, expected a Problem with periodic=Periodic(tolerance).")
    passes = problem.periodic.passes if passes is None else count("passes", passes)
    step = problem.periodic.step if step is None else choice("step", step, METHODS)
    by_newton = step == "newton"
    tracking(problem)
    options["budget"] = budget_of(options.get("budget"))  # one for all passes
    search = _PeriodicSearch(problem, by_newton, passes, callback, options)
    try:
        while search.next is not None and len(search.lines) < search.passes and not search.is_cut:
            search.go(search.next)
    except (KeyboardInterrupt, StopIteration):
        search.interrupted = True
    return search.best_plan({"step": step, "passes": passes})


class _PeriodicSearch:
    """The passes of solve_periodic and the best plan.

    Args:
        problem: With `periodic`.
        by_newton: Whether the step is "newton", else "follow".
        passes: Maximum number.
        callback: Called with each PeriodicPass.
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
        # Rank (lower is better), the plan, and whether no step would lower its cost by more than FOLLOW_LEFT of it.
        self.best: tuple[tuple[bool, bool, float], Plan, bool] | None = None
        self.accepted: BoundarySensitivity | None = None  # from which steps are tried
        self.first, self.penalty = 0, 0.0  # of the steps, to try next; of the last one's merit
        self.confirmed = math.inf  # cost from which longer steps were tried again

    def go(self, problem: Problem) -> None:
        """One pass; sets the problem of the next, None if converged or no step is accepted."""
        plan = solve(problem, **self.options)
        self.options = single_start(self.options)
        _, periodic = periodic_problem(plan)
        ran = bool(np.isfinite(plan.xs).all())
        miss = periodic.miss(plan.space, plan.xs) if ran else math.inf
        try:
            answer = response(plan) if self.by_newton and ran else None
            trial = None if answer is None else self._trial(answer)
        except PlannerError:  # no step is known: the passes before count
            if not self.lines:
                raise
            answer = trial = None
            ran = False
        expected = 0.0 if trial is None else trial.decrease
        taken_back = answer is not None and self.accepted is not answer
        left = math.nan if answer is None or taken_back else expected
        cost = plan.cost - terminal_goal_cost(plan)
        open_ = not plan.converged or miss > 1.0
        steady = bool(self.lines) and abs(cost - self.lines[-1].cost) <= periodic.cost_tolerance * abs(cost)
        most = (FOLLOW_LEFT if steady else LEFT) * abs(cost)
        known = abs(cost - self.confirmed) <= periodic.cost_tolerance * abs(cost)  # what longer steps lead to from here
        if answer is not None and left <= most and not (open_ or known) and self.first > 0:
            self.confirmed, trial = cost, improved_boundary(answer) or trial
            left = 0.0 if trial is None else trial.decrease
        line = PeriodicPass(len(self.lines), cost, miss, left, plan.nit, plan.status)
        self.lines.append(line)
        rank = open_, taken_back, miss if open_ or not self.by_newton else cost
        if self.best is None or rank < self.best[0]:
            self.best = rank, plan, left <= FOLLOW_LEFT * abs(cost)
        elif taken_back and trial is None and self.accepted is not None and self.best[1] is self.accepted.plan:
            self.best = *self.best[:2], True  # its steps have led nowhere
        if plan.status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        if self.callback is not None:
            self.callback(line)
        small_reduction = not self.by_newton or left <= most
        if not ran or (small_reduction and not open_):
            self.next = None
            if ran:  # the best plan costs no more than this one
                self.best = *self.best[:2], True
        elif answer is None:
            self.next = _followed(plan)
        else:
            late = self.passes - len(self.lines) <= _TO_CLOSE
            if self.accepted is answer and open_ and (late or (steady and small_reduction)):
                trial = improved_boundary(answer, max(self.first, ONLY_CLOSING)) or trial
            self.next = None
            if trial is not None:
                self.next, self.first, self.penalty = trial.problem, trial.number, trial.penalty

    def _trial(self, answer: BoundarySensitivity) -> BoundaryTrial | None:
        """A step from the last plan, or a shorter one from the one before, if its step has made the merit worse."""
        before = self.accepted
        if before is not None:
            worse = answer.merit(self.penalty) > before.merit(self.penalty) * (1.0 + MERIT_SLACK)
            self.first = self.first + SHORTER if worse else max(self.first - 1, 0)
            answer = before if worse else answer
        self.accepted = answer
        return improved_boundary(answer, self.first)

    @property
    def is_cut(self) -> bool:
        """Whether the budget of the passes is exhausted before they have converged."""
        budget = self.options.get("budget")
        return self.next is not None and budget is not None and bool(self.lines) and budget.exhausted

    def best_plan(self, options: dict[str, Any]) -> Plan:
        """The best plan, with the record of the passes in its options."""
        if self.best is None:
            raise KeyboardInterrupt  # before the first plan
        _, plan, at_best = self.best
        status = plan.status
        _, periodic = periodic_problem(plan)
        if self.interrupted:
            status = Status.INTERRUPTED
        elif self.is_cut:
            status = self.options["budget"].end
        elif plan.converged and not periodic.miss(plan.space, plan.xs) <= 1.0:
            status = Status.NOT_PERIODIC
        elif status is Status.CONVERGED and not (at_best if self.by_newton else _has_best_ends(plan)):
            status = Status.NOT_OPTIMAL
        told = [finite([line.cost, line.miss, line.left, line.iterations]) for line in self.lines]
        return replace(plan, status=status, options=plan.options | options | {"tried": told})


def _has_best_ends(plan: Plan) -> bool:
    """Whether another start and end of a periodic plan would lower its cost by at most FOLLOW_LEFT."""
    try:
        left = response(plan).step(0.0).decrease
    except PlannerError:  # no step is known
        return False
    return left <= FOLLOW_LEFT * abs(plan.cost - terminal_goal_cost(plan))


def _followed(plan: Plan) -> Problem:
    """The problem whose start and reference are the plan's last state in the periodic components."""
    problem, periodic = periodic_problem(plan)
    space, last = plan.space, plan.xs[-1]
    before = last if periodic.image is None else periodic.image.undo(space, last)
    start, goal = ends_of(problem)
    ends = BoundaryStates(periodic.brought(space, start, before), periodic.brought(space, goal, last))
    changed = with_ends(problem, ends, plan.us)
    return replace(changed, us=warm_start(plan, changed))
