"""Distances of a mechanism's solids, their derivatives, and how near they can have come between two poses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from planner.dynamics.batch import KernelCall
from planner.dynamics.kinematics import link_places
from planner.kernels.tree.mechanism_table import chain_of
from planner.model.contact.signed_distance import MEASURES, CollisionShape, PlacedShapes, kind_of
from planner.model.mechanism import Mechanism


class SignedDistances:
    """Signed distances of pairs of solids of a machine and its world, m.

    Args:
        mechanism: The machine.
        pairs: (P) solids in the order of model.contact.collision_shapes.in_order.
    """

    def __init__(self, mechanism: Mechanism, pairs: Sequence[tuple[CollisionShape, CollisionShape]]) -> None:
        self.mechanism = mechanism
        solids = list({id(solid): solid for pair in pairs for solid in pair}.values())
        place = {id(solid): i for i, solid in enumerate(solids)}
        self._link = np.array([solid.link for solid in solids], dtype=np.int64)
        self._T = np.array([solid.T for solid in solids]).reshape(-1, 4, 4)
        self._half = np.array([solid.half for solid in solids]).reshape(-1, 3)
        self._radius = np.array([solid.radius for solid in solids])
        self._reach = np.array([solid.reach for solid in solids])
        self._pairs = np.array([[place[id(solid)] for solid in pair] for pair in pairs], dtype=np.int64).reshape(-1, 2)
        self._kind = np.array([kind_of(*pair) for pair in pairs], dtype=np.int64)
        self._flat = np.array([pair[1].plane for pair in pairs], dtype=bool)
        chains = [[set(chain_of(mechanism.parent, solid.link)) for solid in pair] for pair in pairs]
        # What moves both of a pair changes no distance.
        self._sign = np.zeros((len(pairs), mechanism.nv))
        for k, (one, other) in enumerate(chains):
            self._sign[k, sorted(one - other)], self._sign[k, sorted(other - one)] = 1.0, -1.0

    def values(self, q: Any, beyond: np.ndarray | float = np.inf) -> np.ndarray:
        """Distances (K, P) in poses q (K, nq).

        What is above `beyond` (P,) need not be known: it may be the distance of the balls around both, which is less.
        """
        T = self._places(link_places(KernelCall(self.mechanism, q=q))[0])
        return self._measured(T, beyond)[0]

    def derivatives(self, q: Any, beyond: np.ndarray | float = np.inf) -> tuple[np.ndarray, np.ndarray]:
        """Distances (K, P) and their derivatives by motion (K, P, nv), which are zero above `beyond`."""
        T, screws, origin = link_places(KernelCall(self.mechanism, q=q))
        values, n, p = self._measured(self._places(T), beyond)
        arms = p[:, :, None] - origin[:, None]  # (K, P, nv, 3)
        moments = np.cross(arms, n[:, :, None])
        along = np.einsum("kia,kpia->kpi", screws[..., :3], moments) + np.einsum("kia,kpa->kpi", screws[..., 3:], n)
        return values, self._sign * along

    def motion_bound(self, q: Any, dq: np.ndarray) -> np.ndarray:
        """How far at most (K, P) a motion dq (K, nv) moves any point of one of a pair relative to the other, m.

        By a screw of unit speed no point of a ball around a solid moves faster. A plane has no ball, so what moves it
        is seen from the other's.
        """
        T, screws, origin = link_places(KernelCall(self.mechanism, q=q))
        centres = self._places(T)[..., :3, 3]
        found = np.zeros((len(T), len(self._pairs)))
        for k, (a, b) in enumerate(self._pairs):
            for i in np.flatnonzero(self._sign[k]):
                s = a if self._sign[k, i] > 0.0 or self._flat[k] else b
                w, v = screws[:, i, :3], screws[:, i, 3:]
                speed = np.linalg.norm(v + np.cross(w, centres[:, s] - origin[:, i]), axis=-1)
                found[:, k] += np.abs(dq[:, i]) * (speed + np.linalg.norm(w, axis=-1) * self._reach[s])
        return found

    def _places(self, T: np.ndarray) -> np.ndarray:
        """Poses (K, S, 4, 4) of the solids, of the links' T (K, nv, 4, 4)."""
        world = np.broadcast_to(np.eye(4), (len(T), 1, 4, 4))
        return np.concatenate([T, world], axis=1)[:, self._link] @ self._T

    def _measured(self, T: np.ndarray, beyond: np.ndarray | float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Distances (K, P), directions and places (K, P, 3) where solids are at T (K, S, 4, 4)."""
        a, b = self._pairs.T
        way = T[:, a][..., :3, 3] - T[:, b][..., :3, 3]
        over = np.sum(way * T[:, b][..., :3, 2], axis=-1)
        far = np.where(self._flat, over, np.sqrt(np.sum(way * way, axis=-1)))
        values = far - self._reach[a] - np.where(self._flat, 0.0, self._reach[b])
        n, p = np.zeros((2, *values.shape, 3))
        near = values < beyond
        for kind, measure in enumerate(MEASURES):
            k, i = np.nonzero(near & (self._kind == kind))
            if len(k):
                values[k, i], n[k, i], p[k, i] = measure(self._placed(T, k, a[i]), self._placed(T, k, b[i]))
        return values, n, p

    def _placed(self, T: np.ndarray, k: np.ndarray, s: np.ndarray) -> PlacedShapes:
        return PlacedShapes(T[k, s, :3, :3], T[k, s, :3, 3], self._half[s], self._radius[s])


def distance_lower_bound(values: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """The least distances (K-1, P) that pairs can have had between poses, from those there (K, P) and how they moved.

    A distance changes no faster than its pair moves: between two poses that are `moved` (K-1, P) m apart it is at least
    half of their sum less half of that.
    """
    return 0.5 * (values[:-1] + values[1:] - moved)
