"""Augmented Lagrangian (Hestenes, Powell, Rockafellar) for bounds of states, exact goals and constraints.

    repeat   minimize J + penalties at shifted bounds, from the last controls              solvers.slq,
             problem.constraints.trajectory_constraints
             multiplier <- max(0, multiplier + weight (e - bound))               of every bound and stage
             increase the weights of components whose violation did not fall enough
    until    violations are within the tolerance, and no multiplier acts at a bound that is not active

Where clearances or ranges are violated between knots, those of the affected stages are tightened, and the rounds
continue. The plan is no minimum with the tightened bounds, so the slopes of its penalties are no multipliers: the
bounds move with the old ones, and the next update comes after a solve.

The first round has no penalties, and is the only one if its result has no violation. The second takes its weights from
the result of the first, as ALGENCAN does (Birgin and Martinez 2014): the penalties then cost about as much as J, those
of state bounds more. Only clearances have penalties from the beginning, since a trajectory through an obstacle is a
local minimum. They begin softer, as a penalty method (N&W 17.1): along stiff ones a step moves the knot at which a
motion touches an obstacle by one stage or so, while soft ones act on many knots.

Rounds whose violation far exceeds the tolerance end before their minimum (inexact augmented Lagrangian; Bertsekas 1982,
section 2.5): the error of the states is then small against the violation that the round is to reach. So does the first.
The last round is solved to its end once nothing is left to tighten.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from planner.problem.constraints.trajectory_constraints import BoundPenalties, TrajectoryConstraints
from planner.problem.plan import Iteration, Plan, Status
from planner.solvers.options import DEFAULT, SolverOptions

SOFTER = (0.03, 0.2)  # of the first penalties of clearances: shares with which the first round begins
SOFTER_TOLERANCE = 1e-4  # expected reduction, of the cost, below which a solve with a share ends

# One solve from first controls (N, nu) with penalties: an iteration limit, the number of the first line, and its
# inexact_tolerance (see solvers.slq).
Minimize = Callable[[np.ndarray, BoundPenalties | None, int, int, float], Plan]


def augmented_lagrangian(
    constraints: TrajectoryConstraints, tolerance: float, minimize: Minimize, first_guess: np.ndarray,
    max_iterations: int, given: BoundPenalties | None = None, options: SolverOptions = DEFAULT,
) -> Plan:  # fmt: skip
    """The plan of a problem with state bounds or constraints; its history counts the iterations of all rounds.

    Args:
        constraints: Constraints of the problem.
        tolerance: Upper limit of the violations.
        minimize: One solve, see Minimize.
        first_guess: First controls (N, nu).
        max_iterations: Limit of all rounds together.
        given: Penalties of the first round, from a warm start; None for the initial ones.
        options: The constants of the augmented Lagrangian.
    """
    if given is None:
        plan, history, first = _first_round(constraints, minimize, first_guess, max_iterations, 0, options)
    else:
        plan, first = minimize(first_guess, given, max_iterations, 0, 0.0), given
        history = list(plan.history)
    penalties, before = first or constraints.zero_penalties(), np.full(constraints.size, np.inf)
    if plan.status is Status.NOT_FINITE:
        return plan
    inexact, tightenings, violations = 0.0, 0, list[float]()  # largest of each round since the last tightening
    for round_ in range(options.max_outer_iterations):
        error, is_minimum = _error(constraints, penalties, plan), True
        if plan.status is Status.INTERRUPTED:
            return replace(plan, history=tuple(history), bound_penalties=penalties if round_ else first)
        if error.max(initial=0.0) <= tolerance:
            assert plan.problem is not None  # set by solve()
            more, less, through = constraints.violation_between_knots(plan.problem.dynamics, plan.xs, plan.us)
            if tightenings == options.max_tightenings or not (more.any() or less.any()):
                if inexact and len(history) <= max_iterations:
                    plan = minimize(plan.us, penalties, max_iterations + 1 - len(history), len(history), 0.0)
                    history, inexact = history + list(plan.history), 0.0
                    continue
                status = _status(plan, inexact)
                status = Status.OUTSIDE_LIMITS if more[:, constraints.split :].any() else status
                return replace(
                    plan, history=tuple(history), status=status, bound_penalties=penalties if round_ else first
                )
            constraints, tightenings = constraints.tightened(more, less), tightenings + 1
            if through:
                left, first_line = max_iterations + 1 - len(history), len(history)
                plan, lines, again = _first_round(constraints, minimize, first_guess, left, first_line, options)
                penalties, history = again or constraints.zero_penalties(), history + lines
            else:
                penalties = penalties._replace(lower=penalties.lower + more, upper=penalties.upper - less)
                is_minimum = round_ == 0 or not penalties.weight.any()  # then weights are still to be found
            error, before = _error(constraints, penalties, plan), np.full(constraints.size, np.inf)
            violations = []
        violations.append(float(error.max()))
        if _has_stalled(violations, options):
            break
        if len(history) > max_iterations:
            return replace(plan, history=tuple(history), status=Status.MAX_ITERATIONS, bound_penalties=penalties)
        if is_minimum:  # of these penalties: elsewhere their slopes are no multipliers
            penalties = _updated_penalties(constraints, penalties, plan, error, before, options)
        before, inexact = error.max(axis=0), 0.0
        if error.max() > options.exact_rounds_violation * tolerance:
            inexact = _inexact_reduction(penalties, error, options) / max(1.0, abs(plan.cost))
        plan = minimize(plan.us, penalties, max_iterations + 1 - len(history), len(history), inexact)
        history += plan.history
    status = _status(plan, inexact)
    status = status if _error(constraints, penalties, plan).max() <= tolerance else Status.OUTSIDE_LIMITS
    return replace(plan, history=tuple(history), status=status, bound_penalties=penalties)


def _status(plan: Plan, inexact: float) -> Status:
    """The status of a last round; one that was to end before its minimum has not converged."""
    return Status.MAX_ITERATIONS if inexact and plan.status is Status.CONVERGED else plan.status


def _has_stalled(violations: list[float], options: SolverOptions) -> bool:
    """Whether the last rounds have not reduced the violation below stall_ratio times its minimum before."""
    last = options.max_stalled_rounds
    return len(violations) > last and not min(violations[-last:]) < options.stall_ratio * min(violations[:-last])


def _first_round(
    constraints: TrajectoryConstraints, minimize: Minimize, first_guess: np.ndarray, max_iterations: int,
    first_line: int, options: SolverOptions,
) -> tuple[Plan, list[Iteration], BoundPenalties | None]:  # fmt: skip
    """The first solve, its iterations, and its penalties, or None.

    Penalties of clearances are scaled by the cost of the first guess if that exceeds 1: else a path through an obstacle
    may cost less than one around it. They grow to that from the shares of SOFTER.
    """
    first = constraints.initial_penalties()
    if first is None:
        plan = minimize(first_guess, None, max_iterations, first_line, options.first_round_tolerance)
        history, violation = list(plan.history), constraints.violation(plan.xs, plan.us).max(initial=0.0)
        solve_exactly = violation <= options.exact_rounds_violation * constraints.tolerance
        if solve_exactly and plan.status is Status.CONVERGED and len(history) <= max_iterations:
            plan = minimize(plan.us, None, max_iterations + 1 - len(history), first_line + len(history), 0.0)
            history += plan.history
        return plan, history, None
    plan, us, history = minimize(first_guess, None, 0, first_line, 0.0), first_guess, list[Iteration]()
    if 1.0 < plan.cost < options.max_scaling_cost:
        first = first._replace(weight=plan.cost * first.weight)
    for share, tolerance in (*((share, SOFTER_TOLERANCE) for share in SOFTER), (1.0, 0.0)):
        most = max_iterations + bool(history) - len(history)
        soft = first._replace(weight=share * first.weight)
        plan = minimize(us, soft, most, first_line + len(history), tolerance)
        us, history = plan.us, history + list(plan.history)
        if share < 1.0 and plan.status is Status.CONVERGED and len(history) > max_iterations:
            return replace(plan, status=Status.MAX_ITERATIONS), history, soft
        if plan.status in (Status.NOT_FINITE, Status.INTERRUPTED) or len(history) > max_iterations:
            return plan, history, soft
    return plan, history, first


def _inexact_reduction(penalties: BoundPenalties, error: np.ndarray, options: SolverOptions) -> float:
    """The expected reduction below which a round may end, from the errors (N+1, H) of the round before.

    An LQ problem that expects less than 1/2 w d^2 moves a component by less than d. Early multipliers are estimates, so
    d is a small part of the violation that the round is to reach.
    """
    part = options.inner_accuracy * options.required_violation_ratio
    return float(0.5 * part**2 * np.sum(penalties.weight * error**2))


def _error(constraints: TrajectoryConstraints, penalties: BoundPenalties, plan: Plan) -> np.ndarray:
    """(N+1, H) the violation, or without one the slack of a bound with a nonzero multiplier."""
    e, (low, high) = constraints.deviations(plan.xs, plan.us), constraints.inward_shifts(penalties)
    lower, upper = constraints.lower, constraints.upper
    above, below = np.maximum(e - upper, -high), np.maximum(lower - e, -low)
    exact = lower == upper
    return np.where(exact, np.abs(e - np.where(exact, upper, 0.0)), np.maximum(np.abs(above), np.abs(below)))


def _updated_penalties(
    constraints: TrajectoryConstraints, penalties: BoundPenalties, plan: Plan, error: np.ndarray, before: np.ndarray,
    options: SolverOptions,
) -> BoundPenalties:  # fmt: skip
    """Multipliers after a solve, larger weights where the violation did not fall enough, and first ones.

    Bounds that have no weight yet take one from cost and violation, all of them once one of them is violated.
    """
    e, weight = constraints.deviations(plan.xs, plan.us), penalties.weight
    low, high = np.maximum(penalties.lower - e, 0.0), np.maximum(e - penalties.upper, 0.0)  # multipliers over weights
    growth = np.where(error.max(axis=0) > options.required_violation_ratio * before, options.penalty_growth, 1.0)
    growth = np.where(weight.max(axis=0) * growth > options.max_penalty, 1.0, growth)
    lower, upper = shifted_bounds(constraints.lower, constraints.upper, low / growth, high / growth)
    has_weight = weight > 0.0
    outside = float(np.sum(np.where(has_weight, 0.0, constraints.violation(plan.xs, plan.us)) ** 2))
    first = 2.0 * max(abs(plan.cost), np.finfo(float).tiny) / outside if outside else 0.0
    first = first * (np.isfinite(constraints.lower) | np.isfinite(constraints.upper))
    first[:, : constraints.split] *= options.state_bound_penalty_factor
    return BoundPenalties(
        np.where(has_weight, lower, constraints.lower),
        np.where(has_weight, upper, constraints.upper),
        np.where(has_weight, weight * growth, first),
    )


def shifted_bounds(
    lower: np.ndarray, upper: np.ndarray, low: np.ndarray, high: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Bounds shifted inwards by their multipliers over the weights, of the lower and of the upper ones."""
    exact = lower == upper
    shift = np.where(exact, high - low, 0.0)  # one multiplier of either sign
    moved, other = lower + np.where(exact, -shift, low), upper - np.where(exact, shift, high)
    return moved, np.where(exact, moved, other)
