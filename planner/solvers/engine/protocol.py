"""The protocol of engines: memory and arithmetic of one solve, called by solve(), and trajectories that it may track.

A controller tracks a TrackedTrajectory while a solve writes the next one to other memory.
"""

from __future__ import annotations

import math
from typing import NamedTuple, Protocol

import numpy as np

from planner.base.errors import PlannerError
from planner.kernels.lq.tracked_trajectory import FOLLOWED, load_tracked, store_tracked
from planner.kernels.lq.workspace import ACCEPTED, CONVERGED, INDEFINITE, NO_STEP, Workspace
from planner.kernels.numba.lanes import lane_array
from planner.model.space import StateSpace
from planner.problem.constraints.trajectory_constraints import BoundPenalties
from planner.problem.costs.terms import Quadratic

TrajectoryArrays = tuple[np.ndarray, np.ndarray, np.ndarray]  # xs (N+1, nx), us (N, nu), K (N, nu, ndx)
StatesAndControls = tuple[np.ndarray, np.ndarray]  # xs (N+1, nx), us (N, nu)

TIME_TOLERANCE = 1e-6  # of a stage: smaller differences of time are zero
_STAGES = FOLLOWED.stages
MAX_SETS = 20  # limit of the active-set sweeps of one iteration; convergence takes less than ten
MAX_SKIPPED = 16  # upper limit of the iterations without an active-set search after searches that cycled


def shift_trajectory(target: StatesAndControls, source: StatesAndControls, stages: float, space: StateSpace) -> int:
    """Write states and controls shifted by a real number of stages; after the end the last ones repeat.

    Args:
        target: Written arrays.
        source: Arrays of the same shapes.
        stages: At least 0.
        space: Of the states.

    Returns:
        The number of whole stages, by which gains shift.
    """
    (xs, us), (own_xs, own_us) = target, source
    m = int(stages + TIME_TOLERANCE)
    part, m = stages - m, min(m, len(us))
    if m == 0:
        xs[:], us[:] = own_xs, own_us
    else:
        left = len(us) - m
        xs[: left + 1], us[:left] = own_xs[m:], own_us[m:]
        xs[left + 1 :], us[left:] = own_xs[-1], own_us[-1]
    if part > TIME_TOLERANCE:
        xs[:-1] = space.integrate(xs[:-1], part * space.difference(xs[1:], xs[:-1]))
    return m


class TrackedTrajectory:
    """A trajectory with gains, with memory for N more stages after its end: it can be tracked from any stage on.

    Attributes:
        xs: (N+1, nx).
        us: (N, nu).
        K: (N, nu, ndx) a view of the gains.
        trajectory: The three.
    """

    def __init__(self, w: Workspace, space: StateSpace) -> None:
        self._space, self._N, (nu, width) = space, len(w.us), w.K.shape[1:]
        self.xs, self.us, self._x0 = np.zeros_like(w.xs), np.zeros_like(w.us), np.zeros(w.xs.shape[1])
        self._rows = lane_array(2 * self._N, nu, width)
        self._address, self._stride = self._rows.ctypes.data, self._rows.strides[0]
        self._first = self._rows[: self._N]
        self.K = self._first[:, :, w.first : w.first + w.ndx]
        self.trajectory = self.xs, self.us, self.K
        arrays = {"x0": self._x0, "xs": self.xs, "us": self.us, "K": self._rows}
        self._table = FOLLOWED.table({"stages": 0}, arrays)

    def take(self, trajectory: TrajectoryArrays) -> None:
        """Copy a trajectory, unless it is this one."""
        if trajectory[2] is not self.K:
            self.xs[:], self.us[:], self.K[:] = trajectory

    def begin(self, w: Workspace, x0: np.ndarray, stages: float) -> None:
        """Load it, shifted by `stages`, into a solve that starts at x0 (nx,); rollouts use its gains."""
        m = int(stages + TIME_TOLERANCE)
        if stages - m > TIME_TOLERANCE:
            m = self._between(w, x0, stages)
        else:
            m = min(m, self._N)
            self._table[_STAGES], self._x0[:] = m, x0
            load_tracked(w.table, self._table)
        w.use_gains(self._first, self._address + m * self._stride)

    def _between(self, w: Workspace, x0: np.ndarray, stages: float) -> int:
        """As load_tracked, for a fractional shift; returns the number of whole stages."""
        N = self._N
        m = shift_trajectory((w.xs, w.us), (self.xs, self.us), stages, self._space)
        self._rows[N : N + m] = self._rows[N - 1]
        w.k.fill(0.0)
        w.us[0] += self.K[min(m, N - 1)] @ self._space.single_difference(x0, w.xs[0])
        w.xs[0] = x0
        return m

    def use(self, w: Workspace) -> None:
        """Let the next sweep write its gains to this memory."""
        w.use_gains(self._first, self._address)

    def keep(self, w: Workspace) -> float:
        """Copy a solve's trajectory, whose gains are already in this memory; the squared norm of its last state."""
        return store_tracked(w.table, self._table)


class Direction(NamedTuple):
    """The minimum of the LQ problem along the trajectory."""

    gradient_norm: float  # of Eq. 19
    slope: float  # of J along the direction (Eq. 42), negative where it descends
    model_change: float  # of the LQ problem's cost for the full step, negative
    definite: bool  # whether R + B'PB is positive definite at every stage; else there is no direction

    def is_stationary(self, gradient_tolerance: float, expected_reduction_tolerance: float) -> bool:
        """The stopping criteria: gradient norm (Eq. 20), or expected reduction of the full step."""
        return self.gradient_norm <= gradient_tolerance or -self.model_change <= expected_reduction_tolerance

    def expected_reduction(self, step: float) -> float:
        """Expected reduction of J for a step length: parabola of the slope at 0 and model_change at 1; 0 means 1."""
        if step == 0.0:
            return -self.model_change
        step = min(step, 1.0)
        return -step * (self.slope + step * (self.model_change - self.slope))


class IterationResult(NamedTuple):
    """The result of one iteration."""

    kind: int  # ACCEPTED, CONVERGED, INDEFINITE or NO_STEP
    gradient_norm: float  # of Eq. 19, before the step
    slope: float  # of J along the direction (Eq. 42), negative
    step: float  # alpha of Eq. 36; 0 unless accepted
    expected: float  # reduction of J that the LQ problem expects of that step
    cost: float  # J after the step


class DefectStep(NamedTuple):
    """The direction of the LQ problem with defects."""

    dxs: np.ndarray  # (N+1, ndx)
    dus: np.ndarray  # (N, nu)
    multipliers: np.ndarray  # (N, ndx) of the defects
    slope: float  # of J along the direction, defects aside
    gradient_norm: float


class Engine(Protocol):
    """Memory and arithmetic of one solve. Not shared between threads.

    Attributes:
        largest_control_weight: The largest magnitude in R, the unit of mu, which is added to R + B'PB.
        state_regularization: Weight on changes of the states in the next sweeps, in addition to the cost's; relative
            to the cost's mean weight of each. Zero after a start.
        holds_bounds: Whether in the next sweeps a control at a bound that depends on the state keeps its value, in
            place of following the bound. False after a reset.
        curved: Whether the last direction's Hessians have the curvature of distances; gains of a plan do without.
    """

    largest_control_weight: float
    state_regularization: float
    holds_bounds: bool
    curved: bool

    def reset(self) -> None:
        """Restore the state of a new engine."""
        ...

    def set_penalties(self, penalties: BoundPenalties | None) -> None:
        """Add penalties to the cost from the next start on; None for none."""
        ...

    def use_second_order(self, exact: bool) -> None:
        """Whether the next sweeps have the dynamics' second-order terms, after start_from_controls(exact=True)."""
        ...

    def start_from_controls(self, x0: np.ndarray, us: np.ndarray, exact: bool = False) -> float:
        """Roll out the first guess us (N, nu), within its bounds; its cost.

        With `exact` the Hessians have the dynamics' second-order terms.
        """
        ...

    def compute_direction(self, mu: float, relinearize: bool, active_set: bool = True) -> Direction:
        """Linearize (if `relinearize`) and solve the LQ problem with mu added to R (Eq. 31-35).

        With `active_set`, sweeps are repeated until the active bounds and penalties do not change along the direction.
        If that fails, or without it, each stage solves a box QP, with the penalties active at the trajectory.
        """
        ...

    def line_search(self, feedback: bool, rule: int, cost: float, slope: float) -> tuple[float, float]:
        """Step along the direction (Eq. 36): its length, 0 for none, and the cost after it."""
        ...

    @property
    def has_active_bounds(self) -> bool:
        """Whether the last sweep had controls at their bounds."""
        ...

    def whole_step(self) -> np.ndarray:
        """A copy of the step (N, nu) of the controls, without feedback, that the last sweep found."""
        ...

    def start_from_trajectory(self, x0: np.ndarray, trajectory: TrajectoryArrays, stages: float = 0.0) -> float:
        """Roll out u = us + K (x - xs) of a trajectory, some stages on, from x0 (nx,), and take it; its cost.

        After a start, whose memory and terms it uses.
        """
        ...

    def backtrack_along(self, dxs: np.ndarray, dus: np.ndarray, cost: float) -> tuple[float, float]:
        """Backtrack along a change (N+1, ndx) of states and (N, nu) of controls until the cost falls.

        Rollouts use the gains of the last sweep about the current trajectory.

        Returns:
            The step length, 0 for none, and the cost after it.
        """
        ...

    def set_trajectory(self, xs: np.ndarray, us: np.ndarray) -> np.ndarray:
        """Set states (N+1, nx) and controls (N, nu) as the trajectory, after a start; its defects (N, ndx)."""
        ...

    def defect_direction(self, defects: np.ndarray, relinearize: bool) -> DefectStep | None:
        """The LQ direction with defects (N, ndx); None if the sweep is not definite."""
        ...

    def rollout_closing_defects(self, cost: float, slope: float) -> tuple[float, float]:
        """Roll out with the gains of defect_direction, which closes all defects, if Armijo's rule accepts a step.

        Returns:
            The step, 0 for none, and the cost after.
        """
        ...

    def iterate(
        self, feedback: bool, rule: int, mu: float, relinearize: bool, cost: float,
        gradient_tolerance: float, expected_reduction_tolerance: float,
    ) -> IterationResult:  # fmt: skip
        """compute_direction, stopping criteria and line_search: one iteration."""
        direction = self.compute_direction(mu, relinearize)
        norm, slope = direction.gradient_norm, direction.slope
        if not direction.definite:
            return IterationResult(INDEFINITE, norm, 0.0, 0.0, 0.0, cost)
        if direction.is_stationary(gradient_tolerance, expected_reduction_tolerance):
            return IterationResult(CONVERGED, norm, slope, 0.0, -direction.model_change, cost)
        step, after = self.line_search(feedback, rule, cost, slope)
        return IterationResult(
            ACCEPTED if step else NO_STEP, norm, slope, step, direction.expected_reduction(step), after
        )

    def sweep(self, mu: float, relinearize: bool) -> IterationResult:
        """compute_direction without a search for the active set: CONVERGED, INDEFINITE, or NO_STEP for NaN."""
        direction = self.compute_direction(mu, relinearize, active_set=False)
        norm, slope, change, definite = direction
        if not definite:
            return IterationResult(INDEFINITE, norm, 0.0, 0.0, 0.0, 0.0)
        kind = CONVERGED if direction.is_stationary(math.inf, math.inf) else NO_STEP
        return IterationResult(kind, norm, slope, 0.0, -change, 0.0)

    def gradient(self) -> np.ndarray:
        """A copy of the gradient (N, nu) of Eq. 19 that the last sweep computed."""
        ...

    def trajectory(self) -> tuple[np.ndarray, np.ndarray]:
        """Copies of xs (N+1, nx) and us (N, nu)."""
        ...

    def gains(self) -> np.ndarray:
        """A copy of K (N, nu, ndx)."""
        ...

    def read(self, max_norm: float) -> TrajectoryArrays | None:
        """The trajectory and its gains, in memory that the second next call overwrites.

        None unless the norm of its last state is below `max_norm`.
        """
        ...


class ActiveSetSchedule:
    """Iterations with an active-set search: after each cycle twice as many skip it, at most MAX_SKIPPED."""

    def __init__(self) -> None:
        self._skipped, self._next = 0, 1

    def due(self) -> bool:
        """Whether to search for the active set in this iteration."""
        self._skipped -= 1
        return self._skipped < 0

    def record_convergence(self) -> None:
        """The search converged."""
        self._next = 1

    def record_cycle(self) -> None:
        """The search did not converge."""
        self._skipped, self._next = self._next, min(2 * self._next, MAX_SKIPPED)


def state_weights(Q: np.ndarray, control_weight: float) -> np.ndarray:
    """The unit (ndx,) of state_regularization: the mean over the stages of each diagonal entry of Q (N+1, ndx, ndx).

    States of zero weight get the largest mean.
    """
    mean = np.abs(np.diagonal(Q, axis1=1, axis2=2)).sum(axis=0) / (len(Q) - 1)
    return np.where(mean > 0.0, mean, mean.max() or control_weight)


def check_quadratic(model: Quadratic, N: int, nu: int, ndx: int) -> None:
    """Check the shapes of a user-defined quadratic model, which might broadcast to a wrong gradient."""
    expected = {"Q": (N + 1, ndx, ndx), "q": (N + 1, ndx), "R": (N, nu, nu), "r": (N, nu)}
    if getattr(model, "S", None) is not None:
        expected["S"] = (N, nu, ndx)
    check_shapes("the cost's quadratize", {name: (getattr(model, name), shape) for name, shape in expected.items()})


def check_shapes(what: str, parts: dict[str, tuple[np.ndarray, tuple[int, ...]]]) -> None:
    """Check that a user's function `what` gives parts, by name, of the shape beside each."""
    for name, (part, shape) in parts.items():
        if np.shape(part) != shape:
            raise PlannerError(f"{what} gives {name} of shape {np.shape(part)}, expected {shape}.")
