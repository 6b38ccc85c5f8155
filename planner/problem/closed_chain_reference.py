"""A first guess for closed chains: a trajectory on which they stay closed, and controls along it.

Between poses the path is straight towards the next one and projected onto the closure constraints at every small step;
a spline in time passes through these states. At its positions, velocities and accelerations

    M qdd + h = tau + J'f

gives the controls (problem.initial_guess.inverse_dynamics_controls).
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np

from planner.base.errors import PlannerError
from planner.dynamics.assembly import assembled
from planner.model.mechanism import Mechanism
from planner.problem.initial_guess import inverse_dynamics_controls, minimum_jerk

STEP = 0.05  # rad or m of the joint that moves most, between projected states
MIN_PARTS, MAX_PARTS = 25, 100  # between two poses at rest, and between any two
MAX_JUMP = 10.0  # in STEP, between projected states: beyond it the chains were assembled in another branch


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
    poses = np.tile(x0, (len(q), 1))
    poses[:, :nq] = q
    poses[:, nq : nq + nv] = 0.0
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
        start_values = x0[nq : nq + nv] if a == 0 else np.zeros(nv)
        last = np.zeros(nv) if at_rest[b] else (y[-1, :nv] - y[-2, :nv]) / (dt * (times[-1] - times[-2]))
        curve = CubicSpline(dt * times, y[:, :nv], bc_type=((1, start_values), (1, last)))  # pyright: ignore
        n = np.arange(stages[a], stages[b] + 1)
        dx = np.zeros((len(n), space.ndx))
        dx[:, :nv] = curve(dt * n)
        states_at_knots[n] = space.integrate(np.tile(states[0], (len(n), 1)), dx)
    middle = space.difference(states_at_knots[1:], states_at_knots[:-1])[:, :nv] / dt
    speeds = np.concatenate([x0[None, nq : nq + nv], 0.5 * (middle[1:] + middle[:-1]), 2.0 * middle[-1:]])
    speeds[-1] = 0.0 if at_rest[-1] else 1.5 * middle[-1] - 0.5 * middle[-2]
    half = np.zeros((N, space.ndx))
    half[:, :nv] = 0.5 * dt * middle
    at = space.integrate(states_at_knots[:-1], half)[:, :nq]
    states_at_knots[:, nq : nq + nv] = speeds
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
