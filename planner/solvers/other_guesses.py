"""Other first guesses: in place of a diverging one, and for a solve that ends without success from its own.

collision-free  controls that track a path without collisions to the goal (problem.collision_free_path)
tracked         controls that track the straight line to the goal, for machines that can
held            controls that hold the machine at its start by feedback, or brake it
line            the straight line of states to the goal, with the same controls (solvers.multiple_shooting)
shaken          the controls with a smooth random change, the same each time
swings          controls that swing between their bounds, in time with the start's slowest oscillation

Open-loop controls of an unstable or unsupported robot may make the rollout diverge. Here a rollout with feedback
records the applied controls. The gains are those of an LQR about a state at rest, with unit state weights and R such
that a control costs 1 if it changes the state at a rate of norm 1 per second.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from planner.base.errors import PlannerError
from planner.dynamics.assembly import assembled
from planner.dynamics.protocol import Control, feedback_control, rollout
from planner.dynamics.quasi_static import equilibrium
from planner.model.capabilities import capabilities_of
from planner.model.space import space_of
from planner.problem.collision_free_path import collision_free_motion
from planner.problem.constraints.clearance import pair_clearance_of
from planner.problem.costs.tracking import tracking_of
from planner.problem.initial_guess import quintic
from planner.problem.problem import Problem
from planner.solvers.gains import tracking_gains
from planner.solvers.multiple_shooting import line_to_the_end
from planner.solvers.multistart import smooth

DIVERGENCE_FACTOR = 1e10  # limit of a state, relative to max(1, largest of the start): as in MuJoCo
_STAGES = 100  # of the LQ problem, after which its gains are constant
_AGAIN = 10  # stages between linearizations, at the least
_ALONG = 100  # linearizations along a reference, at the most
_WEAKEST = 1e-9  # smallest weight of a control, relative to the largest
SHAKE = 0.01  # of each control's limit: to leave a saddle
LARGE_SHAKE = 0.3  # of the same: to find another motion
SAME = 1e-3  # relative difference below which a guess is the problem's own


def has_diverged(xs: np.ndarray) -> np.ndarray:
    """(N+1,) whether each state of a rollout xs (N+1, nx) is not finite or exceeds DIVERGENCE_FACTOR."""
    with np.errstate(invalid="ignore"):
        return np.asarray(
            ~(np.abs(xs) < DIVERGENCE_FACTOR * max(1.0, float(np.abs(xs[0]).max(initial=0.0)))).all(axis=1)
        )


def stabilizing_guess(problem: Problem) -> np.ndarray | None:
    """Controls (N, nu) with a finite rollout, which regulate the start or brake; None where both diverge."""
    with np.errstate(all="ignore"):  # these may diverge too
        for way in (_holding, _braking):
            us = _written_down(problem, way(problem))
            if us is not None:
                return us
    return None


def line_tracking_controls(problem: Problem, goal: np.ndarray) -> np.ndarray | None:
    """Controls (N, nu) that track the straight line to a goal (nx,) by feedback; None if the rollout diverges."""
    with np.errstate(all="ignore"):
        return _written_down(problem, _leading(problem, _straight(problem, goal), problem.N // _ALONG))


def tracking_controls(problem: Problem, xs: np.ndarray, us: np.ndarray | None = None) -> np.ndarray | None:
    """Controls (N, nu) that track states xs (N+1, nx) by feedback; None if the rollout diverges.

    The feedforward is us (N, nu), which unstable robots need on long trajectories; without it, the equilibrium controls
    of the states.
    """
    with np.errstate(all="ignore"):
        return _written_down(
            problem,
            _leading(problem, lambda n, _: xs[n], problem.N // _ALONG) if us is None else _kept_to(problem, xs, us),
        )


def _written_down(problem: Problem, control: Control) -> np.ndarray | None:
    """The controls (N, nu), within bounds, of a rollout with a controller from the start; None if it diverges."""
    limit = DIVERGENCE_FACTOR * max(1.0, float(np.abs(problem.x0).max(initial=0.0)))
    us = np.zeros((problem.N, problem.dynamics.nu))
    xs, us = rollout(problem.dynamics, problem.x0, us, control, bounds=problem.bounds, limit=limit)
    finite = np.isfinite(xs).all() and np.isfinite(us).all()
    return us if finite and np.isfinite(problem.cost.value(xs, us)) else None


def _at_rest(problem: Problem, x: np.ndarray) -> np.ndarray:
    """A copy of a state (nx,) with zero velocities; unchanged for dynamics without a mechanism."""
    mechanism = capabilities_of(problem.dynamics).mechanism
    return x.copy() if mechanism is None else mechanism.at_rest(x)


def _regulator(problem: Problem, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Equilibrium control (nu,) of x (nx,), approximate where there is none, and LQR gains (nu, ndx) about it."""
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
    """LQR about the start with zero velocities."""
    space, x = space_of(problem.dynamics), _at_rest(problem, problem.x0)
    u, K = _regulator(problem, x)
    return lambda n, now: u + K @ space.difference(now, x)


def _straight(problem: Problem, goal: np.ndarray) -> Callable[[int, np.ndarray], np.ndarray]:
    """The state (nx,) at each knot of the straight line from the start to a goal (nx,), by a quintic in time.

    With loop closures it is projected onto them where that converges.
    """
    space, start = space_of(problem.dynamics), _at_rest(problem, problem.x0)
    way = space.difference(_at_rest(problem, goal), start)
    places, speeds, _ = quintic(np.zeros(1), np.ones(1), problem.duration, problem.N)
    mechanism = capabilities_of(problem.dynamics).mechanism
    closed: Any = mechanism if mechanism is not None and mechanism.has_closed_chains else None

    def state_on_line(n: int, _: np.ndarray) -> np.ndarray:
        x = space.integrate(start, places[n] * way)
        if mechanism is not None:
            x[mechanism.velocities] = speeds[n] * way[: mechanism.nv]
        if closed is not None:
            with contextlib.suppress(PlannerError):  # else the line without closures
                return assembled(closed, x)
        return x

    return state_on_line


def _leading(problem: Problem, place: Callable[[int, np.ndarray], np.ndarray], stages: int = _AGAIN) -> Control:
    """LQR about the state `place(n, now)` of each stage, updated after so many stages, or _AGAIN if these are more."""
    space, stages = space_of(problem.dynamics), max(stages, _AGAIN)
    u, K = np.zeros(0), np.zeros(0)

    def control(n: int, now: np.ndarray) -> np.ndarray:
        nonlocal u, K
        x = place(n, now)
        if n % stages == 0:
            u, K = _regulator(problem, _at_rest(problem, x))
        return u + K @ space.difference(now, x)

    return control


def _kept_to(problem: Problem, xs: np.ndarray, us: np.ndarray) -> Control:
    """Time-varying LQR about states xs (N+1, nx) and controls us (N, nu).

    Linearized with these controls, on which the constraint forces of loop closures depend.
    """
    dynamics = problem.dynamics
    A, B = dynamics.linearize(xs, us)
    R = _weights(B.reshape(-1, B.shape[2]), dynamics.dt * np.sqrt(len(B)))
    N, ndx, nu = B.shape
    K = tracking_gains(A, B, np.tile(np.eye(ndx), (N + 1, 1, 1)), np.tile(R, (N, 1, 1)))
    return feedback_control(dynamics, xs, us, np.zeros((N, nu, ndx)) if K is None else K)


def _weights(B: np.ndarray, dt: float) -> np.ndarray:
    """R (nu, nu) for B (ndx, nu): a control that changes the state at a rate of norm 1 per second costs 1."""
    R = (np.linalg.norm(B, axis=0) / dt) ** 2
    return np.diag(np.maximum(R, _WEAKEST * R.max(initial=1.0)))


def _braking(problem: Problem) -> Control:
    """LQR about the present state with zero velocities: brakes a robot that cannot be regulated at its start."""
    return _leading(problem, lambda _, now: _at_rest(problem, now))


def other_guesses(problem: Problem) -> Iterator[tuple[str, np.ndarray | None, np.ndarray]]:
    """Names, states (N+1, nx) or None, and controls (N, nu) of first guesses, the most promising first."""
    own, held = problem.first_guess, stabilizing_guess(problem)
    for name, us in (*_towards_the_goal(problem), ("held", held)):
        if us is not None and not np.allclose(us, own, rtol=SAME, atol=SAME * np.abs(own).max()):
            yield name, None, us
    if (line := line_to_the_end(problem)) is not None:
        yield "line", line, own if held is None else held
    if problem.bounds is not None:  # which tell how large a change is
        for seed in (1, 2):
            yield "shaken", None, shaken(problem, LARGE_SHAKE, seed)


def _towards_the_goal(problem: Problem) -> Iterator[tuple[str, np.ndarray | None]]:
    """Names and controls (N, nu), None where none are found, of motions to a goal of all joints."""
    machine, tracking = capabilities_of(problem.dynamics), tracking_of(problem.cost)
    mechanism = machine.mechanism
    if mechanism is None or tracking is None or np.any(machine.unactuated) or problem.periodic is not None:
        return
    if not np.all(np.diagonal(tracking.Q[-1])[: space_of(problem.dynamics).ndx // 2] > 0.0):
        return
    goal = tracking.x_ref[-1]
    apart = pair_clearance_of(problem.constraints)
    if apart is not None:
        motion = collision_free_motion(apart, mechanism, problem.x0, goal, problem.duration, problem.N)
        if motion is not None:
            yield "collision-free", tracking_controls(problem, *motion)
    yield "tracked", line_tracking_controls(problem, goal)


def shaken(problem: Problem, share: float = SHAKE, seed: int = 0) -> np.ndarray:
    """The first guess (N, nu) and a smooth random function of a share of each control's limit."""
    us = problem.first_guess
    sizes = np.maximum(np.abs(us).max(axis=0), 1.0)
    if problem.bounds is not None:
        widths = 0.5 * np.ptp([problem.bounds.lower, problem.bounds.upper], axis=0).reshape(-1, us.shape[1]).min(axis=0)
        sizes = np.where(np.isfinite(widths), widths, sizes)
    return us + share * sizes * smooth(np.random.default_rng(seed), us.shape)


def swings(problem: Problem) -> list[np.ndarray]:
    """Controls (N, nu) that swing between their bounds, with half cycles of the slowest oscillation about the start."""
    if problem.bounds is None:
        return []
    start = np.stack([problem.x0, problem.x0])
    A = problem.dynamics.linearize(start, problem.first_guess[:1])[0][0]
    halves = np.abs(np.angle(np.linalg.eigvals(A))) * problem.N / np.pi  # half cycles within the duration
    halves = halves[halves > 0.5]
    if not len(halves):
        return []
    middle, size = _middle_and_size(problem)
    share = (np.arange(problem.N)[:, None] + 0.5) / problem.N
    n = int(halves.min())  # a larger swing takes longer than the small one of the linearization
    return [
        middle + sign * size * np.sin(np.pi * count * share)
        for count in (n, n - 1, n + 1) if count > 0 for sign in (1.0, -1.0)
    ]  # fmt: skip


def _middle_and_size(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """Middle and half width (N, nu) of the bounds of the controls; the first guess and 0 where one is infinite."""
    assert problem.bounds is not None
    lower, upper = problem.bounds.lower, problem.bounds.upper
    with np.errstate(invalid="ignore"):
        both, middle, half = np.isfinite(upper - lower), 0.5 * (lower + upper), 0.5 * (upper - lower)
    return np.where(both, middle, problem.first_guess), np.where(both, half, 0.0)
