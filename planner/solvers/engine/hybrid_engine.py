"""The engine of compiled dynamics and costs with others in NumPy beside them: a user's own costs.

The kernels roll candidates out and know the most of their cost. NumPy adds what it knows: a cost to each candidate of
the line search, and along the trajectory gradients to l and Hessians, with what is mixed of controls and states, to T
of the sweep. So what a user adds costs what it takes itself, and no more.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from planner.kernels.lq import line_search
from planner.kernels.lq.workspace import ALPHA, COSTS, SLOPES
from planner.problem.costs.residuals.arrays import ResidualArrays
from planner.problem.costs.terms import Cost, SumCost
from planner.problem.problem import Problem
from planner.solvers.engine.compiled import CompiledEngine
from planner.solvers.engine.protocol import check_shapes


class HybridEngine(CompiledEngine):
    """Compiled dynamics and costs, and other costs beside them.

    Args:
        problem: Whose cost is the sum of all.
        dynamics: Compiled.
        cost: What kernels know.
        residuals: What they know too.
        own: What they do not know.
    """

    def __init__(
        self, problem: Problem, dynamics: Any, cost: Any, residuals: ResidualArrays | None = None,
        own: Sequence[Cost] = (),
    ) -> None:  # fmt: skip
        super().__init__(problem, dynamics, cost, residuals)
        self._own: Cost | None = None if not own else own[0] if len(own) == 1 else SumCost(*own)
        self._R = cost.R
        self._adds = bool(own)  # whether anything is added
        self._dynamics_of = dynamics
        self._upper: np.ndarray | None = None  # (width, width) 1 where T is read
        self._of_dynamics: np.ndarray | None = None  # T of the second order alone
        self._touched = np.empty(0, dtype=int)  # stages whose T has something added

    def start_from_controls(self, x0: np.ndarray, us: np.ndarray, exact: bool = False) -> float:
        """Roll out the first guess, within its bounds; its cost."""
        self._of_dynamics = None
        cost = super().start_from_controls(x0, us, exact)
        if self._adds:
            w = self._w
            w.use_second_order(True)
            w.T[:] = 0.0
            if self._own is not None and math.isfinite(cost):
                model = self._own.quadratize(w.xs.copy(), w.us.copy())
                check_shapes(model, len(w.us), w.us.shape[1], w.ndx)
                self.largest_control_weight = float(np.abs(self._R + model.R).max()) or 1.0
        return cost

    def _search(self, rule: int, feedback: bool, cost: float, slope: float) -> tuple[float, float]:
        w = self._w
        if not self._adds or rule == line_search.INITIAL_ROLLOUT:
            step, J = super()._search(rule, feedback, cost, slope)
            return step, J + self._value(w.xs, w.us) if self._adds and math.isfinite(J) else J
        alpha, costs, slopes = (w.search[row] for row in (ALPHA, COSTS, SLOPES))
        bracket = np.empty(3)  # a TRY begins another one in the memory of the search
        line_search.first_step_lengths(rule, alpha, bracket)
        for _ in range(line_search.batches(rule)):
            super()._search(line_search.EVALUATE_ONLY, feedback, cost, slope)
            for i in range(len(alpha)):  # one by one: Armijo need not know the cost of all
                costs[i] += self._value(*w.trial(i)) if math.isfinite(costs[i]) else 0.0
                if line_search.decided(rule, alpha, costs, cost, slope, i + 1):
                    costs[i + 1 :] = math.nan
                    break
            lane = line_search.choose(rule, alpha, costs, slopes, cost, slope, bracket)
            if lane >= 0:
                self._dynamics_of.take(w, self._memory, lane)
                return float(alpha[lane]), float(costs[lane])
            line_search.refine(rule, alpha, bracket)
        return 0.0, cost

    def _value(self, xs: np.ndarray, us: np.ndarray) -> float:
        """The cost that is added."""
        return 0.0 if self._own is None else float(self._own.value(xs.copy(), us.copy()))  # its maker may keep them

    def _quadratize_more(self) -> None:
        """Gradients and Hessians that are added along the trajectory."""
        if not self._adds:
            return
        w = self._w
        self._of_dynamics = None
        w.T[self._touched] = 0.0
        self._touched = self._touched[:0]
        if self._own is None:
            return
        model = self._own.quadratize(w.xs.copy(), w.us.copy())
        nu, x = w.us.shape[1], slice(w.first, w.first + w.ndx)
        if self._upper is None:
            self._upper = np.triu(np.ones((w.T.shape[1], w.T.shape[1])))
        w.l[:, x] += model.q
        w.l[:-1, :nu] += model.r
        w.T[:, x, x] = model.Q * self._upper[x, x]
        w.T[:-1, :nu, :nu] = model.R * self._upper[:nu, :nu]
        if model.S is not None:
            w.T[:-1, :nu, x] = model.S
        self._touched = np.arange(len(w.T))

    def _second_order(self) -> None:
        if not self._adds:
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
        if not self._adds:
            super().use_second_order(exact)
            return
        if self._of_dynamics is not None and exact != self._swept:
            T = self._w.T
            T[self._diagonals] = self._curvature
            T[:] += self._of_dynamics if exact else -self._of_dynamics
            self._curvature[:] = T[self._diagonals]
        self._swept = exact

    def _hold(self) -> None:
        if not self._adds:
            super()._hold()
            return
        self._w.T[self._diagonals] = self._curvature + self.state_regularization * self._state_weights
        if self.state_regularization > 0.0:
            self._touched = np.arange(len(self._w.T))
