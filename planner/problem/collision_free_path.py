"""Collision-free paths: the clearance of poses, and RRT-Connect, as a first guess (Kuffner and LaValle 2000).

Two trees grow from start and goal towards random poses and towards each other. Samples spread from near the straight
line outwards. The path is then shortened and its corners are rounded. A solver changes a motion a little at a time: it
improves the path, but it does not find on which side to pass an obstacle.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from weakref import WeakKeyDictionary

import numpy as np

from planner.base.errors import PlannerError
from planner.dynamics.contact_kinematics import SignedDistances
from planner.model.mechanism import SCREW, Mechanism
from planner.problem.constraints.clearance import PairClearance
from planner.problem.initial_guess import inverse_dynamics_controls, minimum_jerk

EXTRA_SHARE = 0.5  # of the required clearance, in addition to it, in the first search of a path
ROUNDED_SHARE = 0.1  # of the required clearance, the clearance at rounded corners of a path

_paths: WeakKeyDictionary[Mechanism, dict[bytes, np.ndarray | None]] = WeakKeyDictionary()
"""Cache of paths by all that decides them: ends, pairs, clearances, offsets, seed and number of samples. A problem is
rebuilt for every finer discretization."""
STEP = 0.05  # rad or m of the joint that moves most, between poses that are checked
MAX_STEPS = 10  # by which a tree grows towards a sample
MAX_SAMPLES, MORE_SAMPLES = 600, 3000  # of a search; of one for a motion on which a solve is to begin
PATHS = 4  # searches in vain, after which no further pose of a goal is asked whether a path leads to it
_NO_PATH = 1e-12  # m, violation of a pose to which none is found: less than that of any pose in collision
MIN_SPREAD, MAX_SPREAD = 0.1, 1.5  # rad or m, standard deviation of first and last samples about the straight line
SHORTCUTS = 200  # random straight cuts that are tried
SAMPLES = 200  # equal parts of a path
ROUNDING_SHARES = (0.5, 0.4, 0.3, 0.2, 0.15, 0.1, 0.05)  # of a path's length over which corners are averaged, in order
IsFree = Callable[[np.ndarray], np.ndarray]
"""Poses (K, n) -> (K,) bool, whether each is free of collisions."""


class CollisionChecker:
    """Distances of the pairs of a clearance constraint at poses of a mechanism.

    Args:
        clearance: The pairs, and the required distance of each.
        mechanism: The machine.
    """

    def __init__(self, clearance: PairClearance, mechanism: Mechanism) -> None:
        self._clearance, self._lower, self._mechanism = clearance, clearance.lower, mechanism
        self._distances = SignedDistances(mechanism, [pair[:2] for pair in clearance.pairs])
        self._offset = np.array([pair.distance_offset for pair in clearance.pairs])
        self._names = "\n".join(pair.names for pair in clearance.pairs).encode()

    @property
    def without_extra(self) -> CollisionChecker:
        """The checker of the clearances as they are required, without any more."""
        if not np.any(self._clearance.more):
            return self
        return CollisionChecker(replace(self._clearance, more=np.zeros_like(self._clearance.more)), self._mechanism)

    def distances(self, q: np.ndarray, exact_below: np.ndarray | float = np.inf) -> np.ndarray:
        """(K, P) m at poses (K, nq); above `exact_below` (P,) a lower bound of the distance."""
        return self._distances.values(q, exact_below - self._offset) + self._offset

    def clearance_violation(self, q: np.ndarray) -> float:
        """The largest violation of a required distance at a pose (nq,), m; 0 for none."""
        return float(np.max(self._lower - self.distances(q[None], self._lower)[0], initial=0.0))

    def violation_from(self, start: np.ndarray | None) -> Callable[[np.ndarray], float]:
        """The same as a function of poses (nq,), and a little for one to which no path from a start (nq,) is found."""
        mechanism = self._mechanism
        if start is None or mechanism.has_closed_chains or not has_path_search(mechanism):
            return self.clearance_violation
        if self.clearance_violation(start) > 0.0:
            return self.clearance_violation
        in_vain = 0

        def violation(pose: np.ndarray) -> float:
            nonlocal in_vain
            depth = self.clearance_violation(pose)
            if depth > 0.0 or in_vain == PATHS:
                return max(depth, _NO_PATH)
            found = self.find_path(start, pose) is not None
            in_vain += not found
            return 0.0 if found else _NO_PATH

        return violation

    def find_path(
        self, start: np.ndarray, goal: np.ndarray, seed: int = 0, samples: int = MAX_SAMPLES
    ) -> np.ndarray | None:
        """Poses (K, nq) of a collision-free path from start to goal (nq,); None where none was found in the samples.

        The search requires EXTRA_SHARE more clearance first, then the required one; never more than at the ends. With
        `more` clearance none is sought where there is none without it.
        """
        paths = _paths.setdefault(self._mechanism, {})
        numbers = seed.to_bytes(8, "little"), samples.to_bytes(8, "little")
        sizes = self._lower.tobytes(), self._clearance.more.tobytes(), self._offset.tobytes()
        key = b"".join([start.tobytes(), goal.tobytes(), *sizes, *numbers, self._names])
        if key not in paths:
            closer = self.without_extra
            in_vain = closer is not self and closer.find_path(start, goal, seed, samples) is None
            paths[key] = None if in_vain else self._search(start, goal, seed, samples)
        return paths[key]

    def seek_path(self, start: np.ndarray, goal: np.ndarray) -> np.ndarray | None:
        """The same by a longer search, where the first one finds none."""
        path = self.find_path(start, goal)
        return self.find_path(start, goal, samples=MORE_SAMPLES) if path is None else path

    def _search(self, start: np.ndarray, goal: np.ndarray, seed: int, samples: int) -> np.ndarray | None:
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
            path = rrt_connect(is_free, start, goal, low, high, seed, is_nearly_free, samples)
            if path is not None:
                return path
        return None


def has_path_search(mechanism: Mechanism) -> bool:
    """Whether paths are searched for a machine: for one of hinges and slides without contacts."""
    return not (np.any(mechanism.kind != SCREW) or mechanism.contacts or mechanism.body_contacts)


def collision_free_motion(
    apart: PairClearance, mechanism: Mechanism, x0: np.ndarray, goal: np.ndarray, duration: float, N: int
) -> tuple[np.ndarray, np.ndarray] | None:
    """States (N+1, nx) along a collision-free path, and controls (N, nu) by inverse dynamics.

    None where no path is found, or unless the machine is fully actuated, of hinges and slides, and from rest to rest.
    """
    nq, v = mechanism.nq, mechanism.velocities
    if not has_path_search(mechanism):
        return None
    if np.any(x0[v]) or np.any(goal[v]):
        return None
    path = CollisionChecker(apart, mechanism).seek_path(x0[:nq], goal[:nq])
    if path is None:
        return None
    xs = np.tile(x0, (N + 1, 1))
    xs[:, :nq], xs[:, v], _ = along(path, duration, np.arange(N + 1) / N)
    try:
        return xs, inverse_dynamics_controls(mechanism, *along(path, duration, (np.arange(N) + 0.5) / N))
    except PlannerError:  # the actuators do not reach every joint
        return None


def rrt_connect(
    is_free: IsFree, start: np.ndarray, goal: np.ndarray, lower: np.ndarray, upper: np.ndarray, seed: int = 0,
    is_nearly_free: IsFree | None = None, samples: int = MAX_SAMPLES,
) -> np.ndarray | None:  # fmt: skip
    """Poses (SAMPLES + 1, n) along a free path from start to goal (n,), between bounds; None where none was found.

    The straight line where that is free. Rounded corners need only be `is_nearly_free`.
    """
    if _last_free(is_free, start, goal) is None:
        return _resampled(np.stack([start, goal]))
    rng = np.random.default_rng(seed)
    trees: list[tuple[list[np.ndarray], list[int]]] = [([start], [-1]), ([goal], [-1])]
    for k in range(samples):
        grown, other = trees
        spread = MIN_SPREAD * (MAX_SPREAD / MIN_SPREAD) ** (k / samples)
        sample = start + rng.uniform() * (goal - start) + spread * rng.normal(size=len(start))
        new = _grow(is_free, *grown, np.clip(sample, lower, upper), MAX_STEPS)
        if new is not None:
            reached = _grow(is_free, *other, grown[0][new], 10**6)
            if reached is not None and np.array_equal(other[0][reached], grown[0][new]):
                halves = [_from_root(*grown, new), _from_root(*other, reached)]
                if not np.array_equal(halves[0][0], start):
                    halves = halves[::-1]
                path = _shortened(is_free, np.array([*halves[0], *halves[1][-2::-1]]), rng)
                return _rounded(is_nearly_free or is_free, path)
        trees.reverse()
    return None


def along(path: np.ndarray, duration: float, s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The motion along a path (W, n) from rest to rest at shares s (K,) of its duration: q, qd, qdd, each (K, n)."""
    from scipy.interpolate import CubicSpline  # 0.4 s that `planner run` need not pay

    curve = CubicSpline(np.linspace(0.0, 1.0, len(path)), path)
    share, rate, acceleration = minimum_jerk(s)
    speed, change = rate[:, None] / duration, acceleration[:, None] / duration**2
    return curve(share), curve(share, 1) * speed, curve(share, 2) * speed**2 + curve(share, 1) * change


def _between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Poses after a up to b, at most STEP from each other."""
    count = max(1, int(np.ceil(np.abs(b - a).max() / STEP)))
    return a + (np.arange(1, count + 1) / count)[:, None] * (b - a)


def _last_free(is_free: IsFree, a: np.ndarray, b: np.ndarray) -> np.ndarray | None:
    """The last free pose on the straight line from a, which is free, to b; None where all of it is free."""
    poses = _between(a, b)
    blocked = np.flatnonzero(~is_free(poses))
    if not len(blocked):
        return None
    return poses[blocked[0] - 1] if blocked[0] else a


def _grow(is_free: IsFree, poses: list[np.ndarray], parents: list[int], to: np.ndarray, max_steps: int) -> int | None:
    """Extend a tree from its nearest pose towards another by at most `max_steps`: the new pose's index, if any."""
    nearest = int(np.argmin(np.abs(np.array(poses) - to).max(axis=1)))
    displacement = to - poses[nearest]
    distance = float(np.abs(displacement).max())
    if distance == 0.0:
        return nearest
    end = to if distance <= max_steps * STEP else poses[nearest] + max_steps * STEP / distance * displacement
    last = _last_free(is_free, poses[nearest], end)
    new = end if last is None else last
    if np.array_equal(new, poses[nearest]):
        return None
    poses.append(new)
    parents.append(nearest)
    return len(poses) - 1


def _from_root(poses: list[np.ndarray], parents: list[int], index: int) -> list[np.ndarray]:
    """Poses from a tree's root to one of its poses."""
    path = []
    while index >= 0:
        path.append(poses[index])
        index = parents[index]
    return path[::-1]


def _shortened(is_free: IsFree, path: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The path with straight cuts wherever these are free."""
    path = _resampled(path)
    for _ in range(SHORTCUTS):
        i, j = sorted(rng.integers(0, len(path), 2))
        if j > i + 1 and _last_free(is_free, path[i], path[j]) is None:
            cut = path[i] + np.linspace(0.0, 1.0, j - i + 1)[:, None] * (path[j] - path[i])
            path = np.concatenate([path[:i], cut, path[j + 1 :]])
    return _resampled(path)


def _resampled(path: np.ndarray) -> np.ndarray:
    """(SAMPLES + 1, n) poses at equal distances along the path."""
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    distinct = np.concatenate([[True], np.diff(lengths) > 0.0])
    at = np.linspace(0.0, lengths[-1], SAMPLES + 1)
    return np.column_stack([np.interp(at, lengths[distinct], column) for column in path[distinct].T])


def _rounded(is_free: IsFree, path: np.ndarray) -> np.ndarray:
    """The path with its corners averaged over the largest share that stays free; its ends stay."""
    for share in ROUNDING_SHARES:
        half = int(0.5 * share * SAMPLES)
        ends = 2.0 * path[0] - path[half:0:-1], 2.0 * path[-1] - path[-2 : -half - 2 : -1]
        window = np.hanning(2 * half + 3)[1:-1]
        longer = np.concatenate([ends[0], path, ends[1]])
        smooth = np.column_stack([np.convolve(column, window / window.sum(), "valid") for column in longer.T])
        if np.all(is_free(smooth)):
            return smooth
    return path
