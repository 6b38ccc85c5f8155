"""Multiple shooting: a first guess of the states, whose defects close on the way.

From states xs and controls us that need not fit, stage n ends with a defect g(n), its difference from the next state.
Each iteration solves the LQ problem with these defects (kernels.lq.defects). Its direction is taken in one of two ways,
measured by the merit function (N&W 18.3; Han, Powell)

    merit = J(xs, us) + nu' sum |g(n)|,    nu above the multipliers of the defects:

a rollout with the sweep's gains, which closes all defects at once and ends this phase, if its cost is sufficiently
below the merit and below that of a rollout of the first controls; else a part alpha of the direction for states and
controls alike, whose defects remain as far as the dynamics are nonlinear. Short steps regularize the states (see
solvers.regularization), up to a limit: a full step closes all defects whatever that weight.
Hessians are Gauss-Newton's.
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
from planner.solvers.options import DEFAULT, SolverOptions
from planner.solvers.regularization import Regularization

GROWTH_MARGIN = 1.1  # nu below this multiple of the largest multiplier is set again

Value = Callable[[np.ndarray, np.ndarray], float]  # of states (N+1, nx) and controls (N, nu)


def guessed_states(problem: Problem, states: np.ndarray | str | None) -> np.ndarray | None:
    """The first guess of the states (N+1, nx) of solve(states=...); its first state is the problem's start.

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
    """The straight line (N+1, nx) to the cost's final reference; None where it does not weigh the whole final state.

    Also None with constraints: the line may cross an obstacle.
    """
    tracking = tracking_of(problem.cost)
    if tracking is None or problem.constraints or problem.periodic is not None:
        return None
    return guessed_states(problem, "line") if np.all(np.diagonal(tracking.Q[-1]) > 0.0) else None


def close_defects(
    problem: Problem, engine: Engine, exact: bool, xs: np.ndarray, us: np.ndarray, max_iterations: int,
    callback: Callable[[Iteration], object] | None, penalties: BoundPenalties | None = None,
    options: SolverOptions = DEFAULT,
) -> tuple[float, list[Iteration], bool]:  # fmt: skip
    """Take steps along states with defects until a rollout closes these, or for a limited number of iterations.

    Controls that do not reach the guessed states spoil the direction: steps stay short while the states are regularized
    more and more. Then the same states are tried with a share of the controls.

    Args:
        problem: Of the engine.
        engine: To be started; it has a trajectory without defects afterwards.
        exact: Whether its Hessians are exact from then on.
        xs: (N+1, nx) the states; the first becomes the problem's.
        us: (N, nu) the controls.
        max_iterations: Of the solve; options limit those with defects.
        callback: Called with each Iteration.
        penalties: That the engine adds to the cost; None for none.
        options: The constants of multiple shooting.

    Returns:
        The cost afterwards; the iterations, whose costs are those of states with defects; whether it was interrupted.
    """
    xs, history, J = np.concatenate([problem.x0[None], xs[1:]]), list[Iteration](), partial(_value, problem, penalties)
    rollouts, limit = list[tuple[float, float]](), min(max_iterations, options.max_defect_iterations)
    interrupted = False
    for share in [options.control_share**k for k in range(options.control_trials)] + [0.0]:
        cost = engine.start_from_controls(problem.x0, share * us, exact)
        rollouts.append((cost if math.isfinite(cost) else math.inf, share))
        try:
            closed = _defect_iterations(problem, engine, J, xs, share * us, (limit, cost), history, callback, options)
        except (KeyboardInterrupt, StopIteration):
            interrupted = True
            break
        if closed is not None:
            engine.use_second_order(exact)
            engine.state_regularization = 0.0
            return closed, history, False
    return engine.start_from_controls(problem.x0, min(rollouts)[1] * us, exact), history, interrupted


def _defect_iterations(
    problem: Problem, engine: Engine, value: Value, xs: np.ndarray, us: np.ndarray, limits: tuple[int, float],
    history: list[Iteration], callback: Callable[[Iteration], object] | None, options: SolverOptions,
) -> float | None:  # fmt: skip
    """The steps from one pair of states and controls: the cost once defects are closed, else None.

    `limits` are those of the iterations in all, and of the cost of a rollout that closes defects: that of the controls.
    """
    space, bounds = space_of(problem.dynamics), problem.bounds
    us = us if bounds is None else bounds.clip(slice(None), us, xs[:-1])
    regularization = Regularization(engine, False, regularize_states=True, options=options)
    nu, relinearize, limit = np.zeros(space.ndx), True, options.max_defect_regularization
    defects, cost = engine.set_trajectory(xs, us), value(xs, us)
    while len(history) < limits[0] and engine.state_regularization <= limit and math.isfinite(cost):
        direction = engine.defect_direction(defects, relinearize)
        if direction is None:
            break
        largest = np.abs(direction.multipliers).max(axis=0)
        outdated = (nu < GROWTH_MARGIN * largest) | (nu > options.max_merit_ratio * largest)
        nu = np.where(outdated, options.merit_factor * largest, nu)
        merit = cost + float(nu @ np.abs(defects).sum(axis=0))
        slope = direction.slope - (merit - cost)
        cost_limit = min(merit, limits[1]) if math.isfinite(limits[1]) else merit
        step, after = engine.rollout_closing_defects(cost_limit, slope)
        closed = step > 0.0
        if not closed:
            trial = _step(problem, value, xs, us, direction, nu, merit, slope, defects, options.max_defect_halvings)
            step, xs, us, defects, after = trial
        actual = merit - after if closed else cost - after
        line = Iteration(len(history), cost, direction.gradient_norm, step, -slope, actual, regularization.weight)
        history.append(line)
        if callback is not None:
            callback(line)
        if closed:
            return after
        relinearize = step > 0.0
        if relinearize:
            regularization.decrease(step, False)
            engine.set_trajectory(xs, us)
        else:
            regularization.increase()
        cost = after
    return None


def _step(
    problem: Problem, value: Value, xs: np.ndarray, us: np.ndarray, direction: DefectStep, nu: np.ndarray,
    merit: float, slope: float, defects: np.ndarray, halvings: int,
) -> tuple[float, np.ndarray, np.ndarray, np.ndarray, float]:  # fmt: skip
    """Armijo's step along a direction for the merit, or 0; with states, controls, defects and cost after it."""
    space, bounds, step = space_of(problem.dynamics), problem.bounds, 1.0
    for _ in range(halvings):
        trial_x, trial_u = space.integrate(xs, step * direction.dxs), us + step * direction.dus
        if bounds is not None:
            trial_u = bounds.clip(slice(None), trial_u, trial_x[:-1])
        with np.errstate(all="ignore"):  # a candidate may diverge
            J = value(trial_x, trial_u)
            trial_defects = space.difference(problem.dynamics.step(trial_x[:-1], trial_u), trial_x[1:])
            trial = J + float(nu @ np.abs(trial_defects).sum(axis=0))
        if trial <= merit + ARMIJO_C1 * step * slope:
            return step, trial_x, trial_u, trial_defects, J
        step *= 0.5
    return 0.0, xs, us, defects, value(xs, us)


def _value(problem: Problem, penalties: BoundPenalties | None, xs: np.ndarray, us: np.ndarray) -> float:
    """The cost with that of penalties."""
    J, constraints = problem.cost.value(xs, us), problem.trajectory_constraints
    return J if penalties is None or constraints is None else J + constraints.value(penalties, xs, us)
