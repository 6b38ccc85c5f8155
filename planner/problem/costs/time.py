"""TimeCost: the weighted duration of a motion."""

from __future__ import annotations

import numpy as np

from planner.base.arguments import number
from planner.model.space import StateSpace
from planner.problem.costs.terms import Quadratic, Term


class TimeCost(Term):
    """weight N dt: the same for every motion of a duration (s)."""

    def __init__(self, duration: float, weight: float, space: StateSpace) -> None:
        self.duration, self.weight = duration, number("the time's weight", weight, minimum=0.0)
        self.space, self.nx, self.ndx = space, space.nx, space.ndx

    def value(self, xs: np.ndarray, us: np.ndarray) -> float:
        """The weighted duration."""
        return self.weight * self.duration

    def quadratize(self, xs: np.ndarray, us: np.ndarray) -> Quadratic:
        """Zeros."""
        (N, nu), ndx = us.shape, self.ndx
        return Quadratic(np.zeros((N + 1, ndx, ndx)), np.zeros((N + 1, ndx)), np.zeros((N, nu, nu)), np.zeros((N, nu)))
