"""WorkBudget: limit of a repair's work, counted in iterations, so that results do not depend on computing speed."""

from __future__ import annotations

from planner.problem.plan import Plan
from planner.problem.problem import Problem

WORK_OF_A_REPAIR = 4e8  # iterations times stages times squared states: some 30 s of an idle core, for 14 states or more
SMALL = 14  # number of states up to which the time per iteration is constant


class WorkBudget:
    """Iterations times stages that solves have taken and may still take."""

    def __init__(self, limit: float) -> None:
        """Start unused, with `limit` iterations times stages."""
        self.limit, self.used = limit, 0

    @classmethod
    def of_repair(cls, problem: Problem) -> WorkBudget:
        """The budget of a whole repair: the time of an iteration grows with the square of the states."""
        return cls(round(WORK_OF_A_REPAIR / max(len(problem.x0), SMALL) ** 2))

    @property
    def exhausted(self) -> bool:
        """Whether no further solve may begin."""
        return self.used >= self.limit

    def iterations(self, problem: Problem, asked: int, starts: int = 1) -> int:
        """Iterations allowed for each start of a solve: `asked`, or fewer if the remaining work is less."""
        return int(min(asked, max(1, (self.limit - self.used) // (problem.N * starts))))

    def charge(self, plan: Plan, iterations: int | None = None) -> None:
        """Count a solve; its iterations are the plan's, or of all its starts, unless given."""
        self.used += plan.N * (plan.total_iterations if iterations is None else iterations)


def was_cut(plan: Plan, allowed: int, asked: int) -> bool:
    """Whether a solve ended only because the work budget allowed fewer iterations than `asked`."""
    return allowed < asked and not plan.success and plan.nit >= allowed
