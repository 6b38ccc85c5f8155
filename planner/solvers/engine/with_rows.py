"""The engine of compiled dynamics and costs with constraints.

Constraints of terms that kernels know are residuals, each bound a row of the table whose bounds and weights the
multipliers move: nothing else changes. What others add, functions of their maker's and power, is NumPy: their cost to
each candidate of the line search, which the kernels only roll out, and along the trajectory their gradients to l and
their Hessians, with what is mixed of controls and states, to T of the sweep.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from planner.kernels.lq import search
from planner.kernels.lq.workspace import ALPHA, BRACKET, COSTS, SLOPES
from planner.problem.constraints.kept import Kept
from planner.problem.constraints.of_terms import ResidualMeasure, hinge_terms
from planner.problem.costs.residuals.arrays import ResidualArrays, joined
from planner.problem.problem import Problem
from planner.problem.state_ranges import Hinges
from planner.solvers.engine.compiled import CompiledEngine


class _Bounds(NamedTuple):
    """Rows of the table that are the lower, or the upper, bounds of some columns of the hinges."""

    rows: slice
    columns: slice
    lower: bool


class RowsEngine(CompiledEngine):
    """Compiled dynamics and costs, and rows of constraints."""

    def __init__(
        self, problem: Problem, kept: Kept, dynamics: Any, cost: Any, residuals: ResidualArrays | None = None
    ) -> None:
        assert kept.rows is not None
        rows = kept.rows
        compiled = [part for part in rows.parts if isinstance(part.measure, ResidualMeasure)]
        terms, self._bounds_of = [] if residuals is None else [residuals], list[_Bounds]()
        first = sum(len(part.weight) for part in terms)
        for part in compiled:
            measure: Any = part.measure  # a ResidualMeasure
            lower, upper, R = rows.lower[:, part.columns], rows.upper[:, part.columns], measure.rows
            asked = np.isfinite(lower) | np.isfinite(upper)
            exact = bool(np.all((lower == upper)[asked]))
            for side, used in ((0.0, exact), (-1.0, not exact and np.isfinite(lower).any()),
                               (1.0, not exact and np.isfinite(upper).any())):  # fmt: skip
                if used:
                    terms.append(hinge_terms(measure.arrays, np.full(R, side), rows.N))
                    self._bounds_of.append(_Bounds(slice(first, first + R), part.columns, side < 0.0))
                    first += R
        super().__init__(problem, dynamics, cost, joined(terms) if terms else None)
        self._kept, self._scale, self._dynamics_of = kept, rows.scale, dynamics
        others, self._columns = rows.only([part for part in rows.parts if part not in compiled])
        self._others = Kept(None, others, kept.tolerance) if others.parts else None
        self._hinges: Hinges | None = None  # of the others
        self._of_dynamics: np.ndarray | None = None  # T of the second order alone
        self._touched = np.empty(0, dtype=int)  # stages whose T has something of rows

    def hinge(self, hinges: Hinges | None) -> None:
        """Have these hinges added to the cost from the next start on; None for none."""
        kept = self._kept
        super().hinge(None if hinges is None or kept.ranges is None else kept.of_ranges(hinges))
        if self._bounds_of:
            of_rows = None if hinges is None else kept.of_rows(hinges)
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
            self._hinges = None if hinges is None else Hinges(*(one[:, self._columns] for one in kept.of_rows(hinges)))

    def start(self, x0: np.ndarray, us: np.ndarray, exact: bool = False) -> float:
        """Roll out the first guess, within its bounds; its cost."""
        self._of_dynamics = None
        cost = super().start(x0, us, exact)
        if self._others is not None:
            self._w.use_second_order(True)
            self._w.T[:] = 0.0
        return cost

    def _search(self, rule: int, feedback: bool, cost: float, slope: float) -> tuple[float, float]:
        w = self._w
        if self._others is None or rule == search.START:
            step, J = super()._search(rule, feedback, cost, slope)
            return step, J if self._others is None else J + self._value(w.xs, w.us)
        alpha, costs, slopes, bracket = (w.search[row] for row in (ALPHA, COSTS, SLOPES, BRACKET))
        search.ladder(rule, alpha, bracket)
        # Armijo takes the first that does: it need not know the cost of the others.
        first = rule in (search.ARMIJO, search.CLOSING)
        lanes = [slice(i, i + 1) for i in range(len(alpha))] if first else [slice(0, len(alpha))]
        for _ in range(search.batches(rule)):
            super()._search(search.TRY, feedback, cost, slope)
            for some in lanes:
                for i in range(len(alpha))[some]:
                    costs[i] += self._value(*w.trial(i)) if math.isfinite(costs[i]) else 0.0
                lane = search.choose(rule, alpha[some], costs[some], slopes[some], cost, slope, bracket)
                if lane >= 0:
                    self._dynamics_of.take(w, self._memory, some.start + lane)
                    return float(alpha[some][lane]), float(costs[some][lane])
            search.refine(rule, alpha, bracket)
        return 0.0, cost

    def _value(self, xs: np.ndarray, us: np.ndarray) -> float:
        """The cost of the hinges of constraints that kernels do not know."""
        if self._hinges is None or self._others is None:
            return 0.0
        return self._others.value_of_rows(self._hinges, xs, us)

    def _quadratize_more(self) -> None:
        w, others = self._w, self._others
        if others is None:
            return
        self._of_dynamics = None
        w.T[self._touched] = 0.0
        self._touched = self._touched[:0]
        if self._hinges is None:
            return
        A, B = self._dynamics_of.nominal_jacobians(w)
        n, by_z, slope, curvature = others.pull_of_rows(self._hinges, w.xs, w.us, A, B)
        if not len(n):
            return
        nu, first, ndx = w.us.shape[1], w.first, w.ndx
        rows = np.zeros((len(n), slope.shape[1], w.T.shape[1]))
        rows[:, :, first : first + ndx], rows[:, :, :nu] = by_z[:, :, :ndx], by_z[:, :, ndx:]
        w.l[n] += np.einsum("ncz,nc->nz", rows, slope)
        w.T[n] = np.triu(np.swapaxes(rows, 1, 2) @ (curvature[:, :, None] * rows))
        self._touched = n

    def _second_order(self) -> None:
        if self._others is None:
            super()._second_order()
            return
        w = self._w
        own = w.T.copy()
        w.T[:] = 0.0
        super()._second_order()
        self._of_dynamics = w.T.copy()
        w.T[:] = own + self._of_dynamics if self._swept else own
        self._touched = np.arange(len(w.T))

    def use_second_order(self, exact: bool) -> None:
        """Whether the next sweeps have the second-order terms."""
        if self._others is None:
            super().use_second_order(exact)
            return
        if self._of_dynamics is not None and exact != self._swept:
            T = self._w.T
            T[self._diagonals] = self._curvature
            T[:] += self._of_dynamics if exact else -self._of_dynamics
            self._curvature[:] = T[self._diagonals]
        self._swept = exact

    def _hold(self) -> None:
        if self._others is None:
            super()._hold()
            return
        self._w.T[self._diagonals] = self._curvature + self.hold * self._state_weights
        if self.hold > 0.0:
            self._touched = np.arange(len(self._w.T))
