"""Multiple shooting: states as a first guess. Gaps between the stages are open at first, and close on the way.

From states xs and controls us that need not fit, stage n ends a gap g(n) from the next state. Each iteration solves the
LQ problem whose deviations have these gaps (kernels.lq.defects). Its direction is taken in one of two ways, measured by

    merit = J(xs, us) + nu' sum |g(n)|,    nu above the multipliers of the gaps (Han, Powell):

a rollout with the sweep's gains, which closes all gaps at once and ends this phase, if its cost falls enough below the
merit and below that of a rollout of the first controls; else a part alpha of the direction for states and controls
alike, whose gaps are those of the dynamics being curved. Where steps are short, changes of the states are held (see
regularization). Hessians are Gauss and Newton's.
A full step of an LQ problem closes its gaps whatever the weights, so these are held only so far.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np

from planner.base.arguments import choice
from planner.base.errors import PlannerError
from planner.kernels.lq.line_search import ARMIJO_C1
from planner.model.space import space_of
from planner.problem.costs.tracking import states as checked_states
from planner.problem.costs.tracking import tracking_of
from planner.problem.initial_guess import interpolated_states
from planner.problem.plan import Iteration
from planner.problem.problem import Problem
from planner.problem.state_bounds import BoundPenalties
from planner.solvers.engine import DefectStep, Engine
from planner.solvers.regularization import Regularization

ABOVE = 2.0  # nu over the largest multiplier, when it is set
STALE = 8.0  # nu over the largest multiplier, from which on it is set again
HALVINGS = 12  # of a step, before the states are held more
MAX_STATE_REGULARIZATION = (
    0.01  # the weight on changes of the states, relative to the cost's, beyond which it only keeps gaps open
)
SHARE, SHARES = 0.25, 6  # of the first controls, whenever states and controls are too far apart; then none of them
MAX_DEFECT_ITERATIONS = (
    60  # iterations across gaps; who needs more is better off with the rollout of the controls so far
)

Value = Callable[[np.ndarray, np.ndarray], float]  # of states (N+1, nx) and controls (N, nu)


def guessed_states(problem: Problem, states: np.ndarray | str | None) -> np.ndarray | None:
    """The first guess of the states (N+1, nx) that solve(states=...) asks for; its first is the problem's start.

    Raises:
        PlannerError: Neither "line" nor such an array; or a line to a cost that has no reference.
    """
    if states is None:
        return None
    space = space_of(problem.dynamics)
    if not isinstance(states, str):
        return checked_states("states", states, space, (problem.N + 1,))
    choice("states", states, ("line",))
    tracking = tracking_of(problem.cost)
    if tracking is None:
        raise PlannerError(
            "states is 'line' and the cost has no reference state at the end, expected an array of states (N+1, nx)."
        )
    return interpolated_states(space, problem.x0, tracking.x_ref[-1], problem.duration, problem.N)


def line_to_the_end(problem: Problem) -> np.ndarray | None:
    """The straight line (N+1, nx) to the state that a cost asks for at the end; None where it does not ask for all.

    Nor where constraints are kept: what stands between start and goal would be crossed.
    """
    tracking = tracking_of(problem.cost)
    if tracking is None or problem.constraints or problem.periodic is not None:
        return None
    return guessed_states(problem, "line") if np.all(np.diagonal(tracking.Q[-1]) > 0.0) else None


def close_defects(
    problem: Problem, engine: Engine, exact: bool, xs: np.ndarray, us: np.ndarray, most: int,
    callback: Callable[[Iteration], object] | None, penalties: BoundPenalties | None = None,
) -> tuple[float, list[Iteration], bool]:  # fmt: skip
    """Take steps across gaps until a rollout closes them, or for the first MOST iterations.

    Controls under which the guessed states are out of reach lead the direction astray: steps stay short while the
    states are held more and more. Then the same states are tried with a share of the controls.

    Args:
        problem: Whose cost and dynamics the engine has.
        engine: To be started; holds a trajectory without gaps afterwards.
        exact: Whether its Hessians are exact from then on.
        xs: (N+1, nx) the states; the first becomes the problem's.
        us: (N, nu) the controls.
        most: Iterations.
        callback: Called with each line.
        penalties: That the engine adds to the cost; None for none.

    Returns:
        The cost afterwards; the lines, whose costs are those of states with gaps; whether this was interrupted.
    """
    xs, history, J = np.concatenate([problem.x0[None], xs[1:]]), list[Iteration](), partial(_value, problem, penalties)
    rolled, most, interrupted = list[tuple[float, float]](), min(most, MAX_DEFECT_ITERATIONS), False
    for share in [SHARE**k for k in range(SHARES)] + [0.0]:
        cost = engine.start_from_controls(problem.x0, share * us, exact)
        rolled.append((cost if math.isfinite(cost) else math.inf, share))
        try:
            closed = _defect_iterations(problem, engine, J, xs, share * us, (most, cost), history, callback)
        except (KeyboardInterrupt, StopIteration):
            interrupted = True
            break
        if closed is not None:
            engine.use_second_order(exact)
            engine.state_regularization = 0.0
            return closed, history, False
    return engine.start_from_controls(problem.x0, min(rolled)[1] * us, exact), history, interrupted


def _defect_iterations(
    problem: Problem, engine: Engine, value: Value, xs: np.ndarray, us: np.ndarray, most: tuple[int, float],
    history: list[Iteration], callback: Callable[[Iteration], object] | None,
) -> float | None:  # fmt: skip
    """The steps from one pair of states and controls: the cost where gaps are closed, else None.

    `most` has the iterations in all, and what a rollout without states costs, which one that closes gaps must not.
    """
    space, bounds = space_of(problem.dynamics), problem.bounds
    us = us if bounds is None else bounds.clip(slice(None), us, xs[:-1])
    regularization, nu, fresh = Regularization(engine, False, holds=True), np.zeros(space.ndx), True
    gaps, cost = engine.set_trajectory(xs, us), value(xs, us)
    while len(history) < most[0] and engine.state_regularization <= MAX_STATE_REGULARIZATION and math.isfinite(cost):
        way = engine.defect_direction(gaps, fresh)
        if way is None:
            break
        largest = np.abs(way.multipliers).max(axis=0)
        nu = np.where((nu < 1.1 * largest) | (nu > STALE * largest), ABOVE * largest, nu)
        merit = cost + float(nu @ np.abs(gaps).sum(axis=0))
        slope = way.slope - (merit - cost)
        step, after = engine.rollout_closing_defects(min(merit, most[1]) if math.isfinite(most[1]) else merit, slope)
        closed = step > 0.0
        if not closed:
            step, xs, us, gaps, after = _step(problem, value, xs, us, way, nu, merit, slope, gaps)
        line = (way.gradient_norm, step, -slope, merit - after if closed else cost - after, regularization.shown)
        history.append(Iteration(len(history), cost, *line))
        if callback is not None:
            callback(history[-1])
        if closed:
            return after
        fresh = step > 0.0
        if fresh:
            regularization.decrease(step, False)
            engine.set_trajectory(xs, us)
        else:
            regularization.increase()
        cost = after
    return None


def _step(
    problem: Problem, value: Value, xs: np.ndarray, us: np.ndarray, way: DefectStep, nu: np.ndarray, merit: float,
    slope: float, gaps: np.ndarray,
) -> tuple[float, np.ndarray, np.ndarray, np.ndarray, float]:  # fmt: skip
    """The longest step along a direction that lowers the merit enough, or 0: states, controls, gaps and cost after."""
    space, bounds, step = space_of(problem.dynamics), problem.bounds, 1.0
    for _ in range(HALVINGS):
        trial_x, trial_u = space.integrate(xs, step * way.dxs), us + step * way.dus
        if bounds is not None:
            trial_u = bounds.clip(slice(None), trial_u, trial_x[:-1])
        with np.errstate(all="ignore"):  # a candidate may run away
            J = value(trial_x, trial_u)
            open_ = space.difference(problem.dynamics.step(trial_x[:-1], trial_u), trial_x[1:])
            trial = J + float(nu @ np.abs(open_).sum(axis=0))
        if trial <= merit + ARMIJO_C1 * step * slope:
            return step, trial_x, trial_u, open_, J
        step *= 0.5
    return 0.0, xs, us, gaps, value(xs, us)


def _value(problem: Problem, penalties: BoundPenalties | None, xs: np.ndarray, us: np.ndarray) -> float:
    """The cost with that of penalties."""
    J = problem.cost.value(xs, us)
    return (
        J
        if penalties is None or problem.trajectory_constraints is None
        else J + problem.trajectory_constraints.value(penalties, xs, us)
    )
