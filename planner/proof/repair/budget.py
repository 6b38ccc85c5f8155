"""WorkBudget: how much a repair may solve, counted so that it ends alike on a slow machine and a fast one."""

from __future__ import annotations

from planner.problem.plan import Plan
from planner.problem.problem import Problem

WORK_OF_A_REPAIR = 4e8  # iterations times stages times squared states: some 30 s of an idle core, for 14 states or more
SMALL = 14  # states, up to which an iteration takes no less time than with as many


class WorkBudget:
    """Iterations times stages that solves have taken and may still take."""

    def __init__(self, limit: float) -> None:
        """Begin with nothing used of `limit`, iterations times stages."""
        self.limit, self.used = limit, 0

    @classmethod
    def of_repair(cls, problem: Problem) -> WorkBudget:
        """The budget of a whole repair: the time of an iteration grows with the square of the states."""
        return cls(round(WORK_OF_A_REPAIR / max(len(problem.x0), SMALL) ** 2))

    @property
    def exhausted(self) -> bool:
        """Whether no other solve begins."""
        return self.used >= self.limit

    def iterations(self, problem: Problem, asked: int, starts: int = 1) -> int:
        """The iterations that each of the starts of a solve may take: those asked for, or what the work left allows."""
        return int(min(asked, max(1, (self.limit - self.used) // (problem.N * starts))))

    def charge(self, plan: Plan, iterations: int | None = None) -> None:
        """Count a solve; its iterations are those of its plan, or of all its starts, unless given."""
        taken = sum(start.iterations for start in plan.starts) or plan.nit
        self.used += plan.N * (taken if iterations is None else iterations)


def was_cut(plan: Plan, allowed: int, asked: int) -> bool:
    """Whether a solve ended only because the work allowed it fewer iterations than were asked for."""
    return allowed < asked and not plan.success and plan.nit >= allowed
