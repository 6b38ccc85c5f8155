"""WorkBudget: the limit of a run, counted in work, so that its plan is the same on a computer of any speed and load.

    work = iterations x stages x work_of_stage(problem)

A unit is about a second of one core of 2024. It is estimated from the sizes of the problem alone: its degrees of
freedom, contacts, closures, pairs kept apart and evaluations of the dynamics per stage. A proof counts as some
iterations. A budget may also have a deadline by the clock. A plan that the deadline cut depends on the computer, and
its status says so.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from planner.base.arguments import number
from planner.dynamics import CompiledDynamics
from planner.dynamics.protocol import integrator_of
from planner.model.capabilities import capabilities_of
from planner.model.space import space_of
from planner.problem.constraints.clearance import pair_clearance_of
from planner.problem.plan import Plan, Status
from planner.problem.problem import Problem

DEFAULT_WORK = 60.0
"""Of `planner run`."""
PROOF = 1.0, 80.0  # of a proof: work, and iterations of a solve that take as long as the rest
# Work of one stage in an iteration, measured on models of 2 to 76 states, to within a factor of 2 or so.
CALL = 2e-6
RATES = 4e-8  # times evaluations times (degrees of freedom and rows of closures)^2
CONTACT = 3e-8  # times evaluations
RICCATI = 8e-10  # times ndx^3
PAIR = 3e-6  # of shapes that are kept apart
IN_NUMPY = 5e-4  # of what no kernel computes: dynamics of the user's own, the Wolfe rule
WARM_START = 1e-4  # gains and rollouts stage by stage
CLOSURE_ROWS = 3


class WorkBudget:
    """Work that solves and proofs may take, and have taken.

    Attributes:
        limit: Of the work; infinite for none.
        deadline: Of time.monotonic(), s; None for none.
        spent: Work by purpose, of this budget and of its parts.
    """

    def __init__(self, limit: float = math.inf, seconds: float | None = None) -> None:
        """Start unused.

        Args:
            limit: Of the work, above 0 or 0 for none at all.
            seconds: From now on, after which solves end by the clock; None for no such limit.

        Raises:
            PlannerError: A negative limit, or seconds not above 0.
        """
        self.limit = limit if limit == math.inf else number("work", limit, minimum=0.0)
        self.seconds = None if seconds is None else number("budget", seconds, greater_than=0.0)
        self.deadline = None if self.seconds is None else time.monotonic() + self.seconds
        self.spent: dict[str, float] = {}
        self._purpose = "solve"
        self._parent: WorkBudget | None = None

    def part(self, purpose: str, share: float = 1.0) -> WorkBudget:
        """A budget with a share of what is left, whose work counts here too, under its purpose."""
        part = WorkBudget(share * self.left)
        part.seconds, part.deadline, part._purpose, part._parent = self.seconds, self.deadline, purpose, self
        return part

    def before_proof(self, problem: Problem) -> WorkBudget:
        """For a solve: what is left without the proof of its plan, which makes it exhausted if that is nothing."""
        part = self.part(self._purpose)
        part.limit = max(0.0, self.left - work_of_proof(problem))
        return part

    @property
    def whole(self) -> WorkBudget:
        """The budget that this is a part of, or itself."""
        return self if self._parent is None else self._parent.whole

    @property
    def used(self) -> float:
        """The work taken."""
        return sum(self.spent.values())

    @property
    def left(self) -> float:
        """The work that may still be taken, at least 0."""
        return max(0.0, self.limit - self.used)

    @property
    def out_of_time(self) -> bool:
        """Whether the deadline has passed."""
        return self.deadline is not None and time.monotonic() >= self.deadline

    @property
    def seconds_left(self) -> float:
        """Until the deadline; 0 after it, infinite without one."""
        return math.inf if self.deadline is None else max(0.0, self.deadline - time.monotonic())

    @property
    def exhausted(self) -> bool:
        """Whether no further solve may begin."""
        return self.left <= 0.0 or self.out_of_time

    @property
    def end(self) -> Status:
        """The status of a solve that this budget cuts now."""
        return Status.TIME_LIMIT if self.out_of_time else Status.WORK_LIMIT

    def iterations(self, problem: Problem, asked: int, starts: int = 1, in_numpy: bool = False) -> int:
        """Iterations allowed for each start of a solve: `asked`, or fewer if the remaining work is less."""
        allowed = self.left / (problem.N * work_of_stage(problem, in_numpy) * starts)
        return asked if allowed >= asked else max(1, int(allowed))

    def charge(self, problem: Problem, iterations: int, in_numpy: bool = False) -> None:
        """Count iterations of a problem."""
        self._count(iterations * problem.N * work_of_stage(problem, in_numpy), self._purpose)

    def charge_warm_start(self, problem: Problem) -> None:
        """Count a warm start: a few rollouts that track a plan, and the gains for them, stage by stage in NumPy."""
        self._count(problem.N * (WARM_START + 3.0 * work_of_stage(problem)), self._purpose)

    def charge_proof(self, problem: Problem) -> None:
        """Count a proof of a plan of a problem."""
        self._count(work_of_proof(problem), "proofs")

    def _count(self, work: float, purpose: str) -> None:
        self.spent[purpose] = self.spent.get(purpose, 0.0) + work
        if self._parent is not None:
            self._parent._count(work, purpose)

    def to_dict(self) -> dict[str, Any]:
        """As JSON values."""
        return {
            "work": self.limit, "seconds": self.seconds, "used": self.used, "spent": dict(self.spent),
            "exhausted": self.end.name if self.exhausted else None,
        }  # fmt: skip

    def __str__(self) -> str:
        parts = ", ".join(f"{purpose} {work:.2g}" for purpose, work in self.spent.items())
        limit = "" if self.limit == math.inf else f" of {self.limit:g}"
        return f"{self.used:.2g}{limit}" + (f": {parts}" if parts else "")


class UntilDeadline:
    """A callback that ends a solve after a deadline of time.monotonic(), s."""

    def __init__(self, deadline: float, callback: Callable[[Any], object] | None) -> None:
        """Check the clock after each call of `callback`, which may be None."""
        self.deadline, self.callback = deadline, callback

    def __call__(self, line: Any) -> None:
        """Raise StopIteration after the deadline."""
        if self.callback is not None:
            self.callback(line)
        if time.monotonic() >= self.deadline:
            raise StopIteration


def budget_of(given: WorkBudget | float | None) -> WorkBudget | None:
    """The budget that a WorkBudget or a number of work stands for; None for none.

    Raises:
        PlannerError: A negative number, or no number.
    """
    return given if given is None or isinstance(given, WorkBudget) else WorkBudget(number("budget", given, minimum=0.0))


def work_of_proof(problem: Problem) -> float:
    """The work of a proof, without rollouts."""
    return PROOF[0] + PROOF[1] * problem.N * work_of_stage(problem)


def work_of_stage(problem: Problem, in_numpy: bool = False) -> float:
    """The work of one stage in one iteration, by the sizes of the problem: derivatives, Riccati sweep, line search.

    Args:
        problem: Any.
        in_numpy: Whether no kernels can solve it, as with dynamics of the user's own.
    """
    dynamics, ndx = problem.dynamics, space_of(problem.dynamics).ndx
    mechanism, pairs = capabilities_of(dynamics).mechanism, pair_clearance_of(problem.constraints)
    evaluations = getattr(dynamics, "substeps", 1) * integrator_of(dynamics).evaluations
    size, contacts = ndx // 2, 0
    if mechanism is not None:
        size = mechanism.nv + CLOSURE_ROWS * (len(mechanism.loops) + len(mechanism.polynomial_couplings))
        contacts = len(mechanism.contacts) + len(mechanism.body_contacts)
    rates = evaluations * (RATES * size**2 + CONTACT * contacts)
    if problem.objective is not None and "jerk" in problem.objective.weights:
        ndx *= 2  # accelerations and their rates are states
    rates += IN_NUMPY if in_numpy or not isinstance(dynamics, CompiledDynamics) else 0.0
    return CALL + rates + RICCATI * ndx**3 + PAIR * (0 if pairs is None else len(pairs.pairs))


def with_cut(plan: Plan, budget: WorkBudget, fewer: bool, recorded: dict[str, Any]) -> Plan:
    """The plan with the status of a solve that a budget cut, if it did; `fewer`: it allowed less than was asked for."""
    by_clock = budget.out_of_time and any(
        status is Status.INTERRUPTED for status in (plan.status, *(start.status for start in plan.starts))
    )
    if by_clock:
        recorded["cut"] = Status.TIME_LIMIT.name
    if by_clock and plan.status is Status.INTERRUPTED:
        return replace(plan, status=Status.TIME_LIMIT)
    if fewer and plan.status is Status.MAX_ITERATIONS:
        plan = replace(plan, status=Status.WORK_LIMIT)
    if plan.status is Status.WORK_LIMIT:  # of the solve, or of a relaxation after it
        recorded |= record_of_cut(plan.status, budget)
    return plan


def record_of_cut(status: Status, budget: WorkBudget) -> dict[str, Any]:
    """What the options of a plan say of the budget that cut its solve, or the search that it is of."""
    limit = {"work": budget.whole.limit} if status is Status.WORK_LIMIT else {}
    return {"cut": status.name} | limit
