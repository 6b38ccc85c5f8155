"""Multiple shooting: states as a first guess. Gaps between the stages are open at first, and close on the way.

From states xs and controls us that need not fit, stage n ends a gap g(n) from the next state. Each iteration solves the
LQ problem whose deviations have these gaps (kernels.lq.gaps). Its direction is taken in one of two ways, measured by

    merit = J(xs, us) + nu' sum |g(n)|,    nu above the multipliers of the gaps (Han, Powell):

a rollout with the sweep's gains, which closes all gaps at once and ends this phase, if its cost falls enough below the
merit; else a part alpha of the direction for states and controls alike, whose gaps are those of the dynamics being
curved. Where steps are short, changes of the states are held (see regularisation). Hessians are Gauss and Newton's.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from planner.base.arguments import choice
from planner.base.errors import PlannerError
from planner.kernels.lq.search import SUFFICIENT
from planner.model.space import space_of
from planner.problem.costs.tracking import states as checked_states
from planner.problem.costs.tracking import tracking_of
from planner.problem.guess import line_of_states
from planner.problem.plan import Iteration
from planner.problem.problem import Problem
from planner.solvers.engine import Engine
from planner.solvers.regularisation import Regularisation

ABOVE = 2.0  # nu over the largest multiplier, when it is set
STALE = 8.0  # nu over the largest multiplier, from which on it is set again
HALVINGS = 12  # of a step, before the states are held more


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
    return line_of_states(space, problem.x0, tracking.x_ref[-1], problem.duration, problem.N)


def close_gaps(
    problem: Problem, engine: Engine, xs: np.ndarray, us: np.ndarray, most: int,
    callback: Callable[[Iteration], object] | None,
) -> tuple[float, list[Iteration]]:  # fmt: skip
    """Take steps across gaps until a rollout closes them; at the latest after `most` of them.

    Args:
        problem: Whose cost and dynamics the engine has.
        engine: After a start; holds the closed trajectory afterwards.
        xs: (N+1, nx) the states; the first becomes the problem's.
        us: (N, nu) the controls.
        most: Iterations.
        callback: Called with each line.

    Returns:
        The cost of the closed trajectory, infinite where no rollout ended, and the lines, whose costs are those of states
        with gaps.
    """
    space, bounds = space_of(problem.dynamics), problem.bounds
    xs = np.concatenate([problem.x0[None], xs[1:]])
    regularisation, history = Regularisation(engine, False, holds=True), list[Iteration]()
    us = us if bounds is None else bounds.clip(slice(None), us, xs[:-1])
    gaps, cost, nu, fresh = engine.place(xs, us), problem.cost.value(xs, us), np.zeros(space.ndx), True
    while len(history) < most and not regularisation.exhausted and math.isfinite(cost):
        way = engine.cross(gaps, fresh)
        if way is None:
            break
        largest = np.abs(way.multipliers).max(axis=0)
        nu = np.where((nu < 1.1 * largest) | (nu > STALE * largest), ABOVE * largest, nu)
        merit = cost + float(nu @ np.abs(gaps).sum(axis=0))
        slope = way.slope - (merit - cost)
        step, after = engine.close(merit, slope)
        closed = step > 0.0
        if not closed:
            step, fresh = 1.0, False
            for _ in range(HALVINGS):
                trial_x, trial_u = space.integrate(xs, step * way.dxs), us + step * way.dus
                if bounds is not None:
                    trial_u = bounds.clip(slice(None), trial_u, trial_x[:-1])
                with np.errstate(all="ignore"):  # a candidate may run away
                    J = problem.cost.value(trial_x, trial_u)
                    open_ = space.difference(problem.dynamics.step(trial_x[:-1], trial_u), trial_x[1:])
                    trial = J + float(nu @ np.abs(open_).sum(axis=0))
                if trial <= merit + SUFFICIENT * step * slope:
                    xs, us, after, fresh = trial_x, trial_u, J, True
                    break
                step *= 0.5
        step = step if closed or fresh else 0.0
        history.append(Iteration(len(history), cost, way.gradient_norm, step, -slope, merit - after, regularisation.shown))
        if callback is not None:
            callback(history[-1])
        if closed:
            return after, history
        if fresh:
            regularisation.lower(step, False)
            gaps, cost = engine.place(xs, us), after
        else:
            regularisation.raise_()
    return engine.close(math.inf, 0.0)[1], history
