"""TrajectoryConstraints: state bounds, exact goals and constraints of a problem, and their augmented Lagrangian.

A component is a number e with lower <= e <= upper at each knot: of the deviation x (-) reference, or of a constraint.
With a multiplier per bound and a weight w the penalty is (Rockafellar; Nocedal & Wright, section 17.4)

    1/2 w (max(0, e - (upper - multiplier / w))^2 + max(0, (lower + multiplier / w) - e)^2),

a one-sided parabola at bounds shifted by the multipliers; where lower = upper a parabola. The kernels compute the same
(see kernels.lq.quadratic). Columns of e are those of state bounds, then those of constraints.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from planner.dynamics import Dynamics
from planner.model.coordinates import Coordinate
from planner.model.space import StateSpace
from planner.problem.constraints.clearance import PairClearanceFunction
from planner.problem.constraints.constraint_stack import ConstraintStack
from planner.problem.costs.terms import Quadratic

ROUNDING = 1e-9  # relative violation of a bound that counts as none
PARTS = 4  # of a stage, at whose ends ranges are checked
BETWEEN_KNOTS = 5.0  # tolerances by which a range may be violated between knots: half of what passes in a replay


class BoundPenalties(NamedTuple):
    """Shifted bounds and weights of each component, as a plan stores them."""

    lower: np.ndarray  # (N+1, H)
    upper: np.ndarray  # (N+1, H)
    weight: np.ndarray  # (N+1, H)


@dataclass(frozen=True, eq=False)
class StateBounds:
    """Bounds of H components of the deviations from a reference."""

    space: StateSpace  # Of the states
    reference: np.ndarray  # (N+1, nx)
    component: np.ndarray  # (H,) of a deviation (ndx,)
    lower: np.ndarray  # (N+1, H), of the deviation; -inf where there is none
    upper: np.ndarray  # (N+1, H)
    at_end: int  # Number of exact goals, for the end alone: the last components
    coordinates: tuple[Coordinate, ...]  # (H,) their names and units

    def deviations(self, xs: np.ndarray) -> np.ndarray:
        """The components (N+1, H) of states xs (N+1, nx)."""
        return self.space.difference(xs, self.reference)[:, self.component]

    def violation(self, xs: np.ndarray) -> np.ndarray:
        """(M+1, H) violations of the bounds; 0 within.

        At the knots (M = N), or at equal parts of every stage too, which have the reference and bounds of its start
        (the start itself is unbounded, so the first stage has those of its end).
        """
        N, i = len(self.reference) - 1, np.arange(len(xs))
        rows = i * N // (len(xs) - 1)
        rows[(rows == 0) & (i > 0)] = min(1, N - 1)
        e = self.space.difference(xs, self.reference[rows])[:, self.component]
        return np.maximum(np.maximum(e - self.upper[rows], self.lower[rows] - e), 0.0)

    def bounds_for_stages(
        self, dynamics: Dynamics, xs: np.ndarray, us: np.ndarray, tolerance: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """(N+1, H) lower and upper bounds of knots with which the stages beside them keep the ranges, else -inf, inf.

        A stage is checked at the ends of its PARTS, by the plan's own integrator. From a violation of `tolerance` on,
        the nearer of its two knots must move inwards by as much. The first knot is given, the last one has a goal.
        """
        bounds = np.full(self.lower.shape, -np.inf), np.full(self.upper.shape, np.inf)
        if getattr(dynamics, "integrator", "") == "discrete":  # a map has no states between knots
            return bounds
        N, ranges = len(us), slice(0, self.lower.shape[1] - self.at_end)
        times = np.tile(dynamics.dt / PARTS * np.arange(1, PARTS), N)
        inside = dynamics.step(np.repeat(xs[:-1], PARTS - 1, axis=0), np.repeat(us, PARTS - 1, axis=0), times)
        rows = np.repeat(np.maximum(np.arange(N), min(1, N - 1)), PARTS - 1)
        e = self.space.difference(inside, self.reference[rows])[:, self.component]
        knots = self.deviations(xs)
        for bound, limit, sign in zip(bounds, (self.lower, self.upper), (-1.0, 1.0), strict=True):
            over = (sign * (e - limit[rows])).reshape(N, PARTS - 1, -1).max(axis=1)
            e_knots = sign * knots
            e_knots[[0, -1]] = -np.inf
            nearer = np.maximum(e_knots[:-1], e_knots[1:])
            needed = np.where(over > tolerance, nearer - over, np.inf)
            bound[1:-1, ranges] = sign * np.minimum(needed[:-1], needed[1:])[:, ranges]
        return bounds

    def at_bound(self, xs: np.ndarray, tolerance: float) -> np.ndarray:
        """Whether (N+1, H) states are at a bound or outside of it."""
        e = self.deviations(xs)
        return (e >= self.upper - tolerance) | (e <= self.lower + tolerance)

    def value(self, penalties: BoundPenalties, xs: np.ndarray) -> float:
        """The cost that penalties add for states xs (N+1, nx)."""
        return _penalty(penalties, self.deviations(xs))

    def with_penalties(self, penalties: BoundPenalties, model: Quadratic, xs: np.ndarray) -> Quadratic:
        """The quadratic model of a cost along xs (N+1, nx) with that of the penalties."""
        return self._with(model, xs, *_penalty_gradients(penalties, e := self.deviations(xs), sides_of(penalties, e)))

    def next_sides(self, penalties: BoundPenalties, e: np.ndarray, dxs: np.ndarray, sides: np.ndarray) -> np.ndarray:
        """The sides, as of sides_of, of deviations e (N+1, H) after a step dxs (N+1, ndx) of the states.

        Exact goals and rotations stay where they are (see kernels.lq.active_set).
        """
        slack = np.where(sides == 0.0, 1.0, -1.0) * ROUNDING * (1.0 + np.abs(e))
        after = e + dxs[:, self.component]
        crossed = np.where(after > penalties.upper + slack, 1.0, np.where(after < penalties.lower - slack, -1.0, 0.0))
        rotations = [j + i for _, j in self.space.quaternions for i in range(3)]
        return np.where((penalties.lower == penalties.upper) | np.isin(self.component, rotations), sides, crossed)

    def with_active_sides(
        self, penalties: BoundPenalties, model: Quadratic, xs: np.ndarray, sides: np.ndarray, dxs: np.ndarray
    ) -> tuple[Quadratic, float, float]:
        """A model along xs with the parabolas of the penalties replaced by those of given sides.

        Returns:
            The model; its value at xs less the cost's; and the slope of the cost along dxs (N+1, ndx) less its own.
        """
        e = self.deviations(xs)
        (slope, own), (curvature, own_curvature) = zip(
            _penalty_gradients(penalties, e, sides),
            _penalty_gradients(penalties, e, sides_of(penalties, e)),
            strict=True,
        )
        rows = self.space.difference_jacobian(self.space.difference(xs, self.reference))[:, self.component]
        weight = np.where(penalties.weight > 0.0, penalties.weight, 1.0)
        more_slope = np.einsum("nh,nhi,ni->", own - slope, rows, dxs)
        more_cost = 0.5 * np.sum((slope**2 - own**2) / weight)
        return self._with(model, xs, slope - own, curvature - own_curvature), float(more_cost), float(more_slope)

    def _with(self, model: Quadratic, xs: np.ndarray, slope: np.ndarray, curvature: np.ndarray) -> Quadratic:
        """A model with first and second derivatives (N+1, H) by the deviations added."""
        rows = self.space.difference_jacobian(self.space.difference(xs, self.reference))[:, self.component]
        q = model.q + np.einsum("nhi,nh->ni", rows, slope)
        return model._replace(Q=model.Q + np.einsum("nhi,nh,nhj->nij", rows, curvature, rows), q=q)


def _penalty(penalties: BoundPenalties, e: np.ndarray) -> float:
    """The cost that penalties add for components e (N+1, H)."""
    above, below = np.maximum(e - penalties.upper, 0.0), np.maximum(penalties.lower - e, 0.0)
    return 0.5 * float(np.sum(penalties.weight * (above**2 + below**2)))


def sides_of(penalties: BoundPenalties, e: np.ndarray) -> np.ndarray:
    """Sides of deviations e (N+1, H): 1 above, -1 below, 0 within their bounds."""
    return np.where(e >= penalties.upper, 1.0, np.where(e < penalties.lower, -1.0, 0.0))


def _penalty_gradients(penalties: BoundPenalties, e: np.ndarray, sides: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First and second derivatives (N+1, H) of the parabolas of these sides at deviations e."""
    bound = np.where(sides > 0.0, penalties.upper, np.where(sides < 0.0, penalties.lower, e))
    return penalties.weight * (e - bound), penalties.weight * np.abs(sides)


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

    def inward_shifts(self, penalties: BoundPenalties) -> tuple[np.ndarray, np.ndarray]:
        """Inward shifts (N+1, H) of the lower and of the upper bounds: multipliers over weights."""
        with np.errstate(invalid="ignore"):  # of bounds that are infinite
            shifts = penalties.lower - self.lower, self.upper - penalties.upper
        return np.nan_to_num(shifts[0], nan=0.0), np.nan_to_num(shifts[1], nan=0.0)

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
        if not np.any(penalties.weight):
            return 0.0
        if not np.isfinite(xs).all():  # a rollout that diverged
            return float("inf")
        return _penalty(penalties, self.rows.values(xs, us))

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
