"""The engine of any dynamics and costs, in NumPy, for user-defined ones. Its line search rules are compiled."""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.base.errors import PlannerError
from planner.kernels.lq import line_search
from planner.kernels.numba.jit import announce
from planner.kernels.numba.lanes import WIDTH
from planner.model.space import space_of
from planner.problem.constraints.trajectory_constraints import BoundPenalties
from planner.problem.control_bounds import StepBounds
from planner.problem.costs.terms import Cost, Quadratic
from planner.problem.costs.tracking import tracking_of
from planner.problem.problem import Problem
from planner.solvers import lq
from planner.solvers.engine.protocol import (
    MAX_SETS,
    ActiveSetSchedule,
    DefectStep,
    Direction,
    Engine,
    TrajectoryArrays,
    check_quadratic,
    check_shapes,
    shift_trajectory,
    state_weights,
)


class NumpyEngine(Engine):
    """Engine of any Dynamics and Cost."""

    def __init__(self, problem: Problem) -> None:
        announce(line_search.choose)
        self._dynamics, self._own_cost, self._bounds = problem.dynamics, problem.cost, problem.bounds
        self._constraints = problem.trajectory_constraints
        # Without batches, eight candidates cost eight rollouts: Armijo tries them one by one, the longest first. The
        # step is the same.
        self._batched = bool(getattr(problem.dynamics, "batched", True))
        self._bracket = np.empty(3)
        self._space = space_of(problem.dynamics)
        self._gains = (problem.N, problem.dynamics.nu, self._space.ndx)
        self.reset()

    def reset(self) -> None:
        """Restore the state of a new engine."""
        N, nu, ndx = self._gains
        self._cost, self.largest_control_weight, self.state_regularization = self._own_cost, 1.0, 0.0
        self._state_weights = np.ones(ndx)  # set by a start of finite cost
        self._penalties: BoundPenalties | None = None
        self._sweep: lq.Sweep | None = None
        self._exact, self._second_order_used, self._second = False, False, None
        self.holds_bounds, self.curved = False, False
        self._schedule, self._active, self._gradient = ActiveSetSchedule(), np.zeros((N, nu)), np.zeros((N, nu))
        # One attribute, so that an interrupt never leaves states of one trajectory with controls of another.
        self._nominal = np.empty((0, self._space.nx)), np.empty((0, nu))

    def set_penalties(self, penalties: BoundPenalties | None) -> None:
        """Add penalties to the cost from the next start on; None for none."""
        self._penalties = penalties

    def _value(self, xs: np.ndarray, us: np.ndarray) -> float:
        J, penalties, constraints = self._cost.value(xs, us), self._penalties, self._constraints
        return J if penalties is None or constraints is None else J + constraints.value(penalties, xs, us)

    def _quadratized(self, xs: np.ndarray, us: np.ndarray, A: np.ndarray, B: np.ndarray) -> Quadratic:
        model = self._cost.quadratize(xs, us)
        if self._penalties is None or self._constraints is None:
            return model
        return self._constraints.with_penalties(self._penalties, model, xs, us, A, B)

    def _step_bounds(self, xs: np.ndarray, us: np.ndarray) -> StepBounds | None:
        """Bounds of the change of us (N, nu) along the states xs (N+1, nx); None without control bounds."""
        if self._bounds is None:
            return None
        bounds = self._bounds.step_bounds(xs, us)
        return StepBounds(bounds.lower, bounds.upper) if self.holds_bounds else bounds

    def start_from_controls(self, x0: np.ndarray, us: np.ndarray, exact: bool = False) -> float:
        """Set the rollout of the first guess us (N, nu), clipped to bounds; its cost."""
        if exact and not callable(getattr(self._dynamics, "second_order", None)):
            raise PlannerError(
                'hessian="exact" needs second derivatives and these dynamics have none, expected a method '
                "second_order(xs, us, costates) (see planner.dynamics.Dynamics)."
            )
        self._exact = self._second_order_used = exact
        self.state_regularization, self._schedule, self._active = 0.0, ActiveSetSchedule(), np.zeros(us.shape)
        first = us[:, None, :].copy()
        xs, J = self._rollout(x0, first, None, us)  # no gains yet
        self._nominal = xs[:, 0].copy(), first[:, 0].copy()
        if np.isfinite(J[0]):
            model = self._cost.quadratize(*self._nominal)
            check_quadratic(model, *self._gains)
            self.largest_control_weight = float(np.abs(model.R).max()) or 1.0
            tracking = tracking_of(self._cost)
            Q = model.Q if tracking is None else tracking.Q  # as in the kernels, in no rotated frame
            self._state_weights = state_weights(Q, self.largest_control_weight)
        return float(J[0])

    @property
    def has_active_bounds(self) -> bool:
        """Whether the last sweep had controls at their bounds."""
        return bool(self._active.any())

    def whole_step(self) -> np.ndarray:
        """A copy of the step (N, nu) of the controls, without feedback, that the last sweep found."""
        assert self._sweep is not None
        return self._sweep.k.copy()

    def start_from_trajectory(self, x0: np.ndarray, trajectory: TrajectoryArrays, stages: float = 0.0) -> float:
        """Set the rollout of u = us + K (x - xs) of a trajectory, shifted by `stages`, from x0 (nx,); its cost."""
        xs, us, K = np.empty_like(trajectory[0]), np.empty_like(trajectory[1]), trajectory[2]
        m = shift_trajectory((xs, us), trajectory[:2], stages, self._space)
        K, first = K[np.minimum(np.arange(m, m + len(K)), len(K) - 1)], us[:, None, :]
        states, J = self._rollout(x0, first, K, xs)
        self._nominal = states[:, 0].copy(), first[:, 0].copy()
        return float(J[0])

    def backtrack_along(self, dxs: np.ndarray, dus: np.ndarray, cost: float) -> tuple[float, float]:
        """Backtrack along a change until the cost falls: the step length, 0 for none, and the cost after it."""
        assert self._sweep is not None
        k = dus - np.einsum("nij,nj->ni", self._sweep.K, dxs[:-1])
        return self._search_once(k, cost, 0.0)

    def weigh(self, cost: Cost) -> None:
        """Use another cost of the same shapes from the next rollout on."""
        self._cost = cost

    def _rollout(
        self, x0: np.ndarray, us: np.ndarray, K: np.ndarray | None, nominal: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Rollouts of candidates us (N, c, nu), modified in place by feedback: xs (N+1, c, nx) and costs (c,)."""
        N, candidates, _ = us.shape
        xs = np.empty((N + 1, candidates, len(x0)))
        xs[0] = x0
        with np.errstate(all="ignore"):  # a candidate may diverge: its cost is then not finite
            for n in range(N):
                if K is not None:
                    us[n] += self._space.difference(xs[n], nominal[n]) @ K[n].T
                if self._bounds is not None:
                    us[n] = self._bounds.clip(n, us[n], xs[n])
                xs[n + 1] = self._dynamics.step(xs[n], us[n])  # Eq. 10
            J = np.array([self._value(xs[:, c], us[:, c]) for c in range(candidates)], dtype=float)
        return xs, J

    def _slope(self, xs: np.ndarray, us: np.ndarray, K: np.ndarray | None) -> float:
        """dJ/dalpha of the update at one candidate xs (N+1, nx), us (N, nu)."""
        A, B = self._dynamics.linearize(xs, us)
        model, bounds = self._quadratized(xs, us, A, B), self._step_bounds(xs, us)
        if K is not None and self._space.quaternions:  # difference(x, nominal) depends on x
            K = K @ self._space.difference_jacobian(self._space.difference(xs[:-1], self._nominal[0][:-1]))
        dx, total = np.zeros(self._space.ndx), 0.0
        for n in range(len(us)):
            du = self._dus[n] + K[n] @ dx if K is not None else self._dus[n]
            if bounds is not None:  # a clipped control stays at its bound, which may depend on the state
                floor = 0.0 if bounds.lower_by_x is None else bounds.lower_by_x[n] @ dx
                ceiling = 0.0 if bounds.upper_by_x is None else bounds.upper_by_x[n] @ dx
                du = np.where((bounds.lower[n] >= 0.0) & (du < floor), floor, du)
                du = np.where((bounds.upper[n] <= 0.0) & (du > ceiling), ceiling, du)
            total += float(model.q[n] @ dx + model.r[n] @ du)
            dx = A[n] @ dx + B[n] @ du
        return total + float(model.q[-1] @ dx)

    def use_second_order(self, exact: bool) -> None:
        """Set whether the next sweeps include the second-order terms."""
        self._second_order_used = exact

    def _second_order(self, xs: np.ndarray, us: np.ndarray) -> np.ndarray:
        """The dynamics' second-order terms (N, ndx+nu, ndx+nu) for the costates of the trajectory."""
        N, nu, ndx = self._gains
        dynamics: Any = self._dynamics
        T = np.asarray(dynamics.second_order(xs, us, lq.costates(self._A, self._model)))
        check_shapes("the dynamics' second_order", {"an array": (T, (N, ndx + nu, ndx + nu))})
        return T

    def compute_direction(self, mu: float, relinearize: bool, active_set: bool = True) -> Direction:
        """Linearize (if `relinearize`) and solve the LQ problem with mu added to R (Eq. 31-35)."""
        if relinearize:
            self._linearize()
            self._second = self._second_order(*self._nominal) if self._exact else None
        bounds = self._step_bounds(*self._nominal)
        sweep = self._solve_lq(mu, bounds, active_set)
        if sweep is None:
            return Direction(self._norm, 0.0, 0.0, False)
        self._sweep, self._bounds_now = sweep, bounds
        return Direction(self._norm, sweep.slope, sweep.value, True)

    def line_search(self, feedback: bool, rule: int, cost: float, slope: float) -> tuple[float, float]:
        """Step along the direction (Eq. 36): its length, 0 for none, and the cost after it."""
        sweep, (xs0, us0) = self._sweep, self._nominal
        if sweep is None or not slope < 0.0:  # clipping may remove the descent
            return 0.0, cost
        self._dus = sweep.k if feedback else lq.direction(self._A, self._B, sweep, self._bounds_now)[1]
        alpha, J = np.empty(WIDTH), np.empty(WIDTH)
        xs, us = np.empty((len(xs0), WIDTH, xs0.shape[1])), np.empty((len(us0), WIDTH, us0.shape[1]))
        bracket = self._bracket
        line_search.first_step_lengths(rule, alpha, bracket)
        slopes = np.zeros_like(alpha)
        one_by_one = not self._batched and rule == line_search.ARMIJO
        lanes = [slice(c, c + 1) for c in range(WIDTH)] if one_by_one else [slice(0, WIDTH)]
        for _ in range(line_search.batches(rule)):
            J[:] = np.nan
            for some in lanes:
                us[:, some] = us0[:, None, :] + alpha[some, None] * self._dus[:, None, :]  # Eq. 36
                xs[:, some], J[some] = self._rollout(xs0[0], us[:, some], sweep.K if feedback else None, xs0)
                if line_search.decided(rule, alpha, J, cost, slope, some.stop):
                    break
            if rule == line_search.WOLFE:
                for c in np.flatnonzero(np.isfinite(J)):
                    slopes[c] = self._slope(xs[:, c], us[:, c], sweep.K if feedback else None)
            lane = line_search.choose(rule, alpha, J, slopes, cost, slope, bracket)
            if lane >= 0:
                self._nominal = xs[:, lane].copy(), us[:, lane].copy()
                return float(alpha[lane]), float(J[lane])
            line_search.refine(rule, alpha, bracket)
        return 0.0, cost

    def _solve_lq(self, mu: float, bounds: StepBounds | None, active_set: bool) -> lq.Sweep | None:
        """The sweep by active set, or with a box QP at each stage; None if it is not definite."""
        constraints, penalties, xs = self._constraints, self._penalties, self._nominal[0]
        of_states = None
        if constraints is not None and penalties is not None and constraints.ranges is not None:
            of_ranges = constraints.of_ranges(penalties)
            of_states = lq.StatePenalties(constraints.ranges, of_ranges, xs) if of_ranges.weight.any() else None
        if active_set and (bounds is not None or of_states is not None) and self._schedule.due():
            sweep, self._active = lq.solve_active_set(
                self._A, self._B, self._model, mu, bounds, self._added(), of_states, self._active, MAX_SETS
            )
            if sweep is not None:
                self._schedule.record_convergence()
                return sweep
            self._schedule.record_cycle()
        sweep = lq.riccati(self._A, self._B, self._model, mu, bounds, self._added())
        if sweep is not None and sweep.active_bounds is not None:
            self._active = sweep.active_bounds
        return sweep

    def _linearize(self) -> None:
        xs0, us0 = self._nominal
        self._A, self._B = self._dynamics.linearize(xs0, us0)  # Eq. 35
        N, nu, ndx = self._gains  # with quaternions ndx differs from nx
        check_shapes("the dynamics' linearize", {"A": (self._A, (N, ndx, ndx)), "B": (self._B, (N, ndx, nu))})
        self._model = self._quadratized(xs0, us0, self._A, self._B)
        bounds = self._step_bounds(xs0, us0)
        with np.errstate(
            over="ignore", invalid="ignore"
        ):  # costates of unstable stages may overflow; NaN does not converge
            self._gradient = lq.reduced_gradient(self._A, self._B, self._model, bounds)
            self._norm = float(np.linalg.norm(lq.projected(self._gradient, bounds)))

    def _added(self) -> np.ndarray | None:
        """Second-order terms and state_regularization (N, ndx+nu, ndx+nu), the first state without the latter."""
        second = self._second if self._second_order_used else None
        if self.state_regularization == 0.0:
            return second
        N, nu, ndx = self._gains
        added, i = np.zeros((N, ndx + nu, ndx + nu)) if second is None else second.copy(), np.arange(ndx)
        added[1:, i, i] += self.state_regularization * self._state_weights
        return added

    def set_trajectory(self, xs: np.ndarray, us: np.ndarray) -> np.ndarray:
        """Set states (N+1, nx) and controls (N, nu) as the trajectory, after a start; its defects (N, ndx)."""
        self._nominal = xs.copy(), us.copy()
        return self._space.difference(self._dynamics.step(xs[:-1], us), xs[1:])

    def defect_direction(self, defects: np.ndarray, relinearize: bool) -> DefectStep | None:
        """The LQ direction with defects (N, ndx); None if the sweep is not definite."""
        if relinearize:
            self._linearize()
        self._second_order_used = False
        A, B, model, bounds = self._A, self._B, self._model, self._step_bounds(*self._nominal)
        sweep = lq.riccati(A, B, model, 0.0, bounds, self._added(), defects)
        if sweep is None:
            return None
        self._sweep = sweep
        dxs, dus = lq.direction(A, B, sweep, None, defects)
        multipliers = np.einsum("nij,nj->ni", sweep.P[1:], dxs[1:]) + sweep.s[1:]
        return DefectStep(dxs, dus, multipliers, float(np.sum(model.q * dxs) + np.sum(model.r * dus)), self._norm)

    def rollout_closing_defects(self, cost: float, slope: float) -> tuple[float, float]:
        """Line search by rollouts with the gains of defect_direction, which close all defects: step length and cost."""
        assert self._sweep is not None
        return self._search_once(self._sweep.k, cost, slope)

    def _search_once(self, k: np.ndarray, cost: float, slope: float) -> tuple[float, float]:
        """Armijo step length along controls k (N, nu) with the gains of the last sweep, and the cost after it."""
        assert self._sweep is not None
        xs0, us0 = self._nominal
        alpha = np.empty(WIDTH)
        line_search.first_step_lengths(line_search.DEFECT_STEP, alpha, self._bracket)
        us = us0[:, None, :] + alpha[:, None] * k[:, None, :]
        xs, J = self._rollout(xs0[0], us, self._sweep.K, xs0)
        lane = line_search.choose(line_search.DEFECT_STEP, alpha, J, np.zeros_like(alpha), cost, slope, self._bracket)
        if lane < 0:
            return 0.0, cost
        self._nominal = xs[:, lane].copy(), us[:, lane].copy()
        return float(alpha[lane]), float(J[lane])

    def gradient(self) -> np.ndarray:
        """A copy of the gradient (N, nu) of Eq. 19 that the last sweep computed."""
        return self._gradient.copy()

    def trajectory(self) -> tuple[np.ndarray, np.ndarray]:
        """Copies of xs (N+1, nx) and us (N, nu)."""
        xs, us = self._nominal
        return xs.copy(), us.copy()

    def gains(self) -> np.ndarray:
        """A copy of K (N, nu, ndx)."""
        return self._sweep.K.copy() if self._sweep is not None else np.zeros(self._gains)

    def read(self, max_norm: float) -> TrajectoryArrays | None:
        """Copies of the trajectory and its gains; None unless the norm of its last state is below `max_norm`."""
        xs, us = self.trajectory()
        return (xs, us, self.gains()) if xs[-1] @ xs[-1] < max_norm**2 else None
