"""The motion through the poses of a task: straight in joint space from stop to stop, on a spline where it passes.

From rest to rest between two poses it is the polynomial of fifth order; through several, the cubic spline with the
velocities at its ends. It is a first guess, no more: the solver makes the plan.
"""

from __future__ import annotations

import itertools

import numpy as np

from planner.base.errors import PlannerError
from planner.dynamics import RigidBodyDynamics
from planner.problem.collision_checker import CollisionChecker
from planner.problem.initial_guess import inverse_dynamics_controls
from planner.problem.tasks.poses import Poses, is_screws
from planner.problem.tasks.timed_task import Task

PARTS = 8  # of a way around: its inner poses are passed, with a spline between them
_EVEN = np.linspace(0.0, 1.0, 1001)
_FROM_REST = 10.0 * _EVEN**3 - 15.0 * _EVEN**4 + 6.0 * _EVEN**5


def with_via_poses(poses: Poses, free: CollisionChecker, seed: int = 0) -> Poses:
    """The poses with others between them, so that the way through all of them touches nothing.

    Stages between that have no room for more stay as they are, and so does a way that is not found: then the solver
    has to find it.
    """
    stages, found, stops = [int(poses.stages[0])], [poses.q[0]], [bool(poses.at_rest[0])]
    for k in range(1, len(poses.q)):
        a, b = int(poses.stages[k - 1]), int(poses.stages[k])
        way = free.find_path(poses.q[k - 1], poses.q[k], seed) if b - a > PARTS else None
        straight = None if way is None else way[0] + np.linspace(0.0, 1.0, len(way))[:, None] * (way[-1] - way[0])
        if way is not None and np.abs(way - straight).max() > 1e-9:
            part = np.arange(1, PARTS) / PARTS
            rests = poses.at_rest[k - 1] and poses.at_rest[k]
            when = np.interp(part, _FROM_REST, _EVEN) if rests else part
            stages += (a + np.round(when * (b - a))).astype(int).tolist()
            found += list(way[np.round(part * (len(way) - 1)).astype(int)])
            stops += [False] * len(part)
        stages.append(b)
        found.append(poses.q[k])
        stops.append(bool(poses.at_rest[k]))
    return Poses(np.array(stages), np.array(found), np.array(stops))


def interpolate(task: Task, poses: Poses, x0: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions (K, nq), velocities and accelerations (K, nv) at times t (K,), of a machine of hinges and slides."""
    from scipy.interpolate import BPoly, CubicSpline  # 0.4 s that `planner run` need not pay

    mechanism = task.mechanism
    nq = mechanism.nq
    stops = [0, *(k for k in range(1, len(poses.q) - 1) if poses.at_rest[k]), len(poses.q) - 1]
    found = np.zeros((3, len(t), nq))
    for a, b in itertools.pairwise(stops):
        at = task.dt * poses.stages[a : b + 1]
        q = poses.q[a : b + 1]
        first = x0[nq : nq + mechanism.nv] if a == 0 else np.zeros(nq)
        last = np.zeros(nq) if poses.at_rest[b] else (q[-1] - q[-2]) / (at[-1] - at[-2])
        if len(q) == 2:
            zero = np.zeros(nq)
            curve = BPoly.from_derivatives(at, [[q[0], first, zero], [q[1], last, zero]])
        else:
            curve = CubicSpline(at, q, bc_type=((1, first), (1, last)))  # pyright: ignore
        inside = (t >= at[0]) & (t <= at[-1]) if b == stops[-1] else (t >= at[0]) & (t < at[-1])
        for order in range(3):
            found[order, inside] = curve(t[inside], order)
    return found[0], found[1], found[2]


def reference_states(task: Task, poses: Poses, x0: np.ndarray) -> np.ndarray:
    """The states (N+1, nx) of the motion, activations as at the start."""
    mechanism, space = task.mechanism, task.mechanism.space
    nq, nv, t = mechanism.nq, mechanism.nv, task.dt * np.arange(task.N + 1)
    xs = np.tile(x0, (task.N + 1, 1))
    if is_screws(task):
        q, qd, _ = interpolate(task, poses, x0, t)
        xs[:, :nq], xs[:, nq : nq + nv] = q, qd
        return xs
    xs[:, nq : nq + nv] = 0.0
    states = np.tile(xs[0], (len(poses.q), 1))
    states[:, :nq] = poses.q
    for k in range(len(states) - 1):
        a, b = poses.stages[k : k + 2]
        s = (np.arange(a, b + 1) - a) / (b - a)
        way = space.difference(states[k + 1], states[k])
        xs[a : b + 1] = space.integrate(
            np.tile(states[k], (b - a + 1, 1)), (10.0 * s**3 - 15.0 * s**4 + 6.0 * s**5)[:, None] * way
        )
        speed = (30.0 * s**2 - 60.0 * s**3 + 30.0 * s**4) / ((b - a) * task.dt)
        xs[a : b + 1, nq : nq + nv] = speed[:, None] * way[:nv]
    return xs


def controls(task: Task, poses: Poses, dynamics: RigidBodyDynamics, x0: np.ndarray) -> np.ndarray | None:
    """Controls (N, nu) along the motion by inverse dynamics; None where the actuators do not reach every joint."""
    mechanism = task.mechanism
    if not is_screws(task) or mechanism.contacts or mechanism.body_contacts or dynamics.prescribed:
        return None
    middle = task.dt * (np.arange(task.N) + 0.5)  # where a control that is held over a stage is best taken
    try:
        return inverse_dynamics_controls(mechanism, *interpolate(task, poses, x0, middle))
    except PlannerError:
        return None


def joint_displacement(task: Task, poses: Poses) -> np.ndarray:
    """(nv,) how far each degree of freedom goes, there and back."""
    space = task.mechanism.space
    xs = np.tile(task.mechanism.home, (len(poses.q), 1))
    xs[:, : task.mechanism.nq] = poses.q
    return np.abs(space.difference(xs[1:], xs[:-1])).sum(axis=0)[: task.mechanism.nv]
