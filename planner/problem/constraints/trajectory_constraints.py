"""TrajectoryConstraints: state bounds, exact goals and constraints of a problem, and their augmented Lagrangian.

A component is a number e with lower <= e <= upper at each knot. With a multiplier per bound and a weight w the penalty
is (Rockafellar; Nocedal & Wright, section 17.4)

    1/2 w (max(0, e - (upper - multiplier / w))^2 + max(0, (lower + multiplier / w) - e)^2),

a one-sided parabola at bounds shifted by the multipliers, as in problem.state_bounds. Columns of e are those of state
bounds, then those of constraints.
"""

from __future__ import annotations

from copy import copy

import numpy as np

from planner.dynamics import Dynamics
from planner.problem.constraints.clearance import PairClearanceFunction
from planner.problem.constraints.constraint_stack import ConstraintStack
from planner.problem.costs.terms import Quadratic
from planner.problem.state_bounds import BoundPenalties, StateBounds

BETWEEN_KNOTS = 5.0  # tolerances by which a range may be violated between knots: half of what passes in a replay


class TrajectoryConstraints:
    """State bounds and constraints side by side.

    Args:
        ranges: Bounds of the states; None for none.
        rows: Constraints; None for none.
        tolerance: The largest violation that passes.

    Attributes:
        lower: (N+1, H) of all columns.
        upper: (N+1, H).
        split: Number of columns of state bounds.
    """

    def __init__(self, ranges: StateBounds | None, rows: ConstraintStack | None, tolerance: float) -> None:
        self.ranges, self.rows, self.tolerance = ranges, rows, tolerance
        parts = [part for part in (ranges, rows) if part is not None]
        self.lower = np.concatenate([part.lower for part in parts], axis=1)
        self.upper = np.concatenate([part.upper for part in parts], axis=1)
        self.split = 0 if ranges is None else ranges.lower.shape[1]

    @property
    def size(self) -> int:
        """H, the number of columns."""
        return self.lower.shape[1]

    def zero_penalties(self) -> BoundPenalties:
        """Penalties with zero weights."""
        return BoundPenalties(self.lower.copy(), self.upper.copy(), np.zeros_like(self.lower))

    def initial_penalties(self) -> BoundPenalties | None:
        """Penalties of the first solve, of clearance alone: before multipliers are known; None for none."""
        penalties = self.zero_penalties()
        for function, columns, scale in self._clearances():
            weight = function.initial_penalty / scale**2
            penalties.weight[:, columns] = np.where(np.isfinite(self.lower[:, columns]), weight, 0.0)
        return penalties if penalties.weight.any() else None

    def _clearances(self) -> list[tuple[PairClearanceFunction, slice, np.ndarray]]:
        """Clearance constraints: function, columns and scale of each."""
        if self.rows is None:
            return []
        return [
            (part.function, slice(self.split + part.columns.start, self.split + part.columns.stop),
             self.rows.scale[part.columns])
            for part in self.rows.parts if isinstance(part.function, PairClearanceFunction)
        ]  # fmt: skip

    def violation_between_knots(
        self, dynamics: Dynamics, xs: np.ndarray, us: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, bool]:
        """Required shifts (N+1, H) of the lower and upper bounds, and whether a pair may have touched between knots.

        Bounds move inwards at both ends of a stage with a violation inside, of ranges from BETWEEN_KNOTS tolerances on.
        Where a pair may have touched, those of all stages do: the motion may have passed through the obstacle.
        """
        more, less, through = np.zeros_like(self.lower), np.zeros_like(self.lower), False
        if self.ranges is not None:
            k = slice(0, self.split)
            low, high = self.ranges.bounds_for_stages(dynamics, xs, us, BETWEEN_KNOTS * self.tolerance)
            more[:, k] = np.subtract(low, self.lower[:, k], where=np.isfinite(low), out=more[:, k].copy()).clip(0.0)
            less[:, k] = np.subtract(self.upper[:, k], high, where=np.isfinite(high), out=less[:, k].copy()).clip(0.0)
        for function, columns, scale in self._clearances():
            violation = function.clearance_violation(dynamics, xs, us)
            touched = (violation > function.lower).any(axis=0)
            violation = np.where(touched, violation.max(axis=0), violation) * scale
            violation = np.where(violation > self.tolerance, violation, 0.0)
            more[1:, columns] = violation
            more[:-1, columns] = np.maximum(more[:-1, columns], violation)
            through |= bool(touched.any())
        return more, less, through

    def tightened(self, more: np.ndarray, less: np.ndarray) -> TrajectoryConstraints:
        """The same with lower bounds raised and upper ones lowered by (N+1, H); where they would cross, neither."""
        tightened, fits = copy(self), self.lower + more <= self.upper - less
        tightened.lower = np.where(fits, self.lower + more, self.lower)
        tightened.upper = np.where(fits, self.upper - less, self.upper)
        return tightened

    def of_ranges(self, penalties: BoundPenalties) -> BoundPenalties:
        """The columns of state bounds."""
        return penalties if self.rows is None else BoundPenalties(*(part[:, : self.split] for part in penalties))

    def of_rows(self, penalties: BoundPenalties) -> BoundPenalties:
        """The columns of constraints."""
        return BoundPenalties(*(part[:, self.split :] for part in penalties))

    def deviations(self, xs: np.ndarray, us: np.ndarray) -> np.ndarray:
        """Returns e (N+1, H) of states xs (N+1, nx) and controls us (N, nu)."""
        parts = [] if self.ranges is None else [self.ranges.deviations(xs)]
        if self.rows is not None:
            parts.append(self.rows.values(xs, us))
        return parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)

    def violation(self, xs: np.ndarray, us: np.ndarray) -> np.ndarray:
        """(N+1, H) at the knots, 0 within bounds."""
        e = self.deviations(xs, us)
        return np.maximum(np.maximum(e - self.upper, self.lower - e), 0.0)

    def value(self, penalties: BoundPenalties, xs: np.ndarray, us: np.ndarray) -> float:
        """The cost that penalties add."""
        J = 0.0 if self.ranges is None else self.ranges.value(self.of_ranges(penalties), xs)
        return J if self.rows is None else J + self.value_of_rows(self.of_rows(penalties), xs, us)

    def with_penalties(
        self, penalties: BoundPenalties, model: Quadratic, xs: np.ndarray, us: np.ndarray, A: np.ndarray, B: np.ndarray
    ) -> Quadratic:
        """A cost's quadratic model along xs (N+1, nx), us (N, nu) with that of the penalties; A and B of Eq. 35."""
        if self.ranges is not None:
            model = self.ranges.with_penalties(self.of_ranges(penalties), model, xs)
        if self.rows is None:
            return model
        n, by_z, slope, curvature = self.penalty_derivatives(self.of_rows(penalties), xs, us, A, B)
        if not len(n):
            return model
        ndx, (N, nu) = A.shape[1], us.shape
        h, H = np.zeros((N + 1, ndx + nu)), np.zeros((N + 1, ndx + nu, ndx + nu))
        h[n] = np.einsum("ncz,nc->nz", by_z, slope)
        H[n] = np.swapaxes(by_z, 1, 2) @ (curvature[:, :, None] * by_z)
        H[n, :ndx, :ndx] += self.rows.second_derivatives(xs, n, slope)
        Q, q = model.Q + H[:, :ndx, :ndx], model.q + h[:, :ndx]
        R, r, S = model.R + H[:-1, ndx:, ndx:], model.r + h[:-1, ndx:], H[:-1, ndx:, :ndx]
        return Quadratic(Q, q, R, r, S if model.S is None else model.S + S)

    def value_of_rows(self, penalties: BoundPenalties, xs: np.ndarray, us: np.ndarray) -> float:
        """The cost that penalties of constraints add."""
        assert self.rows is not None
        lower, upper, weight = penalties
        if not np.any(weight):
            return 0.0
        if not np.isfinite(xs).all():  # a rollout that diverged
            return float("inf")
        e = self.rows.values(xs, us)
        above, below = np.maximum(e - upper, 0.0), np.maximum(lower - e, 0.0)
        return 0.5 * float(np.sum(weight * (above**2 + below**2)))

    def penalty_derivatives(
        self, penalties: BoundPenalties, xs: np.ndarray, us: np.ndarray, A: np.ndarray, B: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Where penalties of constraints act, and their derivatives.

        Returns:
            The knots n (k,) where any is active, there the derivatives of all components by z = (x, u), (k, C, ndx+nu),
            and the first and second derivatives (k, C) of the penalties by the components.
        """
        assert self.rows is not None
        (N, nu), ndx = us.shape, A.shape[1]
        slope, curvature = self._penalty_gradients(penalties, xs, us)
        n = np.flatnonzero(curvature.any(axis=1))
        by_z = np.zeros((len(n), slope.shape[1], ndx + nu))
        if len(n):
            by_x, by_u = self.rows.derivatives(xs, us, A, B, curvature > 0.0)
            by_z[:, :, :ndx], last = by_x[n], n < N
            by_z[last, :, ndx:] = by_u[n[last]]
        return n, by_z, slope[n], curvature[n]

    def _penalty_gradients(
        self, penalties: BoundPenalties, xs: np.ndarray, us: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """First and second derivatives (N+1, C) of the penalties of constraints by their components."""
        assert self.rows is not None
        lower, upper, weight = penalties
        if not np.any(weight):
            return np.zeros_like(weight), np.zeros_like(weight)
        e = self.rows.values(xs, us)
        above, below = np.maximum(e - upper, 0.0), np.maximum(lower - e, 0.0)
        return weight * (above - below), weight * ((e >= upper).astype(float) + (e < lower))

    def multipliers(self, penalties: BoundPenalties, xs: np.ndarray, us: np.ndarray) -> tuple[np.ndarray, ...]:
        """Multipliers (N+1, R) of each constraint: decrease of the cost per unit by which the bound is relaxed.

        Positive at an upper bound, negative at a lower one, zero where neither is active: with them and the derivatives
        of h the gradient of J is zero (conditions of Karush, Kuhn and Tucker). Of a constraint of controls the
        components at the starts of stages come first, then those at their ends.
        """
        if self.rows is None:
            return ()
        slope, found = (
            self._penalty_gradients(self.of_rows(penalties), xs, us)[0] * self.rows.scale,
            dict[int, list[np.ndarray]](),
        )
        for part in self.rows.parts:
            found.setdefault(id(part.constraint), []).append(slope[:, part.columns])
        return tuple(np.concatenate(parts, axis=1) for parts in found.values())
