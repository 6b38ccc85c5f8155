"""ProblemFile: the problem of a problem.toml, solved as the file asks for."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from planner.cases.problem_file.cycles import unrolled
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.solvers.free_time import solve_for
from planner.solvers.options import single_start
from planner.solvers.periodic import solve_periodic
from planner.solvers.phase_times import solve_phase_times
from planner.solvers.slq import solve
from planner.solvers.work import budget_of

SEARCH_SHARE = 0.7  # of the work, for the times of phases: the rest is for the cycles after the first one


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
            plan = self._replace(cycles=1)._at_best_times(callback, options)
            assert plan.problem is not None  # it was solved
            return self._replace(problem=plan.problem)._unrolled(plan, callback, options)
        if self.problem.periodic is not None:
            plan = solve_periodic(self.problem, callback=callback, **options)
            return self._unrolled(plan, callback, options)
        if self.objective is None:
            return solve(self.problem, callback=callback, **options)
        return solve_for(self.problem, durations=self.durations, callback=callback, **options)  # its own objective

    def _at_best_times(self, callback: Callable[[Any], object] | None, options: dict[str, Any]) -> Plan:
        """The plan of least cost by the times of its phases; several starts are for the first solve."""
        budget, one = options["budget"], self._replace(phase_times={})
        part = None if budget is None else budget.part("phase times", SEARCH_SHARE)
        each = options | {"budget": part}

        def solved(problem: Problem) -> Plan:
            nonlocal each
            plan = one._replace(problem=problem).solved(None, **each)
            each = single_start(each)
            return plan

        return solve_phase_times(self.problem, self.phase_times, solved, callback, part)

    def _unrolled(self, plan: Plan, callback: Callable[[Any], object] | None, options: dict[str, Any]) -> Plan:
        """The plan of as many cycles as the file asks for, from that of one; that one if it is no solution."""
        if self.cycles == 1 or not plan.converged or (options["budget"] is not None and options["budget"].exhausted):
            return plan
        return unrolled(self.problem, plan, self.cycles, callback=callback, **options)
