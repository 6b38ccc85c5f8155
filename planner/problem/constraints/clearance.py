"""Clearance between pairs of collision shapes: one constraint, with a component for each pair.

The kernels compute the distances as terms of two shapes. Here NumPy computes all pairs at once; well above its bound a
pair's distance is replaced by that of the bounding spheres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from planner.base.arguments import number, set_fields
from planner.dynamics import Dynamics
from planner.dynamics.signed_distances import SignedDistances, distance_lower_bound
from planner.model.mjcf.collision_pairs import CollisionPair
from planner.problem.constraints.quantities import KernelResidual, mechanism_of
from planner.problem.costs.penalty import arrays_of_terms
from planner.problem.costs.penalty_terms import Clearance

EXACT_RANGE = 2.0  # of the required clearance, up to which distances are exact
PARTS = 8  # of a stage, at whose ends clearance is checked between knots


@dataclass(frozen=True, eq=False)
class PairClearance:
    """Distances of pairs of shapes, m.

    Attributes:
        pairs: Pairs with the required clearance of each; planner.constraints.Avoid finds them.
        more: (P,) m, clearance in addition to that.
        penalty_length: m, violation that costs 1/2 per second in the first solve, before multipliers are known. The
            trajectory then stays on the side of an obstacle on which its first guess is.
    """

    pairs: tuple[CollisionPair, ...]
    more: np.ndarray
    penalty_length: float
    unit = "m"

    def __post_init__(self) -> None:
        length = number("penalty_length", self.penalty_length, greater_than=0.0)
        set_fields(self, pairs=tuple(self.pairs), penalty_length=length)

    def __str__(self) -> str:
        return "clearance"

    def __repr__(self) -> str:
        return f"PairClearance({len(self.pairs)} pairs)"

    @property
    def lower(self) -> np.ndarray:
        """(P,) m, the required clearance of each pair."""
        return np.array([pair.required_clearance for pair in self.pairs]) + self.more

    @property
    def names(self) -> tuple[str, ...]:
        """(P,) short names of the pairs, for pictures."""
        return tuple(pair.names.replace("geom ", "").replace("'", "").replace(" and ", ", ") for pair in self.pairs)

    def residual_function(self, dynamics: Dynamics, N: int) -> PairClearanceFunction:
        """The constraint function for a machine."""
        return PairClearanceFunction(self, dynamics, N)


class PairClearanceFunction(KernelResidual):
    """The distances of a PairClearance, and their violation between knots."""

    def __init__(self, what: PairClearance, dynamics: Dynamics, N: int) -> None:
        mechanism = mechanism_of(dynamics, what)
        terms = [
            Clearance(a=pair.a, b=pair.b, lift=pair.distance_offset, lower=lower, tolerance=1.0)
            for pair, lower in zip(what.pairs, what.lower, strict=True)
        ]
        super().__init__(dynamics, what, arrays_of_terms(mechanism, N, terms, dynamics.dt))
        self._distances = SignedDistances(mechanism, [pair[:2] for pair in what.pairs])
        self.lower = what.lower
        self._offset = np.array([pair.distance_offset for pair in what.pairs])
        self._exact_below = EXACT_RANGE * np.abs(what.lower) + what.penalty_length - self._offset
        self.initial_penalty = dynamics.dt / what.penalty_length**2

    def values(self, xs: np.ndarray, us: np.ndarray, n: np.ndarray) -> np.ndarray:
        """(K, P) m, distances; a lower bound of the distance for pairs well above their bounds."""
        return self._distances.values(self._q(xs), self._exact_below) + self._offset

    def shown(self, xs: np.ndarray, us: np.ndarray, n: np.ndarray) -> np.ndarray:
        """(K, P) m, the exact distances of all pairs, for pictures."""
        return self._distances.values(self._q(xs)) + self._offset

    def derivatives(self, xs: np.ndarray, us: np.ndarray, n: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(K, P, ndx) and zeros (K, P, nu)."""
        by_x = np.zeros((len(xs), self.rows, self._ndx))
        own = self._distances.derivatives(self._q(xs), self._exact_below)[1]
        by_x[:, :, : own.shape[2]] = own
        return by_x, np.zeros((len(xs), self.rows, self._nu))

    def clearance_violation(self, dynamics: Dynamics, xs: np.ndarray, us: np.ndarray) -> np.ndarray:
        """The largest violation (N, P), m, on each stage of a trajectory xs (N+1, nx), us (N, nu).

        It is checked at the ends of PARTS of the stage, by the plan's own integrator. Between these, a lower bound of
        the distance that follows from the motion of the shapes must not be negative.
        """
        N = len(us)
        times = np.tile(dynamics.dt / PARTS * np.arange(PARTS), N)
        inside = dynamics.step(np.repeat(xs[:-1], PARTS, axis=0), np.repeat(us, PARTS, axis=0), times)
        inside[::PARTS] = xs[:-1]
        states = np.concatenate([inside, xs[-1:]])
        values = self.values(states, us, np.arange(len(states)))
        displacement = self.mechanism.space.difference(states[1:, : self._nx], states[:-1, : self._nx])
        motion = self._distances.motion_bound(self._q(states[:-1]), displacement[:, : self.mechanism.nv])
        nearest = np.minimum(values[:-1], values[1:])
        violation = np.maximum(self.lower - nearest, -distance_lower_bound(values, motion))
        return violation.reshape(N, PARTS, -1).max(axis=1)

    def _q(self, xs: np.ndarray) -> np.ndarray:
        return xs[:, : self.mechanism.nq]


def pair_clearance_of(constraints: Sequence[object]) -> PairClearance | None:
    """The PairClearance among constraints; None for none."""
    return next((one.of for one in constraints if isinstance(getattr(one, "of", None), PairClearance)), None)  # type: ignore[attr-defined]
