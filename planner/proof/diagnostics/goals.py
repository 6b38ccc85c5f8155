"""Diagnose goals that the plan itself misses, because their weights are too small, and ignored parts of the file.

And standing machines: goal poses that are not stable, jumps that are not found, falls along the trajectory.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.base.errors import PlannerError
from planner.base.measured import Quantity
from planner.dynamics.inverse_kinematics import Target
from planner.dynamics.kinematics import center_of_mass, frame_pose
from planner.dynamics.statics import STRIDE, clearance, static_equilibrium, stays_in_air
from planner.model.capabilities import capabilities_of, rolling_radii, stands_on_ground
from planner.model.coordinates import coordinates_of
from planner.model.mjcf.contact_mode import STANDING
from planner.problem.costs.tracking import TrackingCost, tracking_of
from planner.problem.goals import GoalCheck, between, goals_of
from planner.problem.plan import Plan, Status
from planner.problem.problem import Problem
from planner.problem.progress import controls_at_bounds
from planner.problem.stances import BOUND, kept_shares, least_kept
from planner.problem.tasks.cost import WEIGHT
from planner.problem.tasks.flight import missing_height
from planner.problem.tasks.goal import goal_of
from planner.problem.tasks.legs import standing_feet
from planner.problem.tasks.timed_task import DEFAULT_TOLERANCES
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


WEAK_SHARE = 0.5  # of the stages on the ground before a jump: an actuator at its bound in more of them is too weak
MAX_ERROR_GROWTH = 5.0  # exponent over a plan: an error grows by exp(5), 150 times


def standing_goal(plan: Plan, problem: Problem, proof: Proof | None) -> list[SuggestedFix]:
    """The reason why a machine that misses its goal, or does not converge, cannot stand at its goal."""
    asked, cost = problem.parameters, tracking_of(problem.cost)
    mechanism = capabilities_of(problem.dynamics).mechanism
    if not of_file(problem) or (proof is not None and proof.goal.passed and proof.your_file.passed):
        return []
    if asked["settle"] != "auto" or asked["contacts"] not in STANDING or cost is None or problem.goal_specs is not None:
        return []
    goal = cost.x_ref[-1]
    if mechanism is None or not stands_on_ground(mechanism) or np.any(goal[mechanism.velocities]):
        return []
    if stays_in_air(mechanism, goal):
        return []
    try:
        static_equilibrium(mechanism, goal, np.ones(mechanism.nv, dtype=bool))
    except PlannerError as error:
        return [no_fix("goal", "goal_unbalanced", cause=str(error))]
    return []


def gait_needed(plan: Plan, problem: Problem, proof: Proof | None) -> list[SuggestedFix]:
    """The gait for a machine of four feet that a file asks to be elsewhere at rest, without saying which feet swing."""
    asked, mechanism = problem.parameters, capabilities_of(problem.dynamics).mechanism
    if not of_file(problem) or mechanism is None or "rest" not in asked.get("resolved", {}).get("weights", {}):
        return []
    goals = asked.get("goal")
    passes = isinstance(goals, list) and any(isinstance(one, dict) and one.get("through") for one in goals)
    feet = standing_feet(mechanism, plan.xs[0])
    if passes or len(feet) != 4 or np.any(rolling_radii(mechanism)):
        return []
    way = np.diff(center_of_mass(mechanism, plan.xs[[0, -1], : mechanism.nq]), axis=0)[0]
    way -= feet[0].normal * (feet[0].normal @ way)
    distance = float(np.linalg.norm(way))
    return [fix(problem, "gait", "trot", "gait_needed", distance=Quantity(distance, "m"))] if distance > STRIDE else []


def jump_not_found(plan: Plan, problem: Problem, proof: Proof | None) -> list[SuggestedFix]:
    """How high a machine that stands gets, where no solve converged to the jump that it is asked for."""
    mechanism, goals = capabilities_of(problem.dynamics).mechanism, problem.parameters.get("goal")
    if not of_file(problem) or not isinstance(goals, list) or mechanism is None or plan.converged:
        return []
    feet = standing_feet(mechanism, plan.xs[0])
    if not feet or not np.any(mechanism.gravity) or not np.isfinite(plan.xs).all():
        return []
    up = -mechanism.gravity / np.linalg.norm(mechanism.gravity)
    ranges = np.tile([-np.inf, np.inf], (mechanism.nv, 1))
    if problem.limits is not None:
        ranges = problem.limits.position_ranges(problem.dynamics)
    for k, given in enumerate(goals, 1):
        goal = goal_of(given, f"goal {k}")
        if not goal.through or goal.frame is None or goal.position is None:
            continue
        position, time = np.asarray(goal.position, dtype=float), goal.after(problem.duration)
        x = between(plan.t, plan.xs, np.array([time]))[0]
        q, asked = x[: mechanism.nq], float(up @ position)
        reached = float(up @ frame_pose(mechanism, q, mechanism.frame(goal.frame))[:3, 3])
        if asked - reached <= goal.tolerances(DEFAULT_TOLERANCES)["position"]:
            continue
        start = plan.xs[0, : mechanism.nq]
        missing = missing_height(mechanism, [Target(goal.frame, position)], start, ranges)
        if missing > STRIDE:
            heights = {"asked": asked, "reached": reached, "standing": asked - missing}
            values = {name: Quantity(value, "m") for name, value in heights.items()}
            values["time"] = Quantity(time, "s")
            return [no_fix("goal", "jump_not_found", frame=goal.frame, advice=_of_jump(plan, problem, time), **values)]
    return []


def _of_jump(plan: Plan, problem: Problem, time: float) -> str:
    """What may find a higher jump: more work only for a solve that was cut, more force only where it lacks."""
    several = problem.parameters.get("starts", 1) != 1 or len(plan.starts) > 1
    advice = [] if several else [f"`starts = {STARTS}`"]
    advice += ["a start that crouches"]
    if plan.status is Status.WORK_LIMIT:
        advice += ["more `work`"]
    mechanism = capabilities_of(problem.dynamics).mechanism
    assert mechanism is not None  # checked by jump_not_found
    pushes = [n for n in range(plan.N) if plan.t[n] < time and clearance(mechanism, plan.xs[n]) <= 0.0]
    if problem.bounds is not None and pushes:
        works = np.abs(plan.us) > 0.0  # a control that rests at a bound of 0 is not too weak
        share = np.max((controls_at_bounds(problem, plan.xs, plan.us) & works)[pushes].mean(axis=0), initial=0.0)
        advice += ["stronger actuators"] if share > WEAK_SHARE else []
    return " or ".join(advice)


def loses_balance(proof: Proof) -> bool:
    """Whether a standing machine falls, with joint ranges respected under its gains: joint stops are then no cause."""
    problem = proof.replay.plan.problem
    mechanism = None if problem is None else capabilities_of(problem.dynamics).mechanism
    if mechanism is None or not stands_on_ground(mechanism) or proof.mode is not None or not proof.plan.passed:
        return False
    if any(one.name == "position_range_violation" for one in proof.refined_feedback.failures):
        return False
    if proof.refined_feedback.passed:  # it stands in MuJoCo as in the plan
        return False
    return _growth_rate(proof) * proof.replay.plan.t[-1] > MAX_ERROR_GROWTH


def _growth_rate(proof: Proof) -> float:
    """Growth rate of errors without gains, 1/s; NaN if unknown."""
    return next((one.value for one in proof.growth.measured if one.name == "growth_rate_open_loop"), float("nan"))


def _error_share(proof: Proof) -> float:
    """The largest error with the plan's gains, of what passes."""
    return float(proof.errors.measured["feedback"].max())


def falling(plan: Plan, problem: Problem, proof: Proof | None) -> list[SuggestedFix]:
    """The finding that the machine loses its balance, by itself or where MuJoCo's ground differs; after its fixes."""
    if proof is None or not loses_balance(proof):
        return []
    share = _error_share(proof)
    return [no_fix("goal", "falls" if share > 1.0 else "ground_differs", rate=_growth_rate(proof), share=share)]
