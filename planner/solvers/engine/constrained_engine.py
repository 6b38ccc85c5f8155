"""The engine of compiled dynamics and costs with constraints.

Constraints of terms that kernels know are residuals, each bound a row of the table whose bounds and weights the
multipliers move: nothing else changes. Others, functions of their maker's and power, are NumPy and added, as a user's
own costs are (planner.solvers.engine.hybrid_engine).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from planner.problem.constraints.quantities import ResidualFunction, penalty_arrays
from planner.problem.constraints.trajectory_constraints import TrajectoryConstraints
from planner.problem.costs.residuals.arrays import ResidualArrays, joined
from planner.problem.costs.terms import Cost
from planner.problem.problem import Problem
from planner.problem.state_bounds import BoundPenalties
from planner.solvers.engine.hybrid_engine import HybridEngine


class _Bounds(NamedTuple):
    """Rows of the table that are the lower, or the upper, bounds of some columns of the penalties."""

    rows: slice
    columns: slice
    lower: bool


class ConstrainedEngine(HybridEngine):
    """Compiled dynamics and costs, and rows of constraints."""

    def __init__(
        self, problem: Problem, kept: TrajectoryConstraints, dynamics: Any, cost: Any, residuals: ResidualArrays | None
        = None,
        own: Sequence[Cost] = (),
    ) -> None:  # fmt: skip
        assert kept.rows is not None
        rows = kept.rows
        compiled = [part for part in rows.parts if isinstance(part.function, ResidualFunction)]
        terms, self._bounds_of = [] if residuals is None else [residuals], list[_Bounds]()
        first = sum(len(part.weight) for part in terms)
        for part in compiled:
            measure: Any = part.function  # a ResidualFunction
            lower, upper, R = rows.lower[:, part.columns], rows.upper[:, part.columns], measure.rows
            asked = np.isfinite(lower) | np.isfinite(upper)
            exact = bool(np.all((lower == upper)[asked]))
            for side, used in ((0.0, exact), (-1.0, not exact and np.isfinite(lower).any()),
                               (1.0, not exact and np.isfinite(upper).any())):  # fmt: skip
                if used:
                    terms.append(penalty_arrays(measure.arrays, np.full(R, side), rows.N))
                    self._bounds_of.append(_Bounds(slice(first, first + R), part.columns, side < 0.0))
                    first += R
        super().__init__(problem, dynamics, cost, joined(terms) if terms else None, own)
        self._kept, self._scale = kept, rows.scale
        others, self._columns = rows.subset([part for part in rows.parts if part not in compiled])
        self._others = TrajectoryConstraints(None, others, kept.tolerance) if others.parts else None
        self._adds = self._adds or self._others is not None
        self._penalties: BoundPenalties | None = None  # of the others

    def set_penalties(self, penalties: BoundPenalties | None) -> None:
        """Have these penalties added to the cost from the next start on; None for none."""
        kept = self._kept
        super().set_penalties(None if penalties is None or kept.ranges is None else kept.of_ranges(penalties))
        if self._bounds_of:
            of_rows = None if penalties is None else kept.of_rows(penalties)
            for rows, columns, lower in self._bounds_of:
                if of_rows is None:
                    self.residuals.weight[rows] = 0.0
                    continue
                scale = self._scale[columns, None]
                bound = (of_rows.lower if lower else of_rows.upper)[:, columns].T
                known = np.isfinite(bound)
                self.residuals.bound[rows] = np.where(known, bound, 0.0) / scale
                self.residuals.weight[rows] = np.where(known, of_rows.weight[:, columns].T, 0.0) * scale**2
            self.residuals.changed()
        if self._others is not None:
            self._penalties = (
                None
                if penalties is None
                else BoundPenalties(*(one[:, self._columns] for one in kept.of_rows(penalties)))
            )

    def _value(self, xs: np.ndarray, us: np.ndarray) -> float:
        """The user's own costs, and the cost of the penalties of constraints that kernels do not know."""
        own = super()._value(xs, us)
        if self._penalties is None or self._others is None:
            return own
        return own + self._others.value_of_rows(self._penalties, xs, us)

    def _quadratize_more(self) -> None:
        super()._quadratize_more()
        w, others = self._w, self._others
        if others is None or self._penalties is None:
            return
        A, B = self._dynamics_of.nominal_jacobians(w)
        n, by_z, slope, curvature = others.penalty_derivatives(self._penalties, w.xs, w.us, A, B)
        if not len(n):
            return
        nu, first, ndx = w.us.shape[1], w.first, w.ndx
        rows = np.zeros((len(n), slope.shape[1], w.T.shape[1]))
        rows[:, :, first : first + ndx], rows[:, :, :nu] = by_z[:, :, :ndx], by_z[:, :, ndx:]
        w.l[n] += np.einsum("ncz,nc->nz", rows, slope)
        w.T[n] += np.triu(np.swapaxes(rows, 1, 2) @ (curvature[:, :, None] * rows))
        self._touched = np.union1d(self._touched, n)
