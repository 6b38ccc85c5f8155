"""The engine of compiled dynamics and costs with constraints in Python: functions of their maker's, power.

Linearisation, sweep and rollouts are the kernels'. What rows of constraints add is NumPy: their cost to each candidate
of the line search, which the kernels only roll out, and along the trajectory their gradients to l and their Hessians,
with what is mixed of controls and states, to T of the sweep.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from planner.kernels.lq import search
from planner.kernels.lq.workspace import ALPHA, BRACKET, COSTS, SLOPES
from planner.problem.constraints.kept import Kept
from planner.problem.problem import Problem
from planner.problem.state_ranges import Hinges
from planner.solvers.engine.compiled import CompiledEngine


class RowsEngine(CompiledEngine):
    """Compiled dynamics and costs, and rows of constraints that are not."""

    def __init__(self, problem: Problem, kept: Kept, dynamics: Any, *costs: Any) -> None:
        super().__init__(problem, dynamics, *costs)
        self._kept, self._rolled = kept, dynamics
        self._hinges: Hinges | None = None
        self._of_dynamics: np.ndarray | None = None  # T of the second order alone
        self._second_used = False
        self._touched = np.empty(0, dtype=int)  # stages whose T has something of rows

    def hinge(self, hinges: Hinges | None) -> None:
        """Have these hinges added to the cost from the next start on; None for none."""
        super().hinge(None if hinges is None else self._kept.of_ranges(hinges))
        self._hinges = None if hinges is None else self._kept.of_rows(hinges)

    def start(self, x0: np.ndarray, us: np.ndarray, exact: bool = False) -> float:
        """Roll out the first guess, within its bounds; its cost."""
        self._of_dynamics, self._second_used = None, exact
        cost = super().start(x0, us, exact)
        self._w.use_second_order(True)
        self._w.T[:] = 0.0
        return cost

    def _search(self, rule: int, feedback: bool, cost: float, slope: float) -> tuple[float, float]:
        w = self._w
        if rule == search.START:
            step, J = super()._search(rule, feedback, cost, slope)
            return step, J + self._value(w.xs, w.us)
        alpha, costs, slopes, bracket = (w.search[row] for row in (ALPHA, COSTS, SLOPES, BRACKET))
        search.ladder(rule, alpha, bracket)
        one_by_one = rule == search.ARMIJO  # the first that does is taken: no need to know the others
        for _ in range(search.batches(rule)):
            super()._search(search.TRY, feedback, cost, slope)
            if one_by_one:
                lane = -1
                for i in range(len(alpha)):
                    costs[i] += self._candidate(i, costs[i])
                    if search.choose(rule, alpha[i : i + 1], costs[i : i + 1], slopes[:1], cost, slope, bracket) == 0:
                        lane = i
                        break
            else:
                costs += [self._candidate(i, costs[i]) for i in range(len(alpha))]
                lane = search.choose(rule, alpha, costs, slopes, cost, slope, bracket)
            if lane >= 0:
                self._rolled.take(w, self._memory, lane)
                return float(alpha[lane]), float(costs[lane])
            search.refine(rule, alpha, bracket)
        return 0.0, cost

    def _candidate(self, lane: int, cost: float) -> float:
        return self._value(*self._w.trial(lane)) if math.isfinite(cost) else 0.0

    def _value(self, xs: np.ndarray, us: np.ndarray) -> float:
        """The cost of the hinges of rows."""
        return 0.0 if self._hinges is None else self._kept.value_of_rows(self._hinges, xs, us)

    def _quadratize_more(self) -> None:
        w, kept = self._w, self._kept
        self._of_dynamics = None
        w.T[self._touched] = 0.0
        self._touched = self._touched[:0]
        if self._hinges is None:
            return
        A, B = self._rolled.nominal_jacobians(w)
        n, by_z, slope, curvature = kept.pull_of_rows(self._hinges, w.xs, w.us, A, B)
        if not len(n):
            return
        nu, first, ndx = w.us.shape[1], w.first, w.ndx
        rows = np.zeros((len(n), slope.shape[1], w.T.shape[1]))
        rows[:, :, first : first + ndx], rows[:, :, :nu] = by_z[:, :, :ndx], by_z[:, :, ndx:]
        w.l[n] += np.einsum("ncz,nc->nz", rows, slope)
        w.T[n] = np.triu(np.swapaxes(rows, 1, 2) @ (curvature[:, :, None] * rows))
        self._touched = n

    def _second_order(self) -> None:
        w = self._w
        own = w.T.copy()
        w.T[:] = 0.0
        super()._second_order()
        self._of_dynamics = w.T.copy()
        w.T[:] = own + self._of_dynamics if self._second_used else own
        self._touched = np.arange(len(w.T))

    def use_second_order(self, exact: bool) -> None:
        """Whether the next sweeps have the second-order terms."""
        if self._of_dynamics is not None and exact != self._second_used:
            self._w.T[:] += self._of_dynamics if exact else -self._of_dynamics
        self._second_used = exact
