"""The engine of dynamics and costs that are compiled: a few compiled calls per iteration."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from planner.dynamics import CompiledDynamics, ResidualDynamics
from planner.kernels.lq import search
from planner.kernels.lq.bounded import bounded_direction, riccati_dense_bounded, riccati_structured_bounded
from planner.kernels.lq.quadratic import gradients
from planner.kernels.lq.riccati import direction, riccati_dense, riccati_structured
from planner.kernels.lq.second_order import costates
from planner.kernels.lq.workspace import ACCEPTED, CONVERGED, INDEFINITE, NO_STEP, Workspace
from planner.kernels.precompile import compile_together
from planner.model.space import StateSpace, space_of
from planner.problem.costs.residuals.arrays import ResidualArrays
from planner.problem.costs.tracking import TrackingCost
from planner.problem.problem import Problem
from planner.problem.state_ranges import Hinges
from planner.solvers.engine.protocol import Engine, Outcome, promised


class NoTracking:
    """The weights and references of a TrackingCost that weighs nothing."""

    def __init__(self, N: int, space: StateSpace, nu: int) -> None:
        self.Q, self.R = np.zeros((N + 1, space.ndx, space.ndx)), np.zeros((N, nu, nu))
        self.x_ref, self.u_ref = np.zeros((N + 1, space.nx)), np.zeros((N, nu))
        for i, _ in space.quaternions:
            self.x_ref[:, i] = 1.0


class CompiledEngine(Engine):
    """Dynamics and costs that are compiled: a tracking cost and, where dynamics take them, residuals.

    Attributes:
        residuals: The table of the residuals, whose bounds and weights may change between iterations; or None.
    """

    def __init__(
        self, problem: Problem, dynamics: CompiledDynamics, cost: TrackingCost | NoTracking,
        residuals: ResidualArrays | None = None,
    ) -> None:  # fmt: skip
        self._bounds, self._dynamics = problem.bounds, dynamics
        ranges = problem.ranges
        hinges = None if ranges is None else (ranges.component, ranges.at_end)
        numbers = None if problem.bounds is None else (problem.bounds.lower, problem.bounds.upper)
        servos = None if problem.bounds is None else problem.bounds.servos
        self._w = Workspace(cost, space_of(dynamics), dynamics.structured, numbers, hinges, servos)
        self._memory = dynamics.memory(problem.N)
        self._with_residuals = dynamics if residuals is not None and isinstance(dynamics, ResidualDynamics) else None
        if self._with_residuals is not None:
            self._w.use_residuals(self._with_residuals.residuals(residuals))
        self.residuals = self._w.residuals
        self.largest_control_weight = float(np.abs(cost.R).max()) or 1.0
        self._second: Any = None
        self._exact = False

    def hinge(self, hinges: Hinges | None) -> None:
        """Have these hinges added to the cost from the next start on; None for none."""
        if hinges is None:
            self._w.hinge_weight[:] = 0.0
        else:
            self._w.hinge_lower[:], self._w.hinge_upper[:], self._w.hinge_weight[:] = hinges

    def start(self, x0: np.ndarray, us: np.ndarray, exact: bool = False) -> float:
        """Roll out the first guess, within its bounds; its cost."""
        self._exact = exact
        if exact and self._second is None:
            self._second = self._dynamics.second_order_memory()
        self._w.use_second_order(exact)
        sweep = "riccati structured" if self._dynamics.structured else "riccati dense"
        sweep += "" if self._bounds is None else " bounded"
        more = self._dynamics.second_order_kernels if exact else ()
        kernels = self._dynamics.kernels
        if self._with_residuals is not None:
            kernels = self._with_residuals.residual_kernels(self._w.residuals.solids)
        compile_together((sweep, "gradients", *kernels, *more))
        self._w.xs[0] = x0
        self._w.us[:] = us if self._bounds is None else self._bounds.clip(slice(None), us, None)
        self._w.dus[:] = 0.0
        return self._search(search.START, False, math.inf, 0.0)[1]

    def use_second_order(self, exact: bool) -> None:
        """Whether the next sweeps have the second-order terms."""
        self._w.use_second_order(exact)

    def iterate(
        self, feedback: bool, rule: int, mu: float, fresh: bool, cost: float,
        gradient_tolerance: float, decrease_tolerance: float,
    ) -> Outcome:  # fmt: skip
        """Linearise (if `fresh`), sweep, search, accept."""
        w, dynamics = self._w, self._dynamics
        if fresh:
            dynamics.linearize_nominal(w, self._memory)  # Eq. 35
            gradients(w.table)
            if self._with_residuals is not None:
                self._with_residuals.quadratize_nominal(w, self._memory)
            self._quadratize_more()
            if self._exact:
                costates(w.table, dynamics.dt)
                self._second_order()
        if self._bounds is not None:
            return self._iterate_bounded(feedback, rule, mu, cost, gradient_tolerance, decrease_tolerance)
        riccati = riccati_structured if dynamics.structured else riccati_dense
        norm, slope, definite = riccati(w.table, mu, dynamics.dt)
        if not definite:
            return Outcome(INDEFINITE, norm, 0.0, 0.0, 0.0, cost)
        if norm <= gradient_tolerance or -0.5 * slope <= decrease_tolerance:
            return Outcome(CONVERGED, norm, slope, 0.0, -0.5 * slope, cost)
        if not feedback:
            direction(w.table, dynamics.dt)
        step, after = self._search(rule, feedback, cost, slope)  # Eq. 36
        if step == 0.0:
            return Outcome(NO_STEP, norm, slope, 0.0, -0.5 * slope, cost)
        return Outcome(ACCEPTED, norm, slope, step, -slope * step * (1.0 - 0.5 * step), after)

    def _iterate_bounded(
        self, feedback: bool, rule: int, mu: float, cost: float, gradient_tolerance: float, decrease_tolerance: float
    ) -> Outcome:
        """The sweep and search of iterate, with bounds."""
        w, dynamics, bounds = self._w, self._dynamics, self._bounds
        if bounds is not None and bounds.servos is not None:
            w.lower[:], w.upper[:], w.lower_share[:], w.upper_share[:] = bounds.shares(w.xs, w.us)
        riccati = riccati_structured_bounded if dynamics.structured else riccati_dense_bounded
        norm, value, definite = riccati(w.table, mu, dynamics.dt)
        if not definite:
            return Outcome(INDEFINITE, norm, 0.0, 0.0, 0.0, cost)
        if norm <= gradient_tolerance or -value <= decrease_tolerance:
            return Outcome(CONVERGED, norm, 2.0 * value, 0.0, -value, cost)
        slope = bounded_direction(w.table, dynamics.dt)
        step, after = self._search(rule, feedback, cost, slope) if slope < 0.0 else (0.0, cost)
        if step == 0.0:
            return Outcome(NO_STEP, norm, slope, 0.0, -value, cost)
        return Outcome(ACCEPTED, norm, slope, step, promised(slope, value, step), after)

    def _search(self, rule: int, feedback: bool, cost: float, slope: float) -> tuple[float, float]:
        """The step that is taken and the cost after it."""
        return self._dynamics.search(self._w, self._memory, rule, feedback, cost, slope)

    def _quadratize_more(self) -> None:
        """What a subclass adds to gradients and Hessians along the trajectory."""

    def _second_order(self) -> None:
        self._dynamics.second_order_nominal(self._w, self._memory, self._second)

    def gradient(self) -> np.ndarray:
        """A copy of the gradient (N, nu) of Eq. 19, as the last sweep found it."""
        return self._w.gradient.copy()

    def trajectory(self) -> tuple[np.ndarray, np.ndarray]:
        """Copies of xs (N+1, nx) and us (N, nu)."""
        return self._w.xs.copy(), self._w.us.copy()

    def gains(self) -> np.ndarray:
        """A copy of K (N, nu, ndx)."""
        first = self._w.first
        return self._w.K[:, :, first : first + self._w.ndx].copy()
