"""Diagnose goals that the plan itself misses, because their weights are too small, and ignored parts of the file."""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.base.measured import Quantity
from planner.model.capabilities import capabilities_of
from planner.model.coordinates import coordinates_of
from planner.problem.costs.tracking import TrackingCost, tracking_of
from planner.problem.goals import GoalCheck, goals_of
from planner.problem.plan import Plan, Status
from planner.problem.problem import Problem
from planner.problem.stances import BOUND, kept_shares, least_kept
from planner.problem.tasks.cost import WEIGHT
from planner.proof.diagnostics.solving import STARTS
from planner.proof.diagnostics.suggested_fix import SuggestedFix, fix, no_fix, of_file, rounded_up
from planner.proof.verdict import Proof
from planner.solvers.continuation import DistantContacts, has_softer
from planner.solvers.trapped import stays_away

TARGET_SHARE = 0.5  # of the tolerance: the error to aim at
NOWHERE = 1e-3  # of the way to a goal: what goes no farther was not moved
PATH_RAISE = 10.0  # factor on the weights of a path that a plan leaves
MIN_RAISE, MAX_RAISE = 3.0, 1e6  # limits of the factor on a weight
_WEIGHTS = ("final_position", "final_velocity")
_Raises = dict[int, tuple[float, dict[str, Any]]]  # by coordinate: factor on a weight, and the values of the finding


def untouched(plan: Plan, problem: Problem, proof: Proof | None) -> list[SuggestedFix]:
    """An object that is to be moved, and that the plan never touches: no weight of its goal has a gradient."""
    family = DistantContacts(problem)
    if not stays_away(problem, plan) or family.factor <= 1.0 or family.touches(plan.xs):
        return []
    away = [one for one in goals_of(problem, plan.xs) if one.miss(plan.t, plan.xs) > one.tolerance]
    positions = [one for one in away if not one.unit.endswith("/s")]
    return [no_fix("goal", "untouched")] if any(family.concerns(one.error) for one in positions) else []


def not_moved(plan: Plan, problem: Problem, proof: Proof | None) -> list[SuggestedFix]:
    """A machine with contacts that no solve moved, not from shaken controls: no weight of a goal has a gradient."""
    if not (has_softer(problem) and stays_away(problem, plan, NOWHERE)) or DistantContacts(problem).factor > 1.0:
        return []
    several = problem.parameters.get("starts", 1) != 1 or len(plan.starts) > 1
    advice = [] if several else [f"`starts = {STARTS}`"]
    advice += ["a [[goal]] of joints on the way", "more `duration`"]
    return [no_fix("goal", "not_moved", advice=", or ".join(advice))]


def larger_weights(plan: Plan, problem: Problem, proof: Proof | None) -> list[SuggestedFix]:
    """Final weights that bring the end error within half of its tolerance.

    A final weight W leaves an error e of a displacement d, like a spring of stiffness W against one of stiffness
    c = e W / (d - e); so the error e' needs the weight c (d - e') / e'. What is to be exact is met with any weight.
    """
    if problem.requirements is not None and problem.requirements.goal is not None:
        return []
    if plan.status is Status.INFEASIBLE and "lacks_weight" not in plan.options.get("relaxation", {}):
        return []  # by its limits, with any weights
    if proof is None:
        return _of_task(plan, problem)
    cost = tracking_of(problem.cost)
    goal_failures = [one for one in proof.goal.failures if one.name.startswith(("planned", "replayed"))]
    followed = proof.refined_open_loop.passed or proof.refined_feedback.passed
    of_plan = followed or any(one.name.startswith("planned") for one in goal_failures)
    if cost is None or not goal_failures or not of_plan:
        return []
    times: dict[str, _Raises] = {key: {} for key in _WEIGHTS}
    coordinates = [(one.name, one.unit) for one in coordinates_of(problem.dynamics)]
    ranges = problem.ranges
    exact = [] if ranges is None else ranges.component[len(ranges.component) - ranges.at_end :].tolist()
    for goal in goals_of(problem, plan.xs):
        if goal.alone or (goal.name, goal.unit) not in coordinates or not np.isfinite(goal.tolerance):
            continue
        ends = (plan.xs[-1:], proof.replay.xs[-1:]) if followed else (plan.xs[-1:],)
        miss = max(float(goal.error(x)[0]) for x in ends)
        if miss > goal.tolerance and coordinates.index((goal.name, goal.unit)) not in exact:
            key = _WEIGHTS[goal.unit.endswith("/s")]
            times[key][coordinates.index((goal.name, goal.unit))] = _raised(problem, goal, miss)
    own = [_of_weight(problem, cost, key, found) for key, found in times.items() if found]
    if len(own) > 1:  # one without the other is met by missing the other by more
        both = {one.key.partition(".")[2]: one.value for one in own}
        own = [fix(problem, "weights", both, own[0].code, **own[0].values)]
    return [*_of_task(plan, problem), *own]


def _of_task(plan: Plan, problem: Problem) -> list[SuggestedFix]:
    """A larger weight of all goals of a task, if the plan misses some: an error falls as the weight rises."""
    goals = [one for one in goals_of(problem, plan.xs) if one.alone and np.isfinite(one.tolerance)]
    over = {one.name: one.miss(plan.t, plan.xs) / one.tolerance for one in goals}
    worst = max(goals, key=lambda one: over[one.name], default=None)
    if worst is None or not over[worst.name] > 1.0 or not of_file(problem):
        return []
    own = float(problem.parameters["weights"].get("goal", WEIGHT))
    values = {"miss": Quantity(over[worst.name] * worst.tolerance, worst.unit), "goal": worst.name}
    raised = own * float(np.clip(over[worst.name] / TARGET_SHARE, MIN_RAISE, MAX_RAISE))
    values["tolerance"] = Quantity(worst.tolerance)
    return [fix(problem, "weights.goal", rounded_up(raised), "task_missed", **values)]


def ignored_stance(plan: Plan, problem: Problem, proof: Proof | None) -> list[SuggestedFix]:
    """More weight of the motion that has the phases or the gait, for a plan whose feet do otherwise.

    That motion is the cost's reference. Where it does not do what they ask either, a goal on the way is left.
    """
    cost, mechanism = tracking_of(problem.cost), capabilities_of(problem.dynamics).mechanism
    if not problem.stances or cost is None or mechanism is None or not np.isfinite(plan.xs).all():
        return []
    stance, share = least_kept(problem.stances, problem.dynamics, plan.t, plan.xs)
    if share >= BOUND:
        return []
    begin, end = max(stance.spans, key=lambda span: span[1] - span[0])
    values = {"stance": str(stance), "share": share, "bound": BOUND, "time": Quantity(0.5 * (begin + end), "s")}
    weights = np.diagonal(cost.Q[0])[: mechanism.nv] / problem.dynamics.dt
    led = kept_shares([stance], problem.dynamics, plan.t, cost.x_ref)[0] >= BOUND
    if not (led and weights.any() and of_file(problem)):
        return [no_fix("phase", "stance_ignored", **values)]
    raised, alike = [rounded_up(PATH_RAISE * float(one)) for one in weights], bool(np.ptp(weights) == 0.0)
    value: Any = raised[0]
    if not alike and all(mechanism.joint_names):
        by_joint = zip(mechanism.joint_names, mechanism.joint_links, strict=True)
        value = {name: raised[links] for name, links in by_joint}
        value = {name: own[0] if len(own) == 1 else own for name, own in value.items() if any(own)}
    return [fix(problem, "weights.position", value, "stance_outweighed", **values)]


def _raised(problem: Problem, goal: GoalCheck, miss: float) -> tuple[float, dict[str, Any]]:
    """Factor on the goal's weight, and the values of the finding."""
    aim, way = TARGET_SHARE * goal.tolerance, float(goal.error(problem.x0[None])[0])
    raised = miss / aim
    if miss < way:
        raised = miss / (way - miss) * (way - aim) / aim
    values = {"miss": Quantity(miss, goal.unit), "goal": goal.name, "tolerance": Quantity(goal.tolerance)}
    return float(np.clip(raised, MIN_RAISE, MAX_RAISE)), values


def _of_weight(problem: Problem, cost: TrackingCost, key: str, found: _Raises) -> SuggestedFix:
    mechanism = capabilities_of(problem.dynamics).mechanism
    weights = np.diagonal(cost.Q[-1]).copy()
    worst = max(found, key=lambda i: found[i][0])
    values = found[worst][1]
    value: object
    if mechanism is None:
        raised_weight = rounded_up(found[worst][0] * float(weights[worst]))
        return fix(problem, f"weights.{key}", raised_weight, "goal_missed", **values)
    first = 0 if key == "final_position" else mechanism.nv
    own = weights[first : first + mechanism.nv]
    if np.ptp(own) == 0.0 or not all(mechanism.joint_names):
        value = rounded_up(max(times * float(weights[i]) for i, (times, _) in found.items()))
    else:
        raised = {i: times for i, (times, _) in found.items()}
        table = {}
        for name, links in zip(mechanism.joint_names, mechanism.joint_links, strict=True):
            new = [float(own[i]) * raised.get(first + i, 1.0) for i in range(links.start, links.stop)]
            asked = any(first + i in raised for i in range(links.start, links.stop))
            new = [rounded_up(one) for one in new] if asked else new
            if any(new):
                table[name] = new[0] if len(new) == 1 else new
        value = table
    return fix(problem, f"weights.{key}", value, "goal_missed", **values)


def without_ignored(plan: Plan, problem: Problem, proof: Proof | None) -> list[SuggestedFix]:
    """No ignored parts, for a plan that is reproduced in its own model and misses its goal in the user's file."""
    ignored = problem.parameters.get("ignore")
    if proof is None or not of_file(problem) or not ignored or proof.your_file.passed:
        return []
    followed = proof.refined_open_loop.passed or proof.refined_feedback.passed
    failures = proof.your_file.failures
    goal_failures = [one for one in failures if one.name.startswith("replayed")]
    pushed = any(one.name == "unknown_contacts" for one in failures)  # these contacts move the end, too
    if pushed or not followed or not goal_failures or not proof.goal.passed:
        return []
    values = {"ignored": ", ".join(ignored), "missed": str(goal_failures[0])}
    return [fix(problem, "ignore", [], "ignored_matters", **values)]
