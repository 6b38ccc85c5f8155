"""The cost of a task, and its goals: one error for each, in m, rad or m/s, at its time.

Goals at the end have no weight of their own where the machine rests there (weights `rest`, or a gait): their pose has.
A goal has the weight WEIGHT / tolerance^2 on its squared error / 2 at its stage, so that an error of the tolerance
costs more than the whole effort. A path has PATH_RATE times that weight. Unless a goal is a via point, velocities of
the joints that move the frame have a weight there, which rises with that of the goal.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from planner.base.arguments import number
from planner.dynamics import RigidBodyDynamics
from planner.dynamics.inverse_kinematics import Target
from planner.dynamics.kinematics import frame_pose, jacobian
from planner.kernels.tree.mechanism_table import chain_of
from planner.model.capabilities import ballistic_dofs, rolling_radii
from planner.model.coordinates import coordinates_of_mechanism
from planner.model.mechanism import Mechanism
from planner.problem.costs.frame import FrameCost
from planner.problem.costs.terms import GoalSpec, SumCost, where_finite
from planner.problem.costs.tracking import TrackingCost
from planner.problem.default_weights import VELOCITY, servos_of
from planner.problem.goals import MIN_TOLERANCES
from planner.problem.reaching_cost import servo_reference, staying_cost, with_slip
from planner.problem.tasks.goal import Follow
from planner.problem.tasks.timed_task import DEFAULT_TOLERANCES, Task, TimedGoal, unit_of

WEIGHT = 4.0  # in 1 / tolerance^2
PATH_RATE = 25.0  # 1/s, weight of a path relative to a goal


def task_cost(
    task: Task, dynamics: RigidBodyDynamics, reference: np.ndarray, weights: dict[str, Any]
) -> TrackingCost | SumCost:
    """The cost of a task.

    Args:
        task: Goals and paths.
        dynamics: The machine.
        reference: (N+1, nx) the states through its poses, at rest at the end.
        weights: Arguments of TrackingCost.joints, `goal` in place of WEIGHT, hold, rest and slip. Their reference is
            that of the positions' poses, at rest, unless it is given.
    """
    mechanism, N = task.mechanism, task.N
    weights = dict(weights)
    given, (hold, rest, slip) = weights.pop("goal", None), (weights.pop(name, 0.0) for name in ("hold", "rest", "slip"))
    factor = number("weights.goal", WEIGHT if given is None else given, greater_than=0.0)
    posed = bool(rest) or "reference" in weights  # the goals' pose has weights before and after the end
    last_factor = 0.0 if posed and given is None else factor
    if not task.rests:
        weights["final_velocity"] = 0.0
    at_rest = mechanism.at_rest(reference)
    if "control" not in weights and servos_of(dynamics).any():
        weights["control"] = servo_reference(dynamics, reference)
    weights.setdefault("reference", at_rest)
    base = TrackingCost.joints(dynamics, at_rest[N], N, **weights)
    base = staying_cost(dynamics, base, hold, rest)
    Q, x_ref = base.Q.copy(), base.x_ref.copy()
    terms: list[Any] = []
    for one in task.goals:
        weight = last_factor if one.last else factor
        for dof, value in one.joints.items():
            Q[one.stage, dof, dof] += weight / one.tolerances[_part(unit_of(mechanism, dof))] ** 2
            x_ref[one.stage, mechanism.q_address[dof]] = value
        if not (one.goal.through or one.last):
            strict = factor / WEIGHT * (DEFAULT_TOLERANCES["velocity"] / one.tolerances["velocity"]) ** 2
            for dof in _moving_dofs(mechanism, one):
                i = mechanism.nv + dof
                Q[one.stage, i, i] += strict * VELOCITY / MIN_TOLERANCES[f"{unit_of(mechanism, dof)}/s"] ** 2
        if one.goal.frame is not None and weight > 0.0:
            terms.append(_of_frame(task, one, weight))
    for path in task.follows:
        terms += _of_path(task, path, factor, Q, x_ref)
    tracking = TrackingCost(Q, base.R, x_ref, base.u_ref, base.space)
    states = reference[[0, *(one.stage for one in task.goals), N]]
    return with_slip(SumCost(tracking, *terms) if terms else tracking, dynamics, slip, states)


def task_goal_specs(task: Task, x0: np.ndarray) -> tuple[GoalSpec, ...]:
    """The goals for the proof: every goal and path, and rest at the end, of all that something can stop from x0."""
    mechanism, found = task.mechanism, []
    coordinates = coordinates_of_mechanism(mechanism)
    for one in task.goals:
        at_end = one.last and one.time >= task.duration * (1.0 - 1e-9)
        times, tolerances, goal = None if at_end else (one.time,), one.tolerances, one.goal
        for dof, value in one.joints.items():
            name, unit = coordinates[dof]
            error = partial(_joint_error, np.array([mechanism.q_address[dof]]), np.array([[value]]))
            found.append(GoalSpec(name + one.when, unit, error, times, tolerances[_part(unit)]))
        if goal.frame is None:
            continue
        position = None if goal.position is None else np.asarray(goal.position, dtype=float)
        targets = {"position": position, "orientation": goal.quaternion, "pointing": goal.direction}
        for part, value in targets.items():
            if value is not None:
                error = partial(_frame_error, mechanism, Target(goal.frame, **{part: value}))
                unit = "m" if part == "position" else "rad"
                found.append(GoalSpec(f"{part} of {goal.frame}{one.when}", unit, error, times, tolerances[part]))
        if not (goal.through or one.last):
            error = partial(_speed, mechanism, goal.frame)
            found.append(GoalSpec(f"speed of {goal.frame}{one.when}", "m/s", error, times, tolerances["velocity"]))
    for path in task.follows:
        at = task.judged_times(path)
        points, times = path.at(at, task.duration), tuple(at.tolist())
        if path.frame is not None:
            error = partial(_path_error, mechanism, path.frame, points)
            found.append(GoalSpec(f"path of {path.what}", "m", error, times, task.tolerance(path)))
            continue
        for k, name in enumerate(path.joints):  # each in its own unit
            error = partial(_joint_error, mechanism.q_address[[mechanism.joint(name).start]], points[:, [k]])
            found.append(GoalSpec(f"path of {name}", task.units(path)[k], error, times, task.tolerance(path)))
    if task.rests:
        nv, states = mechanism.nv, mechanism.velocities
        stopped = np.flatnonzero(~ballistic_dofs(mechanism, x0))
        radii = rolling_radii(mechanism)
        for i in stopped:
            name, unit = coordinates[nv + i]
            # A wheel is at rest where its rim is, as the machine on it.
            name, unit, size = (f"{name} at its rim", "m/s", radii[i]) if radii[i] > 0.0 else (name, unit, 1.0)
            found.append(GoalSpec(name, unit, partial(_abs_velocity, states.start + int(i), size)))
    return tuple(found)


def _of_frame(task: Task, one: TimedGoal, factor: float) -> FrameCost:
    """The term of a goal of a frame."""
    goal, at = one.goal, dict[str, Any]()
    for part, target in (("position", goal.position), ("orientation", goal.quaternion), ("pointing", goal.direction)):
        if target is not None:
            at |= {part: target, **_at_stage(task, one, f"{part}_weight", factor / one.tolerances[part] ** 2)}
    return FrameCost(task.mechanism, str(goal.frame), dt=task.dt, **at)


def _at_stage(task: Task, one: TimedGoal, name: str, weight: float) -> dict[str, Any]:
    """Arguments of FrameCost for a weight at one stage."""
    if one.last:
        return {f"final_{name}": weight}
    rows = np.zeros((task.N + 1, 3))
    rows[one.stage] = weight / task.dt  # running weights are multiplied by dt
    return {name: rows, f"final_{name}": 0.0}


def _of_path(task: Task, path: Follow, factor: float, Q: np.ndarray, x_ref: np.ndarray) -> list[Any]:
    """The terms of a path; one of joints goes into the weights Q (N+1, ndx, ndx) and their reference."""
    mechanism, (first, last) = task.mechanism, task.span(path)
    weight = factor / task.tolerance(path) ** 2 * PATH_RATE
    stages = np.arange(first, last + 1)
    points = task.positions_at(path, np.arange(task.N + 1))
    if path.frame is None:
        for k, name in enumerate(path.joints):
            dof = mechanism.joint(name).start
            Q[stages, dof, dof] += task.dt * weight
            x_ref[stages, mechanism.q_address[dof]] = points[stages, k]
        return []
    rows = np.zeros((task.N + 1, 3))
    rows[stages] = weight
    final = task.dt * weight if last == task.N else 0.0
    weighed = {"position_weight": rows, "final_position_weight": final}
    return [FrameCost(mechanism, path.frame, position=points, dt=task.dt, **weighed)]


def _part(unit: str) -> str:
    """The tolerance of a goal that joints have, by their unit."""
    return "position" if unit == "m" else "orientation"


def _moving_dofs(mechanism: Mechanism, one: TimedGoal) -> list[int]:
    """The degrees of freedom that move a goal's frame, or its joints."""
    if one.goal.frame is None:
        return list(one.joints)
    return chain_of(mechanism.parent, mechanism.frame(one.goal.frame).link)


def _joint_error(addresses: np.ndarray, points: np.ndarray, xs: np.ndarray) -> np.ndarray:
    """(K,) max difference of joint positions from points (1 or K, n), rad or m."""
    return np.abs(xs[:, addresses] - points).max(axis=1)


def _abs_velocity(address: int, size: float, xs: np.ndarray) -> np.ndarray:
    return size * np.abs(xs[:, address])


def _frame_error(mechanism: Mechanism, target: Target, xs: np.ndarray) -> np.ndarray:
    """(K,) errors of a frame from the one part of a target, m or rad, as in inverse_kinematics.residuals."""

    def error_of(finite: np.ndarray) -> np.ndarray:
        T = frame_pose(mechanism, xs[finite, : mechanism.nq], target.frame)
        if target.position is not None:
            return np.linalg.norm(T[:, :3, 3] - target.position, axis=1)
        if target.orientation is not None:
            from scipy.spatial.transform import Rotation  # 0.4 s that `planner run` need not pay

            reference = Rotation.from_quat(target.orientation[[1, 2, 3, 0]]).as_matrix()
            return Rotation.from_matrix(reference.T @ T[:, :3, :3]).magnitude()
        assert target.pointing is not None
        axis, direction = target.pointing
        chord = np.linalg.norm(T[:, :3, :3] @ axis - direction, axis=1)
        return 2.0 * np.arcsin(np.minimum(0.5 * chord, 1.0))

    return where_finite(xs, error_of)


def _path_error(mechanism: Mechanism, frame: str, points: np.ndarray, xs: np.ndarray) -> np.ndarray:
    def error_of(finite: np.ndarray) -> np.ndarray:
        here = frame_pose(mechanism, xs[finite, : mechanism.nq], frame)[:, :3, 3]
        return np.linalg.norm(here - points[finite], axis=1)

    return where_finite(xs, error_of)


def _speed(mechanism: Mechanism, frame: str, xs: np.ndarray) -> np.ndarray:
    def error_of(finite: np.ndarray) -> np.ndarray:
        J = jacobian(mechanism, xs[finite, : mechanism.nq], frame)[:, :3]
        return np.linalg.norm(np.einsum("kai,ki->ka", J, xs[finite, mechanism.velocities]), axis=1)

    return where_finite(xs, error_of)
