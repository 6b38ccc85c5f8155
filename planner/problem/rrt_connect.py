"""A way in joint space from start to goal on which nothing comes too near: a first guess.

Two trees grow from start and goal towards random poses and towards each other (RRT-Connect, Kuffner and LaValle 2000),
which are sought about the straight way, farther and farther from it; what they find is shortened and rounded. A solver
only changes a motion a little at a time: it makes this one good, but it does not find from which side to pass a post,
or a window.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from planner.problem.initial_guess import minimum_jerk

STEP = 0.05  # rad or m of the joint that moves most, between poses that are looked at
REACH = 10  # steps by which a tree grows at once
MAX_POSES = 600  # poses tried
NEAR, FAR = 0.1, 1.5  # rad or m from the straight way, in which poses are sought at first and at last
SHORTCUTS = 200
SAMPLES = 200  # of a way that is rounded
ROUNDED = (
    0.5,
    0.4,
    0.3,
    0.2,
    0.15,
    0.1,
    0.05,
)  # of its length, over which its corners are averaged: the widest that may be

Free = Callable[[np.ndarray], np.ndarray]
"""Whether poses (K, n) are free, (K,)."""


def rrt_connect(
    free: Free, start: np.ndarray, goal: np.ndarray, lower: np.ndarray, upper: np.ndarray, seed: int = 0,
    nearly: Free | None = None,
) -> np.ndarray | None:  # fmt: skip
    """Poses (SAMPLES + 1, n) along a free way from start to goal (n,), between bounds; None where none was found.

    The straight way where that is free. Where corners are rounded, poses need only be `nearly` free.
    """
    if _reached(free, start, goal) is None:
        return _even(np.stack([start, goal]))
    rng = np.random.default_rng(seed)
    trees: list[tuple[list[np.ndarray], list[int]]] = [([start], [-1]), ([goal], [-1])]
    for k in range(MAX_POSES):
        grown, other = trees
        wide = NEAR * (FAR / NEAR) ** (k / MAX_POSES)
        to = np.clip(start + rng.uniform() * (goal - start) + wide * rng.normal(size=len(start)), lower, upper)
        new = _grow(free, *grown, to, REACH)
        if new is not None:
            met = _grow(free, *other, grown[0][new], 10**6)
            if met is not None and np.array_equal(other[0][met], grown[0][new]):
                ways = [_back(*grown, new), _back(*other, met)]
                if not np.array_equal(ways[0][0], start):
                    ways = ways[::-1]
                return _rounded(nearly or free, _shortened(free, np.array([*ways[0], *ways[1][-2::-1]]), rng))
        trees.reverse()
    return None


def along(way: np.ndarray, duration: float, s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The motion along a way (W, n) from rest to rest at parts s (K,) of its duration: q, qd, qdd, each (K, n)."""
    from scipy.interpolate import CubicSpline  # 0.4 s that `planner run` need not pay

    curve = CubicSpline(np.linspace(0.0, 1.0, len(way)), way)
    share, rate, acceleration = minimum_jerk(s)
    speed, change = rate[:, None] / duration, acceleration[:, None] / duration**2
    return curve(share), curve(share, 1) * speed, curve(share, 2) * speed**2 + curve(share, 1) * change


def _between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Poses after a up to b, not farther than a step from each other."""
    count = max(1, int(np.ceil(np.abs(b - a).max() / STEP)))
    return a + (np.arange(1, count + 1) / count)[:, None] * (b - a)


def _reached(free: Free, a: np.ndarray, b: np.ndarray) -> np.ndarray | None:
    """The last free pose of the straight way from a, which is free, to b; None for all of it."""
    poses = _between(a, b)
    blocked = np.flatnonzero(~free(poses))
    if not len(blocked):
        return None
    return poses[blocked[0] - 1] if blocked[0] else a


def _grow(free: Free, poses: list[np.ndarray], parents: list[int], to: np.ndarray, most: int) -> int | None:
    """Grow a tree from its nearest pose towards another, by so many steps at most: the new pose's place, if any."""
    near = int(np.argmin(np.abs(np.array(poses) - to).max(axis=1)))
    way = to - poses[near]
    far = float(np.abs(way).max())
    if far == 0.0:
        return near
    end = to if far <= most * STEP else poses[near] + most * STEP / far * way
    reached = _reached(free, poses[near], end)
    new = end if reached is None else reached
    if np.array_equal(new, poses[near]):
        return None
    poses.append(new)
    parents.append(near)
    return len(poses) - 1


def _back(poses: list[np.ndarray], parents: list[int], at: int) -> list[np.ndarray]:
    """The way from a tree's root to one of its poses."""
    way = []
    while at >= 0:
        way.append(poses[at])
        at = parents[at]
    return way[::-1]


def _shortened(free: Free, way: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The way with straight cuts wherever these are free."""
    way = _even(way)
    for _ in range(SHORTCUTS):
        i, j = sorted(rng.integers(0, len(way), 2))
        if j > i + 1 and _reached(free, way[i], way[j]) is None:
            cut = way[i] + np.linspace(0.0, 1.0, j - i + 1)[:, None] * (way[j] - way[i])
            way = np.concatenate([way[:i], cut, way[j + 1 :]])
    return _even(way)


def _even(way: np.ndarray) -> np.ndarray:
    """The way as so many poses at equal distances."""
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1))])
    kept = np.concatenate([[True], np.diff(lengths) > 0.0])
    at = np.linspace(0.0, lengths[-1], SAMPLES + 1)
    return np.column_stack([np.interp(at, lengths[kept], column) for column in way[kept].T])


def _rounded(free: Free, way: np.ndarray) -> np.ndarray:
    """The way with its corners averaged away, as far as it stays free; its ends stay."""
    for part in ROUNDED:
        half = int(0.5 * part * SAMPLES)
        ends = 2.0 * way[0] - way[half:0:-1], 2.0 * way[-1] - way[-2 : -half - 2 : -1]
        longer = np.concatenate([ends[0], way, ends[1]])
        window = np.hanning(2 * half + 3)[1:-1]
        smooth = np.column_stack([np.convolve(column, window / window.sum(), "valid") for column in longer.T])
        if np.all(free(smooth)):
            return smooth
    return way
