"""Poses in which nothing that is kept apart is too near, and ways between them on which nothing comes too near."""

from __future__ import annotations

from functools import partial
from weakref import WeakKeyDictionary

import numpy as np

from planner.dynamics.signed_distances import SignedDistances
from planner.model.mechanism import Mechanism
from planner.problem.constraints.clearance import PairClearance
from planner.problem.rrt_connect import rrt_connect

CLEARANCE_SHARE = 0.5  # of the clearance beyond which a way keeps apart, where it can
CUT = 0.1  # of the clearance that it keeps where its corners are rounded

_ways: WeakKeyDictionary[Mechanism, dict[bytes, np.ndarray | None]] = WeakKeyDictionary()
"""Ways that were found: a problem is built again for every finer step."""


class CollisionChecker:
    """Which poses keep the pairs of a constraint apart.

    Args:
        apart: The pairs, and how far each is to be apart.
        mechanism: Whose poses.
    """

    def __init__(self, apart: PairClearance, mechanism: Mechanism) -> None:
        self._apart, self._mechanism = apart, mechanism
        self._clearances = SignedDistances(mechanism, [pair[:2] for pair in apart.pairs])
        self._lift = np.array([pair.distance_offset for pair in apart.pairs])

    def distances(self, q: np.ndarray, beyond: np.ndarray | float = np.inf) -> np.ndarray:
        """(K, P) m, of poses (K, nq); what is above `beyond` (P,) may be less than it is."""
        return self._clearances.values(q, beyond - self._lift) + self._lift

    def clearance_violation(self, q: np.ndarray) -> float:
        """By how much a pose (nq,) has a pair nearer than it may be, m; 0 for a free one."""
        return float(np.max(self._apart.lower - self.distances(q[None], self._apart.lower)[0], initial=0.0))

    def find_path(self, start: np.ndarray, goal: np.ndarray, seed: int = 0) -> np.ndarray | None:
        """Poses (K, nq) from start to goal (nq,) on which nothing is nearer than it may be; None where none was found.

        It keeps some room more where it can. At the ends pairs may be as near as they are there.
        """
        ways = _ways.setdefault(self._mechanism, {})
        key = b"".join([start.tobytes(), goal.tobytes(), self._apart.lower.tobytes(), seed.to_bytes(8, "little")])
        if key not in ways:
            ways[key] = self._sought(start, goal, seed)
        return ways[key]

    def _sought(self, start: np.ndarray, goal: np.ndarray, seed: int) -> np.ndarray | None:
        ends = self.distances(np.stack([start, goal])).min(axis=0)
        low, high = self._mechanism.joint_range.T
        first, last = np.minimum(start, goal), np.maximum(start, goal)
        low = np.minimum(np.where(np.isfinite(low), low, first - np.pi), first)
        high = np.maximum(np.where(np.isfinite(high), high, last + np.pi), last)
        for room in (CLEARANCE_SHARE, 0.0):
            lower = np.minimum(self._apart.lower * (1.0 + room), ends - 1e-9)

            def free(q: np.ndarray, lower: np.ndarray = lower) -> np.ndarray:
                return np.all(self.distances(q, lower) >= lower, axis=1)

            nearly = partial(free, lower=np.minimum(CUT * self._apart.lower, lower))
            way = rrt_connect(free, start, goal, low, high, seed, nearly)
            if way is not None:
                return way
        return None
