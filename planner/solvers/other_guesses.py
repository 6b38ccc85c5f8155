"""Other first guesses for a solve that ends without success from its own.

collision-free  controls that track a path without collisions to the goal (problem.avoid)
tracked         controls that track the straight line to the goal, for machines that can (solvers.stabilizing_guess)
held            controls that hold the machine at its start by feedback, or brake it
line            the straight line of states to the goal, with the same controls (solvers.multiple_shooting)
shaken          the controls with a smooth random change, the same each time
swings          controls that swing between their bounds, in time with the start's slowest oscillation
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from planner.model.capabilities import capabilities_of
from planner.model.space import space_of
from planner.problem.avoid import collision_free_motion
from planner.problem.constraints.clearance import pair_clearance_of
from planner.problem.costs.tracking import tracking_of
from planner.problem.problem import Problem
from planner.solvers.multiple_shooting import line_to_the_end
from planner.solvers.multistart import smooth
from planner.solvers.stabilizing_guess import line_tracking_controls, stabilizing_guess, tracking_controls

SHAKE = 0.01  # of each control's limit: to leave a saddle
LARGE_SHAKE = 0.3  # of the same: to find another motion
SAME = 1e-3  # relative difference below which a guess is the problem's own


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
