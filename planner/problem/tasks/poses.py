"""Poses of a task: a configuration at each of its times, by inverse kinematics; unreachable goals are refused."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from planner.base.arguments import array
from planner.base.errors import PlannerError
from planner.dynamics import RigidBodyDynamics
from planner.dynamics.assembly import assembled
from planner.dynamics.inverse_kinematics import Target, inverse_kinematics, residuals
from planner.dynamics.kinematics import frame_pose
from planner.dynamics.statics import static_equilibrium
from planner.model.capabilities import unreached_dofs
from planner.model.mechanism import SCREW, Frame
from planner.model.mjcf.prescribed_joints import prescribed_dofs_of
from planner.problem.collision_free_path import CollisionChecker
from planner.problem.tasks.goal import Follow
from planner.problem.tasks.pose_constraints import (
    FOOT_SCALE,
    Feet,
    PoseConstraints,
    ResidualAndJacobian,
    both,
    carried_stance,
    feet_of,
    kept_center_of_mass,
)
from planner.problem.tasks.timed_task import Task, TimedGoal, unit_of

MAX_CONFIGURATIONS = 60  # along a path; joints follow a spline between them
PATH_STARTS = 2  # number of starts of inverse kinematics on a path with constraints, the first at the previous pose


class Poses(NamedTuple):
    """Configurations at stages, the first of them the start."""

    stages: np.ndarray  # (E,)
    q: np.ndarray  # (E, nq)
    at_rest: np.ndarray  # (E,) bool

    @property
    def table(self) -> np.ndarray:
        """(E, 2 + nq) float: stage, whether at rest, configuration."""
        return np.column_stack([self.stages, self.at_rest, self.q]).astype(float)


class _Search(NamedTuple):
    """The arguments of poses_of."""

    dynamics: RigidBodyDynamics
    ranges: np.ndarray
    seed: int
    check: bool
    checker: CollisionChecker | None
    constraints: PoseConstraints | None
    feet: Feet | None
    start: np.ndarray
    steps: frozenset[int]
    kept_center: ResidualAndJacobian | None  # of a machine that nothing pushes from outside


class _Way(NamedTuple):
    """How inverse kinematics may meet targets."""

    mask: np.ndarray  # (nv,) bool, degrees of freedom that may move
    fixed: ResidualAndJacobian | None  # what keeps feet on the ground, or the centre of mass of what floats
    begin: np.ndarray  # (nq,) the configuration from which it searches


class StageTargets(NamedTuple):
    """Goals at one stage."""

    targets: list[Target]
    labels: list[str]
    joints: dict[int, float]  # positions by degree of freedom


def poses_of(
    task: Task, dynamics: RigidBodyDynamics, x0: np.ndarray, ranges: np.ndarray, seed: int = 0, check: bool = True,
    checker: CollisionChecker | None = None, constraints: PoseConstraints | None = None,
    steps: frozenset[int] = frozenset(),
) -> Poses:  # fmt: skip
    """The configurations of a task, each found from the previous one.

    Args:
        task: Goals and paths.
        dynamics: The machine. Where a goal moves a foot of it, it stands on the others. Else a machine that steps is
            carried along the ground with its stance. Else, or where its legs do not meet the goal from there,
            unactuated joints move only if the actuated ones do not reach it: feet stay where the start has them, or if
            that is too near stand elsewhere, or leave the ground at a via point.
        x0: (nx,) start.
        ranges: (nv, 2) rad or m, of hinges and slides.
        seed: Of the random starts of inverse kinematics.
        check: Whether to refuse unreachable goals.
        checker: Collision checker; None for no avoidance.
        constraints: On poses; None for none.
        steps: Links of the feet that step, of a gait or of phases; by default none.

    Raises:
        PlannerError: An unreachable goal, goals that contradict each other or a constraint, or a path from t = 0 that
            does not begin at the start.
    """
    mechanism = task.mechanism
    q = x0[: mechanism.nq]
    feet, kept = feet_of(mechanism, q), kept_center_of_mass(dynamics, x0)
    search = _Search(dynamics, ranges, seed, check, checker, constraints, feet, q, steps, kept)
    stages, found, at_rest = [0], [q], [not np.any(x0[mechanism.velocities])]
    if check:
        for path in task.follows:
            _check_path_start(task, path, q)
    for stage in _stages(task):
        here = [one for one in task.goals if one.stage == stage]
        if check and stage < task.N:  # the limits check the end
            _check_joints(task, here, ranges)
        asked = stage_targets(task, stage, here)
        q = _pose(task, search, q, asked, stage, here)
        stages.append(stage)
        found.append(q)
        at_rest.append(any(not one.goal.through for one in here) if stage < task.N else task.rests)
    if stages[-1] < task.N:  # no goal at the end but rest
        stages, found, at_rest = [*stages, task.N], [*found, q], [*at_rest, task.rests]
    return Poses(np.array(stages), np.array(found), np.array(at_rest))


def stored_poses(table: np.ndarray, task: Task) -> Poses:
    """The poses of a task, from Poses.table.

    Raises:
        PlannerError: They are not of this task.
    """
    table = array("the table of the plan's poses", table, ("E", 2 + task.mechanism.nq))
    stages = table[:, 0]
    if not len(stages) or stages[[0, -1]].tolist() != [0, task.N] or np.any(np.diff(stages) < 1) or np.any(stages % 1):
        raise PlannerError(f"the plan's poses are not at stages that rise from 0 to {task.N}.")
    if missing := sorted(set(_stages(task)).difference(stages.tolist())):
        raise PlannerError(
            f"the plan's poses have none at stage {missing[0]}, expected one at each goal and along paths."
        )
    return Poses(stages.astype(int), table[:, 2:], table[:, 1] != 0.0)


def _check_joints(task: Task, here: Sequence[TimedGoal], ranges: np.ndarray) -> None:
    """Refuse goals of joints outside of their ranges."""
    for one in here:
        for dof, value in one.joints.items():
            low, high = ranges[dof]
            if not low <= value <= high:
                raise PlannerError(
                    f"{one.label} has {task.mechanism.joint_of(dof)} at {value:g}, outside of its range: expected "
                    f"{low:.6g} ... {high:.6g}."
                )


def _stages(task: Task) -> list[int]:
    """Stages with goals and, per path, at most MAX_CONFIGURATIONS intervals; without stage 0."""
    stages = {one.stage for one in task.goals}
    for path in task.follows:
        first, last = task.span(path)
        stages |= set(np.linspace(first, last, min(last - first, MAX_CONFIGURATIONS) + 1).round().astype(int).tolist())
    return sorted(stages - {0})


def stage_targets(task: Task, stage: int, here: Sequence[TimedGoal]) -> StageTargets:
    """What goals `here` and paths ask for at a stage.

    Raises:
        PlannerError: Goals that contradict each other.
    """
    targets, labels, joints = [], [], {}
    for one in here:
        goal = one.goal
        for dof, value in one.joints.items():
            if abs(joints.setdefault(dof, value) - value) > 1e-9:
                name = task.mechanism.joint_of(dof)
                both = f"{name} is at {joints[dof]:g} and {value:g}"
                raise PlannerError(f"{one.label} contradicts a goal at the same time: {both}, expected one of them.")
        if goal.frame is not None:
            position = None if goal.position is None else np.asarray(goal.position, dtype=float)
            angle = one.tolerances["pointing" if goal.orientation is None else "orientation"]
            targets.append(
                Target(goal.frame, position, goal.quaternion, goal.direction, one.tolerances["position"], angle)
            )
            labels.append(one.label)
    for path in task.follows:
        first, last = task.span(path)
        if first <= stage <= last:
            point = task.positions_at(path, np.array([stage]))[0]
            if path.frame is not None:
                targets.append(Target(path.frame, point, metre_scale=task.tolerance(path)))
                labels.append(f"the path of {path.frame} at {stage * task.dt:.4g} s")
            else:
                named = zip(path.joints, point, strict=True)
                joints |= {task.mechanism.joint(name).start: value for name, value in named}
    return StageTargets(targets, labels, joints)


def _pose(
    task: Task, search: _Search, q: np.ndarray, asked: StageTargets, stage: int, here: Sequence[TimedGoal]
) -> np.ndarray:  # fmt: skip
    """The configuration (nq,) at a stage."""
    mechanism, ranges, before = task.mechanism, search.ranges, q
    q = q.copy()
    for dof, value in asked.joints.items():
        q[mechanism.q_address[dof]] = value
    if mechanism.reduction is not None:
        q = mechanism.reduction.closed(q, np.zeros(mechanism.nv), mechanism.q_address)[0]
    if mechanism.has_closed_chains:
        x = np.concatenate([q, np.zeros(mechanism.space.nx - len(q))])
        q = assembled(mechanism, x, asked.joints)[: len(q)]
    violation = None if search.checker is None else search.checker.violation_from(before if here else None)
    missing = None if search.constraints is None else search.constraints.at(stage)
    if not asked.targets:
        if search.check and missing is not None:
            _check_constraints(task, search, q, stage, here)
        return _on_ground(task, search, q, asked, here)

    def tried(
        targets: list[Target], joints: dict[int, float], short: Callable[[np.ndarray], float] | None = None,
        missing: ResidualAndJacobian | None = None,
    ) -> tuple[np.ndarray, float]:  # fmt: skip
        found = None
        for mask, fixed, begin in _ways(search, q, targets, joints, any(one.goal.through for one in here)):
            further = both(missing, fixed) if missing is not None and fixed is not None else missing or fixed
            other = inverse_kinematics(
                mechanism, targets, begin, ranges=ranges, free=mask, seed=search.seed, short=short,
                missing=further, starts=None if here or missing is None else PATH_STARTS,
            )  # fmt: skip
            if fixed is not None:
                other = other._replace(residual=max(other.residual, float(np.abs(fixed(other.q)[0]).max())))
            found = other if found is None or other.rank < found.rank else found
            if found.residual <= 1.0:
                break
        assert found is not None
        return found.q, found.residual

    best, residual = tried(asked.targets, asked.joints, violation)
    violated = None if missing is None or search.constraints is None else search.constraints.violated(stage, best)
    if residual <= 1.0 and violated is not None and search.constraints is not None:
        other, residual = tried(asked.targets, asked.joints, violation, missing)
        if residual <= 1.0 and search.constraints.violated(stage, other) is None:
            return other
        if search.check:
            target_errors = [_errors(task, other, target) for target in asked.targets]
            over = [max(distance / target.metre_scale, angle / target.turn_scale)
                    for target, (distance, angle) in zip(asked.targets, target_errors, strict=True)]  # fmt: skip
            k = int(np.argmax(over))
            target, label, (distance, angle) = asked.targets[k], asked.labels[k], target_errors[k]
            far = distance / target.metre_scale >= angle / target.turn_scale
            away = f"{distance:.3g} m" if far else f"{angle:.3g} rad"
            raise PlannerError(
                f"{label} contradicts {violated.constraint}: where that is kept {target.frame} is at best {away} away; "
                "move the goal, or widen the constraint."
            )
    if residual <= 1.0 or not search.check:
        return best
    within = " within the ranges of the joints" if np.isfinite(ranges).any() else ""
    if search.kept_center is not None:
        within += ", since nothing pushes the machine from outside and its centre of mass stays"
    for target, label in zip(asked.targets, asked.labels, strict=True):
        if target.position is not None:
            near, alone = tried([target._replace(orientation=None, pointing=None)], {})
            if alone > 1.0:
                point = frame_pose(mechanism, near, target.frame)[:3, 3]
                words = ", ".join(f"{float(value):.4g}" for value in np.round(point, 9) + 0.0)
                away = float(np.linalg.norm(point - target.position))
                raise PlannerError(
                    f"{label} is out of reach by {away:.3g} m{within}: positions are in m, and the nearest point is "
                    f"[{words}]."
                )
        near, alone = tried([target], {})
        if alone > 1.0:
            distance, angle = _errors(task, near, target)
            raise PlannerError(
                f"{label} is out of reach{within}: {target.frame} gets to its position but not with that orientation, "
                f"at best {distance:.3g} m and {angle:.3g} rad away."
            )
    together = list(dict.fromkeys([*asked.labels, *(one.label for one in here if one.joints)]))
    if len(together) == 1:
        stands = ", and its feet cannot stand where they are or elsewhere" if search.feet is not None else ""
        raise PlannerError(
            f"{together[0]} is out of reach{within}{stands}: the pose is missed by at least {residual:.2g} tolerances."
        )
    raise PlannerError(
        f"{' and '.join(together)} contradict each other at {stage * task.dt:.4g} s{within}: together "
        f"they are missed by at least {residual:.2g} tolerances; move one, or give it another time."
    )


def _check_constraints(task: Task, search: _Search, q: np.ndarray, stage: int, here: Sequence[TimedGoal]) -> None:
    """Refuse joint goals that violate a constraint by more than their tolerances allow."""
    assert search.constraints is not None
    violated, missing = search.constraints.violated(stage, q), search.constraints.at(stage)
    if violated is None or missing is None or not here:
        return
    r, J = missing(q)
    own = np.zeros(task.mechanism.nv)
    for one in here:
        for dof in one.joints:
            own[dof] = one.tolerances["position" if unit_of(task.mechanism, dof) == "m" else "orientation"]
    others = np.any(J[:, own == 0.0] != 0.0, axis=1)  # joints without a goal may change these
    if np.any((np.abs(r) - np.abs(J) @ own > 1.0) & ~others):
        asked = " and ".join(one.label for one in here)
        raise PlannerError(f"{asked} contradicts {violated.constraint}: move the goal, or widen the constraint.")


def _errors(task: Task, q: np.ndarray, target: Target) -> tuple[float, float]:
    r, _, turns = residuals(task.mechanism, q, target)
    return float(np.linalg.norm(r[~turns])), float(np.linalg.norm(r[turns]))


def _ways(
    search: _Search, q: np.ndarray, targets: Sequence[Target], joints: dict[int, float], passed: bool
) -> list[_Way]:
    """How targets may be met from a configuration q (nq,), in the order to try it.

    Where the targets move some feet all joints move, with the other feet where they are and those elsewhere on the
    ground, or in the air and the others carrying the machine. Then, of a machine that steps, all, with its stance
    carried along. Then the actuated ones; all, with feet that stay; all, with feet elsewhere on the ground; and all
    without feet, in the air or at a via point (`passed`). All of them for closed chains, and for a machine that nothing
    pushes from outside, whose centre of mass stays. Those with a goal in `joints` are fixed, and what nothing acts on.
    """
    dynamics, mechanism = search.dynamics, search.dynamics.mechanism
    prescribed = prescribed_dofs_of(dynamics)
    actuated = np.any(mechanism.actuators.acts_on[mechanism.actuators.pushes], axis=0)
    actuated[prescribed] = True
    everything = np.ones(mechanism.nv, dtype=bool)
    feet = search.feet
    if search.kept_center is not None:
        ways = [_Way(everything, search.kept_center, q)]
    elif mechanism.has_closed_chains:
        ways = [_Way(everything, feet.fixed if feet is not None and feet.carry else None, q)]
    else:
        reached = everything if feet is None else ~unreached_dofs(mechanism, prescribed)
        ways = [_Way(actuated, None, q)]
        if feet is not None and feet.carry:
            ways.append(_Way(everything, feet.fixed, q))
            if stance := carried_stance(feet, search.steps, search.start, q, targets):
                ways.insert(0, _Way(everything, stance.feet.fixed, stance.q))
            frames = [one.frame if isinstance(one.frame, Frame) else mechanism.frame(one.frame) for one in targets]
            targeted = np.isin(feet.links, [frame.link for frame in frames])
            if targeted.any() and not targeted.all() and not passed:
                ways = [*(_Way(everything, rows(targeted), q) for rows in (feet.stepped, feet.lifted)), *ways]
        if feet is not None:
            ways.append(_Way(reached, feet.on_ground, q))
        if passed or feet is None:
            ways.append(_Way(reached, None, q))
        ways = ways[:1] if actuated.all() else ways
    others = ~np.isin(np.arange(mechanism.nv), list(joints))
    return [one._replace(mask=one.mask & others) for one in ways]


def _on_ground(
    task: Task, search: _Search, q: np.ndarray, asked: StageTargets, here: Sequence[TimedGoal]
) -> np.ndarray:  # fmt: skip
    """The pose (nq,) at rest of joints that have goals: a machine that stood stands, where the legs then carry it."""
    mechanism = task.mechanism
    if search.feet is None or not search.feet.carry or not here or any(one.goal.through for one in here):
        return q
    try:
        there = static_equilibrium(mechanism, q)[: mechanism.nq]
    except PlannerError:  # it does not balance
        return q
    asked_q = [int(mechanism.q_address[dof]) for dof in asked.joints]
    return q if np.abs(there - q)[asked_q].max(initial=0.0) > FOOT_SCALE else there


def _check_path_start(task: Task, path: Follow, q: np.ndarray) -> None:
    """Refuse a path from t = 0 whose first point is not at the start."""
    mechanism = task.mechanism
    if task.span(path)[0] > 0:
        return
    point = task.positions_at(path, np.array([0]))[0]
    if path.frame is not None:
        here = frame_pose(mechanism, q, path.frame)[:3, 3]
    else:
        here = np.array([q[mechanism.q_address[mechanism.joint(name).start]] for name in path.joints])
    away = float(np.linalg.norm(here - point))
    if away > task.tolerance(path):
        unit = task.units(path)[0]
        words = ", ".join(f"{float(value):.4g}" for value in here)
        raise PlannerError(
            f"the path of {path.what} begins at t = 0, {away:.3g} {unit} from where the start has it: expected its "
            f"first point at [{words}] {unit}, or a later first time."
        )


def is_screws(task: Task) -> bool:
    """Whether all degrees of freedom are hinges and slides."""
    return bool(np.all(task.mechanism.kind == SCREW))
