"""The engine of compiled dynamics and costs: a few compiled calls per iteration."""

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
from planner.kernels.lq.workspace import W, Workspace
from planner.kernels.precompile import compile_together
from planner.model.space import space_of
from planner.problem.constraints.trajectory_constraints import BoundPenalties
from planner.problem.costs.residual_arrays import ResidualArrays
from planner.problem.costs.tracking import NoTracking, TrackingCost
from planner.problem.problem import Problem
from planner.solvers.engine.protocol import (
    MAX_SETS,
    ActiveSetSchedule,
    DefectStep,
    Direction,
    Engine,
    TrackedTrajectory,
    TrajectoryArrays,
    state_weights,
)
from planner.solvers.lq import MAX_GRADIENT

_EXACT = W.exact
# Arrays of a Workspace that solves do not write; step bounds of servos are computed before each sweep.
_READ_ONLY = {
    "x_ref", "u_ref", "vector_x", "vector_dx", "quaternion_x", "quaternion_dx", "ball", "stage_row", "stage_column",
    "stage_value", "final_row", "final_column", "final_value", "control_row", "control_column", "control_value",
    "lower", "upper", "range_lower", "range_upper", "penalty_dx", "servo_control", "servo_start", "servo_x", "servo_dx",
    "servo_at_start", "servo_at_end", "servo_low", "servo_high",
}  # fmt: skip


class CompiledEngine(Engine):
    """Engine of compiled dynamics, a tracking cost and, if the dynamics support them, residuals.

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
        self._w = Workspace(cost, self._space, dynamics.structured, numbers, penalties, servos, dynamics.outputs)
        free = (riccati_dense, riccati_structured)
        boxed = (riccati_dense_bounded, riccati_structured_bounded)
        self._riccati = (free if problem.bounds is None else boxed)[dynamics.structured]
        self._memory = dynamics.memory(problem.N)  # scratch, like _second: kernels write it before reading
        self._with_residuals = dynamics if residuals is not None and isinstance(dynamics, ResidualDynamics) else None
        if self._with_residuals is not None:
            self._w.use_residuals(self._with_residuals.residuals(residuals))
        self.residuals = self._w.residuals
        self._control_weight = float(np.abs(cost.R).max()) or 1.0
        self._state_weights = state_weights(cost.Q, self._control_weight)
        columns = self._w.first + np.arange(self._w.ndx)
        self._diagonals = slice(1, -1), columns, columns  # of the state blocks of T, without the first and last knot
        self._second: Any = None
        self._curvature = np.zeros((problem.N - 1, self._w.ndx))  # entries of T on these diagonals
        self.reset()

    def reset(self) -> None:
        """Restore the state of a new engine."""
        w = self._w
        for name, array in w._arrays.items():  # some are allocated later
            if name not in _READ_ONLY:
                array.fill(0.0)
        w.search.fill(0.0)
        self._curvature.fill(0.0)
        w.use_gains(w._arrays["K"], w._arrays["K"].ctypes.data)
        w.use_second_order(False)
        w.use_defects(False)
        # The tracked plan and the next one, alternating: their gains are not copied.
        self._tracked: tuple[TrackedTrajectory, TrackedTrajectory] | None = None
        self._exact, self._second_order_used, self.state_regularization = False, False, 0.0
        self.holds_bounds, self.curved = False, False
        self._schedule, self.largest_control_weight = ActiveSetSchedule(), self._control_weight
        self.set_penalties(None)

    def set_penalties(self, penalties: BoundPenalties | None) -> None:
        """Add penalties to the cost from the next start on; None for none."""
        w = self._w
        # Zero bounds with zero weights, since 0 * inf is NaN.
        w.penalty_lower[:], w.penalty_upper[:], w.penalty_weight[:] = penalties or (0.0, 0.0, 0.0)
        self._has_penalties = bool(w.penalty_weight.any())

    def start_from_controls(self, x0: np.ndarray, us: np.ndarray, exact: bool = False) -> float:
        """Set the rollout of the first guess us (N, nu), clipped to bounds; its cost."""
        self._exact, self._second_order_used, self.state_regularization = exact, exact, 0.0
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
        self._schedule, self._w.active_bounds[:] = ActiveSetSchedule(), 0.0
        self._w.xs[0] = x0
        self._w.us[:] = us if self._bounds is None else self._bounds.clip(slice(None), us, None)
        self._w.dus[:] = 0.0
        return self._search(line_search.INITIAL_ROLLOUT, False, math.inf, 0.0)[1]

    @property
    def has_active_bounds(self) -> bool:
        """Whether the last sweep had controls at their bounds."""
        return bool(self._w.active_bounds.any())

    def whole_step(self) -> np.ndarray:
        """A copy of the step (N, nu) of the controls, without feedback, that the last sweep found."""
        return self._w.k.copy()

    def start_from_trajectory(self, x0: np.ndarray, trajectory: TrajectoryArrays, stages: float = 0.0) -> float:
        """Set the rollout of u = us + K (x - xs) of a trajectory, shifted by `stages`, from x0 (nx,); its cost."""
        w = self._w
        if self._tracked is None:
            self._tracked = TrackedTrajectory(w, self._space), TrackedTrajectory(w, self._space)
        plan, next_one = self._tracked
        plan.take(trajectory)
        plan.begin(w, x0, stages)
        cost = self._search(line_search.INITIAL_ROLLOUT, True, math.inf, 0.0)[1]
        next_one.use(w)
        return cost

    def backtrack_along(self, dxs: np.ndarray, dus: np.ndarray, cost: float) -> tuple[float, float]:
        """Backtrack along a change until the cost falls: the step length, 0 for none, and the cost after it."""
        w = self._w
        w.k[:] = dus - np.einsum("nij,nj->ni", w.K[:, :, w.first : w.first + w.ndx], dxs[:-1])
        return self._search(line_search.DEFECT_STEP, True, cost, 0.0)

    def cost_arrays(self) -> dict[str, np.ndarray]:
        """The arrays of weights, references and bounds that kernels read; they may change between iterations.

        After a change the engine must not be released: `reset` does not restore them.
        """
        return self._w._arrays

    def use_tables(self, entries: np.ndarray, addresses: np.ndarray) -> None:
        """Let kernels read the cost_arrays at `entries` of the table from memory owned by the caller."""
        self._w.table[entries] = addresses

    def use_second_order(self, exact: bool) -> None:
        """Set whether the next sweeps include the second-order terms."""
        self._second_order_used = exact
        self._w.use_second_order(exact)

    def _add_state_regularization(self) -> None:
        """Add state_regularization to the Hessians of the sweep, except at the first and last knot."""
        w, weights = self._w, self.state_regularization * self._state_weights
        w.use_second_order(self._second_order_used, not self._second_order_used and self.state_regularization > 0.0)
        if self._second_order_used:
            w.T[self._diagonals] = self._curvature + weights
        elif self.state_regularization > 0.0:
            w.state_regularization[self._diagonals] = weights

    def compute_direction(self, mu: float, relinearize: bool, active_set: bool = True) -> Direction:
        """Linearize (if `relinearize`) and solve the LQ problem with mu added to R (Eq. 31-35)."""
        w, dt, bounded = self._w, self._dynamics.dt, self._bounds is not None
        if relinearize:
            self._linearize(self._exact)
        if self._exact or self.state_regularization > 0.0 or w.table[_EXACT]:
            self._add_state_regularization()
        self._update_step_bounds()
        if active_set and (bounded or self._has_penalties) and self._schedule.due():
            direction = self._active_set_direction(mu)
            update_active_set(w.table, dt, True)
            if direction is not None:
                return direction
        norm, value, definite = self._riccati(w.table, mu, dt, *([False] if bounded else []))
        if not bounded:
            return Direction(norm, value, 0.5 * value, definite)
        return Direction(norm, self._bounded_slope(norm, value) if definite else 0.0, value, definite)

    def _bounded_slope(self, gradient_norm: float, value: float) -> float:
        """The slope of J along the clipped direction, or the model's change where rounding hides it."""
        slope = bounded_direction(self._w.table, self._dynamics.dt)
        return slope if gradient_norm < MAX_GRADIENT else value

    def _active_set_direction(self, mu: float) -> Direction | None:
        """The direction with the converged active set of bounds and penalties; None if it does not converge."""
        w, dt, bounded = self._w, self._dynamics.dt, self._bounds is not None
        gradient_norm = 0.0
        for sets in range(MAX_SETS):
            norm, value, definite = self._riccati(w.table, mu, dt, *([True] if bounded else []))
            if not definite:
                break
            if sets == 0:
                gradient_norm = norm  # later sweeps have other active penalties
            changes, more_cost, more_slope = update_active_set(w.table, dt, False)
            if changes == 0:
                self._schedule.record_convergence()
                slope = self._bounded_slope(gradient_norm, value) if bounded else value
                change = (value if bounded else 0.5 * value) + more_cost
                return Direction(gradient_norm, slope + more_slope, change, True)
        self._schedule.record_cycle()
        return None

    def line_search(self, feedback: bool, rule: int, cost: float, slope: float) -> tuple[float, float]:
        """Step along the direction (Eq. 36): its length, 0 for none, and the cost after it."""
        if not slope < 0.0:  # clipping may remove the descent
            return 0.0, cost
        if not feedback and self._bounds is None:
            direction(self._w.table, self._dynamics.dt)
        step, after = self._search(rule, feedback, cost, slope)
        return step, after if step else cost

    def _linearize(self, second: bool) -> None:
        """Derivatives of dynamics and cost along the trajectory; with `second` the dynamics' second ones too."""
        w, dynamics = self._w, self._dynamics
        dynamics.linearize_nominal(w, self._memory)  # Eq. 35
        gradients(w.table)
        if self._with_residuals is not None:
            self._with_residuals.quadratize_nominal(w, self._memory)
        self._quadratize_own()
        if second:
            costates(w.table, dynamics.dt)
            self._second_order()
        if len(w.T):
            self._curvature[:] = w.T[self._diagonals]

    def _update_step_bounds(self) -> None:
        """Compute the step bounds of servos, which depend on the state."""
        w, bounds = self._w, self._bounds
        if bounds is not None and bounds.servos is not None:
            w.lower[:], w.upper[:], w.lower_share[:], w.upper_share[:] = bounds.shares(w.xs, w.us)
            if self.holds_bounds:
                w.lower_share[:] = w.upper_share[:] = 0.0

    def set_trajectory(self, xs: np.ndarray, us: np.ndarray) -> np.ndarray:
        """Set states (N+1, nx) and controls (N, nu) as the trajectory, after a start; its defects (N, ndx)."""
        w = self._w
        w.xs[:], w.us[:] = xs, us
        return self._space.difference(self._dynamics.stage_ends(w, self._memory), w.xs[1:])

    def defect_direction(self, defects: np.ndarray, relinearize: bool) -> DefectStep | None:
        """The LQ direction with defects (N, ndx); None if the sweep is not definite."""
        w, dt = self._w, self._dynamics.dt
        if relinearize:
            self._linearize(False)
        self.use_second_order(False)
        self._add_state_regularization()
        self._update_step_bounds()
        w.use_defects(True)
        w.defects[:] = defects
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
        """Line search by rollouts with the gains of defect_direction, which close all defects: step length and cost."""
        return self._search(line_search.DEFECT_STEP, True, cost, slope)

    def _search(self, rule: int, feedback: bool, cost: float, slope: float) -> tuple[float, float]:
        """One line search of the kernels: the step length, 0 for none, and the cost after it."""
        return self._dynamics.search(self._w, self._memory, rule, feedback, cost, slope)

    def _quadratize_own(self) -> None:
        """Add gradients and Hessians of terms in NumPy; none in this class."""

    def _second_order(self) -> None:
        self._dynamics.second_order_nominal(self._w, self._memory, self._second)

    def gradient(self) -> np.ndarray:
        """A copy of the gradient (N, nu) of Eq. 19 that the last sweep computed."""
        return self._w.gradient.copy()

    def trajectory(self) -> tuple[np.ndarray, np.ndarray]:
        """Copies of xs (N+1, nx) and us (N, nu)."""
        return self._w.xs.copy(), self._w.us.copy()

    def gains(self) -> np.ndarray:
        """A copy of K (N, nu, ndx)."""
        first = self._w.first
        return self._w.K[:, :, first : first + self._w.ndx].copy()

    def read(self, max_norm: float) -> TrajectoryArrays | None:
        """The trajectory and its gains, in memory that the second next call overwrites.

        None unless the norm of its last state is below `max_norm`.
        """
        if self._tracked is None:
            self._tracked = TrackedTrajectory(self._w, self._space), TrackedTrajectory(self._w, self._space)
            self._tracked[1].K[:] = self.gains()
        plan, next_one = self._tracked
        if not next_one.keep(self._w) < max_norm**2:
            return None
        self._tracked = next_one, plan
        return next_one.trajectory
