"""Diagnose standing machines: goal poses that are not stable, jumps that are not found, falls along the trajectory."""

from __future__ import annotations

import numpy as np

from planner.base.errors import PlannerError
from planner.base.measured import Quantity
from planner.dynamics.inverse_kinematics import Target
from planner.dynamics.kinematics import center_of_mass, frame_pose
from planner.dynamics.statics import STRIDE, clearance, static_equilibrium, stays_in_air
from planner.model.capabilities import capabilities_of, rolling_radii, stands_on_ground
from planner.model.mjcf.contact_mode import STANDING
from planner.problem.costs.tracking import tracking_of
from planner.problem.goals import between
from planner.problem.plan import Plan, Status
from planner.problem.problem import Problem
from planner.problem.progress import controls_at_bounds
from planner.problem.tasks.flight import missing_height
from planner.problem.tasks.goal import goal_of
from planner.problem.tasks.legs import standing_feet
from planner.problem.tasks.timed_task import DEFAULT_TOLERANCES
from planner.proof.diagnostics.solving import STARTS
from planner.proof.diagnostics.suggested_fix import SuggestedFix, fix, no_fix, of_file
from planner.proof.verdict import Proof

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
