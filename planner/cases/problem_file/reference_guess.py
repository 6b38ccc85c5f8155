"""The first controls of a problem file: by the word that it has for them, or chosen by what they lead to.

line            the straight line in joint space, or through the poses of a task, by inverse dynamics, for machines
                whose actuators reach every joint; of closed chains the line that keeps them closed
collision-free  a path in joint space that keeps its distance from all that the problem avoids, tracked by gains
tracking        gains of a regulator that tracks that line, for any other machine
hold            the start held against gravity, as far as the actuators can
zero            no control
auto            collision-free where something is avoided and there is such a path, line where there is one, else
                tracking where that ends nearer to the goal than hold does, else hold; of a gait, or of jumps to
                goals in the air, the controls that multiple shooting finds along it
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from planner.base.errors import PlannerError
from planner.dynamics.protocol import rollout_states
from planner.dynamics.quasi_static import quasi_static_controls
from planner.dynamics.rigid_body import RigidBodyDynamics
from planner.model.space import space_of
from planner.problem.collision_free_path import collision_free_motion
from planner.problem.constraints.clearance import pair_clearance_of
from planner.problem.costs.tracking import tracking_of
from planner.problem.default_weights import servos_of
from planner.problem.initial_guess import interpolated_states, straight_line
from planner.problem.problem import Problem
from planner.problem.tasks.reference_motion import closed_chain_reference
from planner.solvers.multiple_shooting import IN_FLIGHT, controls_along
from planner.solvers.other_guesses import line_tracking_controls, tracking_controls

SHOTS = 40  # iterations along a gait: a step of 18 degrees of freedom takes 5, a walk of five steps 15, of 35 too 31
STRAYS = 0.1  # of the largest motion: from there on gains keep a guess on its way
GUESSES = ("auto", "line", "collision-free", "tracking", "hold", "zero")


class ReferenceTrajectory(NamedTuple):
    """A way in place of the straight line to a goal."""

    controls: np.ndarray | None  # (N, nu) controls along it by inverse dynamics; None where there are none
    states: np.ndarray  # (N+1, nx) its states
    direct: bool  # whether its end alone is asked for
    walks: bool = False  # whether feet swing and stand on it, so that no controls of a pose at rest follow it


def first_guess(
    problem: Problem, kind: str, goal: np.ndarray, way: ReferenceTrajectory | None = None,
    jump: tuple[Problem, np.ndarray] | None = None,
) -> np.ndarray | None:  # fmt: skip
    """Controls (N, nu) of a kind that lead towards a goal (nx,), or along a way or a jump; None for zero.

    A jump is the problem of following one, and its states (N+1, nx).

    Raises:
        PlannerError: There is no line, or the tracked rollout diverges.
    """
    if kind == "zero":
        return None
    dynamics: Any = problem.dynamics  # of a mechanism
    apart = pair_clearance_of(problem.constraints)
    direct = way is None or way.direct
    if apart is not None and direct and kind in ("collision-free", "auto") and not dynamics.prescribed:
        end = goal if way is None else way.states[-1]
        motion = collision_free_motion(apart, dynamics.mechanism, problem.x0, end, problem.duration, problem.N)
        found = None if motion is None else tracking_controls(problem, *motion)
        if found is not None:
            return found
    if kind == "collision-free":
        raise PlannerError(
            "guess is 'collision-free', expected 'auto', 'line', 'tracking', 'hold' or 'zero': no collision-free "
            "path was "
            "found; it is for machines of hinges and slides that avoid something, at rest at both ends, with actuators "
            "for every joint."
        )
    if way is None and kind in ("line", "tracking", "auto"):
        way = _closed(problem, goal)
    if kind in ("line", "auto") and not dynamics.prescribed:
        reference = _along(problem, _straight(problem, goal) if way is None else way)
        if reference is not None:
            return reference
    if kind == "line":
        raise PlannerError(
            "guess is 'line', expected 'tracking', 'hold' or 'zero': a line is for machines of hinges and slides "
            "that are at rest at both ends, whose actuators reach every joint, without contacts."
        )
    hold = np.tile(quasi_static_controls(problem.dynamics, problem.x0), (problem.N, 1))
    found = None
    if kind == "auto" and jump is not None:
        found = controls_along(*jump, _servos_along(jump[0]), SHOTS, IN_FLIGHT)
    elif kind == "auto" and way is not None and way.walks:
        found = controls_along(problem, way.states, _servos_along(problem), SHOTS)
    elif kind != "hold":
        found = line_tracking_controls(problem, goal) if way is None else tracking_controls(problem, way.states)
    if found is None and kind == "tracking":
        raise PlannerError("guess is 'tracking', expected 'hold' or 'zero': this machine diverges with the gains.")
    if found is None or (kind == "auto" and not _rollout_cost(problem, found) < _rollout_cost(problem, hold)):
        return hold
    return found


def _servos_along(problem: Problem) -> np.ndarray:
    """Controls (N, nu) with which servos go along the cost's reference; 0 of motors."""
    tracking, dynamics = tracking_of(problem.cost), problem.dynamics
    assert tracking is not None  # of a file's problem
    assert isinstance(dynamics, RigidBodyDynamics)
    return np.where(servos_of(dynamics), tracking.u_ref, 0.0)


def _closed(problem: Problem, goal: np.ndarray) -> ReferenceTrajectory | None:
    """The way to a goal (nx,) that keeps chains closed; None for machines without any, and where there is none."""
    dynamics: Any = problem.dynamics
    mechanism = dynamics.mechanism
    if not mechanism.has_closed_chains:
        return None
    poses = np.stack([problem.x0, goal])[:, : mechanism.nq]
    rest = ~np.any(np.stack([problem.x0, goal])[:, mechanism.velocities], axis=1)
    found = closed_chain_reference(mechanism, problem.x0, np.array([0, problem.N]), poses, rest, dynamics.dt)
    return None if found is None else ReferenceTrajectory(found.controls, found.states, direct=True)


def _straight(problem: Problem, goal: np.ndarray) -> ReferenceTrajectory:
    """The straight line in joint space to a goal (nx,)."""
    dynamics: Any = problem.dynamics
    straight = straight_line(dynamics.mechanism, problem.x0, goal, problem.duration, problem.N)
    rows = interpolated_states(space_of(dynamics), problem.x0, goal, problem.duration, problem.N)
    return ReferenceTrajectory(straight, rows, direct=True)


def _along(problem: Problem, way: ReferenceTrajectory) -> np.ndarray | None:
    """The controls along a way; with gains where an unstable machine leaves it, and None where there are none."""
    if way.controls is None:
        return None
    with np.errstate(all="ignore"):
        away = space_of(problem.dynamics).difference(
            rollout_states(problem.dynamics, problem.x0, way.controls), way.states
        )
    if np.abs(away).max(axis=0).max() < STRAYS * np.ptp(way.states, axis=0).max():  # false of what is not finite
        return way.controls
    return tracking_controls(problem, way.states, way.controls)


def _rollout_cost(problem: Problem, us: np.ndarray) -> float:
    """The cost of a rollout; infinite where it runs away."""
    with np.errstate(all="ignore"):
        us = us if problem.bounds is None else problem.bounds.clip(slice(None), us, None)
        cost = problem.cost.value(rollout_states(problem.dynamics, problem.x0, us), us)
    return cost if np.isfinite(cost) else np.inf
