"""The LQ problem with bounds of controls and penalties of states, in NumPy: the twin of kernels.lq.active_set."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from planner.kernels.lq.active_set import MULTIPLIER_ROUNDING, ROUNDING
from planner.problem.control_bounds import StepBounds
from planner.problem.costs.terms import Quadratic
from planner.problem.state_bounds import BoundPenalties, StateBounds, sides_of
from planner.solvers import lq


class StatePenalties(NamedTuple):
    """Hinges of ranges along a trajectory."""

    ranges: StateBounds
    penalties: BoundPenalties
    xs: np.ndarray  # (N+1, nx)


def solve_active_set(
    A: np.ndarray, B: np.ndarray, quadratic: Quadratic, mu: float, bounds: StepBounds | None, second: np.ndarray | None,
    pulling: StatePenalties | None, active_bounds: np.ndarray, most: int,
) -> tuple[lq.Sweep | None, np.ndarray]:  # fmt: skip
    """The sweep whose own linear motion tells the set of held controls and of penalties that it has.

    Args:
        A: (N, ndx, ndx).
        B: (N, ndx, nu).
        quadratic: Of the cost with its penalties as they pull now.
        mu: Regularization, added to R.
        bounds: Of the controls, or None.
        second: (N, ndx+nu, ndx+nu) added to the Hessians, or None.
        pulling: The penalties, or None.
        held: (N, nu) the set to begin with.
        most: Sweeps.

    Returns:
        The sweep, with the slope of the cost along its direction and what the cost falls by in its value; None where
        no set settles or a model is not definite. And the last set of held controls.
    """
    model, more_cost, more_slope, e, sides = quadratic, 0.0, 0.0, None, None
    if pulling is not None:
        e = pulling.ranges.deviations(pulling.xs)
        sides = sides_of(pulling.penalties, e)
    for _ in range(most):
        sweep = lq.riccati(A, B, model, mu, bounds, second, held=active_bounds if bounds is not None else None)
        if sweep is None:
            return None, active_bounds
        dxs, dus = _motion(A, B, sweep)
        after = active_bounds if bounds is None else _held(sweep, bounds, active_bounds, dxs, dus)
        same = np.array_equal(after, active_bounds)
        if pulling is not None and e is not None and sides is not None:
            after_sides = pulling.ranges.next_sides(pulling.penalties, e, dxs, sides)
            same = same and np.array_equal(after_sides, sides)
            _, more_cost, more_slope = pulling.ranges.with_active_sides(
                pulling.penalties, quadratic, pulling.xs, sides, dxs
            )
            if not same:
                sides = after_sides
                model, _, _ = pulling.ranges.with_active_sides(pulling.penalties, quadratic, pulling.xs, sides, dxs)
        if same:
            return sweep._replace(slope=sweep.slope + more_slope, value=sweep.value + more_cost), active_bounds
        active_bounds = after
    return None, active_bounds


def _motion(A: np.ndarray, B: np.ndarray, sweep: lq.Sweep) -> tuple[np.ndarray, np.ndarray]:
    """The linear motion dxs (N+1, ndx), dus (N, nu) of a sweep, with no look at bounds."""
    dxs, dus = np.zeros((len(A) + 1, A.shape[1])), np.empty(sweep.k.shape)
    for n in range(len(A)):
        dus[n] = sweep.k[n] + sweep.K[n] @ dxs[n]
        dxs[n + 1] = A[n] @ dxs[n] + B[n] @ dus[n]
    return dxs, dus


def _held(
    sweep: lq.Sweep, bounds: StepBounds, active_bounds: np.ndarray, dxs: np.ndarray, dus: np.ndarray
) -> np.ndarray:
    """The next set of held controls (N, nu): -1 at the lower bound, 1 at the upper one, 0 free."""
    lower, upper = bounds.lower, bounds.upper
    if bounds.lower_by_x is not None and bounds.upper_by_x is not None:
        lower = lower + np.einsum("nij,nj->ni", bounds.lower_by_x, dxs[:-1])
        upper = upper + np.einsum("nij,nj->ni", bounds.upper_by_x, dxs[:-1])
    parts = [sweep.rows[2][:, :, None], sweep.rows[0] * dus[:, None, :], sweep.rows[1] * dxs[:-1, None, :]]
    multiplier = sum(part.sum(axis=2) for part in parts)
    size = sum(np.abs(part).sum(axis=2) for part in parts)
    slack = ROUNDING * (1.0 + np.abs(dus))
    free = np.where(dus < lower - slack, -1.0, np.where(dus > upper + slack, 1.0, 0.0))
    wrong = (np.abs(multiplier) > MULTIPLIER_ROUNDING * size) & (active_bounds * multiplier > 0.0)
    return np.where(active_bounds == 0.0, free, np.where(wrong, 0.0, active_bounds))
