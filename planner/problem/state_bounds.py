"""Ranges of the states and exact goals, as a problem has them and as penalties of an augmented Lagrangian.

A component e of the deviation x (-) reference is to stay in lower <= e <= upper. With a multiplier per bound and a
weight w, what the cost gains is (Rockafellar; Nocedal & Wright, section 17.4)

    1/2 w (max(0, e - (upper - multiplier / w))^2 + max(0, (lower + multiplier / w) - e)^2),

a hinge at bounds that the multipliers have shifted; where lower = upper it is a parabola. The kernels compute the
same (see kernels.lq.quadratic).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from planner.model.coordinates import Coordinate
from planner.model.space import StateSpace
from planner.problem.costs.terms import Quadratic

ROUNDING = 1e-9  # of a deviation: how far one may be beyond its bound and still count as within


class BoundPenalties(NamedTuple):
    """Shifted bounds and weights of each component's range, as a plan keeps them."""

    lower: np.ndarray  # (N+1, H)
    upper: np.ndarray  # (N+1, H)
    weight: np.ndarray  # (N+1, H)


@dataclass(frozen=True, eq=False)
class StateBounds:
    """H components of the deviations from a reference, and their ranges."""

    space: StateSpace  # Of the states
    reference: np.ndarray  # (N+1, nx)
    component: np.ndarray  # (H,) of a deviation (ndx,)
    lower: np.ndarray  # (N+1, H), of the deviation; -inf where there is none
    upper: np.ndarray  # (N+1, H)
    at_end: int  # How many of them, the last ones, are exact goals: for the end alone
    coordinates: tuple[Coordinate, ...]  # (H,) their names and units

    def zero_penalties(self) -> BoundPenalties:
        """Penalties with zero weights."""
        return BoundPenalties(self.lower.copy(), self.upper.copy(), np.zeros_like(self.lower))

    def deviations(self, xs: np.ndarray) -> np.ndarray:
        """The components (N+1, H) of states xs (N+1, nx)."""
        return self.space.difference(xs, self.reference)[:, self.component]

    def violation(self, xs: np.ndarray) -> np.ndarray:
        """How far (M+1, H) states lie outside of their ranges; 0 within.

        At the knots (M = N), or at equal parts of every stage too, which have the reference and range of its start
        (the start itself is free, so the first stage has those of its end).
        """
        N, i = len(self.reference) - 1, np.arange(len(xs))
        rows = i * N // (len(xs) - 1)
        rows[(rows == 0) & (i > 0)] = min(1, N - 1)
        e = self.space.difference(xs, self.reference[rows])[:, self.component]
        return np.maximum(np.maximum(e - self.upper[rows], self.lower[rows] - e), 0.0)

    def at_bound(self, xs: np.ndarray, tolerance: float) -> np.ndarray:
        """Whether (N+1, H) states are at a bound or outside of it."""
        e = self.deviations(xs)
        return (e >= self.upper - tolerance) | (e <= self.lower + tolerance)

    def value(self, bound_penalties: BoundPenalties, xs: np.ndarray) -> float:
        """The cost that penalties add for states xs (N+1, nx)."""
        above, below = self._beyond(bound_penalties, xs)
        return 0.5 * float(np.sum(bound_penalties.weight * (above**2 + below**2)))

    def with_penalties(self, bound_penalties: BoundPenalties, model: Quadratic, xs: np.ndarray) -> Quadratic:
        """The quadratic model of a cost along xs (N+1, nx) with that of the penalties."""
        return self._with(
            model, xs, *_penalty_gradients(bound_penalties, e := self.deviations(xs), sides_of(bound_penalties, e))
        )

    def next_sides(
        self, bound_penalties: BoundPenalties, e: np.ndarray, dxs: np.ndarray, sides: np.ndarray
    ) -> np.ndarray:
        """Where deviations e (N+1, H) are, in terms of sides_of, when the states have moved by dxs (N+1, ndx).

        Exact goals and rotations stay where they are (see kernels.lq.active_set).
        """
        slack = np.where(sides == 0.0, 1.0, -1.0) * ROUNDING * (1.0 + np.abs(e))
        after = e + dxs[:, self.component]
        moved = np.where(
            after > bound_penalties.upper + slack, 1.0, np.where(after < bound_penalties.lower - slack, -1.0, 0.0)
        )
        rotations = [j + i for _, j in self.space.quaternions for i in range(3)]
        return np.where(
            (bound_penalties.lower == bound_penalties.upper) | np.isin(self.component, rotations), sides, moved
        )

    def with_active_sides(
        self, bound_penalties: BoundPenalties, model: Quadratic, xs: np.ndarray, sides: np.ndarray, dxs: np.ndarray
    ) -> tuple[Quadratic, float, float]:
        """A model along xs with the penalties' own parabolas replaced by those of other sides.

        Returns:
            The model; by how much more than the cost it costs where it begins; and by how much the slope of the cost
            along dxs (N+1, ndx) is above its own.
        """
        e = self.deviations(xs)
        (pull, own), (curvature, own_curvature) = zip(
            _penalty_gradients(bound_penalties, e, sides),
            _penalty_gradients(bound_penalties, e, sides_of(bound_penalties, e)),
            strict=True,
        )
        rows = self.space.difference_jacobian(self.space.difference(xs, self.reference))[:, self.component]
        weight = np.where(bound_penalties.weight > 0.0, bound_penalties.weight, 1.0)
        more_slope = np.einsum("nh,nhi,ni->", own - pull, rows, dxs)
        more_cost = 0.5 * np.sum((pull**2 - own**2) / weight)
        return self._with(model, xs, pull - own, curvature - own_curvature), float(more_cost), float(more_slope)

    def _with(self, model: Quadratic, xs: np.ndarray, slope: np.ndarray, curvature: np.ndarray) -> Quadratic:
        """A model with first and second derivatives (N+1, H) by the deviations added."""
        rows = self.space.difference_jacobian(self.space.difference(xs, self.reference))[:, self.component]
        q = model.q + np.einsum("nhi,nh->ni", rows, slope)
        return model._replace(Q=model.Q + np.einsum("nhi,nh,nhj->nij", rows, curvature, rows), q=q)

    def _beyond(self, bound_penalties: BoundPenalties, xs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        e = self.deviations(xs)
        return np.maximum(e - bound_penalties.upper, 0.0), np.maximum(bound_penalties.lower - e, 0.0)


def sides_of(bound_penalties: BoundPenalties, e: np.ndarray) -> np.ndarray:
    """Where deviations e (N+1, H) are: above 1, below -1, within 0."""
    return np.where(e >= bound_penalties.upper, 1.0, np.where(e < bound_penalties.lower, -1.0, 0.0))


def _penalty_gradients(
    bound_penalties: BoundPenalties, e: np.ndarray, sides: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """First and second derivatives (N+1, H) of the parabolas of these sides at deviations e."""
    bound = np.where(sides > 0.0, bound_penalties.upper, np.where(sides < 0.0, bound_penalties.lower, e))
    return bound_penalties.weight * (e - bound), bound_penalties.weight * np.abs(sides)
