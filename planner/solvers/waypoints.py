"""When via points without times are passed: shares of the duration that make an objective least.

At a solution the cost J of a plan changes with the stage k of a via point as its own term does along the plan, since
all else is stationary (the envelope theorem): dJ/dk = (e^2(k + 1) - e^2(k - 1)) / 2, e its error over its tolerance.
Its sign says which way to move the via points first. Where that is not better each is moved alone, either way: in a
least time some via points are within their tolerance and say little. Steps are whole stages, halved when no move helps.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from planner.problem.objective_problem import base_problem
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.problem.tasks.goal import Goal
from planner.problem.tasks.waypoints import WAYPOINTS, with_stages
from planner.solvers.work import WorkBudget

MAX_TRIALS = 60  # of stages; each costs a solve, and where it is better a search of the duration
FIRST_STEP = 1.0 / 16.0  # of the stages
LEAST_GAIN = 1e-4  # relative, of a trial that is better


def free_waypoints(problem: Problem) -> tuple[int, ...]:
    """The indices of goals whose share of the duration was chosen, in a problem of a file or of task()."""
    return tuple(problem.parameters.get("resolved", {}).get(WAYPOINTS, ()))


def best_waypoints(
    problem: Problem, solved: Callable[[Problem, Plan | None], Plan | None], value: Callable[[Plan], float],
    budget: WorkBudget | None = None,
) -> Plan:  # fmt: skip
    """The best plan of a problem over the stages of its free via points.

    Args:
        problem: With free_waypoints.
        solved: Solves a problem, and again near the best plan so far; None where nothing better is found.
        value: What is to be least.
        budget: Of all solves.
    """
    waypoints, goals = free_waypoints(problem), [Goal(**one) for one in problem.parameters["goal"]]
    best = solved(problem, None)
    assert best is not None  # there is no better one before the first
    stages = np.array([round(problem.N * float(goals[k].share or 1.0)) for k in waypoints])
    step, trials = max(1, round(FIRST_STEP * problem.N)), MAX_TRIALS
    while step:
        better = False
        for move in _moves(_downhill(best, stages)):
            tried = with_stages(goals, waypoints, stages + step * move, problem.N)
            at = np.array([round(problem.N * float(tried[k].share or 1.0)) for k in waypoints])
            if (at == stages).all():
                continue
            if trials == 0 or (budget is not None and budget.exhausted):
                return best
            trials -= 1
            plan = solved(_with_goals(problem, tried), best)
            better = plan is not None and value(plan) < value(best) - LEAST_GAIN * abs(value(best))
            if plan is not None and better:
                best, stages = plan, at
                break
        step = step if better else step // 2
    return best


def _moves(ways: np.ndarray) -> Iterator[np.ndarray]:
    """Moves (W,) of -1, 0 and 1 to try: all via points downhill, each alone, and each the other way."""
    yield ways
    alone = np.diag(np.where(ways == 0, 1, ways))
    yield from alone if len(ways) > 1 or not ways.all() else ()
    yield from -alone


def _downhill(plan: Plan, stages: np.ndarray) -> np.ndarray:
    """(W,) +1 or -1: the way along the stages in which the term of each via point falls; 0 where it does not."""
    problem = plan.problem
    assert problem is not None
    ways = np.zeros(len(stages), dtype=int)
    for i, stage in enumerate(stages):
        neighbors = plan.xs[[stage - 1, stage + 1]]
        own = [one for one in problem.goal_specs or () if one.times is not None and _is_at(one.times, stage, plan.dt)]
        errors = sum(
            np.square(np.concatenate([one.error(x[None]) for x in neighbors]) / (one.tolerance or 1.0)) for one in own
        )
        ways[i] = int(np.sign(np.subtract(*np.broadcast_to(errors, 2))))
    return ways


def _is_at(times: Sequence[float], stage: int, dt: float) -> bool:
    return len(times) == 1 and round(times[0] / dt) == stage


def _with_goals(problem: Problem, goals: Sequence[Goal]) -> Problem:
    """The problem with other goals, and the limits that it has."""
    base = base_problem(problem)
    assert base.recipe is not None  # free_waypoints() found its goals in it
    new = base_problem(base.recipe.rebuilt(goal=[goal.to_dict() for goal in goals]))
    return replace(new, limits=problem.limits, twin=problem.twin)
