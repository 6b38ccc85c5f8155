"""Engines of compiled dynamics and costs with user-defined costs and constraints in NumPy.

Kernels roll candidates out and sum the compiled costs. NumPy adds the other terms: a cost to each candidate of the line
search, and along the trajectory gradients to l and Hessians, with their mixed blocks, to T of the sweep.

Constraints of compiled terms are residuals: each bound is a row of their table, whose bounds and weights the
multipliers change. A direction adds the curvature of clearances to the Hessians of Gauss and Newton, unless a sweep
with it is not definite. Other constraints, as user-defined functions or power, are terms in NumPy.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from typing import Any, NamedTuple

import numpy as np

from planner.kernels.lq import line_search
from planner.kernels.lq.workspace import ALPHA, COSTS, SLOPES
from planner.problem.constraints.clearance import PairClearanceFunction
from planner.problem.constraints.quantities import KernelResidual, penalty_arrays
from planner.problem.constraints.trajectory_constraints import BoundPenalties, TrajectoryConstraints
from planner.problem.costs.residual_arrays import ResidualArrays, joined
from planner.problem.costs.terms import Cost, Quadratic, SumCost
from planner.problem.problem import Problem
from planner.solvers.engine.compiled import CompiledEngine
from planner.solvers.engine.protocol import Direction, check_quadratic


class HybridEngine(CompiledEngine):
    """Engine of compiled dynamics and costs, with further costs in NumPy.

    Args:
        problem: Its cost is the sum of all these costs.
        dynamics: Compiled.
        cost: The compiled tracking cost.
        residuals: The compiled residuals; None for none.
        own: Costs in NumPy.
    """

    def __init__(
        self, problem: Problem, dynamics: Any, cost: Any, residuals: ResidualArrays | None = None,
        own: Sequence[Cost] = (),
    ) -> None:  # fmt: skip
        self._R = cost.R
        self._own: Cost | None = None if not own else own[0] if len(own) == 1 else SumCost(*own)
        self._adds = bool(own)  # whether there are terms in NumPy
        self._dynamics_of = dynamics
        self._upper: np.ndarray | None = None  # (width, width) 1 where T is read
        super().__init__(problem, dynamics, cost, residuals)

    def reset(self) -> None:
        """Restore the state of a new engine."""
        super().reset()
        self._of_dynamics: np.ndarray | None = None  # T of the dynamics' second order alone
        self._at_start: tuple[np.ndarray, np.ndarray, Quadratic] | None = None  # states, controls, terms in NumPy there
        self._changed_stages = np.empty(0, dtype=int)  # of T, to which terms were added

    def start_from_controls(self, x0: np.ndarray, us: np.ndarray, exact: bool = False) -> float:
        """Set the rollout of the first guess us (N, nu), clipped to bounds; its cost."""
        self._of_dynamics = self._at_start = None
        cost = super().start_from_controls(x0, us, exact)
        if self._adds:
            w = self._w
            w.use_second_order(True)
            w.T[:] = 0.0
            if self._own is not None and math.isfinite(cost):
                model = self._own.quadratize(w.xs.copy(), w.us.copy())
                check_quadratic(model, len(w.us), w.us.shape[1], w.ndx)
                self._at_start = (w.xs.copy(), w.us.copy(), model)
                self.largest_control_weight = float(np.abs(self._R + model.R).max()) or 1.0
        return cost

    def _search(self, rule: int, feedback: bool, cost: float, slope: float) -> tuple[float, float]:
        w = self._w
        if not self._adds or rule == line_search.INITIAL_ROLLOUT:
            step, J = super()._search(rule, feedback, cost, slope)
            return step, J + self._value(w.xs, w.us) if self._adds and math.isfinite(J) else J
        alpha, costs, slopes = (w.search[row] for row in (ALPHA, COSTS, SLOPES))
        bracket = np.empty(3)  # EVALUATE_ONLY overwrites the one of the search
        line_search.first_step_lengths(rule, alpha, bracket)
        for _ in range(line_search.batches(rule)):
            super()._search(line_search.EVALUATE_ONLY, feedback, cost, slope)
            for i in range(len(alpha)):  # one by one: Armijo may stop early
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
        """The cost of the terms in NumPy."""
        # Copies: a user-defined cost may store them.
        return 0.0 if self._own is None else float(self._own.value(xs.copy(), us.copy()))

    def _quadratize_own(self) -> None:
        """Add gradients and Hessians of the terms in NumPy along the trajectory."""
        if not self._adds:
            return
        w = self._w
        self._of_dynamics = None
        w.T[self._changed_stages] = 0.0
        self._changed_stages = self._changed_stages[:0]
        if self._own is None:
            return
        model = self._quadratized(self._own)
        nu, x = w.us.shape[1], slice(w.first, w.first + w.ndx)
        if self._upper is None:
            self._upper = np.triu(np.ones((w.T.shape[1], w.T.shape[1])))
        w.l[:, x] += model.q
        w.l[:-1, :nu] += model.r
        w.T[:, x, x] = model.Q * self._upper[x, x]
        w.T[:-1, :nu, :nu] = model.R * self._upper[:nu, :nu]
        if model.S is not None:
            w.T[:-1, :nu, x] = model.S
        self._changed_stages = np.arange(len(w.T))

    def _quadratized(self, own: Cost) -> Quadratic:
        """The terms in NumPy quadratized along the trajectory, which start_from_controls has done for the first."""
        w, start, self._at_start = self._w, self._at_start, None
        if start is not None and np.array_equal(w.us, start[1]) and np.array_equal(w.xs, start[0]):
            return start[2]
        return own.quadratize(w.xs.copy(), w.us.copy())

    def _second_order(self) -> None:
        if not self._adds:
            super()._second_order()
            return
        w = self._w
        own = w.T.copy()
        w.T[:] = 0.0
        super()._second_order()
        self._of_dynamics = w.T.copy()
        w.T[:] = own + self._of_dynamics if self._second_order_used else own
        self._changed_stages = np.arange(len(w.T))

    def use_second_order(self, exact: bool) -> None:
        """Set whether the next sweeps include the second-order terms."""
        if not self._adds:
            super().use_second_order(exact)
            return
        if self._of_dynamics is not None and exact != self._second_order_used:
            T = self._w.T
            T[self._diagonals] = self._curvature
            T[:] += self._of_dynamics if exact else -self._of_dynamics
            self._curvature[:] = T[self._diagonals]
        self._second_order_used = exact

    def _add_state_regularization(self) -> None:
        if not self._adds:
            super()._add_state_regularization()
            return
        self._w.T[self._diagonals] = self._curvature + self.state_regularization * self._state_weights
        if self.state_regularization > 0.0:
            self._changed_stages = np.arange(len(self._w.T))


class _Bounds(NamedTuple):
    """Rows of the residual table for the lower, or the upper, bounds of some columns of the penalties."""

    rows: slice
    columns: slice
    is_lower: bool


class ConstrainedEngine(HybridEngine):
    """Engine of compiled dynamics and costs, with constraints.

    Args: As HybridEngine, and the problem's constraints.
    """

    def __init__(
        self, problem: Problem, constraints: TrajectoryConstraints, dynamics: Any, cost: Any,
        residuals: ResidualArrays | None = None, own: Sequence[Cost] = (),
    ) -> None:  # fmt: skip
        assert constraints.rows is not None
        rows = constraints.rows
        compiled = [part for part in rows.parts if isinstance(part.function, KernelResidual)]
        terms, self._bounds_of = [] if residuals is None else [residuals], list[_Bounds]()
        curved = list[slice]()
        first = sum(len(part.weight) for part in terms)
        for part in compiled:
            function: Any = part.function  # a KernelResidual
            lower, upper, R = rows.lower[:, part.columns], rows.upper[:, part.columns], function.rows
            bounded = np.isfinite(lower) | np.isfinite(upper)
            exact = bool(np.all((lower == upper)[bounded]))
            for side, used in ((0.0, exact), (-1.0, not exact and np.isfinite(lower).any()),
                               (1.0, not exact and np.isfinite(upper).any())):  # fmt: skip
                if used:
                    terms.append(penalty_arrays(function.arrays, np.full(R, side), rows.N))
                    self._bounds_of.append(_Bounds(slice(first, first + R), part.columns, side < 0.0))
                    if isinstance(function, PairClearanceFunction):
                        curved.append(slice(first, first + R))
                    first += R
        self._constraints, self._scale = constraints, rows.scale
        others, self._columns = rows.subset([part for part in rows.parts if part not in compiled])
        self._others = TrajectoryConstraints(None, others, constraints.tolerance) if others.parts else None
        super().__init__(problem, dynamics, cost, joined(terms) if terms else None, own)
        self._adds = self._adds or self._others is not None
        for rows_ in curved:
            self.residuals.bend(rows_)

    def compute_direction(self, mu: float, relinearize: bool, active_set: bool = True) -> Direction:
        """As Engine, with the curvature of clearances where the sweep with it is definite.

        A sweep without a search for the active set, as for the gains of a plan, is that of Gauss and Newton.
        """
        if self.residuals is None or not len(self.residuals.bends):
            return super().compute_direction(mu, relinearize, active_set)
        if relinearize:
            self._linearize(self._exact)
        if active_set:
            schedule, sets = copy(self._schedule), [part.copy() for part in self._sets]
            self._use_curvature(True)
            direction = super().compute_direction(mu, False)
            if direction.definite:
                return direction
            self._schedule = schedule  # the search for the active set begins where it was
            for part, before in zip(self._sets, sets, strict=True):
                part[:] = before
        self._use_curvature(False)
        return super().compute_direction(mu, False, active_set)

    @property
    def _sets(self) -> tuple[np.ndarray, ...]:
        """What a search for the active set changes."""
        return tuple(self._w._arrays[name] for name in ("active_bounds", "penalty_active", "penalty_side"))

    def _linearize(self, second: bool) -> None:
        super()._linearize(second)
        self.curved = False

    def _use_curvature(self, curved: bool) -> None:
        """Whether the Hessians have the curvature of clearances."""
        if curved != self.curved:
            self.residuals.hessian += self.residuals.bends if curved else -self.residuals.bends
            self.curved = curved

    def set_penalties(self, penalties: BoundPenalties | None) -> None:
        """Add penalties to the cost from the next start on; None for none."""
        constraints = self._constraints
        super().set_penalties(
            None if penalties is None or constraints.ranges is None else constraints.of_ranges(penalties)
        )
        self.curved = False
        if self._bounds_of:
            of_rows = None if penalties is None else constraints.of_rows(penalties)
            for rows, columns, lower in self._bounds_of:
                if of_rows is None:
                    self.residuals.bound[rows] = self.residuals.weight[rows] = 0.0
                    continue
                scale = self._scale[columns, None]
                bound = (of_rows.lower if lower else of_rows.upper)[:, columns].T
                known = np.isfinite(bound)
                self.residuals.bound[rows] = np.where(known, bound, 0.0) / scale
                self.residuals.weight[rows] = np.where(known, of_rows.weight[:, columns].T, 0.0) * scale**2
            self.residuals.changed()
        self._penalties: BoundPenalties | None = None  # of constraints in NumPy
        if self._others is not None and penalties is not None:
            self._penalties = BoundPenalties(*(part[:, self._columns] for part in constraints.of_rows(penalties)))

    def _value(self, xs: np.ndarray, us: np.ndarray) -> float:
        """The cost of the terms in NumPy and of the penalties of constraints in NumPy."""
        own = super()._value(xs, us)
        if self._penalties is None or self._others is None:
            return own
        return own + self._others.value_of_rows(self._penalties, xs, us)

    def _quadratize_own(self) -> None:
        super()._quadratize_own()
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
        self._changed_stages = np.union1d(self._changed_stages, n)
