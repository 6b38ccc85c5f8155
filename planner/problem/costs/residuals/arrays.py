"""Residuals as arrays over stages, for NumPy and kernels: names resolved to indices, bounds and weights per stage.

A term has up to six functions e of the state, its rows (kinds in kernels.tree.residuals.kinds). Each row is compared
with a target or bound b at each stage and costs w r^2 / 2:

    target b     r = e - b
    upper b      r = ramp(e - b; a)          0, d^2 / 2a, d - a/2  for d < 0, 0..a, > a; a may be 0
    lower b      r = ramp(b - e; a)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from planner.base.arguments import array, numbers
from planner.base.errors import PlannerError
from planner.kernels.tree.residuals.kinds import KINDS

CONSTANTS = 26  # max number of constants of a term: those of two collision shapes


@dataclass(frozen=True, eq=False)
class ResidualArrays:
    """T terms with M rows and S reference entries in total, over P points; also input of the kernels."""

    link: np.ndarray  # (P,) link of a point or frame, -1 for the world
    offset: np.ndarray  # (P, 3) m, in the link's frame
    share: np.ndarray  # (P,) factor of the point's position in the world
    world: np.ndarray  # (P, N+1, 3) m, added to share times the position
    kind: np.ndarray  # (T,) residual kind
    ends: np.ndarray  # (T, 4) indices of points, by kind; the first is a frame's origin. -1 for none
    # (T, CONSTANTS): direction and level of a scalar, rotation or axis of a frame in its link, two collision shapes
    constant: np.ndarray
    first_row: np.ndarray  # (T+1,) index of the first row of a term
    first_reference: np.ndarray  # (T+1,) index of its first reference entry
    reference: np.ndarray  # (S, N+1) entries of the reference rotation of an orientation, or of a reference pose
    side: np.ndarray  # (M,) +1 for upper, -1 for lower, 0 for a target
    ramp: np.ndarray  # (M,) a
    bound: np.ndarray  # (M, N+1) b, 0 where a row is off
    weight: np.ndarray  # (M, N+1) w, 0 where a row is off; running weights times dt

    def __post_init__(self) -> None:
        for value in vars(self).values():
            value.flags.writeable = False

    def rows(self, t: int) -> slice:
        """The rows of term t."""
        return slice(int(self.first_row[t]), int(self.first_row[t + 1]))

    def references(self, t: int) -> np.ndarray:
        """(stages, number of entries) of the references of term t."""
        return self.reference[self.first_reference[t] : self.first_reference[t + 1]].T

    def along(self, stages: Any) -> ResidualArrays:
        """The same terms at the given stages, in their order."""
        return replace(
            self, world=self.world[:, stages], reference=self.reference[:, stages], bound=self.bound[:, stages],
            weight=self.weight[:, stages],
        )  # fmt: skip


def resampled(measures: ResidualArrays, parts: int, ratio: float) -> ResidualArrays:
    """The terms for stages divided into parts, with running weights multiplied by ratio; final weights unchanged."""
    N = measures.weight.shape[1] - 1
    finer = measures.along(np.append(np.repeat(np.arange(N), parts), N))
    weight = np.array(finer.weight)
    weight[:, :-1] *= ratio
    return replace(finer, weight=weight)


def joined(parts: Sequence[ResidualArrays]) -> ResidualArrays:
    """Concatenate the terms of several ResidualArrays of one mechanism and horizon."""
    together = {f.name: np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(ResidualArrays)}
    first_entry = np.cumsum([0, *(len(part.link) for part in parts[:-1])])
    ends = [np.where(part.ends < 0, -1, part.ends + k) for part, k in zip(parts, first_entry, strict=True)]
    together["ends"] = np.concatenate(ends)
    for name in ("first_row", "first_reference"):
        sizes = np.concatenate([np.diff(getattr(part, name)) for part in parts])
        together[name] = np.cumsum(np.concatenate([[0], sizes]), dtype=np.int64)
    return ResidualArrays(**together)


class ResidualList:
    """Builder of ResidualArrays for N stages: unique points, and terms that refer to them by index."""

    def __init__(self, N: int) -> None:
        self.N = N
        self._numbers: dict[tuple[Any, ...], int] = {}
        self._points: list[tuple[int, np.ndarray, float, np.ndarray]] = []
        self._terms: list[tuple[Any, ...]] = []

    def point(self, link: int, offset: np.ndarray, share: float = 1.0, world: Any = 0.0) -> int:
        """The index of a point, which is added if it is new."""
        world = np.array(np.broadcast_to(world, (self.N + 1, 3)), dtype=float)
        key = (int(link), np.asarray(offset, dtype=float).tobytes(), share, world.tobytes())
        if key not in self._numbers:
            self._numbers[key] = len(self._points)
            self._points.append((int(link), np.asarray(offset, dtype=float), share, world))
        return self._numbers[key]

    def add(
        self, kind: int, ends: Sequence[int], weight: Any, *, bound: Any = 0.0, constant: Any = (), reference: Any = (),
        side: float = 0.0, ramp: float = 0.0,
    ) -> None:  # fmt: skip
        """Add a term: weight and bound broadcast to (rows, N+1), reference reshaped to (its kind's references, N+1)."""
        rows, references = KINDS[kind][:2]
        shape, constants = (rows, self.N + 1), np.zeros(CONSTANTS)
        constants[: np.size(constant)] = np.ravel(constant)
        self._terms.append((
            kind, [*ends, *(4 - len(ends)) * [ends[0] if ends else -1]], constants,
            np.asarray(reference, dtype=float).reshape(references, self.N + 1),
            np.full(rows, side), np.full(rows, ramp), np.array(np.broadcast_to(bound, shape), dtype=float),
            np.array(np.broadcast_to(weight, shape), dtype=float),
        ))  # fmt: skip

    @property
    def count(self) -> int:
        """Number of terms."""
        return len(self._terms)

    def arrays(self) -> ResidualArrays:
        """The points and terms as ResidualArrays."""
        stages, terms = self.N + 1, self._terms
        kind = np.array([term[0] for term in terms], dtype=np.int64)
        rows, references = ([0, *(KINDS[int(k)][i] for k in kind)] for i in range(2))
        empty = (np.zeros((0, stages)), np.zeros(0), np.zeros(0), np.zeros((0, stages)), np.zeros((0, stages)))
        reference, side, ramp, bound, weight = (
            np.concatenate([none, *(term[i] for term in terms)]) for i, none in enumerate(empty, 3)
        )
        links, offsets, shares, worlds = ([point[i] for point in self._points] for i in range(4))
        return ResidualArrays(
            np.array(links, dtype=np.int64), np.array(offsets, dtype=float).reshape(-1, 3),
            np.array(shares, dtype=float),
            np.array(worlds, dtype=float).reshape(-1, stages, 3), kind,
            np.array([term[1] for term in terms], dtype=np.int64).reshape(-1, 4),
            np.array([term[2] for term in terms], dtype=float).reshape(-1, CONSTANTS),
            np.cumsum(rows, dtype=np.int64), np.cumsum(references, dtype=np.int64), reference, side, ramp, bound,
            weight,
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class WeightedTarget:
    """A target and its weights."""

    target: np.ndarray  # (1 or N+1, size)
    stage_weight: np.ndarray  # (1 or N+1, rows) running weights, times dt
    end: np.ndarray  # (1, rows) final weights
    final: bool  # whether a final weight was given; a target with a running weight alone is no goal
    stages: StageData

    @property
    def weight(self) -> np.ndarray:
        """(rows, N+1) running weights, the last column the final ones."""
        weight = np.array(self.stages.rows(self.stage_weight))
        weight[-1] = self.end[0]
        return weight.T


class StageData:
    """The common horizon N of arguments per stage, None while there are none.

    Args:
        dt: s, factor of running weights.
    """

    def __init__(self, dt: float) -> None:
        self.N: int | None = None
        self._dt = dt

    @property
    def horizon(self) -> int:
        """Number of stages of the arrays: N, or 1 for any horizon."""
        return 1 if self.N is None else self.N

    def rows(self, given: np.ndarray) -> np.ndarray:
        """(1 or N+1, size) broadcast to (N+1, size)."""
        return np.broadcast_to(given, (self.horizon + 1, given.shape[1]))

    def asked(
        self, name: str, target: Any, way: Any, final: Any, rows: int, size: int | None = None
    ) -> WeightedTarget | None:
        """Checked target of `size` entries (`rows` by default) and its weights; None without both."""
        checked = None if target is None else self._target(name, target, size or rows)
        running, end = self._weights(f"{name}_weight", way, final, rows)
        weighs = bool(running.any() or end.any())
        if weighs and checked is None:
            raise PlannerError(f"{name}_weight has no target, expected {name}=.")
        if checked is None:
            return None
        if not weighs:
            raise PlannerError(f"{name} has no weight, expected {name}_weight or final_{name}_weight above 0.")
        return WeightedTarget(checked, running, end, final is not None, self)

    def _agree(self, name: str, given: np.ndarray) -> None:
        if given.ndim == 2:
            if self.N is not None and len(given) != self.N + 1:
                raise PlannerError(f"{name} has {len(given)} rows, expected N+1 = {self.N + 1} as the others.")
            self.N = len(given) - 1

    def _target(self, name: str, value: Any, size: int) -> np.ndarray:
        given = numbers(name, value)
        given = array(name, given, ("N+1", size) if given.ndim == 2 else (size,))
        self._agree(name, given)
        return np.atleast_2d(given)

    def _weights(self, name: str, way: Any, final: Any, rows: int) -> tuple[np.ndarray, np.ndarray]:
        """(1 or N+1, rows) running weights times dt, and (1, rows) final weights."""
        given = [numbers(name, way), numbers(f"final_{name}", 0.0 if final is None else final)]
        for label, value in zip((name, f"final_{name}"), given, strict=True):
            if value.ndim == 2 and label == name:
                array(label, value, ("N+1", rows))
                self._agree(label, value)
            elif value.ndim:
                array(label, value, (rows,))
            if not (np.isfinite(value).all() and value.min() >= 0.0):
                raise PlannerError(f"{label} is {value.tolist()}, expected finite weights of at least 0.")
        running, end = (np.atleast_2d(np.broadcast_to(v, v.shape if v.ndim else (rows,))) for v in given)
        return self._dt * running, self._dt * running[-1:] if final is None else end
