"""Periodic motions by passes: a gait, a swing that goes on. The start is an unknown, and the end must meet it.

    repeat   solve from the start x0 with the final cost drawn to the goal r                          planner.slq
             "newton": change x0 and r by what the LQ problem says is left of x(N) = x(0)             planner.ends
             "follow": start from where the motion arrived, and have it arrive there again
    until    the end is within the tolerance of the start (and, for "newton", little is left to gain).

"newton" ends at the periodic motion of least cost, whatever the final weights are; three to six passes. "follow" ends
at a motion whose end is where it would go by itself, which is not that of least cost, and it creeps where the final
weights are large; it needs nothing but solves, and works with ranges of states too. Each pass starts from the motion
of the last. What the final cost 1/2 |x(N) - r|^2 adds to a plan's J is no part of the task: r is a multiplier.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from planner.arguments import choice, count, shown
from planner.ends import Ends, Mismatch, ends_of, mismatch, newton, periodic_problem, tracking, with_ends
from planner.errors import PlannerError
from planner.jsonable import finite
from planner.plan import Plan, Status
from planner.problem import Problem
from planner.slq import solve
from planner.space import space_of
from planner.warm_start import warm_start

STEPS = ("newton", "follow")
PASSES = 8
LEFT = 1e-4
"""Newton passes go on until what is left of their equations, squared and halved, is below this of the cost."""
_SHORTER = 0.25  # the next step from the same place, after a pass that made things worse
_WORSE = 2.0  # times the mismatch: what counts as worse; less comes with steps that are good in the end


class Pass(NamedTuple):
    """One solve of a periodic motion.

    Attributes:
        number: Counted from 0.
        cost: J of the pass without what draws the end to its goal.
        miss: The largest gap between end and start, as a multiple of its tolerance.
        left: Norm of what is left of the Newton equations, root of J's unit; nan where none were made.
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
        return (
            f"{self.number:5d}  {self.cost:15.8g}  {self.miss:14.3g}  {self.left:9.2e}  {self.iterations:10d}  "
            f"{self.status.name}"
        )

    @staticmethod
    def header() -> str:
        """The heading over the lines that str() makes."""
        return f"{'pass':>5}  {'cost':>15}  {'gap/tolerance':>14}  {'left':>9}  {'iterations':>10}  status"


def solve_periodic(
    problem: Problem, *, passes: int = PASSES, step: str = "newton", callback: Callable[[Any], object] | None = None,
    **options: Any,
) -> Plan:  # fmt: skip
    """Optimize a motion that ends where it began.

    Args:
        problem: With `periodic`, and a TrackingCost, alone or in a sum, whose final weight is above 0 on all that must
            come back. Its start and the last row of its x_ref are the first guess of where the motion begins.
        passes: Most solves.
        step: "newton" or "follow"; see the module.
        callback: Called with each Pass; print makes a table. It may raise StopIteration to end.
        options: Of solve(); several starts are for the first pass alone.

    Returns:
        The plan of the last pass, or of the one that came nearest: its problem has the start and the goal that were
        found. CONVERGED when its solve was and it comes back within the tolerance, else NOT_PERIODIC.

    Raises:
        PlannerError: As solve; a problem without `periodic` or such a cost; "newton" with ranges of states.
    """
    if not isinstance(problem, Problem) or problem.periodic is None:
        raise PlannerError(f"problem is {shown(problem)}, expected a Problem with periodic=Periodic(tolerance).")
    count("passes", passes)
    by_newton = choice("step", step, STEPS) == "newton"
    if by_newton and problem.ranges is not None:
        raise PlannerError('ranges of states are no part of the step "newton", expected step="follow" with them.')
    tracking(problem)
    search = _Search(problem, by_newton, callback, options)
    try:
        while len(search.lines) < passes and not search.done:
            search.go()
    except (KeyboardInterrupt, StopIteration):
        search.interrupted = True
    return search.found({"step": step, "passes": passes})


class _Search:
    """Passes, and the best of them.

    Args:
        problem: With `periodic`.
        by_newton: Which step.
        callback: Of each Pass.
        options: Of solve().
    """

    def __init__(
        self, problem: Problem, by_newton: bool, callback: Callable[[Pass], object] | None, options: dict[str, Any]
    ) -> None:
        self.next, self.by_newton, self.callback, self.options = problem, by_newton, callback, options
        self.lines: list[Pass] = []
        self.done = self.interrupted = False
        self.best: tuple[tuple[bool, float], Plan] | None = None  # how far it is from done, and the plan
        self.from_here: tuple[Plan, Mismatch] | None = None  # where Newton's step set out
        self.part = 1.0  # of the next step

    def go(self) -> None:
        """One pass, and the problem of the next."""
        plan = solve(self.next, **self.options)
        self.options = {name: value for name, value in self.options.items() if name not in _SEVERAL}
        problem, periodic = periodic_problem(plan)
        space = space_of(problem.dynamics)
        arrived = bool(np.isfinite(plan.xs).all())
        miss = periodic.miss(space, plan.xs) if arrived else np.inf
        left = mismatch(plan) if self.by_newton and arrived else None
        size = np.nan if left is None else left.size
        cost = plan.cost - drawn(plan)
        line = Pass(len(self.lines), cost, miss, size, plan.nit, plan.status)
        self.lines.append(line)
        rank = (plan.status is not Status.CONVERGED or miss > 1.0, size if left is not None else miss)
        if self.best is None or rank < self.best[0]:
            self.best = rank, plan
        if plan.status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        little = left is None or 0.5 * size**2 <= LEFT * max(abs(cost), np.finfo(float).tiny)
        self.done = plan.status is Status.CONVERGED and miss <= 1.0 and little
        if self.callback is not None:
            self.callback(line)
        if not (self.done or self._lost(left)):
            ends, plan = self._followed(plan) if not self.by_newton else self._stepped(plan, left)
            changed = with_ends(self.next, ends, plan.us)
            self.next = replace(changed, us=warm_start(plan, changed))

    def _lost(self, left: Mismatch | None) -> bool:
        """Whether there is nowhere to set out from: the first solve ran away."""
        self.done = self.done or (left is None and self.from_here is None and not np.isfinite(self.lines[-1].miss))
        return self.done

    def _followed(self, plan: Plan) -> tuple[Ends, Plan]:
        """Start and goal where the motion arrived."""
        problem, periodic = periodic_problem(plan)
        space, end = space_of(problem.dynamics), plan.xs[-1]
        return Ends(*(periodic.brought(space, old, end) for old in ends_of(problem))), plan

    def _stepped(self, plan: Plan, left: Mismatch | None) -> tuple[Ends, Plan]:
        """Newton's step, or a shorter one from where the last set out when that made things worse."""
        before = self.from_here
        if before is not None and (left is None or left.size > _WORSE * before[1].size):
            self.part *= _SHORTER
        elif left is not None:
            self.from_here, self.part = (plan, left), min(1.0, self.part / _SHORTER)
        assert self.from_here is not None  # _lost has looked
        return newton(*self.from_here, self.part), self.from_here[0]

    def found(self, options: dict[str, Any]) -> Plan:
        """The best plan, with how the passes went."""
        if self.best is None:
            raise KeyboardInterrupt  # before there was any plan
        plan, status = self.best[1], self.best[1].status
        problem, periodic = periodic_problem(plan)
        if self.interrupted:
            status = Status.INTERRUPTED
        elif status is Status.CONVERGED and not periodic.miss(space_of(problem.dynamics), plan.xs) <= 1.0:
            status = Status.NOT_PERIODIC
        told = [finite([line.cost, line.miss, line.left, line.iterations]) for line in self.lines]
        return replace(plan, status=status, options=plan.options | options | {"tried": told})


_SEVERAL = ("starts", "rank", "seed", "spread")


def drawn(plan: Plan) -> float:
    """What draws the end of a plan to its goal, of its cost."""
    assert plan.problem is not None
    cost = tracking(plan.problem)
    away = space_of(plan.problem.dynamics).difference(plan.xs[-1], cost.x_ref[-1])
    return float(0.5 * away @ cost.Q[-1] @ away)
