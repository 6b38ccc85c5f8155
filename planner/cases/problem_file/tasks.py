"""Goals and paths of a problem file: [[goal]] and [follow] as a Task, its cost, its first guess, what is judged.

And what the file left to be chosen: for each, the values and the reason.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from planner.base.arguments import short_repr
from planner.base.errors import PlannerError
from planner.cases.problem_file.keys import GOAL, RAMP, RESOLVED
from planner.cases.problem_file.reference_guess import ReferenceTrajectory
from planner.cases.problem_file.states import carried_along, whole_poses_on_ground
from planner.dynamics import RigidBodyDynamics
from planner.dynamics.statics import feet_move, rolling_dofs, stands_somewhere
from planner.model.mechanism import Mechanism
from planner.problem.collision_free_path import CollisionChecker
from planner.problem.constraints.clearance import Avoid, AvoidanceConstraint
from planner.problem.constraints.constraint import Constraint
from planner.problem.costs.terms import Cost, GoalSpec
from planner.problem.default_weights import (
    MOVING_SHARE,
    STANCE_TOLERANCES,
    DefaultWeights,
    default_weights,
    min_jerk_cost,
)
from planner.problem.goals import ROUNDING, static_error
from planner.problem.limits import Limits
from planner.problem.problem import Problem
from planner.problem.reaching_cost import along_gait
from planner.problem.stances import Stance
from planner.problem.tasks.cost import WEIGHT, task_cost, task_goal_specs
from planner.problem.tasks.flight import BENT, check_flight, phases_of_jumps
from planner.problem.tasks.gait import Gait, gait_of, with_feet_of
from planner.problem.tasks.goal import Follow, Goal, follow_of, goal_of, recorded_duration, with_points
from planner.problem.tasks.pose_constraints import PoseConstraints
from planner.problem.tasks.poses import Poses, is_screws, poses_of, stored_poses
from planner.problem.tasks.reference_motion import (
    closed_chain_reference,
    controls,
    joint_displacement,
    reference_states,
    resting,
    with_via_poses,
)
from planner.problem.tasks.timed_task import Task, task_of
from planner.solvers.waypoints import WAYPOINTS, dated_by_way, dated_evenly, undated_waypoints

MAX_GOALS = 1000  # goals
_OF_GOALS = ("final_position", "hold")  # weights of an end in joints, which a task's goals take the place of


class ResolvedTask(NamedTuple):
    """A task and the poses on its way."""

    task: Task
    poses: Poses
    rows: np.ndarray  # (N+1, nx) the states of the motion through them
    apart: AvoidanceConstraint | None  # What is kept apart
    waypoints: tuple[int, ...] = ()  # goals whose share of the duration was chosen
    gait: str = ""  # Sentence about the gait that the rows are; "" for none
    stances: tuple[Stance, ...] = ()  # What the gait asks of feet
    stands: bool = False  # Whether positions refer to the rows all the time: a machine on feet that stay, or a gait


def is_task(table: dict[str, Any], mechanism: Mechanism) -> bool:
    """Whether a table has goals of frames, goals at times or paths, rather than one state to end in."""
    goal = table.get("goal")
    if "follow" in table or (isinstance(goal, list) and any(isinstance(part, (dict, Goal)) for part in goal)):
        return True
    if not isinstance(goal, dict):
        return False
    return bool({"frame", "joints"} & set(goal)) and not set(goal) & set(mechanism.joint_names)


def with_tasks(table: dict[str, Any], mechanism: Mechanism) -> dict[str, Any]:
    """The table with its goals and paths checked, as lists of tables.

    Raises:
        PlannerError: One of them is wrong.
    """
    goals, follows = table.get("goal", []), table.get("follow", [])
    goals = [goals] if isinstance(goals, (dict, Goal)) else goals
    follows = follows if isinstance(follows, list) else [follows]
    if not isinstance(goals, list) or len(goals) > MAX_GOALS:
        keys = ", ".join(GOAL)
        raise PlannerError(
            f"goal is {short_repr(goals)} beside follow, expected at most {MAX_GOALS} tables [[goal]] of: {keys}."
        )
    checked = [goal_of(goal, f"goal {k}") for k, goal in enumerate(goals, 1)]
    paths = [follow_of(path, "follow") for path in follows]
    table = {name: value for name, value in table.items() if name not in ("goal", "follow")}
    if not checked and not paths:
        raise PlannerError("there is neither a goal nor a path, expected a table [[goal]] or [follow].")
    for kind, found in (("goal", checked), ("follow", paths)):
        if found:
            table[kind] = [one.to_dict() for one in found]
    return table


def with_files(table: dict[str, Any], folder: Path, mechanism: Mechanism) -> dict[str, Any]:
    """The table of a file with the rows of the recordings that its paths name."""
    given = table.get("follow")
    joints, actuators = (
        [name for name in names if name] for names in (mechanism.joint_names, mechanism.actuators.names)
    )
    read = partial(with_points, folder=folder, joints=joints, actuators=actuators)
    if isinstance(given, dict):
        return table | {"follow": read(given)}
    if isinstance(given, list):
        return table | {"follow": [read(path) if isinstance(path, dict) else path for path in given]}
    return table


def with_recorded_duration(table: dict[str, Any], folder: Path) -> dict[str, Any]:
    """The table of a file, without a duration that of the longest recording that its paths name."""
    if "duration" in table or "durations" in table:
        return table
    given = table.get("follow", [])
    tables = [one for one in (given if isinstance(given, list) else [given]) if isinstance(one, dict)]
    ends = [end for one in tables if (end := recorded_duration(one, folder)) is not None]
    return table | {"duration": max(ends)} if ends else table


def resolve_task(
    table: dict[str, Any], dynamics: RigidBodyDynamics, x0: np.ndarray, N: int, limits: Limits | None,
    avoid: Avoid | None = None, constraints: Sequence[Constraint] = (), stored: np.ndarray | None = None,
) -> ResolvedTask:  # fmt: skip
    """The task of a table and its poses; those of a stored plan are not refused again, nor sought if they are `stored`.

    Raises:
        PlannerError: What cannot be meant, or not be reached, or only in collision or against a constraint.
    """
    objective = table.get("objective", {})
    goals = [goal_of(goal, f"goal {k}") for k, goal in enumerate(table.get("goal", []), 1)]
    goals = whole_poses_on_ground(dynamics.mechanism, table, goals)
    follows = [Follow(**path) for path in table.get("follow", [])]
    if "time" in objective and (follows or any(goal.time is not None for goal in goals)):
        raise PlannerError(
            "the objective has time, which changes the duration, and goals have times of their own: expected "
            "through = true without a time, a share of the duration, or another objective."
        )
    waypoints = undated_waypoints(goals)
    ranges = np.tile([-np.inf, np.inf], (dynamics.mechanism.nv, 1))
    if limits is not None:
        ranges = limits.position_ranges(dynamics)
    kept = PoseConstraints(constraints, dynamics, x0, N) if constraints else None
    steps = steps_of(table, dynamics.mechanism)
    stepping = steps.stepping_links(dynamics.mechanism, x0) if steps is not None else frozenset()
    poses_for = partial(poses_of, seed=table["seed"], check=RESOLVED not in table, constraints=kept, steps=stepping)
    task_from = partial(task_of, dynamics.mechanism, follows=follows, N=N, dt=dynamics.dt, tolerance=table["tolerance"])
    if waypoints:
        evenly = task_from(dated_evenly(goals, waypoints, N))
        goals = dated_by_way(evenly, waypoints, poses_for(evenly, dynamics, x0, ranges))
    task = task_from(goals)
    search = partial(poses_for, task, dynamics, x0, ranges)
    poses, apart = None if stored is None else stored_poses(stored, task), None
    if avoid is None:
        poses = poses or search()
    else:
        free = partial(CollisionChecker, mechanism=dynamics.mechanism)
        found = poses or search(checker=free(avoid.constraint(dynamics.mechanism, x0).constraint.of))
        apart = avoid.constraint(dynamics.mechanism, x0, _of_goals(task, found))  # they are known now
        through = poses is None and not _is_direct(task) and is_screws(task)
        poses = with_via_poses(found, free(apart.constraint.of), table["seed"]) if through else found
    if RESOLVED not in table:
        check_flight(task, poses, dynamics, ranges)
    stands = steps is not None or _stands_all_along(table, task, poses)
    rows = _rested(poses, task, x0) if stands else reference_states(task, poses, x0)
    if steps is None:
        return ResolvedTask(task, poses, rows, apart, waypoints, stands=stands)
    rows, said, stances = steps.motion(dynamics.mechanism, rows, dynamics.dt, ranges, _is_direct(task))
    return ResolvedTask(task, poses, rows, apart, waypoints, said, stances, stands)


def _rested(poses: Poses, task: Task, x0: np.ndarray) -> np.ndarray:
    """The states (N+1, nx) of the motion through poses that is at rest for a while at the end."""
    return reference_states(task, resting(poses, 1.0 - MOVING_SHARE), x0)


def _stands_all_along(table: dict[str, Any], task: Task, poses: Poses) -> bool:
    """Whether a machine stands, at the end at rest, on feet that stay where they are: its poses keep its balance."""
    asked = bool(task.follows) or "position" in table["weights"]
    stands = task.rests and not asked and stands_somewhere(task.mechanism, poses.q)
    return stands and not feet_move(task.mechanism, poses.q)


def steps_of(table: dict[str, Any], mechanism: Mechanism | None = None) -> Gait | None:
    """Which feet swing when: the gait of a table, or its phases; None where it says nothing about it.

    Without a machine feet have the names that the table has.
    """
    given = [key for key in ("gait", "phase") if key in table]
    if len(given) > 1:
        raise PlannerError("there are gait and [[phase]], expected one of them: both say which feet swing when.")
    gait = gait_of(table[given[0]]) if given else None
    return gait if gait is None or mechanism is None else with_feet_of(gait, mechanism)


def _of_goals(task: Task, poses: Poses) -> dict[str, np.ndarray]:
    """The poses at which there are goals, by the goals' names. Points of a path are not goals."""
    found = {}
    for stage, q in zip(poses.stages, poses.q, strict=True):
        if here := [one for one in task.goals if one.stage == stage]:
            best_pose = "the best pose that was found for " if any(one.goal.frame for one in here) else ""
            found[best_pose + " and ".join(one.label for one in here)] = q
    return found


def weights_of(
    table: dict[str, Any], dynamics: RigidBodyDynamics, x0: np.ndarray, way: ResolvedTask, limits: Limits | None
) -> DefaultWeights:
    """The default weights along the poses, by the controls' own limits; ends are weighed by the goals."""
    bounds = None if limits is None else limits.bounds(dynamics, way.task.N)
    most = None if bounds is None else np.maximum(np.abs(bounds.lower), np.abs(bounds.upper)).max(axis=0)
    rests = way.task.rests and not way.task.follows and "position" not in table["weights"]
    there = path_lengths(dynamics, way.rows) if way.gait else joint_displacement(way.task, way.poses)
    named, jerk = "objective" in table, table.get("objective", {}).get("jerk", 0.0)
    found = default_weights(
        dynamics,
        x0,
        way.rows[-1],
        table["duration"],
        named=named,
        stays=way.stands,
        displacement=there,
        max_control=most,
        jerk=jerk,
        way=way.poses.q if rests else None,
        last_share=float(np.diff(way.poses.stages)[-1] / way.task.N),
    )
    left = () if "rest" in found.weights or way.stands else _OF_GOALS
    weights = {name: weight for name, weight in found.weights.items() if name not in left}
    reasons = {name: reason for name, reason in found.reasons.items() if name not in left}
    if jerk:
        weights["goal"] = np.array(WEIGHT * max(1.0, jerk * min_jerk_cost(there, table["duration"])))
    if "rest" in weights and np.any(rolls := rolling_dofs(dynamics.mechanism, x0[: dynamics.mechanism.nq])):
        # A vehicle gets to where it is asked to be by steering: the pose there is not known before.
        weights |= {"position": np.where(rolls, 0.0, weights["position"]), "goal": np.array(WEIGHT)}
        reasons["position"] += "; none of a vehicle along the ground, for which its goals have weights"
    return walking_weights(DefaultWeights(weights, reasons)) if way.stands else DefaultWeights(weights, reasons)


def walking_weights(found: DefaultWeights) -> DefaultWeights:
    """The default weights where positions refer to a gait, or to the motion of the poses: all the time."""
    weights = {name: weight for name, weight in found.weights.items() if name != "rest"}
    reasons = {name: reason for name, reason in found.reasons.items() if name != "rest"}
    words = f"1 / ({STANCE_TOLERANCES:g} tolerances)^2 from the motion through its poses, of its feet too"
    return DefaultWeights(weights, reasons | {"position": words})


def path_lengths(dynamics: RigidBodyDynamics, rows: np.ndarray) -> np.ndarray:
    """(nv,) the way of each degree of freedom along states (N+1, nx), rad or m."""
    return np.abs(dynamics.space.difference(rows[1:], rows[:-1])).sum(axis=0)[: dynamics.mechanism.nv]


def cost_of(
    way: ResolvedTask, dynamics: RigidBodyDynamics, weights: dict[str, Any]
) -> tuple[Cost, tuple[GoalSpec, ...]]:
    """The cost of a task and what its proof judges."""
    if way.gait:
        weights = along_gait(dynamics, way.rows, weights)
    elif way.stands:
        weights = weights | {"reference": way.rows}
    return task_cost(way.task, dynamics, way.rows, weights), task_goal_specs(way.task, way.rows[0])


def guess_of(way: ResolvedTask, dynamics: RigidBodyDynamics, x0: np.ndarray) -> ReferenceTrajectory:
    """What the first controls may be made of."""
    mechanism = dynamics.mechanism
    if way.gait:
        return ReferenceTrajectory(None, way.rows, _is_direct(way.task), walks=True)
    if mechanism.has_closed_chains:
        found = closed_chain_reference(mechanism, x0, way.poses.stages, way.poses.q, way.poses.at_rest, dynamics.dt)
        if found is not None:
            return ReferenceTrajectory(
                None if dynamics.prescribed else found.controls, found.states, _is_direct(way.task)
            )
    return ReferenceTrajectory(controls(way.task, way.poses, dynamics, x0), way.rows, _is_direct(way.task))


def with_jumps(
    way: ResolvedTask, problem: Problem, table: dict[str, Any], limits: Limits | None
) -> tuple[Problem, np.ndarray] | None:  # fmt: skip
    """The problem with the cost of a motion that has the task's jumps, and its states (N+1, nx); None without jumps.

    Where a machine stands hardly a gradient leads off the ground. This motion is in the air.
    """
    if way.gait or table["guess"] != "auto":
        return None
    dynamics, task = problem.dynamics, way.task
    assert isinstance(dynamics, RigidBodyDynamics)  # of a file's problem
    ranges, moves = (limits or Limits(position="off")).position_ranges(dynamics), None
    for bent in BENT:
        phases = phases_of_jumps(task, way.poses, dynamics, ranges, bent)
        if not phases:
            return None
        rested = _rested(way.poses, task, problem.x0)
        try:
            moves = gait_of(phases).motion(task.mechanism, rested, dynamics.dt, ranges, _is_direct(task))
            break
        except PlannerError:  # its legs do not reach: they have to be more bent
            continue
    if moves is None:
        return None
    rows, said, _ = moves
    flying = way._replace(rows=rows, gait=said, stands=True)
    weights = weights_of(table, dynamics, problem.x0, flying, limits).weights | table["weights"]
    return replace(problem, cost=cost_of(flying, dynamics, weights)[0]), rows


def _is_direct(task: Task) -> bool:
    """Whether its end alone is asked for."""
    return not task.follows and all(one.last for one in task.goals)


def check_task_departure(x0: np.ndarray, wanted: tuple[GoalSpec, ...], task: Task) -> None:
    """Refuse a task that doing nothing solves, unless its goals are at the start exactly: then to stay is the task."""
    asked = [one for one in wanted if one.tolerance is not None]
    if task.follows or any(static_error(one, x0) > (one.tolerance or 0.0) for one in asked):
        return
    ways = {one.name: static_error(one, x0) for one in asked}
    worst = max(asked, key=lambda one: ways[one.name] / (one.tolerance or 1.0))
    if ways[worst.name] > ROUNDING:
        raise PlannerError(
            f"the start is already within the tolerance of every goal (the farthest, {worst.name}, is "
            f"{ways[worst.name]:.3g} {worst.unit} away, and {worst.tolerance:g} pass), expected a smaller tolerance, "
            "or another goal: a plan that does nothing would pass."
        )


def with_resolved(
    table: dict[str, Any], dynamics: RigidBodyDynamics, x0: np.ndarray, goal: np.ndarray, reasons: dict[str, str],
    way: ResolvedTask | None, limits: Limits | None, paths: np.ndarray | None, ramp: float | None,
) -> dict[str, Any]:  # fmt: skip
    """The table with what was chosen by itself: weights and their reasons. A stored plan has them already.

    `paths`: (nv,) rad or m, the way of each degree of freedom where feet step and no task says more; else None.
    """
    if RESOLVED in table:
        return table
    given = table["weights"]
    if way is not None:
        default = weights_of(table, dynamics, x0, way, limits)
    else:
        default = default_weights(
            dynamics, x0, goal, table["duration"], tolerance=table["tolerance"], named="objective" in table,
            stays="position" not in given, jerk=table.get("objective", {}).get("jerk", 0.0),
            displacement=paths, carried_along=carried_along(table["goal"], dynamics),
        )  # fmt: skip
        default = default if paths is None else walking_weights(default)
    filled = {name: weight.tolist() for name, weight in default.weights.items() if name not in given}
    reasons = reasons | {name: reason for name, reason in default.reasons.items() if name not in given}
    waypoints = {} if way is None or not way.waypoints else {WAYPOINTS: list(way.waypoints)}
    ramps = {} if ramp is None else {RAMP: ramp}
    return table | {RESOLVED: {"weights": {**filled, **given}, "reasons": reasons, **waypoints, **ramps}}


def resolved_defaults(parameters: Mapping[str, Any]) -> dict[str, str]:
    """A sentence for each thing that was chosen by itself, by its key; none for plans without a problem file."""
    resolved = parameters.get(RESOLVED, {})
    weights, reasons = resolved.get("weights", {}), resolved.get("reasons", {})
    return {
        f"weights.{name}" if name in weights else name: f"{_values(weights.get(name))}{reason}"
        for name, reason in reasons.items()
    }


def _values(weight: Any) -> str:
    """The range of the numbers of a weight, and ": "."""
    numbers = np.atleast_1d(np.asarray(weight, dtype=float)) if isinstance(weight, (list, float, int)) else np.empty(0)
    if not numbers.size or not np.any(numbers):
        return ""
    low, high = numbers.min(), numbers.max()
    return f"{low:.3g}: " if low == high else f"{low:.3g} to {high:.3g}: "
