"""ResidualCost: weighted sum of squared residuals, base class of PenaltyCost, FrameCost and CenterOfMassCost.

    J = sum over stages and rows of w r^2 / 2,    gradient w r r' J,    Hessian w r'^2 J'J (Gauss and Newton)

with the residual r of a row's value e (see residuals.arrays), r' = dr/de and J the derivative of e by a deviation of
the state. Independent of the control. The reference implementation of kernels.tree.residuals.evaluate.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from functools import partial
from typing import NamedTuple

import numpy as np

from planner.dynamics.contacts import ramp
from planner.model.coordinates import Coordinate
from planner.model.mechanism import Mechanism
from planner.model.space import StateSpace
from planner.problem.costs.goal_spec import GoalSpec
from planner.problem.costs.residuals.arrays import ResidualArrays, resampled
from planner.problem.costs.residuals.functions import RESIDUALS, KinematicsCache
from planner.problem.costs.terms import Quadratic, Term


def values_of(mechanism: Mechanism, arrays: ResidualArrays, xs: np.ndarray) -> np.ndarray:
    """(M, K) of all rows for states xs (K, nx), one for each stage of the arrays."""
    cache = KinematicsCache(mechanism, arrays, xs)
    values = [RESIDUALS[int(kind)](cache, t, False)[0].T for t, kind in enumerate(arrays.kind)]
    return np.concatenate([np.empty((0, len(xs))), *values])


def values_and_jacobians(mechanism: Mechanism, arrays: ResidualArrays, xs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Values (K, M) of all rows for states xs (K, nx), one for each stage, and their derivatives (K, M, ndx)."""
    cache, M = KinematicsCache(mechanism, arrays, xs), len(arrays.weight)
    values, by_x = np.empty((len(xs), M)), np.zeros((len(xs), M, mechanism.space.ndx))
    for t, kind in enumerate(arrays.kind):
        value, J = RESIDUALS[int(kind)](cache, t, True)
        values[:, arrays.rows(t)], by_x[:, arrays.rows(t), : J.shape[2]] = value, J
    return values, by_x


class GoalRows(NamedTuple):
    """Rows of a term that are a goal at the end, with its name and unit."""

    name: str
    unit: str
    term: int
    rows: slice = slice(None)


class ResidualCost(Term):
    """Weighted squared residuals of a mechanism; one term of a cost. Compiled with RigidBodyDynamics.

    Args:
        mechanism: The machine.
        arrays: The terms; of N stages, or of one stage and the end for any horizon.
        N: Stages; None for any horizon.
        goals: Goals at the end; those with a final weight of 0 are ignored.
    """

    def __init__(
        self, mechanism: Mechanism, arrays: ResidualArrays, N: int | None, goals: Sequence[GoalRows] = ()
    ) -> None:
        self.mechanism, self.residual_arrays, self.N, self._goals = mechanism, arrays, N, tuple(goals)
        self.space = mechanism.space
        self.nx, self.ndx = self.space.nx, self.space.ndx

    def residual_arrays_for(self, N: int) -> ResidualArrays:
        """The terms for N stages."""
        return self.residual_arrays if self.N is not None else resampled(self.residual_arrays, N, 1.0)

    def goal_rows(self) -> dict[str, np.ndarray]:
        """Indices of the rows of each goal, by its name: "position of hand"."""
        return {goal.name: self._rows_of(goal)[0] for goal in self._goals}

    def resampled(self, parts: int, ratio: float) -> ResidualCost:
        """The same cost over stages divided into parts, with running weights multiplied by ratio."""
        cost = copy(self)
        cost.N = None if self.N is None else parts * self.N
        cost.residual_arrays = resampled(self.residual_arrays, 1 if self.N is None else parts, ratio)
        return cost

    def augmented(self, own: StateSpace, space: StateSpace) -> ResidualCost:
        """The same cost on a state with appended components."""
        cost = copy(self)
        cost.space, cost.nx, cost.ndx = space, space.nx, space.ndx
        return cost

    def goal_specs(self, _: Sequence[Coordinate]) -> tuple[GoalSpec, ...]:
        """Goals with a final weight above 0."""
        weighed = [goal for goal in self._goals if self._rows_of(goal)[1].any()]
        return tuple(GoalSpec(goal.name, goal.unit, partial(self._missed, goal)) for goal in weighed)

    def _rows_of(self, goal: GoalRows) -> tuple[np.ndarray, np.ndarray]:
        """Indices of a goal's rows, and whether their final weights are above 0."""
        rows = np.arange(len(self.residual_arrays.weight))[self.residual_arrays.rows(goal.term)][goal.rows]
        return rows, self.residual_arrays.weight[rows, -1] > 0.0

    def _missed(self, goal: GoalRows, xs: np.ndarray) -> np.ndarray:
        """(K,) norm of the residual of the rows with a final weight; infinite for states that are not finite."""
        known, missed = np.isfinite(xs).all(axis=1), np.full(len(xs), np.inf)
        rows, weighed = self._rows_of(goal)
        missed[known] = np.linalg.norm(self._at_end(xs[known])[rows[weighed]], axis=0)
        return missed

    def final_cost(self, x: np.ndarray) -> float:
        """The final cost at the end state x (nx,)."""
        return 0.5 * float(self.residual_arrays.weight[:, -1] @ self._at_end(x[None])[:, 0] ** 2)

    def _at_end(self, xs: np.ndarray) -> np.ndarray:
        """(M, K) residuals of states (K, nx), each with the targets of the end."""
        last = self.residual_arrays.along(np.full(len(xs), -1))
        return _residuals(last, self._values(last, xs))[0]

    def _values(self, arrays: ResidualArrays, xs: np.ndarray) -> np.ndarray:
        """(M, K) of the rows for states xs (K, nx), one for each stage of the arrays."""
        return values_of(self.mechanism, arrays, xs)

    def value(self, xs: np.ndarray, us: np.ndarray) -> float:
        """J of a trajectory xs (N+1, nx), us (N, nu)."""
        if not np.isfinite(xs).all():  # a rollout that diverged
            return float("inf")
        stages, arrays = self._weighing(len(us))
        residuals, _ = _residuals(arrays, self._values(arrays, xs[stages]))
        return 0.5 * float(np.sum(arrays.weight * residuals**2))

    def _weighing(self, N: int) -> tuple[np.ndarray, ResidualArrays]:
        """Stages with a weight above 0, and the terms there."""
        arrays = self.residual_arrays_for(N)
        stages = np.flatnonzero(arrays.weight.any(axis=0))
        return stages, arrays.along(stages)

    def quadratize(self, xs: np.ndarray, us: np.ndarray) -> Quadratic:
        """Gradient and Gauss-Newton Hessian by the state; zero by the control."""
        N, nu = us.shape
        model = Quadratic(
            np.zeros((N + 1, self.ndx, self.ndx)), np.zeros((N + 1, self.ndx)), np.zeros((N, nu, nu)), np.zeros((N, nu))
        )
        stages, arrays = self._weighing(N)
        cache = KinematicsCache(self.mechanism, arrays, xs[stages])
        for t, kind in enumerate(arrays.kind):
            value, J = RESIDUALS[int(kind)](cache, t, True)
            rows, n = arrays.rows(t), J.shape[2]
            residual, slope = _residuals(arrays, value.T, rows)
            J = slope.T[:, :, None] * J  # of the residuals
            WJ = arrays.weight[rows].T[:, :, None] * J
            model.q[stages, :n] += np.einsum("nri,rn->ni", WJ, residual)
            model.Q[stages, :n, :n] += np.swapaxes(J, 1, 2) @ WJ
        return model


def _residuals(m: ResidualArrays, values: np.ndarray, rows: slice = slice(None)) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (M, K) of values (M, K) of some rows, and their derivatives by the values."""
    side, a = m.side[rows, None], m.ramp[rows, None]
    e = np.where(side == 0.0, 1.0, side) * (values - m.bound[rows])
    residual, slope = ramp(e, a)
    return np.where(side == 0.0, e, residual), np.where(side == 0.0, 1.0, side * slope)
