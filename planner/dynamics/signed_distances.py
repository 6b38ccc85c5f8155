"""Signed distances of a mechanism's solids, their derivatives, and lower bounds between two poses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from planner.dynamics.kinematics import LinkPlaces
from planner.kernels.tree.mechanism_table import chain_of
from planner.model.contact.signed_distance import MEASURES, CollisionShape, PlacedShapes, kind_of
from planner.model.mechanism import Mechanism


class SignedDistances:
    """Signed distances of P pairs of solids of a machine and its world, m.

    Args:
        mechanism: The machine.
        pairs: (P,) pairs, each in the order of model.contact.collision_shapes.in_order.
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
        # Joints that move both solids of a pair do not change its distance.
        self._sign = np.zeros((len(pairs), mechanism.nv))
        for k, (one, other) in enumerate(chains):
            self._sign[k, sorted(one - other)], self._sign[k, sorted(other - one)] = 1.0, -1.0

    def values(self, q: Any, beyond: np.ndarray | float = np.inf) -> np.ndarray:
        """Distances (K, P), m, at poses q (K, nq).

        Values above the threshold `beyond` (P,), m, may be the smaller distance of the bounding spheres.
        """
        T = self._places(LinkPlaces(self.mechanism, q).T)
        return self._measured(T, beyond)[0]

    def derivatives(self, q: Any, beyond: np.ndarray | float = np.inf) -> tuple[np.ndarray, np.ndarray]:
        """Distances (K, P), m, and their derivatives by q (K, P, nv), zero for distances above `beyond`, m."""
        at = LinkPlaces(self.mechanism, q)
        values, n, p = self._measured(self._places(at.T), beyond)
        arms = p[:, :, None] - at.origin[:, None]  # (K, P, nv, 3)
        moments = np.cross(arms, n[:, :, None])
        angular, linear = at.screws[..., :3], at.screws[..., 3:]
        along = np.einsum("kia,kpia->kpi", angular, moments) + np.einsum("kia,kpa->kpi", linear, n)
        return values, self._sign * along

    def motion_bound(self, q: Any, dq: np.ndarray) -> np.ndarray:
        """Upper bound (K, P), m, of the relative displacement of points of a pair of solids under dq (K, nv).

        Each joint contributes its largest speed over the bounding sphere of the solid that it moves; for a plane, which
        is unbounded, over that of the other solid.
        """
        at = LinkPlaces(self.mechanism, q)
        centres = self._places(at.T)[..., :3, 3]
        found = np.zeros((len(centres), len(self._pairs)))
        for k, (a, b) in enumerate(self._pairs):
            for i in np.flatnonzero(self._sign[k]):
                s = a if self._sign[k, i] > 0.0 or self._flat[k] else b
                w, v = at.screws[:, i, :3], at.screws[:, i, 3:]
                speed = np.linalg.norm(v + np.cross(w, centres[:, s] - at.origin[:, i]), axis=-1)
                found[:, k] += np.abs(dq[:, i]) * (speed + np.linalg.norm(w, axis=-1) * self._reach[s])
        return found

    def _places(self, T: np.ndarray) -> np.ndarray:
        """Poses (K, S, 4, 4) of the solids, from the link poses T (K, nv, 4, 4)."""
        world = np.broadcast_to(np.eye(4), (len(T), 1, 4, 4))
        return np.concatenate([T, world], axis=1)[:, self._link] @ self._T

    def _measured(self, T: np.ndarray, beyond: np.ndarray | float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Distances (K, P), unit normals and points (K, P, 3), m, of solids with poses T (K, S, 4, 4)."""
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
    """Lower bounds (K-1, P), m, of distances between consecutive poses, from the distances `values` (K, P) at them, m.

    A distance changes by at most the relative displacement, `moved` (K-1, P), m, so the bound is half the sum of both
    distances minus half of it.
    """
    return 0.5 * (values[:-1] + values[1:] - moved)
