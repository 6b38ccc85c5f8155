"""Via points without times: goals in order, whose shares of the duration are chosen.

They are passed at first in proportion to the way of the joints. Then an objective moves them, to where it is least. The
indices of those goals are the entry WAYPOINTS of what a plan's table has resolved.

At a solution the cost J of a plan changes with the stage k of a via point as its own term does along the plan, since
all else is stationary (the envelope theorem): dJ/dk = (e^2(k + 1) - e^2(k - 1)) / 2, e its error over its tolerance.
Its sign says which way to move the via points first. Where that is not better each is moved alone, either way: in a
least time some via points are within their tolerance and say little. Steps are whole stages, halved when no move helps.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from planner.base.errors import PlannerError
from planner.problem.objective import base_problem
from planner.problem.plan import Plan, Status
from planner.problem.problem import Problem
from planner.problem.tasks.goal import Goal
from planner.problem.tasks.poses import Poses
from planner.problem.tasks.timed_task import Task
from planner.solvers.work import WorkBudget

WAYPOINTS = "waypoints"
MAX_TRIALS = 60  # of stages; each costs a solve, and where it is better a search of the duration
FIRST_STEP = 1.0 / 16.0  # of the stages
LEAST_GAIN = 1e-4  # relative, of a trial that is better


def undated_waypoints(goals: Sequence[Goal]) -> tuple[int, ...]:
    """The via points without a time that come before a goal of the end."""
    ends = [k for k, one in enumerate(goals) if one.time is None and one.share in (None, 1.0) and not one.through]
    return tuple(k for k, goal in enumerate(goals) if goal.undated and ends and k < ends[-1])


def dated_evenly(goals: Sequence[Goal], waypoints: Sequence[int], N: int) -> list[Goal]:
    """The goals with their waypoints at equal parts of the duration.

    Raises:
        PlannerError: There are not two stages for each; or other goals before the end, which have times.
    """
    dated = [k for k, goal in enumerate(goals) if k not in waypoints and (goal.time, goal.share) != (None, None)]
    if dated:
        raise PlannerError(
            f"goal {waypoints[0] + 1} is passed without a time, and goal {dated[0] + 1} has one: expected a time or a "
            "share for each goal before the end, or for none."
        )
    parts = len(waypoints) + 1
    if 2 * parts > N:
        raise PlannerError(f"there are {N} stages for {len(waypoints)} via points, expected at least {2 * parts}.")
    return with_stages(goals, waypoints, np.round(N * np.arange(1, parts) / parts).astype(int), N)


def dated_by_way(task: Task, waypoints: Sequence[int], poses: Poses) -> list[Goal]:
    """The goals of a task with their waypoints in proportion to the way of the joints, rad or m, between its poses."""
    xs = np.tile(task.mechanism.home, (len(poses.q), 1))
    xs[:, : task.mechanism.nq] = poses.q
    ways = np.linalg.norm(task.mechanism.space.difference(xs[1:], xs[:-1]), axis=1)
    along = np.concatenate([[0.0], np.cumsum(ways)])
    at = {int(stage): k for k, stage in enumerate(poses.stages)}
    shares = [along[at[task.goals[k].stage]] / max(along[-1], 1e-12) for k in waypoints]
    goals = [one.goal for one in task.goals]
    return with_stages(goals, waypoints, np.round(task.N * np.array(shares)).astype(int), task.N)


def with_stages(goals: Sequence[Goal], waypoints: Sequence[int], stages: np.ndarray, N: int) -> list[Goal]:
    """The goals with their waypoints at stages (W,) of N, in order and at least one stage apart."""
    room = np.arange(1, len(stages) + 1)
    stages = np.maximum.accumulate(np.clip(stages, room, N - room[::-1]) - room) + room
    dated = list(goals)
    for k, stage in zip(waypoints, np.minimum(stages, N - room[::-1]), strict=True):
        dated[k] = replace(goals[k], share=int(stage) / N)
    return dated


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
    if best.status is Status.INTERRUPTED:
        return best
    stages = np.array([round(problem.N * float(goals[k].share or 1.0)) for k in waypoints])
    step, trials = max(1, round(FIRST_STEP * problem.N)), MAX_TRIALS
    try:
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
                if plan is not None and plan.status is Status.INTERRUPTED:
                    raise KeyboardInterrupt
                better = plan is not None and value(plan) < value(best) - LEAST_GAIN * abs(value(best))
                if plan is not None and better:
                    best, stages = plan, at
                    break
            step = step if better else step // 2
    except (KeyboardInterrupt, StopIteration):
        return replace(best, status=Status.INTERRUPTED)
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
        known = (one for one in problem.goal_specs or () if one.times is not None and len(one.times) == 1)
        own = [one for one in known if one.times is not None and round(one.times[0] / plan.dt) == stage]
        errors = sum(
            np.square(np.concatenate([one.error(x[None]) for x in neighbors]) / (one.tolerance or 1.0)) for one in own
        )
        ways[i] = int(np.sign(np.subtract(*np.broadcast_to(errors, 2))))
    return ways


def _with_goals(problem: Problem, goals: Sequence[Goal]) -> Problem:
    """The problem with other goals, and the limits that it has."""
    base = base_problem(problem)
    assert base.recipe is not None  # free_waypoints() found its goals in it
    new = base_problem(base.recipe.rebuilt(goal=[goal.to_dict() for goal in goals]))
    return replace(new, limits=problem.limits, twin=problem.twin)
