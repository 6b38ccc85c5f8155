"""The goal of a problem.toml must be away from its start, and something must be able to bring the machine there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from planner.base.errors import PlannerError
from planner.dynamics import RigidBodyDynamics
from planner.dynamics.contacts import body_contact_forces
from planner.dynamics.kinematics import center_of_mass, center_of_mass_jacobian
from planner.dynamics.protocol import rollout_states
from planner.model.capabilities import capabilities_of, unreached_dofs
from planner.model.coordinates import coordinates_of
from planner.model.mjcf.facts import overlaps
from planner.model.mjcf.prescribed_joints import prescribed_dofs_of
from planner.model.space import space_of
from planner.problem.constraints.clearance import model_index_of, pair_clearance_of
from planner.problem.costs.tracking import tracking_of
from planner.problem.goals import MIN_TOLERANCES, ROUNDING, SHARE, goals_of
from planner.problem.problem import Problem
from planner.problem.tasks.pose_constraints import undamped_floating_dofs
from planner.problem.thrust import missing_thrust

DEEP = 3.0  # times as deep as under the machine's weight: what grasps or leans is less deep in what it touches
MIN_JERK_PEAK = 1.875  # velocity of a minimum-jerk motion, over its mean


def check_goal(problem: Problem, goal: np.ndarray, durations: Sequence[float]) -> None:
    """Refuse a goal (nx,) where the machine is already, or where no control brings it in these durations, s, if any."""
    check_goal_differs(problem)
    check_goal_controllable(problem, goal[None])
    check_momentum(problem, goal)
    if durations:
        check_goal_in_time(problem, durations)


def check_goal_differs(problem: Problem) -> None:
    """Refuse a problem that doing nothing solves, unless start and goal are equal: then to stay is the task."""
    cost, x0 = tracking_of(problem.cost), problem.x0
    assert cost is not None  # a problem file has one
    way = np.abs(space_of(problem.dynamics).difference(x0, cost.x_ref[-1]))
    goals = [goal for goal in goals_of(problem) if np.isfinite(goal.tolerance)]
    if not goals or not np.any(way > ROUNDING):
        return
    ways = {goal.name: float(goal.error(x0[None])[0]) for goal in goals}
    largest = max(goals, key=lambda goal: ways[goal.name])
    if ways[largest.name] > 0.0 and all(ways[goal.name] <= goal.tolerance for goal in goals):
        raise PlannerError(
            f"the start is already within the tolerance {largest.tolerance:g} {largest.unit} of the goal (largest "
            f"difference {ways[largest.name]:.3g} at {largest.name}), expected a smaller one, e.g. "
            f"tolerance = {0.1 * ways[largest.name]:.1g}: a plan that does nothing would pass."
        )
    if ways[largest.name] == 0.0 and not np.any(np.abs(cost.Q).max(axis=(0, 1))[way > 0.0]):
        raise PlannerError("no weight is above 0 where start and goal differ, expected one: nothing would move.")


def check_goal_in_time(problem: Problem, durations: Sequence[float]) -> None:
    """Refuse a goal that limits of velocity, or the thrust of what flies, keep from in all of the durations, s."""
    longest, shortest = max(durations), min(durations)
    _check_thrust(problem, shortest)
    dynamics, cost, x0 = problem.dynamics, tracking_of(problem.cost), problem.x0
    assert isinstance(dynamics, RigidBodyDynamics)  # a problem file has them
    assert cost is not None
    if problem.limits is None:
        return
    way = dynamics.space.difference(cost.x_ref[-1], x0)
    tolerances = {goal.name: goal.tolerance for goal in goals_of(problem)}
    for i, ends in enumerate(problem.limits.velocity_ranges(dynamics)):
        name, unit = coordinates_of(dynamics)[i]
        fastest = float(ends[int(way[i] > 0.0)])
        if abs(way[i]) > abs(fastest) * longest + tolerances.get(name, np.inf):
            duration = float(f"{1.05 * MIN_JERK_PEAK * way[i] / fastest:.2g}") if fastest else np.inf
            raise PlannerError(
                f"the goal has {name} {abs(way[i]):.3g} {unit} from the start, and its velocity limit of "
                f"{abs(fastest):.3g} {unit}/s lets it go {abs(fastest) * longest:.3g} {unit} in {longest:g} s, "
                f"expected more time, e.g. duration = {duration:g}, or a higher limit."
            )


def check_goal_controllable(problem: Problem, rows: np.ndarray) -> None:
    """Refuse goals of what nothing drives and nothing but the ground touches in the plan: no control moves it.

    Args:
        problem: Of a file.
        rows: (M, nx) states at rising times up to the end in which all else is as asked; one of them is the end.
    """
    dynamics = problem.dynamics
    assert isinstance(dynamics, RigidBodyDynamics)  # a problem file has them
    space, mechanism = dynamics.space, dynamics.mechanism
    belts = tuple(one for one in mechanism.contacts if one.plane.slide >= 0)
    loose = unreached_dofs(replace(mechanism, contacts=belts), prescribed_dofs_of(dynamics))
    if not np.any(loose):
        return
    by_itself = rollout_states(dynamics, problem.x0, problem.first_guess)[-len(rows) :]
    theirs = np.concatenate([loose, loose, np.zeros(mechanism.na, dtype=bool)])
    reached = space.integrate(rows, np.where(theirs, space.difference(by_itself, rows), 0.0))
    t = problem.dynamics.dt * np.arange(problem.N + 1)[-len(rows) :]
    for goal in goals_of(problem):
        miss = goal.miss(t, reached)
        if miss > goal.tolerance:
            first = mechanism.joint_of(int(np.flatnonzero(loose)[0]))
            raise PlannerError(
                f"nothing drives or holds {first} in the plan, so that {goal.name} ends {miss:.3g} {goal.unit} from "
                "the goal whatever the controls do. If the machine is to push it, write contacts = { penetration = "
                "0.003, friction = 0.8 }: then spheres and capsules of both may touch. Else expected a goal where it "
                "gets by itself, ground under it, or a model without that joint."
            )


def deep_in_each_other(problem: Problem) -> tuple[str, ...]:
    """Sentences about what is deep in each other at the start, and at the goal."""
    return (*deep_at_start(problem), *overlap_at_goal(problem))


def deep_at_start(problem: Problem) -> tuple[str, ...]:
    """A sentence about the two bodies that are deepest in each other at the start, if they are by DEEP rest depths.

    A rest depth is that of the machine's whole weight; without gravity nothing rests. The contact throws them apart:
    the plan begins with a blow.
    """
    mechanism = capabilities_of(problem.dynamics).mechanism
    if mechanism is None or not mechanism.body_contacts:
        return ()
    load = float(np.linalg.norm(mechanism.gravity)) * float(mechanism.mass.sum())
    if load == 0.0:
        return ()
    q = problem.x0[: mechanism.nq]
    depths = body_contact_forces(mechanism, q, np.zeros(mechanism.nv)).depths
    shares = [
        depth / max(pair.law.rest_depth(load), np.finfo(float).tiny)
        for pair, depth in zip(mechanism.body_contacts, depths, strict=True)
    ]
    k = int(np.argmax(shares))
    if shares[k] < DEEP:
        return ()
    name = mechanism.body_contacts[k].name or "two bodies that may touch"
    return (f"the start has {name} {float(depths[k]):.2g} m deep in each other, and their contact throws them apart.",)


def overlap_at_goal(problem: Problem) -> tuple[str, ...]:
    """A sentence about the two shapes of the file that are deepest in each other at the goal, and not at the start.

    Less than a goal's tolerance is no matter. Where shapes are kept apart such a goal is refused.
    """
    mechanism, cost = capabilities_of(problem.dynamics).mechanism, tracking_of(problem.cost)
    if mechanism is None or cost is None or not mechanism.mjcf or problem.periodic is not None:
        return ()
    if pair_clearance_of(problem.constraints) is not None:
        return ()
    model = model_index_of(mechanism).model
    start, goal = (overlaps(model, x[: mechanism.nq]) for x in (problem.x0, cost.x_ref[-1]))
    before = {one.shapes for one in start}
    deep = [one for one in goal if one.depth > MIN_TOLERANCES["m"] and one.shapes not in before]
    if not deep:
        return ()
    return (
        f"the goal has {deep[0].shapes} {deep[0].depth:.2g} m in each other, and the proof's contact throws them "
        "apart: move one of the two, or write `avoid = {}`, which looks for another pose, or refuses the goal.",
    )


def _check_thrust(problem: Problem, shortest: float) -> None:
    """Refuse a goal whose velocities a machine in the air cannot have: its thrusters push less than it weighs.

    Its centre of mass, at a speed v upwards at the start, has at most v - (g - F / m) T after the shortest duration T,
    s, whatever the controls do. With drag nothing is refused: air may carry what moves in it.
    """
    missing, cost = missing_thrust(problem), tracking_of(problem.cost)
    mechanism = capabilities_of(problem.dynamics).mechanism
    if missing is None or mechanism is None or mechanism.drags or cost is None:
        return
    goal = cost.x_ref[-1]
    g, share = float(np.linalg.norm(mechanism.gravity)), missing.thrust / missing.weight
    begins, ends = (
        -mechanism.gravity / g @ center_of_mass_jacobian(mechanism, x[: mechanism.nq]) for x in (problem.x0, goal)
    )
    rises = float(begins @ problem.x0[mechanism.velocities])
    asked = {(one.name, one.unit): one.tolerance for one in goals_of(problem)}
    coordinates = coordinates_of(problem.dynamics)[mechanism.nv : 2 * mechanism.nv]
    tolerances = np.array([asked.get((one.name, one.unit), np.inf) for one in coordinates])
    passes = float(np.abs(ends) @ np.where(ends == 0.0, 0.0, tolerances))
    passes += SHARE * (abs(rises) + (1.0 + share) * g * shortest)  # default tolerances are of the velocity's peak
    if rises - (1.0 - share) * g * shortest < ends @ goal[mechanism.velocities] - passes:
        raise PlannerError(
            f"the thrusters push with at most {missing.thrust:.3g} N of the {missing.weight:.3g} N that the machine "
            "weighs, so that it falls, expected stronger ones, less mass, or weights without final_velocity."
        )


def check_momentum(problem: Problem, goal: np.ndarray) -> None:
    """Refuse a goal (nx,) of a base that floats at rest, without weight, whose centre of mass would have to move."""
    dynamics, x0 = problem.dynamics, problem.x0
    assert isinstance(dynamics, RigidBodyDynamics)  # a problem file has them
    mechanism = dynamics.mechanism
    asked = {one.name: one.tolerance for one in goals_of(problem)}
    names = coordinates_of(dynamics)
    floats = undamped_floating_dofs(dynamics, x0)
    slides = [i for i in np.flatnonzero(floats) if names[i].unit == "m" and names[i].name in asked]
    if not slides:
        return
    shift = center_of_mass(mechanism, goal[: mechanism.nq]) - center_of_mass(mechanism, x0[: mechanism.nq])
    J = center_of_mass_jacobian(mechanism, goal[: mechanism.nq])[:, slides]
    back = np.linalg.lstsq(J, -shift, rcond=None)[0]
    if np.any(np.abs(back) > [asked[names[i].name] for i in slides]):
        there = ", ".join(f"{names[i].name} {by:+.4g} m" for i, by in zip(slides, back, strict=True))
        raise PlannerError(
            f"the goal moves the centre of mass by {np.linalg.norm(J @ back):.3g} m, and nothing pushes the machine "
            f"from outside, expected {there} from there, or a table of joints without its base."
        )
