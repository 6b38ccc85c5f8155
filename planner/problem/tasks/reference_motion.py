"""A first guess of a task's motion: through its poses, straight in joint space between poses at rest.

From rest to rest between two poses it follows minimum_jerk; through several poses, a cubic spline with given end
velocities. The solver makes the plan.

With closed chains the path between poses is straight towards the next one and projected onto the closure constraints at
every small step; a spline in time passes through these states. At its positions, velocities and accelerations

    M qdd + h = tau + J'f

gives the controls (problem.initial_guess.inverse_dynamics_controls).
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np

from planner.base.errors import PlannerError
from planner.dynamics import RigidBodyDynamics
from planner.dynamics.assembly import assembled
from planner.model.mechanism import Mechanism
from planner.problem.collision_free_path import CollisionChecker
from planner.problem.initial_guess import inverse_dynamics_controls, minimum_jerk
from planner.problem.tasks.poses import Poses, is_screws
from planner.problem.tasks.timed_task import Task

VIA_PARTS = 8  # equal parts of a collision-free path, at whose inner ends poses are passed on a spline
_EVEN = np.linspace(0.0, 1.0, 1001)
_FROM_REST = minimum_jerk(_EVEN)[0]
STEP = 0.05  # rad or m of the joint that moves most, between projected states
MIN_PARTS, MAX_PARTS = 25, 100  # between two poses at rest, and between any two
MAX_JUMP = 10.0  # in STEP, between projected states: beyond it the chains were assembled in another branch


def with_via_poses(poses: Poses, checker: CollisionChecker, seed: int = 0) -> Poses:
    """The poses with via poses between them where the straight line from one to the next is in collision.

    Where there are too few stages between two poses, or no path is found, nothing is added: the solver has to find one.
    """
    stages, q, at_rest = [int(poses.stages[0])], [poses.q[0]], [bool(poses.at_rest[0])]
    for k in range(1, len(poses.q)):
        a, b = int(poses.stages[k - 1]), int(poses.stages[k])
        path = checker.find_path(poses.q[k - 1], poses.q[k], seed) if b - a > VIA_PARTS else None
        if path is not None:
            straight = path[0] + np.linspace(0.0, 1.0, len(path))[:, None] * (path[-1] - path[0])
            if np.abs(path - straight).max() > 1e-9:
                share = np.arange(1, VIA_PARTS) / VIA_PARTS
                between_rests = poses.at_rest[k - 1] and poses.at_rest[k]
                times = np.interp(share, _FROM_REST, _EVEN) if between_rests else share
                stages += (a + np.round(times * (b - a))).astype(int).tolist()
                q += list(path[np.round(share * (len(path) - 1)).astype(int)])
                at_rest += [False] * len(share)
        stages.append(b)
        q.append(poses.q[k])
        at_rest.append(bool(poses.at_rest[k]))
    return Poses(np.array(stages), np.array(q), np.array(at_rest))


def resting(poses: Poses, share: float) -> Poses:
    """The poses, the last one reached a share of its interval earlier, for rest until the end."""
    first, last = poses.stages[-2:]
    arrival = int(last - round(share * (last - first)))
    return Poses(
        np.insert(poses.stages, -1, arrival),
        np.concatenate([poses.q, poses.q[-1:]]),
        np.insert(poses.at_rest, -1, True),
    )


def interpolate(task: Task, poses: Poses, x0: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions (K, nq), velocities and accelerations (K, nv) at times t (K,), for hinges and slides alone."""
    from scipy.interpolate import BPoly, CubicSpline  # 0.4 s that `planner run` need not pay

    mechanism = task.mechanism
    nq = mechanism.nq
    rests = [0, *(k for k in range(1, len(poses.q) - 1) if poses.at_rest[k]), len(poses.q) - 1]
    motion = np.zeros((3, len(t), nq))
    for a, b in itertools.pairwise(rests):
        at = task.dt * poses.stages[a : b + 1]
        q = poses.q[a : b + 1]
        start_values = x0[mechanism.velocities] if a == 0 else np.zeros(nq)
        last = np.zeros(nq) if poses.at_rest[b] else (q[-1] - q[-2]) / (at[-1] - at[-2])
        if len(q) == 2:
            zero = np.zeros(nq)
            spline = BPoly.from_derivatives(at, [[q[0], start_values, zero], [q[1], last, zero]])
        else:
            spline = CubicSpline(at, q, bc_type=((1, start_values), (1, last)))  # pyright: ignore
        inside = (t >= at[0]) & (t <= at[-1]) if b == rests[-1] else (t >= at[0]) & (t < at[-1])
        for order in range(3):
            motion[order, inside] = spline(t[inside], order)
    return motion[0], motion[1], motion[2]


def reference_states(task: Task, poses: Poses, x0: np.ndarray) -> np.ndarray:
    """The states (N+1, nx) of the motion, activations as at the start."""
    mechanism, space = task.mechanism, task.mechanism.space
    nq, nv, t = mechanism.nq, mechanism.nv, task.dt * np.arange(task.N + 1)
    xs = np.tile(x0, (task.N + 1, 1))
    if is_screws(task):
        q, qd, _ = interpolate(task, poses, x0, t)
        xs[:, :nq], xs[:, mechanism.velocities] = q, qd
        return xs
    xs[:, mechanism.velocities] = 0.0
    states = np.tile(xs[0], (len(poses.q), 1))
    states[:, :nq] = poses.q
    for k in range(len(states) - 1):
        a, b = poses.stages[k : k + 2]
        share, rate, _ = minimum_jerk((np.arange(a, b + 1) - a) / (b - a))
        displacement = space.difference(states[k + 1], states[k])
        xs[a : b + 1] = space.integrate(np.tile(states[k], (b - a + 1, 1)), share[:, None] * displacement)
        xs[a : b + 1, mechanism.velocities] = (rate / ((b - a) * task.dt))[:, None] * displacement[:nv]
    return xs


def controls(task: Task, poses: Poses, dynamics: RigidBodyDynamics, x0: np.ndarray) -> np.ndarray | None:
    """Controls (N, nu) along the motion by inverse dynamics; None unless the actuators reach every joint."""
    mechanism = task.mechanism
    if not is_screws(task) or dynamics.capabilities.contacts or dynamics.prescribed:
        return None
    middle = task.dt * (np.arange(task.N) + 0.5)  # where a control that is constant over a stage is best taken
    try:
        return inverse_dynamics_controls(mechanism, *interpolate(task, poses, x0, middle))
    except PlannerError:
        return None


def joint_displacement(task: Task, poses: Poses) -> np.ndarray:
    """(nv,) the distance that each degree of freedom covers, in either direction, rad or m."""
    space = task.mechanism.space
    xs = np.tile(task.mechanism.home, (len(poses.q), 1))
    xs[:, : task.mechanism.nq] = poses.q
    return np.abs(space.difference(xs[1:], xs[:-1])).sum(axis=0)[: task.mechanism.nv]


class ClosedChainReference(NamedTuple):
    """A trajectory on which closed chains stay closed."""

    states: np.ndarray  # (N+1, nx)
    controls: np.ndarray | None  # (N, nu); None unless the actuators reach every feasible direction


def closed_chain_reference(
    mechanism: Mechanism, x0: np.ndarray, stages: np.ndarray, q: np.ndarray, at_rest: np.ndarray, dt: float
) -> ClosedChainReference | None:
    """The trajectory through poses q (E, nq) at stages (E,), the first that of x0 (nx,); None where there is none.

    Args:
        mechanism: A machine with closed chains.
        x0: The start.
        stages: From 0 to N.
        q: The poses.
        at_rest: (E,) True where the machine is at rest.
        dt: Length of a stage, s.
    """
    from scipy.interpolate import CubicSpline  # 0.4 s that `planner run` need not pay

    space, nq, nv, N = mechanism.space, mechanism.nq, mechanism.nv, int(stages[-1])
    poses = np.tile(mechanism.at_rest(x0), (len(q), 1))
    poses[:, :nq] = q
    ends = [0, *(k for k in range(1, len(q) - 1) if at_rest[k]), len(q) - 1]
    states_at_knots = np.tile(poses[0], (N + 1, 1))
    for a, b in itertools.pairwise(ends):
        try:
            times, states = _closed(mechanism, poses[a : b + 1], stages[a : b + 1], b == a + 1)
        except PlannerError:  # a pose that cannot be closed
            return None
        y = space.difference(states, states[0])
        if np.any(np.abs(np.diff(y, axis=0)).max(axis=1) > MAX_JUMP * STEP):
            return None
        start_values = x0[mechanism.velocities] if a == 0 else np.zeros(nv)
        last = np.zeros(nv) if at_rest[b] else (y[-1, :nv] - y[-2, :nv]) / (dt * (times[-1] - times[-2]))
        curve = CubicSpline(dt * times, y[:, :nv], bc_type=((1, start_values), (1, last)))  # pyright: ignore
        n = np.arange(stages[a], stages[b] + 1)
        dx = np.zeros((len(n), space.ndx))
        dx[:, :nv] = curve(dt * n)
        states_at_knots[n] = space.integrate(np.tile(states[0], (len(n), 1)), dx)
    middle = space.difference(states_at_knots[1:], states_at_knots[:-1])[:, :nv] / dt
    speeds = np.concatenate([x0[None, mechanism.velocities], 0.5 * (middle[1:] + middle[:-1]), 2.0 * middle[-1:]])
    speeds[-1] = 0.0 if at_rest[-1] else 1.5 * middle[-1] - 0.5 * middle[-2]
    half = np.zeros((N, space.ndx))
    half[:, :nv] = 0.5 * dt * middle
    at = space.integrate(states_at_knots[:-1], half)[:, :nq]
    states_at_knots[:, mechanism.velocities] = speeds
    try:
        return ClosedChainReference(
            states_at_knots, inverse_dynamics_controls(mechanism, at, middle, np.diff(speeds, axis=0) / dt)
        )
    except PlannerError:  # the actuators do not reach every direction
        return ClosedChainReference(states_at_knots, None)


def _closed(
    mechanism: Mechanism, poses: np.ndarray, stages: np.ndarray, from_rest: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Stages (K,) and closed states (K, nx) on the path through poses; `from_rest` for two poses at rest."""
    space, times, states = mechanism.space, [float(stages[0])], [poses[0]]
    for k in range(1, len(poses)):
        distance = float(np.abs(space.difference(poses[k], states[-1])).max())
        parts = int(np.clip(np.ceil(distance / STEP), MIN_PARTS if from_rest else 1, MAX_PARTS))
        parts = min(parts, int(stages[k] - stages[k - 1]))
        t = np.linspace(0.0, 1.0, parts + 1)
        shares = minimum_jerk(t)[0] if from_rest else t
        for i in range(1, parts + 1):
            left = (shares[i] - shares[i - 1]) / (1.0 - shares[i - 1])
            step = left * space.difference(poses[k], states[-1])
            states.append(assembled(mechanism, space.integrate(states[-1], step)))
            times.append(stages[k - 1] + t[i] * (stages[k] - stages[k - 1]))
    return np.array(times), np.array(states)
