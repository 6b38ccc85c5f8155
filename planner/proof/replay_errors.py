"""Steps 3 and 4 of a proof: whether MuJoCo at a refined step reproduces the plan, and whether it meets the goal.

Errors are reported by unit, for the coordinate with the largest error relative to its bound. The whole path is judged,
at every step of the simulator. A machine's own rules (Requirements) replace the checks of the end and the cost.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from planner.base.measured import Measurement, Section
from planner.problem.costs.tracking import TrackingCost
from planner.problem.goals import GoalCheck, goals_of, terms_of
from planner.problem.problem import Problem
from planner.problem.stances import BOUND, least_kept
from planner.proof.error_scales import (
    COST_BOUND,
    SHARE,
    SMOOTHED,
    by_unit,
    is_nonsmooth,
    is_path_judged,
    judged_cost,
    limit_violations,
    path_error_bounds,
    replayed_violations,
    word_of,
)
from planner.proof.replays.replaying import Replay

_NO_RANGES = "of joints, controls and forces: a plan knows none, MuJoCo holds them"


def tracking(run: Replay, problem: Problem) -> Section:
    """Compare one replay with the plan."""
    path = path_errors(run, problem)
    common = (
        Measurement("simulator_warnings", float(len(run.warnings)), "", 0.0, " ".join(run.warnings)),
        Measurement("ranges_reached", float(len(run.reached)), "", None, " ".join(run.reached) or _NO_RANGES),
        *limit_violations(problem, run.xs, _controls(run), "of the replay", run.plan),
        *replayed_violations(run, problem),
    )
    if problem.requirements is not None and problem.requirements.tracking is not None:
        section = problem.requirements.tracking(run)
        return replace(section, measured=(*section.measured, *path, *common))
    return Section(run.title, (*path, cost_error(run, problem), *common))


def path_errors(run: Replay, problem: Problem) -> tuple[Measurement, ...]:
    """The errors at the end and over the path by unit, each the largest relative to its bound."""
    error, bounds, measured, smoothed = np.abs(run.error), path_error_bounds(run.plan), [], is_nonsmooth(run.plan)
    share = f"{100.0 * (SMOOTHED if smoothed else SHARE):g} %"
    for part, along in (("end", error[-1:]), ("path", error)):
        for word, unit, which, names in by_unit(problem):
            most = along[:, which].max(axis=0)
            worst = int(np.argmax(np.where(np.isfinite(most), most / bounds[which], np.inf)))
            value, bound = float(most[worst]), float(bounds[which[worst]])
            when = f" at t = {run.t[int(np.argmax(along[:, which[worst]]))]:.4g} s" if part == "path" else ""
            jumps = part == "path" and not is_path_judged(run.plan, unit)
            why = "velocities jump at contacts: not judged" if jumps else f"the bound is {share} of its range of motion"
            note = f"of {names[worst]}{when}; {why}"
            measured.append(Measurement(f"{part}_{word}_error", value, unit, None if jumps else bound, note))
    return tuple(measured)


def cost_error(run: Replay, problem: Problem) -> Measurement:
    """Difference of MuJoCo's cost from the plan's, in % of the plan's."""
    cost, plan = judged_cost(problem), run.plan
    planned, scale = cost(problem, plan.xs, plan.us), cost.scale(plan, problem)
    with np.errstate(all="ignore"):
        reached = cost(problem, run.xs[:: run.substeps], run.stage_controls)
        error = 100.0 * abs(reached - planned) / scale
    note = f"{cost.name}: {reached:.5g} in MuJoCo, {planned:.5g} planned"
    if cost.final:
        note += "; what the end costs is judged as the goal"
    if scale > abs(planned):
        note += f"; relative to {scale:.3g}, what errors at their bounds cost"
    bound = 100.0 * SMOOTHED if is_nonsmooth(run.plan) else COST_BOUND
    by_errors = 100.0 * cost.change_by_errors(plan, problem) / scale
    if by_errors > bound:
        bound, note = by_errors, f"{note}; the bound is what path errors at theirs change"
    return Measurement("cost_error", error, "%", bound, note)


def _controls(run: Replay) -> np.ndarray | None:
    """(N, nu) the controls at the knots; None where they are not those of the plan's machine."""
    return run.ctrl[:: run.substeps] if run.ctrl.shape[1] == run.plan.us.shape[1] else None


def costs_with_goals(problem: Problem) -> list[TrackingCost]:
    """The terms of a problem's cost with a final weight, and so a goal state."""
    costs = terms_of(problem.cost)
    return [cost for cost in costs if isinstance(cost, TrackingCost) and np.any(cost.Q[-1])]


def goal(run: Replay, problem: Problem) -> Section:
    """Judge the plan and its replay by every goal of the cost or task, at its time, or by the machine's own rule."""
    if problem.requirements is not None and problem.requirements.goal is not None:
        return problem.requirements.goal(run)
    goals = goals_of(problem, run.plan.xs)
    if not goals and problem.periodic is None:
        return Section("goal", not_applicable="no goal was asked for")
    motions = {"planned": (run.t, run.plan_xs), "replayed": (run.t, run.xs)}
    errors = [one for who, motion in motions.items() for one in misses(who, *motion, goals)]
    ignored = [_ignored(who, problem, *motion) for who, motion in motions.items() if problem.stances]
    return Section("goal", (*errors, *ignored, *_return(run, problem)))


def _ignored(who: str, problem: Problem, t: np.ndarray, xs: np.ndarray) -> Measurement:
    """In which share of its time the stance that is kept least is not, of states xs (M, nx) at times t (M,)."""
    stance, share = least_kept(problem.stances, problem.dynamics, t, xs)
    return Measurement(f"{who}_ignored_stance", 100.0 - share, "%", 100.0 - BOUND, f"of the time of {stance}")


def _return(run: Replay, problem: Problem) -> tuple[Measurement, ...]:
    """Closure error of a trajectory that must be periodic; MuJoCo's is judged by the path error bounds."""
    if problem.periodic is None:
        return ()
    space, note = run.plan.space, "from the end of a cycle to its start, as a multiple of the tolerance"
    return tuple(
        Measurement(f"{who}_return_miss", problem.periodic.miss(space, xs), "", bound, note)
        for who, xs, bound in (("planned", run.plan.xs, 1.0), ("replayed", run.xs, None))
    )


def misses(who: str, t: np.ndarray, xs: np.ndarray, goals: tuple[GoalCheck, ...]) -> list[Measurement]:
    """Distance of a trajectory, states xs (M, nx) at times t (M,), from goals.

    Goals with a tolerance of their own are listed one by one; of the others, for each unit the one with the largest
    error relative to its tolerance.
    """
    measured = []
    whose = "the plan" if who == "planned" else "MuJoCo"
    for one in goals:
        if one.alone:
            key, when = one.name.replace(" ", "_"), "" if one.times is None else ", at its time"
            note = f"{whose} from {one.name}{when}"
            if one.times is not None and len(one.times) > 1:
                note = f"largest, {whose} from {one.name}, {one.times[0]:g} to {one.times[-1]:g} s"
            measured.append(Measurement(f"{who}_{key}_miss", one.miss(t, xs), one.unit, _bound(one), note))
    shared = [one for one in goals if not one.alone]
    for unit in dict.fromkeys(one.unit for one in shared):
        judged = [one for one in shared if one.unit == unit and math.isfinite(one.tolerance)]
        of_unit = judged or [one for one in shared if one.unit == unit]
        value, most = worst_of(of_unit, [one.miss(t, xs) for one in of_unit])
        note = f"{whose}'s end from the goal, {most.name}" + ("" if judged else "; a soft goal is not judged")
        measured.append(Measurement(f"{who}_{word_of(unit)}_miss", value, unit, _bound(most), note))
    return measured


def worst_of(goals: Sequence[GoalCheck], missed: Sequence[float]) -> tuple[float, GoalCheck]:
    """The goal with the largest error relative to its tolerance, and that error.

    Of goals without a tolerance, the one with the largest error; NaN counts as the largest.
    """
    judged = all(math.isfinite(one.tolerance) for one in goals)
    scales = [value / one.tolerance if judged else value for value, one in zip(missed, goals, strict=True)]
    worst = int(np.argmax(np.where(np.isfinite(scales), scales, np.inf)))
    return missed[worst], goals[worst]


def _bound(goal: GoalCheck) -> float | None:
    return goal.tolerance if math.isfinite(goal.tolerance) else None
