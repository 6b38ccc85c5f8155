"""A first guess in place of one that runs away: what holds the start, or at least brakes, with gains from a regulator.

An unstable machine, or a fast one that falls through its stages, may reach infinity under controls that were computed
beforehand. Here controls come from gains on the way, and are written down. The gains are those of the LQ problem that
holds a state of the machine, linearized there, where a unit of the state costs as much as its rate of one per second.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Any

import numpy as np

from planner.base.errors import PlannerError
from planner.dynamics.assembly import assembled
from planner.dynamics.quasi_static import equilibrium
from planner.dynamics.rollout import Control, feedback_control, rollout
from planner.model.capabilities import capabilities_of
from planner.model.space import space_of
from planner.problem.initial_guess import quintic
from planner.problem.problem import Problem
from planner.solvers.lqr import tracking_gains

DIVERGENCE_FACTOR = 1e10  # times the start, at least 1: what MuJoCo too takes for an unstable simulation
_STAGES = 100  # of the LQ problem, by which its gains have become constant
_AGAIN = 10  # stages after which a machine that brakes is linearized again
_WEAKEST = 1e-9  # of the largest weight of a control: of one that moves nothing


def has_diverged(xs: np.ndarray) -> np.ndarray:
    """(N+1,) whether each state of a rollout xs (N+1, nx) is not finite, or so large that it soon will be."""
    with np.errstate(invalid="ignore"):
        return np.asarray(
            ~(np.abs(xs) < DIVERGENCE_FACTOR * max(1.0, float(np.abs(xs[0]).max(initial=0.0)))).all(axis=1)
        )


def stabilizing_guess(problem: Problem) -> np.ndarray | None:
    """Controls (N, nu) whose rollout stays finite: they hold the start, or brake; None where neither helps."""
    with np.errstate(all="ignore"):  # they may run away too
        for way in (_holding, _braking):
            us = _written_down(problem, way(problem))
            if us is not None:
                return us
    return None


def line_tracking_controls(problem: Problem, goal: np.ndarray) -> np.ndarray | None:
    """Controls (N, nu) of gains that lead a machine along the straight line to a goal (nx,); None if it runs away."""
    with np.errstate(all="ignore"):
        return _written_down(problem, _leading(problem, _straight(problem, goal)))


def tracking_controls(problem: Problem, xs: np.ndarray, us: np.ndarray | None = None) -> np.ndarray | None:
    """Controls (N, nu) of gains that lead a machine along states xs (N+1, nx); None if it runs away.

    The gains act about us (N, nu), where these are known to move it so: alone they may not keep an unstable machine
    near a long way. Without them they act about what holds the machine.
    """
    with np.errstate(all="ignore"):
        return _written_down(problem, _leading(problem, lambda n: xs[n]) if us is None else _kept_to(problem, xs, us))


def _written_down(problem: Problem, control: Control) -> np.ndarray | None:
    """The controls (N, nu), within their bounds, that a controller gives from the start on; None where it runs away."""
    limit = DIVERGENCE_FACTOR * max(1.0, float(np.abs(problem.x0).max(initial=0.0)))
    us = np.zeros((problem.N, problem.dynamics.nu))
    xs, us = rollout(problem.dynamics, problem.x0, us, control, bounds=problem.bounds, limit=limit)
    finite = np.isfinite(xs).all() and np.isfinite(us).all()
    return us if finite and np.isfinite(problem.cost.value(xs, us)) else None


def _at_rest(problem: Problem, x: np.ndarray) -> np.ndarray:
    """A state (nx,) without its velocities, where the machine tells which these are."""
    mechanism, x = capabilities_of(problem.dynamics).mechanism, x.copy()
    if mechanism is not None:
        x[mechanism.nq : mechanism.nq + mechanism.nv] = 0.0
    return x


def _regulator(problem: Problem, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The control (nu,) that keeps a state x (nx,) as far as one can, and the gains (nu, ndx) that bring it back."""
    dynamics = problem.dynamics
    none = np.zeros(dynamics.nu)
    A, B = (part[0] for part in dynamics.linearize(np.stack([x, x]), none[None]))
    if not (np.isfinite(A).all() and np.isfinite(B).all()):
        return none, np.zeros(B.T.shape)
    u = equilibrium(dynamics, x, none, iterations=1)[1]
    each = (_STAGES, 1, 1)
    Q, R = np.tile(np.eye(len(A)), (_STAGES + 1, 1, 1)), np.tile(_weights(B, dynamics.dt), each)
    K = tracking_gains(np.tile(A, each), np.tile(B, each), Q, R)
    return u, np.zeros(B.T.shape) if K is None else K[0]


def _holding(problem: Problem) -> Control:
    """Gains about the start, its velocities aside."""
    space, x = space_of(problem.dynamics), _at_rest(problem, problem.x0)
    u, K = _regulator(problem, x)
    return lambda n, now: u + K @ space.difference(now, x)


def _straight(problem: Problem, goal: np.ndarray) -> Callable[[int], np.ndarray]:
    """The state of each stage on the straight line from the start to a goal, fast in the middle.

    Of closed chains it is the nearest one that closes them.
    """
    space, start = space_of(problem.dynamics), _at_rest(problem, problem.x0)
    way = space.difference(_at_rest(problem, goal), start)
    places, speeds, _ = quintic(np.zeros(1), np.ones(1), problem.duration, problem.N)
    mechanism = capabilities_of(problem.dynamics).mechanism
    closed: Any = mechanism if mechanism is not None and mechanism.has_closed_chains else None

    def state_on_line(n: int) -> np.ndarray:
        x = space.integrate(start, places[n] * way)
        if mechanism is not None:
            x[mechanism.nq : mechanism.nq + mechanism.nv] = speeds[n] * way[: mechanism.nv]
        if closed is not None:
            with contextlib.suppress(PlannerError):  # then it is a way all the same
                return assembled(closed, x)
        return x

    return state_on_line


def _leading(problem: Problem, place: Callable[[int], np.ndarray], us: np.ndarray | None = None) -> Control:
    """Gains about the state of each stage on a way, taken anew as it goes on, and about controls us (N, nu)."""
    space = space_of(problem.dynamics)
    u, K = np.zeros(0), np.zeros(0)

    def control(n: int, now: np.ndarray) -> np.ndarray:
        nonlocal u, K
        x = place(n)
        if n % _AGAIN == 0:
            u, K = _regulator(problem, _at_rest(problem, x))
        return (u if us is None else us[n]) + K @ space.difference(now, x)

    return control


def _kept_to(problem: Problem, xs: np.ndarray, us: np.ndarray) -> Control:
    """Gains about states xs (N+1, nx) and the controls us (N, nu) that move a machine along them.

    They are those of the LQ problem along the way: what forces of closed chains do depends on the controls.
    """
    dynamics = problem.dynamics
    A, B = dynamics.linearize(xs, us)
    R = _weights(B.reshape(-1, B.shape[2]), dynamics.dt * np.sqrt(len(B)))
    N, ndx, nu = B.shape
    K = tracking_gains(A, B, np.tile(np.eye(ndx), (N + 1, 1, 1)), np.tile(R, (N, 1, 1)))
    return feedback_control(dynamics, xs, us, np.zeros((N, nu, ndx)) if K is None else K)


def _weights(B: np.ndarray, dt: float) -> np.ndarray:
    """R (nu, nu) of controls that B (ndx, nu) has: a rate of one per second costs as much as a unit of the state."""
    R = (np.linalg.norm(B, axis=0) / dt) ** 2
    return np.diag(np.maximum(R, _WEAKEST * R.max(initial=1.0)))


def _braking(problem: Problem) -> Control:
    """Gains about where the machine is, which take its velocity away: for one that leaves its start anyhow."""
    space = space_of(problem.dynamics)
    u, K = np.zeros(0), np.zeros(0)

    def control(n: int, now: np.ndarray) -> np.ndarray:
        nonlocal u, K
        x = _at_rest(problem, now)
        if n % _AGAIN == 0:
            u, K = _regulator(problem, x)
        return u + K @ space.difference(now, x)

    return control
