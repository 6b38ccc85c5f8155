"""Bounds of the states and exact goals, and their penalties in an augmented Lagrangian.

A component e of the deviation x (-) reference is to stay in lower <= e <= upper. With a multiplier per bound and a
weight w, the penalty is (Rockafellar; Nocedal & Wright, section 17.4)

    1/2 w (max(0, e - (upper - multiplier / w))^2 + max(0, (lower + multiplier / w) - e)^2),

a one-sided parabola at bounds shifted by the multipliers; where lower = upper a parabola. The kernels compute the same
(see kernels.lq.quadratic).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from planner.dynamics.protocol import Dynamics
from planner.model.coordinates import Coordinate
from planner.model.space import StateSpace
from planner.problem.costs.terms import Quadratic

ROUNDING = 1e-9  # relative violation of a bound that counts as none
PARTS = 4  # of a stage, at whose ends ranges are checked


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

    def zero_penalties(self) -> BoundPenalties:
        """Penalties with zero weights."""
        return BoundPenalties(self.lower.copy(), self.upper.copy(), np.zeros_like(self.lower))

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
            beyond = (sign * (e - limit[rows])).reshape(N, PARTS - 1, -1).max(axis=1)
            free = sign * knots
            free[[0, -1]] = -np.inf
            nearer = np.maximum(free[:-1], free[1:])
            kept = np.where(beyond > tolerance, nearer - beyond, np.inf)
            bound[1:-1, ranges] = sign * np.minimum(kept[:-1], kept[1:])[:, ranges]
        return bounds

    def at_bound(self, xs: np.ndarray, tolerance: float) -> np.ndarray:
        """Whether (N+1, H) states are at a bound or outside of it."""
        e = self.deviations(xs)
        return (e >= self.upper - tolerance) | (e <= self.lower + tolerance)

    def value(self, penalties: BoundPenalties, xs: np.ndarray) -> float:
        """The cost that penalties add for states xs (N+1, nx)."""
        above, below = self._violations(penalties, xs)
        return 0.5 * float(np.sum(penalties.weight * (above**2 + below**2)))

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

    def _violations(self, penalties: BoundPenalties, xs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        e = self.deviations(xs)
        return np.maximum(e - penalties.upper, 0.0), np.maximum(penalties.lower - e, 0.0)


def sides_of(penalties: BoundPenalties, e: np.ndarray) -> np.ndarray:
    """Sides of deviations e (N+1, H): 1 above, -1 below, 0 within their bounds."""
    return np.where(e >= penalties.upper, 1.0, np.where(e < penalties.lower, -1.0, 0.0))


def _penalty_gradients(penalties: BoundPenalties, e: np.ndarray, sides: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First and second derivatives (N+1, H) of the parabolas of these sides at deviations e."""
    bound = np.where(sides > 0.0, penalties.upper, np.where(sides < 0.0, penalties.lower, e))
    return penalties.weight * (e - bound), penalties.weight * np.abs(sides)
