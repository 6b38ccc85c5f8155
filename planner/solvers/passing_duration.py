"""The shortest duration found in which a motion keeps limits that it does not keep in its own.

Durations grow until one passes, and by more each time, which takes few solves for any ratio. Between it and the longest
that has failed, bisection follows (in the logarithm) from the plan that passed, in less time. So what is found is a
bracket, and counts in solves alone: continuation in time (see planner.solvers.continuation).
"""

from __future__ import annotations

import math
from collections.abc import Callable

from planner.base.errors import PlannerError
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.problem.rediscretize import lengthened, rounded_duration

LENGTHENINGS = tuple(1.1**k for k in (1, 2, 4, 8, 16))  # of the duration: up to 4.6 times
PRECISION = 1.05  # ratio of a duration that passes to one that fails, at which no shorter one is looked for

# The smallest s reached in another duration from a plan at s, and its plan: at 0 it passes; else the same s and plan.
InDuration = Callable[[Problem, float, Plan], tuple[float, Plan]]


def find_passing_duration(
    problem: Problem, s: float, plan: Plan, in_duration: InDuration, report: Callable[[float], object]
) -> None:
    """Report each duration found to pass, s: the last one is the shortest, to within PRECISION of one that fails.

    Args:
        problem: That fails in its own duration.
        s: Of the easier problem that `plan` is of, above 0.
        plan: Its plan.
        in_duration: One try.
        report: Called with a shorter duration each time, so that a search that is cut has the last one.
    """
    fails = passes = 1.0
    for ratio in LENGTHENINGS:
        fails, passes = passes, ratio
        try:
            s, plan = in_duration(lengthened(problem, ratio), s, plan)
        except PlannerError:  # parts that cannot have another duration
            return
        if s == 0.0:
            break
    else:
        return
    passes = _reported(problem, plan, report)
    while passes > PRECISION * fails:
        between = lengthened(problem, math.sqrt(fails * passes))
        if between.N >= plan.N:  # rounded up
            return
        _, shorter = in_duration(between, 0.0, plan)
        if shorter is plan:
            fails = between.duration / problem.duration
        else:
            plan, passes = shorter, _reported(problem, shorter, report)


def _reported(problem: Problem, plan: Plan, report: Callable[[float], object]) -> float:
    """The duration of a plan, over that of the problem."""
    duration = rounded_duration(plan.problem, 1.0)
    report(duration)
    return duration / problem.duration
