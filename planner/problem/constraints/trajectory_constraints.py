"""What a plan keeps beside the bounds of its controls: ranges of the states, exact goals and constraints, as penalties.

A thing that is kept is a number e with lower <= e <= upper at each knot. With a multiplier per bound and a weight w,
what the cost gains is (Rockafellar; Nocedal & Wright, section 17.4)

    1/2 w (max(0, e - (upper - multiplier / w))^2 + max(0, (lower + multiplier / w) - e)^2),

a hinge at bounds that the multipliers have shifted, as of problem.state_bounds. Columns of e are ranges first, then
rows of constraints; where these are the only ones this file adds nothing to theirs.
"""

from __future__ import annotations

from copy import copy

import numpy as np

from planner.dynamics import Dynamics
from planner.problem.constraints.clearance import PairClearanceFunction
from planner.problem.constraints.constraint_stack import ConstraintStack
from planner.problem.costs.terms import Quadratic
from planner.problem.state_bounds import BoundPenalties, StateBounds


class TrajectoryConstraints:
    """Ranges and rows of constraints side by side.

    Args:
        ranges: Of the states; None for none.
        rows: Of constraints; None for none.
        tolerance: How far beyond each may be.

    Attributes:
        lower: (N+1, H) of all columns.
        upper: (N+1, H).
        split: How many columns are ranges.
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
        """Hinges that weigh nothing."""
        return BoundPenalties(self.lower.copy(), self.upper.copy(), np.zeros_like(self.lower))

    def initial_penalties(self) -> BoundPenalties | None:
        """Hinges of the first solve, of what has weights before multipliers are known; None for none."""
        penalties = self.zero_penalties()
        for measure, columns, scale in self._clearances():
            weight = measure.initial_penalty / scale**2
            penalties.weight[:, columns] = np.where(np.isfinite(self.lower[:, columns]), weight, 0.0)
        return penalties if penalties.weight.any() else None

    def _apart(self) -> list[tuple[PairClearanceFunction, slice, np.ndarray]]:
        """What keeps shapes apart: its measure, its columns and what these are multiplied by."""
        if self.rows is None:
            return []
        return [
            (part.function, slice(self.split + part.columns.start, self.split + part.columns.stop),
             self.rows.scale[part.columns])
            for part in self.rows.parts if isinstance(part.function, PairClearanceFunction)
        ]  # fmt: skip

    def violation_between_knots(self, dynamics: Dynamics, xs: np.ndarray, us: np.ndarray) -> tuple[np.ndarray, bool]:
        """By how much (N+1, H) lower bounds must rise, so that what is kept at knots is kept between them too.

        Those of both ends of a stage. Where a pair may have touched between two knots, those of all stages: the motion
        may have gone through, and from there it leads no way around. Returned beside it is whether any did.
        """
        more, through = np.zeros_like(self.lower), False
        for measure, columns, scale in self._clearances():
            short = measure.clearance_violation(dynamics, xs, us)
            touched = (short > measure.lower).any(axis=0)
            short = np.where(touched, short.max(axis=0), short) * scale
            short = np.where(short > self.tolerance, short, 0.0)
            more[1:, columns] = short
            more[:-1, columns] = np.maximum(more[:-1, columns], short)
            through |= bool(touched.any())
        return more, through

    def tightened(self, more: np.ndarray) -> TrajectoryConstraints:
        """The same with lower bounds (N+1, H) raised."""
        raised = copy(self)
        raised.lower = self.lower + more
        return raised

    def of_ranges(self, penalties: BoundPenalties) -> BoundPenalties:
        """The columns of ranges."""
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
        """How far (N+1, H) the knots are outside; 0 within."""
        if self.rows is None and self.ranges is not None:
            return self.ranges.violation(xs)
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
        if not np.isfinite(xs).all():  # a candidate that ran away
            return float("inf")
        e = self.rows.values(xs, us)
        above, below = np.maximum(e - upper, 0.0), np.maximum(lower - e, 0.0)
        return 0.5 * float(np.sum(weight * (above**2 + below**2)))

    def penalty_derivatives(
        self, penalties: BoundPenalties, xs: np.ndarray, us: np.ndarray, A: np.ndarray, B: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Where rows of constraints pull, and how.

        Returns:
            The knots n (k,) where any does, there the derivatives of all rows by z = (x, u), (k, C, ndx+nu), and the
            first and second derivatives (k, C) of the penalties by the rows.
        """
        assert self.rows is not None
        (N, nu), ndx = us.shape, A.shape[1]
        slope, curvature = self._pull(penalties, xs, us)
        n = np.flatnonzero(curvature.any(axis=1))
        by_z = np.zeros((len(n), slope.shape[1], ndx + nu))
        if len(n):
            by_x, by_u = self.rows.derivatives(xs, us, A, B, curvature > 0.0)
            by_z[:, :, :ndx], last = by_x[n], n < N
            by_z[last, :, ndx:] = by_u[n[last]]
        return n, by_z, slope[n], curvature[n]

    def _pull(self, penalties: BoundPenalties, xs: np.ndarray, us: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """First and second derivatives (N+1, C) of the penalties of constraints by their rows."""
        assert self.rows is not None
        lower, upper, weight = penalties
        if not np.any(weight):
            return np.zeros_like(weight), np.zeros_like(weight)
        e = self.rows.values(xs, us)
        above, below = np.maximum(e - upper, 0.0), np.maximum(lower - e, 0.0)
        return weight * (above - below), weight * ((e >= upper).astype(float) + (e < lower))

    def multipliers(self, penalties: BoundPenalties, xs: np.ndarray, us: np.ndarray) -> tuple[np.ndarray, ...]:
        """Of each constraint (N+1, rows): what the cost would fall by if the bound moved out by one unit, J per unit.

        Positive at an upper bound, negative at a lower one, and zero where neither holds the motion: with them and
        the derivatives of h the gradient of J is zero (the conditions of Karush, Kuhn and Tucker). The rows of a
        constraint of controls are those at the starts of stages, then those at their ends.
        """
        if self.rows is None:
            return ()
        slope, found = self._pull(self.of_rows(penalties), xs, us)[0] * self.rows.scale, dict[int, list[np.ndarray]]()
        for part in self.rows.parts:
            found.setdefault(id(part.constraint), []).append(slope[:, part.columns])
        return tuple(np.concatenate(parts, axis=1) for parts in found.values())
