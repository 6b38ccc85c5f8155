"""The engine of dynamics and costs that are compiled: a few compiled calls per iteration."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from planner.dynamics import CompiledDynamics, ResidualDynamics
from planner.kernels.lq import line_search
from planner.kernels.lq.active_set import update_active_set
from planner.kernels.lq.bounded_riccati import bounded_direction, riccati_dense_bounded, riccati_structured_bounded
from planner.kernels.lq.quadratic import gradients
from planner.kernels.lq.riccati import direction, riccati_dense, riccati_structured
from planner.kernels.lq.second_order import costates
from planner.kernels.lq.workspace import ACCEPTED, CONVERGED, INDEFINITE, NO_STEP, W, Workspace
from planner.kernels.precompile import compile_together
from planner.model.space import StateSpace, space_of
from planner.problem.costs.residuals.arrays import ResidualArrays
from planner.problem.costs.tracking import TrackingCost
from planner.problem.problem import Problem
from planner.problem.state_bounds import BoundPenalties
from planner.solvers.engine.active_set_schedule import MAX_SETS, ActiveSetSchedule
from planner.solvers.engine.protocol import DefectStep, Engine, IterationResult, expected_reduction, state_weights
from planner.solvers.engine.tracked_trajectory import TrackedTrajectory
from planner.solvers.engine.warm_start_shift import TrajectoryArrays

_EXACT = W.exact


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
        penalties = None if ranges is None else (ranges.component, ranges.at_end)
        numbers = None if problem.bounds is None else (problem.bounds.lower, problem.bounds.upper)
        servos = None if problem.bounds is None else problem.bounds.servos
        self._space = space_of(dynamics)
        self._w = Workspace(cost, self._space, dynamics.structured, numbers, penalties, servos)
        free = (riccati_dense, riccati_structured)
        boxed = (riccati_dense_bounded, riccati_structured_bounded)
        # A plan that is followed and the next one, by turns: nothing of their gains is copied.
        self._followed: tuple[TrackedTrajectory, TrackedTrajectory] | None = None
        self._riccati = (free if problem.bounds is None else boxed)[dynamics.structured]
        self._settling, self._hinged = ActiveSetSchedule(), False
        self._memory = dynamics.memory(problem.N)
        self._with_residuals = dynamics if residuals is not None and isinstance(dynamics, ResidualDynamics) else None
        if self._with_residuals is not None:
            self._w.use_residuals(self._with_residuals.residuals(residuals))
        self.residuals = self._w.residuals
        self.largest_control_weight = float(np.abs(cost.R).max()) or 1.0
        self._state_weights = state_weights(cost.Q, self.largest_control_weight)
        columns = self._w.first + np.arange(self._w.ndx)
        self._diagonals = slice(1, -1), columns, columns  # of the states in T, the start's and the end's aside
        self._second: Any = None
        self._exact, self._swept, self.state_regularization = False, False, 0.0
        self._curvature = np.zeros((problem.N - 1, self._w.ndx))  # of T on these diagonals

    def set_penalties(self, penalties: BoundPenalties | None) -> None:
        """Have these penalties added to the cost from the next start on; None for none."""
        if penalties is None:
            self._w.penalty_weight[:] = 0.0
        else:
            self._w.penalty_lower[:], self._w.penalty_upper[:], self._w.penalty_weight[:] = penalties
        self._hinged = bool(self._w.penalty_weight.any())

    def start_from_controls(self, x0: np.ndarray, us: np.ndarray, exact: bool = False) -> float:
        """Roll out the first guess, within its bounds; its cost."""
        self._exact, self._swept, self.state_regularization = exact, exact, 0.0
        if exact and self._second is None:
            self._second = self._dynamics.second_order_memory()
        self._w.use_second_order(exact)
        self._w.use_defects(False)
        sweep = "riccati structured" if self._dynamics.structured else "riccati dense"
        sweep += "" if self._bounds is None else " bounded"
        active = () if self._bounds is None and not len(self._w.penalty_weight.T) else ("choose active",)
        more = self._dynamics.second_order_kernels if exact else ()
        kernels = self._dynamics.kernels
        if self._with_residuals is not None:
            kernels = self._with_residuals.residual_kernels(self._w.residuals.solids)
        compile_together((sweep, "gradients", *active, *kernels, *more))
        self._settling, self._w.active_bounds[:] = ActiveSetSchedule(), 0.0
        self._w.xs[0] = x0
        self._w.us[:] = us if self._bounds is None else self._bounds.clip(slice(None), us, None)
        self._w.dus[:] = 0.0
        return self._search(line_search.INITIAL_ROLLOUT, False, math.inf, 0.0)[1]

    @property
    def has_active_bounds(self) -> bool:
        """Whether the last sweep held controls at their bounds."""
        return bool(self._w.active_bounds.any())

    def start_from_trajectory(self, x0: np.ndarray, trajectory: TrajectoryArrays, stages: float = 0.0) -> float:
        """Roll out u = us + K (x - xs) of a trajectory, some stages on, from x0 (nx,), and take it; its cost."""
        w = self._w
        if self._followed is None:
            self._followed = TrackedTrajectory(w, self._space), TrackedTrajectory(w, self._space)
        plan, next_one = self._followed
        plan.take(trajectory)
        plan.begin(w, x0, stages)
        cost = self._search(line_search.INITIAL_ROLLOUT, True, math.inf, 0.0)[1]
        next_one.use(w)
        return cost

    def backtrack_along(self, dxs: np.ndarray, dus: np.ndarray, cost: float) -> tuple[float, float]:
        """Take the longest part of a change that lowers the cost: which, 0 for none, and the cost after it."""
        w = self._w
        w.k[:] = dus - np.einsum("nij,nj->ni", w.K[:, :, w.first : w.first + w.ndx], dxs[:-1])
        return self._search(line_search.DEFECT_STEP, True, cost, 0.0)

    def cost_arrays(self) -> dict[str, np.ndarray]:
        """The weights, references and bounds as kernels read them, which may change between iterations."""
        return self._w._arrays

    def use_tables(self, entries: np.ndarray, addresses: np.ndarray) -> None:
        """Have kernels read some of these arrays elsewhere, in memory that the caller keeps."""
        self._w.table[entries] = addresses

    def use_second_order(self, exact: bool) -> None:
        """Whether the next sweeps have the second-order terms."""
        self._swept = exact
        self._w.use_second_order(exact)

    def _hold(self) -> None:
        """Put `hold` onto the diagonals of what the sweep adds to its Hessians; start and end are free of it."""
        w, weights = self._w, self.state_regularization * self._state_weights
        w.use_second_order(self._swept, not self._swept and self.state_regularization > 0.0)
        if self._swept:
            w.T[self._diagonals] = self._curvature + weights
        elif self.state_regularization > 0.0:
            w.state_regularization[self._diagonals] = weights

    def iterate(
        self, feedback: bool, rule: int, mu: float, fresh: bool, cost: float,
        gradient_tolerance: float, expected_reduction_tolerance: float,
    ) -> IterationResult:  # fmt: skip
        """Linearize (if `fresh`), sweep, search, accept."""
        w, dynamics = self._w, self._dynamics
        if fresh:
            self._linearize(self._exact)
        if self._exact or self.state_regularization > 0.0 or w.table[_EXACT]:
            self._hold()
        self._boxed()
        norm, slope, value, definite = self._solve_lq(mu, expected_reduction_tolerance < math.inf)
        if not definite:
            return IterationResult(INDEFINITE, norm, 0.0, 0.0, 0.0, cost)
        if norm <= gradient_tolerance or -value <= expected_reduction_tolerance:
            return IterationResult(CONVERGED, norm, slope, 0.0, -value, cost)
        if not feedback and self._bounds is None:
            direction(w.table, dynamics.dt)
        step, after = self._search(rule, feedback, cost, slope) if slope < 0.0 else (0.0, cost)  # Eq. 36
        if step == 0.0:
            return IterationResult(NO_STEP, norm, slope, 0.0, -value, cost)
        return IterationResult(ACCEPTED, norm, slope, step, expected_reduction(slope, value, step), after)

    def _solve_lq(self, mu: float, settle: bool) -> tuple[float, float, float, bool]:
        """Sweep: the gradient's norm, the slope of J, the model's value at its minimum, and whether it is definite.

        With `settle` until the set of bounds and penalties is found that the motion tells. Where none is, or without,
        each
        stage has its box, and penalties pull where they do now.
        """
        w, dt, bounded = self._w, self._dynamics.dt, self._bounds is not None
        if settle and (bounded or self._hinged) and self._settling.due():
            found = self._settled(mu)
            update_active_set(w.table, dt, True)
            if found is not None:
                return found
        norm, value, definite = self._riccati(w.table, mu, dt, *([False] if bounded else []))
        if not bounded:
            return norm, value, 0.5 * value, definite
        return norm, bounded_direction(w.table, dt) if definite else 0.0, value, definite

    def _settled(self, mu: float) -> tuple[float, float, float, bool] | None:
        """What _solve_lq returns, of a set that tells itself; None where none is found."""
        w, dt, bounded = self._w, self._dynamics.dt, self._bounds is not None
        gradient_norm = 0.0
        for sets in range(MAX_SETS):
            norm, value, definite = self._riccati(w.table, mu, dt, *([True] if bounded else []))
            if not definite:
                break
            if sets == 0:
                gradient_norm = norm  # the next ones have other penalties
            changes, more_cost, more_slope = update_active_set(w.table, dt, False)
            if changes == 0:
                self._settling.record_convergence()
                slope = bounded_direction(w.table, dt) if bounded else value
                return gradient_norm, slope + more_slope, (value if bounded else 0.5 * value) + more_cost, True
        self._settling.record_cycle()
        return None

    def _linearize(self, second: bool) -> None:
        """What the sweep needs along the trajectory, with second-order terms or without."""
        w, dynamics = self._w, self._dynamics
        dynamics.linearize_nominal(w, self._memory)  # Eq. 35
        gradients(w.table)
        if self._with_residuals is not None:
            self._with_residuals.quadratize_nominal(w, self._memory)
        self._quadratize_more()
        if second:
            costates(w.table, dynamics.dt)
            self._second_order()
        if len(w.T):
            self._curvature[:] = w.T[self._diagonals]

    def _boxed(self) -> None:
        """The bounds of servos at the states."""
        w, bounds = self._w, self._bounds
        if bounds is not None and bounds.servos is not None:
            w.lower[:], w.upper[:], w.lower_share[:], w.upper_share[:] = bounds.shares(w.xs, w.us)

    def set_trajectory(self, xs: np.ndarray, us: np.ndarray) -> np.ndarray:
        """Take states (N+1, nx) and controls (N, nu) as the trajectory, after a start; its gaps (N, ndx)."""
        w = self._w
        w.xs[:], w.us[:] = xs, us
        return self._space.difference(self._dynamics.stage_ends(w, self._memory), w.xs[1:])

    def defect_direction(self, gaps: np.ndarray, fresh: bool) -> DefectStep | None:
        """Linearize (if `fresh`) and sweep across these gaps; None where the sweep is not definite."""
        w, dt = self._w, self._dynamics.dt
        if fresh:
            self._linearize(False)
        self.use_second_order(False)
        self._hold()
        self._boxed()
        w.use_defects(True)
        w.defects[:] = gaps
        boxed = () if self._bounds is None else (False,)
        norm, _, definite = self._riccati(w.table, 0.0, dt, *boxed)
        if definite:
            direction(w.table, dt)
        w.use_defects(False)
        if not definite:
            return None
        nu, first, ndx = w.us.shape[1], w.first, w.ndx
        multipliers = np.einsum("nij,nj->ni", w.values[:, :, :ndx], w.dxs[1:]) + w.values[:, :, ndx]
        slope = float(np.sum(w.l[:-1, :nu] * w.dus) + np.sum(w.l[:, first : first + ndx] * w.dxs))
        return DefectStep(w.dxs.copy(), w.dus.copy(), multipliers, slope, norm)

    def rollout_closing_defects(self, cost: float, slope: float) -> tuple[float, float]:
        """Close the gaps by a rollout with the gains of `cross`, if Armijo's rule takes one of the first steps."""
        return self._search(line_search.DEFECT_STEP, True, cost, slope)

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

    def read(self, most: float) -> TrajectoryArrays | None:
        """The trajectory and its gains, in memory that is another plan's when the next but one is read.

        None where the norm of its last state is not below `most`.
        """
        if self._followed is None:
            self._followed = TrackedTrajectory(self._w, self._space), TrackedTrajectory(self._w, self._space)
            self._followed[1].K[:] = self.gains()
        plan, next_one = self._followed
        if not next_one.keep(self._w) < most**2:
            return None
        self._followed = next_one, plan
        return next_one.trajectory
