"""ProblemFile: the problem of a problem.toml, solved as the file asks for."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from planner.cases.problem_file.cycles import unrolled
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.solvers.free_time import solve_for
from planner.solvers.periodic import solve_periodic
from planner.solvers.phase_times import solve_phase_times
from planner.solvers.slq import solve
from planner.solvers.work import budget_of


class ProblemFile(NamedTuple):
    """The problem of a problem.toml, and how to solve it."""

    problem: Problem
    starts: int
    seed: int
    objective: dict[str, float] | None  # weights by names of OBJECTIVES, for solve_for; None for the problem as it is
    durations: list[float] | None  # the shortest and the longest, s, for an objective with time
    notes: tuple[str, ...] = ()  # sentences about contacts, and about what was done to start and goal
    work: float | None = None  # of the run
    cycles: int = 1  # of a periodic problem, which is of one, that the plan has
    phase_times: Mapping[int, tuple[float, float]] = {}  # s, by phase from 0, within which it may end

    def solved(self, callback: Callable[[Any], object] | None, **options: Any) -> Plan:
        """The plan, by the solver that the problem asks for; options are those of solve()."""
        options["budget"] = budget_of(options.get("budget"))  # one for all solves
        if self.phase_times:
            one = self._replace(phase_times={}, cycles=1)
            plan = solve_phase_times(
                self.problem, self.phase_times, lambda problem: one._replace(problem=problem).solved(None, **options),
                callback, options["budget"],
            )  # fmt: skip
            assert plan.problem is not None  # it was solved
            return self._replace(problem=plan.problem)._unrolled(plan, callback, options)
        if self.problem.periodic is not None:
            plan = solve_periodic(self.problem, callback=callback, **options)
            return self._unrolled(plan, callback, options)
        if self.objective is None:
            return solve(self.problem, callback=callback, **options)
        return solve_for(self.problem, self.objective, durations=self.durations, callback=callback, **options)

    def _unrolled(self, plan: Plan, callback: Callable[[Any], object] | None, options: dict[str, Any]) -> Plan:
        """The plan of as many cycles as the file asks for, from that of one; that one if it is no solution."""
        if self.cycles == 1 or not plan.converged:
            return plan
        return unrolled(self.problem, plan, self.cycles, callback=callback, **options)
