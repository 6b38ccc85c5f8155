"""The shortest duration found in which a motion keeps limits that it does not keep in its own.

Durations grow by a tenth until one passes, each followed from the plan in the one before. If none does, longer ones are
begun from swings of their own: a longer time has room for more of them. Between the duration found and the longest that
has failed, bisection follows (in the logarithm) from the plan that passed, in less time. So what is found is a bracket,
and counts in solves alone: continuation in time (see planner.solvers.continuation).
"""

from __future__ import annotations

import math
from collections.abc import Callable

from planner.base.errors import PlannerError
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.problem.rediscretize import lengthened, rounded_duration

LENGTHENINGS = tuple(1.1**k for k in range(1, 9))  # of the duration, each followed from the one before: up to 2.1 times
SWING_LENGTHENINGS = tuple(1.1**k for k in (2, 4, 8, 16))  # begun from swings: up to 4.6 times
PRECISION = 1.05  # ratio of a duration that passes to one that fails, at which no shorter one is looked for

# The smallest s reached in another duration from a plan at s, and its plan: at 0 it passes; else the same s and plan.
InDuration = Callable[[Problem, float, Plan], tuple[float, Plan]]


def find_passing_duration(
    problem: Problem, s: float, plan: Plan, in_duration: InDuration, from_swings: Callable[[Problem], Plan | None],
    report: Callable[[float, Plan], object],
) -> None:  # fmt: skip
    """Report each duration found to pass, s: the last one is the shortest, to within PRECISION of one that fails.

    Args:
        problem: That fails in its own duration.
        s: Of the easier problem that `plan` is of, above 0.
        plan: Its plan.
        in_duration: One try from a plan.
        from_swings: One try from swings; None where no plan passes.
        report: Called with a shorter duration and its plan each time, so that a search that is cut has the last one.
    """
    fails = 1.0
    try:
        for ratio in LENGTHENINGS:
            longer = lengthened(problem, ratio)
            s, plan = in_duration(longer, s, plan)
            if s == 0.0:
                break
            fails = ratio
        else:
            fails = 1.0
            for ratio in SWING_LENGTHENINGS:
                longer = lengthened(problem, ratio)
                if (swung := from_swings(longer)) is not None:
                    plan = swung
                    break
                fails = ratio
            else:
                return
    except PlannerError:  # parts that cannot have another duration
        return
    duration = rounded_duration(longer, 1.0)
    report(duration, plan)
    while duration > PRECISION * fails * problem.duration:
        between = lengthened(problem, math.sqrt(fails * duration / problem.duration))
        shorter = rounded_duration(between, 1.0)
        if shorter >= duration:  # rounded up
            return
        _, found = in_duration(between, 0.0, plan)
        if found is plan:
            fails = shorter / problem.duration
        else:
            plan, duration = found, shorter
            report(duration, plan)
