"""Targets and weights that are given once or per stage: checked, and brought to one horizon."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from planner.base.arguments import array, numbers
from planner.base.errors import PlannerError


@dataclass(frozen=True, eq=False)
class WeightedTarget:
    """A target that has weights."""

    target: np.ndarray  # (1 or N+1, size)
    way: np.ndarray  # (1 or N+1, rows), times dt
    end: np.ndarray  # (1, rows)
    final: bool  # whether the end has a weight of its own; what is only weighed on the way is no goal
    stages: StageData

    @property
    def weight(self) -> np.ndarray:
        """(rows, N+1)."""
        weight = np.array(self.stages.rows(self.way))
        weight[-1] = self.end[0]
        return weight.T


class StageData:
    """The horizon that arguments agree on, None while nothing was given per stage.

    Args:
        dt: s, by which weights on the way are multiplied.
    """

    def __init__(self, dt: float) -> None:
        self.N: int | None = None
        self._dt = dt

    @property
    def horizon(self) -> int:
        """Stages to make arrays for: one, and the end, stand for any."""
        return 1 if self.N is None else self.N

    def rows(self, given: np.ndarray) -> np.ndarray:
        """(N+1, size) of (1 or N+1, size)."""
        return np.broadcast_to(given, (self.horizon + 1, given.shape[1]))

    def asked(
        self, name: str, target: Any, way: Any, final: Any, rows: int, size: int | None = None
    ) -> WeightedTarget | None:
        """A target of some size (that of its rows by default) and its weights, checked; None for neither."""
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
        """(1 or N+1, rows) on the way and (1, rows) at the end."""
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
