"""CollisionChecker: clearance of poses, and collision-free paths between two poses."""

from __future__ import annotations

from functools import partial
from weakref import WeakKeyDictionary

import numpy as np

from planner.dynamics.signed_distances import SignedDistances
from planner.model.mechanism import Mechanism
from planner.problem.constraints.clearance import PairClearance
from planner.problem.rrt_connect import rrt_connect

EXTRA_SHARE = 0.5  # of the required clearance, in addition to it, in the first search of a path
ROUNDED_SHARE = 0.1  # of the required clearance, the clearance at rounded corners of a path

_paths: WeakKeyDictionary[Mechanism, dict[bytes, np.ndarray | None]] = WeakKeyDictionary()
"""Cache of paths by ends, clearances and seed, since a problem is rebuilt for every finer discretization."""


class CollisionChecker:
    """Distances of the pairs of a clearance constraint at poses of a mechanism.

    Args:
        clearance: The pairs, and the required distance of each.
        mechanism: The machine.
    """

    def __init__(self, clearance: PairClearance, mechanism: Mechanism) -> None:
        self._lower, self._mechanism = clearance.lower, mechanism
        self._distances = SignedDistances(mechanism, [pair[:2] for pair in clearance.pairs])
        self._offset = np.array([pair.distance_offset for pair in clearance.pairs])

    def distances(self, q: np.ndarray, exact_below: np.ndarray | float = np.inf) -> np.ndarray:
        """(K, P) m at poses (K, nq); above `exact_below` (P,) a lower bound of the distance."""
        return self._distances.values(q, exact_below - self._offset) + self._offset

    def clearance_violation(self, q: np.ndarray) -> float:
        """The largest violation of a required distance at a pose (nq,), m; 0 for none."""
        return float(np.max(self._lower - self.distances(q[None], self._lower)[0], initial=0.0))

    def find_path(self, start: np.ndarray, goal: np.ndarray, seed: int = 0) -> np.ndarray | None:
        """Poses (K, nq) of a collision-free path from start to goal (nq,); None where none was found.

        The search requires EXTRA_SHARE more clearance first, then the required one; never more than at the ends.
        """
        paths = _paths.setdefault(self._mechanism, {})
        key = b"".join([start.tobytes(), goal.tobytes(), self._lower.tobytes(), seed.to_bytes(8, "little")])
        if key not in paths:
            paths[key] = self._search(start, goal, seed)
        return paths[key]

    def _search(self, start: np.ndarray, goal: np.ndarray, seed: int) -> np.ndarray | None:
        at_ends = self.distances(np.stack([start, goal])).min(axis=0)
        low, high = self._mechanism.joint_range.T
        first, last = np.minimum(start, goal), np.maximum(start, goal)
        low = np.minimum(np.where(np.isfinite(low), low, first - np.pi), first)
        high = np.maximum(np.where(np.isfinite(high), high, last + np.pi), last)
        for extra in (EXTRA_SHARE, 0.0):
            lower = np.minimum(self._lower * (1.0 + extra), at_ends - 1e-9)

            def is_free(q: np.ndarray, lower: np.ndarray = lower) -> np.ndarray:
                return np.all(self.distances(q, lower) >= lower, axis=1)

            is_nearly_free = partial(is_free, lower=np.minimum(ROUNDED_SHARE * self._lower, lower))
            path = rrt_connect(is_free, start, goal, low, high, seed, is_nearly_free)
            if path is not None:
                return path
        return None
