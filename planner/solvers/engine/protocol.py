"""The protocol of engines, and the result of one iteration. solve() drives an engine and decides."""

from __future__ import annotations

import math
from typing import NamedTuple, Protocol

import numpy as np

from planner.base.errors import PlannerError
from planner.kernels.lq import line_search
from planner.problem.costs.terms import Quadratic
from planner.problem.state_bounds import BoundPenalties
from planner.solvers.engine.warm_start_shift import TrajectoryArrays


class IterationResult(NamedTuple):
    """The result of one iteration."""

    kind: int  # ACCEPTED, CONVERGED, INDEFINITE or NO_STEP
    gradient_norm: float  # of Eq. 19, before the step
    slope: float  # of J along the direction (Eq. 42), negative
    step: float  # alpha of Eq. 36; 0 unless accepted
    expected: float  # decrease that the LQ model promised for that step
    cost: float  # J after the step


class DefectStep(NamedTuple):
    """The direction of the LQ problem along states with gaps."""

    dxs: np.ndarray  # (N+1, ndx)
    dus: np.ndarray  # (N, nu)
    multipliers: np.ndarray  # (N, ndx) of the gaps
    slope: float  # of J along the direction, gaps aside
    gradient_norm: float


class Engine(Protocol):
    """One solve's memory. Not shared between threads.

    Attributes:
        largest_control_weight: The largest magnitude in R, the measure of what regularizes R + B'PB.
        hold: Weight on changes of the states in the next sweeps, beside their own; relative to the mean of what the
            cost weighs them with. Zero after a start. It only pulls the direction towards the trajectory.
    """

    largest_control_weight: float
    state_regularization: float

    def set_penalties(self, penalties: BoundPenalties | None) -> None:
        """Have these penalties added to the cost from the next start on; None for none."""
        ...

    def use_second_order(self, exact: bool) -> None:
        """Whether the next sweeps have the second-order terms, after start(exact=True)."""
        ...

    def start_from_controls(self, x0: np.ndarray, us: np.ndarray, exact: bool = False) -> float:
        """Roll out the first guess, within its bounds; its cost.

        With `exact` the Hessians have the dynamics' second-order terms.
        """
        ...

    def iterate(
        self, feedback: bool, rule: int, mu: float, fresh: bool, cost: float,
        gradient_tolerance: float, expected_reduction_tolerance: float,
    ) -> IterationResult:  # fmt: skip
        """Linearize (if `fresh`), sweep, search, accept."""
        ...

    @property
    def has_active_bounds(self) -> bool:
        """Whether the last sweep held controls at their bounds."""
        ...

    def start_from_trajectory(self, x0: np.ndarray, trajectory: TrajectoryArrays, stages: float = 0.0) -> float:
        """Roll out u = us + K (x - xs) of a trajectory, some stages on, from x0 (nx,), and take it; its cost.

        After a start, with whose memory and terms it goes on.
        """
        ...

    def backtrack_along(self, dxs: np.ndarray, dus: np.ndarray, cost: float) -> tuple[float, float]:
        """Take the longest part of a change (N+1, ndx) of states and (N, nu) of controls that lowers the cost.

        Rolled out with the gains of the last sweep, about the trajectory that there is.

        Returns:
            The part, 0 for none, and the cost after.
        """
        ...

    def set_trajectory(self, xs: np.ndarray, us: np.ndarray) -> np.ndarray:
        """Take states (N+1, nx) and controls (N, nu) as the trajectory, after a start; its gaps (N, ndx)."""
        ...

    def defect_direction(self, gaps: np.ndarray, fresh: bool) -> DefectStep | None:
        """Linearize (if `fresh`) and sweep across these gaps; None where the sweep is not definite."""
        ...

    def rollout_closing_defects(self, cost: float, slope: float) -> tuple[float, float]:
        """Close the gaps by a rollout with the gains of `cross`, if Armijo's rule takes one of the first steps.

        Returns:
            The step, 0 for none, and the cost after.
        """
        ...

    def sweep(self, mu: float, fresh: bool) -> IterationResult:
        """Linearize (if `fresh`) and sweep, without a search: CONVERGED, or INDEFINITE."""
        return self.iterate(True, line_search.ARMIJO, mu, fresh, 0.0, math.inf, math.inf)

    def gradient(self) -> np.ndarray:
        """A copy of the gradient (N, nu) of Eq. 19, as the last sweep found it."""
        ...

    def trajectory(self) -> tuple[np.ndarray, np.ndarray]:
        """Copies of xs (N+1, nx) and us (N, nu)."""
        ...

    def gains(self) -> np.ndarray:
        """A copy of K (N, nu, ndx)."""
        ...

    def read(self, most: float) -> TrajectoryArrays | None:
        """The trajectory and its gains, in memory that is another plan's when the next but one is read.

        None where the norm of its last state is not below `most`.
        """
        ...


def state_weights(Q: np.ndarray, control_weight: float) -> np.ndarray:
    """What `hold` is relative to (ndx,): the mean over the stages of each diagonal entry of Q (N+1, ndx, ndx).

    Those that the cost does not weigh get the largest of the others.
    """
    mean = np.abs(np.diagonal(Q, axis1=1, axis2=2)).sum(axis=0) / (len(Q) - 1)
    return np.where(mean > 0.0, mean, mean.max() or control_weight)


def expected_reduction(slope: float, value: float, step: float) -> float:
    """The decrease that a parabola of given slope at 0 and value at 1 promises for a step, up to the full one."""
    step = min(step, 1.0)
    return -step * (slope + step * (value - slope))


def check_shapes(model: Quadratic, N: int, nu: int, ndx: int) -> None:
    """A wrong shape from a user's cost could broadcast into a wrong gradient."""
    expected = {"Q": (N + 1, ndx, ndx), "q": (N + 1, ndx), "R": (N, nu, nu), "r": (N, nu)}
    if getattr(model, "S", None) is not None:
        expected["S"] = (N, nu, ndx)
    for name, shape in expected.items():
        have = np.shape(getattr(model, name))
        if have != shape:
            raise PlannerError(f"the cost's quadratize gives {name} of shape {have}, expected {shape}.")
