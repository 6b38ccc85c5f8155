"""Ranges, exact goals and constraints by augmented Lagrangian (Hestenes, Powell, Rockafellar): SLQ inside a loop.

    repeat   minimize J + penalties at shifted bounds, from the last controls       solvers.slq,
    problem.constraints.trajectory_constraints
             multiplier <- max(0, multiplier + weight (e - bound))               of every bound and stage
             raise the weights of components that came not much nearer
    until    no state is further outside than the tolerance, and no bound pulls that the motion has left

Where shapes are kept apart, bounds of stages rise on which they come too near between the knots, and it goes on.

The first round has no penalties, and is all where nothing is violated. The second takes its weights from what the first
found, as ALGENCAN does (Birgin and Martinez 2014): the penalties then cost about what J does, and those of ranges more.
Only what keeps shapes apart has penalties from the beginning, since a motion that went through an obstacle does not
find
the way around it any more.

Rounds far from the tolerance end before their minimum (inexact augmented Lagrangian; Bertsekas 1982, section 2.5): what
is left of them moves the states by little of the violation that they are to reach. So does the first.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from planner.problem.constraints.trajectory_constraints import TrajectoryConstraints
from planner.problem.plan import Iteration, Plan, Status
from planner.problem.state_bounds import BoundPenalties

MAX_ROUNDS = 30
REQUIRED_VIOLATION_RATIO = 0.25  # of the last violation: what must be reached for the weight to stay
PENALTY_GROWTH = 10.0
MAX_SCALING_COST = 1e6  # a first guess by whose cost penalties are weighed
STATE_BOUND_PENALTY_FACTOR = (
    100.0  # times that weight, of ranges: the LQ problem knows which will pull (kernels.lq.active_set)
)
MAX_STALLED_ROUNDS = (
    6  # rounds, with dearer penalties, within which the least violation must fall below LESS of that before
)
STALL_RATIO = 0.5
MAX_TIGHTENINGS = 5  # times that bounds rise for what comes too near between knots
MAX_PENALTY = 1e12  # beyond which weights drown the cost in rounding

INNER_ACCURACY = (
    0.1  # of the violation that a round is to reach: how far a minimum left early may be from the exact one
)
FIRST_ROUND_TOLERANCE = 1e-2  # of the cost: what is left to gain where the first round ends, if much is violated
EXACT_ROUNDS_VIOLATION = 10.0  # tolerances, up to which rounds are solved exactly

# One solve from first controls (N, nu) with penalties: an iteration limit, the number of the first line, and the share
# of
# the cost below which it may end where no more is left to gain.
Minimize = Callable[[np.ndarray, BoundPenalties | None, int, int, float], Plan]


def augmented_lagrangian(
    kept: TrajectoryConstraints, tolerance: float, minimize: Minimize, first_guess: np.ndarray, max_iterations: int,
    given: BoundPenalties | None = None,
) -> Plan:  # fmt: skip
    """The plan of a problem with ranges of its states or constraints; its history counts the iterations of all rounds.

    Args:
        kept: Of the problem.
        tolerance: How far outside what is kept may be.
        minimize: One solve.
        first_guess: (N, nu).
        max_iterations: Limit of all rounds together.
        given: Hinges of the first round, of a motion nearby; None for those of a motion that nothing is known of.
    """
    if given is None:
        plan, history, first = _first_round(kept, minimize, first_guess, max_iterations, 0)
    else:
        plan, first = minimize(first_guess, given, max_iterations, 0, 0.0), given
        history = list(plan.history)
    penalties, before = first or kept.zero_penalties(), np.full(kept.size, np.inf)
    if plan.status is Status.NOT_FINITE:
        return plan
    raised, worst = 0, list[float]()  # the largest errors, since bounds rose
    for round_ in range(MAX_ROUNDS):
        error = _error(kept, penalties, plan)
        if plan.status is Status.INTERRUPTED:
            return replace(plan, history=tuple(history), bound_penalties=penalties if round_ else first)
        if error.max(initial=0.0) <= tolerance:
            more, through = _between_knots(kept, plan)
            if raised == MAX_TIGHTENINGS or not more.any():
                status = Status.OUTSIDE_LIMITS if more.any() else plan.status
                return replace(
                    plan, history=tuple(history), status=status, bound_penalties=penalties if round_ else first
                )
            kept, raised = kept.tightened(more), raised + 1
            if through:
                left = max_iterations + 1 - len(history)
                plan, more_lines, again = _first_round(kept, minimize, first_guess, left, len(history))
                penalties, history = again or kept.zero_penalties(), history + more_lines
            else:
                penalties = penalties._replace(lower=penalties.lower + more)
            error, before = _error(kept, penalties, plan), np.full(kept.size, np.inf)
            worst = []
        worst.append(float(error.max()))
        if len(worst) > MAX_STALLED_ROUNDS and not min(worst[-MAX_STALLED_ROUNDS:]) < STALL_RATIO * min(
            worst[:-MAX_STALLED_ROUNDS]
        ):
            break
        if len(history) > max_iterations:
            return replace(plan, history=tuple(history), status=Status.MAX_ITERATIONS, bound_penalties=penalties)
        penalties = (
            _first_penalties(kept, plan, penalties)
            if round_ == 0
            else _updated_penalties(kept, penalties, plan, error, before)
        )
        before = error.max(axis=0)
        loose = (
            _loose(penalties, error) / max(1.0, abs(plan.cost))
            if error.max() > EXACT_ROUNDS_VIOLATION * tolerance
            else 0.0
        )
        plan = minimize(plan.us, penalties, max_iterations + 1 - len(history), len(history), loose)
        history += plan.history
        if loose and len(history) <= max_iterations and _error(kept, penalties, plan).max() <= tolerance:
            plan = minimize(plan.us, penalties, max_iterations + 1 - len(history), len(history), 0.0)
            history += plan.history
    status = plan.status if _error(kept, penalties, plan).max() <= tolerance else Status.OUTSIDE_LIMITS
    return replace(plan, history=tuple(history), status=status, bound_penalties=penalties)


def _first_round(
    kept: TrajectoryConstraints, minimize: Minimize, first_guess: np.ndarray, max_iterations: int, first_line: int
) -> tuple[Plan, list[Iteration], BoundPenalties | None]:
    """The first solve, its iterations, and the penalties that it had; None for none.

    Where a motion starts with penalties they weigh as much more as its first guess costs above 1: or it would pay to
    leave
    the way around for one that goes through.
    """
    first = kept.initial_penalties()
    if first is None:
        plan = minimize(first_guess, None, max_iterations, first_line, FIRST_ROUND_TOLERANCE)
        history, near = (
            list(plan.history),
            kept.violation(plan.xs, plan.us).max(initial=0.0) <= EXACT_ROUNDS_VIOLATION * kept.tolerance,
        )
        if near and plan.status is Status.CONVERGED and len(history) <= max_iterations:
            plan = minimize(plan.us, None, max_iterations + 1 - len(history), first_line + len(history), 0.0)
            history += plan.history
        return plan, history, None
    cost = minimize(first_guess, None, 0, first_line, 0.0).cost
    if 1.0 < cost < MAX_SCALING_COST:
        first = first._replace(weight=cost * first.weight)
    plan = minimize(first_guess, first, max_iterations, first_line, 0.0)
    return plan, list(plan.history), first


def _between_knots(kept: TrajectoryConstraints, plan: Plan) -> tuple[np.ndarray, bool]:
    """See Kept.violation_between_knots."""
    assert plan.problem is not None  # the solver's own
    return kept.violation_between_knots(plan.problem.dynamics, plan.xs, plan.us)


def _loose(penalties: BoundPenalties, error: np.ndarray) -> float:
    """The promised decrease below which a round may end whose last one left the errors (N+1, H).

    A model that promises less than 1/2 w d^2 moves a component by less than d. Early multipliers are estimates, so d
    is a small part of the violation that the round is to reach.
    """
    return float(0.5 * (INNER_ACCURACY * REQUIRED_VIOLATION_RATIO) ** 2 * np.sum(penalties.weight * error**2))


def _multipliers(kept: TrajectoryConstraints, penalties: BoundPenalties) -> tuple[np.ndarray, np.ndarray]:
    """Over the weight: by how much (N+1, H) the bounds are shifted, inwards."""
    with np.errstate(invalid="ignore"):
        shifts = penalties.lower - kept.lower, kept.upper - penalties.upper
    return np.nan_to_num(shifts[0], nan=0.0), np.nan_to_num(shifts[1], nan=0.0)


def _error(kept: TrajectoryConstraints, penalties: BoundPenalties, plan: Plan) -> np.ndarray:
    """(N+1, H) how far states are outside, or from a bound that still pulls them."""
    e, (low, high) = kept.deviations(plan.xs, plan.us), _multipliers(kept, penalties)
    above, below = np.maximum(e - kept.upper, -high), np.maximum(kept.lower - e, -low)
    exact = kept.lower == kept.upper
    return np.where(exact, np.abs(e - np.where(exact, kept.upper, 0.0)), np.maximum(np.abs(above), np.abs(below)))


def _first_penalties(kept: TrajectoryConstraints, plan: Plan, first: BoundPenalties) -> BoundPenalties:
    """Weights from what a solve without penalties cost and how far it was outside; multipliers of what had
    penalties.
    """
    had, beyond = first.weight > 0.0, kept.violation(plan.xs, plan.us)
    outside = float(np.sum(np.where(had, 0.0, beyond) ** 2))
    weight = 2.0 * max(abs(plan.cost), np.finfo(float).tiny) / outside if outside else 0.0
    used = (np.isfinite(kept.lower) | np.isfinite(kept.upper)).astype(float)
    used[:, : kept.split] *= STATE_BOUND_PENALTY_FACTOR
    begun = BoundPenalties(kept.lower.copy(), kept.upper.copy(), weight * used)
    if not had.any():
        return begun
    updated = _updated_penalties(kept, first, plan, beyond, np.full(kept.size, np.inf))
    return BoundPenalties(*(np.where(had, new, other) for new, other in zip(updated, begun, strict=True)))


def _updated_penalties(
    kept: TrajectoryConstraints, penalties: BoundPenalties, plan: Plan, error: np.ndarray, before: np.ndarray
) -> BoundPenalties:
    """Multipliers after a solve, and weights raised where it brought little."""
    e, weight = kept.deviations(plan.xs, plan.us), penalties.weight
    low, high = (
        np.maximum(penalties.lower - e, 0.0),
        np.maximum(e - penalties.upper, 0.0),
    )  # multipliers over the weight
    raised = np.where(error.max(axis=0) > REQUIRED_VIOLATION_RATIO * before, PENALTY_GROWTH, 1.0)
    raised = np.where(weight.max(axis=0) * raised > MAX_PENALTY, 1.0, raised)
    return BoundPenalties(*shifted_bounds(kept.lower, kept.upper, low / raised, high / raised), weight * raised)


def shifted_bounds(
    lower: np.ndarray, upper: np.ndarray, low: np.ndarray, high: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Bounds moved inwards by multipliers over the weight, of the lower and of the upper ones."""
    exact = lower == upper
    shift = np.where(exact, high - low, 0.0)  # one multiplier of either sign
    moved, other = lower + np.where(exact, -shift, low), upper - np.where(exact, shift, high)
    return moved, np.where(exact, moved, other)
