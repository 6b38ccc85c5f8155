"""Pairs of solids that a plan keeps apart: one constraint, with a row for each pair.

Kernels know the distances as terms of two solids. Here they are NumPy for all pairs at once, and of pairs that are far
from their bounds the distance of the balls around them stands for theirs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from planner.base.arguments import number, set_fields
from planner.dynamics import Dynamics
from planner.dynamics.signed_distances import SignedDistances, distance_lower_bound
from planner.model.mjcf.collision_pairs import CollisionPair
from planner.problem.constraints.quantities import ResidualFunction, mechanism_of
from planner.problem.costs.penalty import arrays_of_terms
from planner.problem.costs.penalty_terms import Clearance

KNOWN = 2.0  # of what a pair is kept apart by, up to which its distance is computed
PARTS = 8  # of a stage, at which pairs are looked at between knots


@dataclass(frozen=True, eq=False)
class PairClearance:
    """Distances of pairs of shapes, m.

    Attributes:
        pairs: Which, and how far they are to be apart; planner.constraints.Avoid finds them.
        more: (P,) m, by which each is kept further apart than that.
        soft: A violation of so many m costs 1/2 a second in the first solve, before multipliers are known: a motion
            then stays on the side of an obstacle on which its first guess is.
    """

    pairs: tuple[CollisionPair, ...]
    more: np.ndarray
    penalty_length: float
    unit = "m"

    def __post_init__(self) -> None:
        set_fields(
            self,
            pairs=tuple(self.pairs),
            penalty_length=number("penalty_length", self.penalty_length, greater_than=0.0),
        )

    def __str__(self) -> str:
        return "clearance"

    def __repr__(self) -> str:
        return f"Apart({len(self.pairs)} pairs)"

    @property
    def lower(self) -> np.ndarray:
        """(P,) m, how far each pair is kept apart."""
        return np.array([pair.required_clearance for pair in self.pairs]) + self.more

    @property
    def names(self) -> tuple[str, ...]:
        """(P,) of the pairs, short, for pictures."""
        return tuple(pair.names.replace("geom ", "").replace("'", "").replace(" and ", ", ") for pair in self.pairs)

    def constraint_function(self, dynamics: Dynamics, N: int) -> PairClearanceFunction:
        """Of a machine."""
        return PairClearanceFunction(self, dynamics, N)


class PairClearanceFunction(ResidualFunction):
    """The rows of an Apart."""

    def __init__(self, what: PairClearance, dynamics: Dynamics, N: int) -> None:
        mechanism = mechanism_of(dynamics, what)
        terms = [
            Clearance(a=pair.a, b=pair.b, lift=pair.distance_offset, lower=lower, tolerance=1.0)
            for pair, lower in zip(what.pairs, what.lower, strict=True)
        ]
        super().__init__(dynamics, what, arrays_of_terms(mechanism, N, terms, dynamics.dt))
        self._clearances = SignedDistances(mechanism, [pair[:2] for pair in what.pairs])
        self.lower = what.lower
        self._lift = np.array([pair.distance_offset for pair in what.pairs])
        self._known = KNOWN * np.abs(what.lower) + what.penalty_length - self._lift
        self.initial_penalty = dynamics.dt / what.penalty_length**2

    def values(self, xs: np.ndarray, us: np.ndarray, n: np.ndarray) -> np.ndarray:
        """(K, P); of pairs that are further than they need be, no more than their distance."""
        return self._clearances.values(self._q(xs), self._known) + self._lift

    def shown(self, xs: np.ndarray, us: np.ndarray, n: np.ndarray) -> np.ndarray:
        """(K, P) the distances of all pairs, however far, for pictures."""
        return self._clearances.values(self._q(xs)) + self._lift

    def derivatives(self, xs: np.ndarray, us: np.ndarray, n: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(K, P, ndx) and zeros (K, P, nu)."""
        by_x = np.zeros((len(xs), self.rows, self._ndx))
        own = self._clearances.derivatives(self._q(xs), self._known)[1]
        by_x[:, :, : own.shape[2]] = own
        return by_x, np.zeros((len(xs), self.rows, self._nu))

    def clearance_violation(self, dynamics: Dynamics, xs: np.ndarray, us: np.ndarray) -> np.ndarray:
        """By how much (N, P) m pairs come nearer than they may on each stage of a motion xs (N+1, nx), us (N, nu).

        At parts of the stage, by the plan's own integrator; and where pairs move so fast that they may have touched
        between two of these, by what that takes.
        """
        N = len(us)
        times = np.tile(dynamics.dt / PARTS * np.arange(PARTS), N)
        inside = dynamics.step(np.repeat(xs[:-1], PARTS, axis=0), np.repeat(us, PARTS, axis=0), times)
        inside[::PARTS] = xs[:-1]
        states = np.concatenate([inside, xs[-1:]])
        values = self.values(states, us, np.arange(len(states)))
        way = self.mechanism.space.difference(states[1:, : self._nx], states[:-1, : self._nx])
        moved = self._clearances.motion_bound(self._q(states[:-1]), way[:, : self.mechanism.nv])
        nearest = np.minimum(values[:-1], values[1:])
        short = np.maximum(self.lower - nearest, -distance_lower_bound(values, moved))
        return short.reshape(N, PARTS, -1).max(axis=1)

    def _q(self, xs: np.ndarray) -> np.ndarray:
        return xs[:, : self.mechanism.nq]


def pair_clearance_of(constraints: Sequence[object]) -> PairClearance | None:
    """The pairs that constraints keep apart; None for none."""
    return next((one.of for one in constraints if isinstance(getattr(one, "of", None), PairClearance)), None)  # type: ignore[attr-defined]
