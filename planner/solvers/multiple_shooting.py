"""Multiple shooting: iterations from a first guess of the states until a rollout closes the defects.

With dynamically infeasible states xs and controls us, stage n has a defect g(n), its end minus the next state. Each
iteration solves the LQ problem with these defects (kernels.lq.defects). One of two steps is taken by the merit function
(N&W 18.3; Han, Powell)

    merit = J(xs, us) + nu' sum |g(n)|,    nu above the multipliers of the defects:

a rollout with the sweep's gains, which closes all defects at once and ends this phase, if its cost is sufficiently
below

    J(xs, us) + closing_share nu' sum |g(n)|,    the merit with a share of 1,

and below that of a rollout of the first controls; else a step length alpha along the direction of states and controls,
which leaves defects (1 - alpha) g to first order. Short steps increase state regularization (see
solvers.step_control), up to a limit. Hessians are Gauss-Newton's.

Early rollouts may be far below the merit and nowhere near the states: a machine that is to jump falls. So along a jump
the share is small; where no step lowers the merit, and in the last iteration, it is 1.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np

from planner.base.arguments import choice
from planner.base.errors import PlannerError
from planner.kernels.lq.line_search import ARMIJO, ARMIJO_C1
from planner.model.space import space_of
from planner.problem.constraints.trajectory_constraints import BoundPenalties
from planner.problem.costs.tracking import states as checked_states
from planner.problem.costs.tracking import tracking_of
from planner.problem.initial_guess import interpolated_states
from planner.problem.plan import Iteration
from planner.problem.problem import Problem
from planner.solvers.engine import DefectStep, Engine, acquire_engine, release_engine
from planner.solvers.options import DEFAULT, SolverOptions
from planner.solvers.step_control import Regularization

ALONG = SolverOptions(max_defect_regularization=1e4)  # along a gait defects fall further where steps are short
# Of a jump the rollout that closes them is to be near the motion. At 1 the first one of a quadruped falls, and the
# solve misses its goal; at a tenth it takes 52 iterations. A pace, which never flies, takes 53 at 1, and fails at a
# tenth.
IN_FLIGHT = SolverOptions(max_defect_regularization=1e4, closing_share=0.1)
GROWTH_MARGIN = 1.1  # nu below this multiple of the largest multiplier is reset

Value = Callable[[np.ndarray, np.ndarray], float]  # of states (N+1, nx) and controls (N, nu)


def guessed_states(problem: Problem, states: np.ndarray | str | None) -> np.ndarray | None:
    """The first guess of the states (N+1, nx) from solve(states=...), or None.

    Raises:
        PlannerError: Neither "line" nor such an array; or "line" for a cost without a final reference.
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
    """The straight line (N+1, nx) to the cost's final reference; None unless all final weights are positive.

    Also None with constraints, since the line may cross an obstacle, and for periodic problems.
    """
    tracking = tracking_of(problem.cost)
    if tracking is None or problem.constraints or problem.periodic is not None:
        return None
    return guessed_states(problem, "line") if np.all(np.diagonal(tracking.Q[-1]) > 0.0) else None


def controls_along(
    problem: Problem, states: np.ndarray, first: np.ndarray, max_iterations: int, options: SolverOptions = ALONG
) -> np.ndarray:
    """Controls (N, nu) of the first rollout that closes the defects of states (N+1, nx), without their limits.

    It begins with the controls `first` (N, nu). Where no rollout closes them, those of the best rollout of shares of
    `first`.
    """
    engine = acquire_engine(problem, ARMIJO)
    _, _, interrupted = close_defects(problem, engine, False, states, first, max_iterations, None, options=options)
    if interrupted:
        raise KeyboardInterrupt
    controls = engine.trajectory()[1]
    release_engine(problem, engine, ARMIJO)
    return controls


def close_defects(
    problem: Problem, engine: Engine, exact: bool, xs: np.ndarray, us: np.ndarray, max_iterations: int,
    callback: Callable[[Iteration], object] | None, penalties: BoundPenalties | None = None,
    options: SolverOptions = DEFAULT,
) -> tuple[float, list[Iteration], bool]:  # fmt: skip
    """Iterate on states with defects until a rollout closes these, within an iteration limit.

    Controls inconsistent with the states give poor directions: steps remain short while state regularization grows.
    Then the same states are tried with a share of the controls (control_share).

    Args:
        problem: Problem of the engine.
        engine: Is started here; its final trajectory has no defects.
        exact: Whether its Hessians are exact afterwards.
        xs: States (N+1, nx); the first is replaced by the problem's start.
        us: Controls (N, nu).
        max_iterations: Limit of the solve; max_defect_iterations limits these iterations too.
        callback: Called with each Iteration.
        penalties: Penalties in the engine's cost, or None.
        options: The constants of multiple shooting.

    Returns:
        The cost of the final rollout; the iterations, whose costs are J(xs, us) with defects; whether interrupted.
    """
    xs, history = np.concatenate([problem.x0[None], xs[1:]]), list[Iteration]()
    J = partial(problem.penalized_cost, penalties)
    rollouts, limit = list[tuple[float, float]](), min(max_iterations, options.max_defect_iterations)
    interrupted = False
    shares = [options.control_share**k for k in range(options.control_trials)] if us.any() else []
    for share in [*shares, 0.0]:
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
    """Iterations from states (N+1, nx) and controls (N, nu): the cost once a rollout closes the defects, else None.

    `limits`: maximum number of iterations in `history`; upper limit of that rollout's cost.
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
        upper, last = (min(cost + share * (merit - cost), limits[1]) for share in (options.closing_share, 1.0))
        step, after = engine.rollout_closing_defects(upper, slope)
        if not (closed := step > 0.0):
            trial = _step(problem, value, xs, us, direction, nu, merit, slope, defects, options.max_defect_halvings)
            if last > upper and (trial[0] == 0.0 or len(history) + 1 == limits[0]):
                step, after = engine.rollout_closing_defects(last, slope)
            if not (closed := step > 0.0):
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
    """Armijo step length for the merit, 0 for none; and states, controls, defects and cost after the step."""
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
