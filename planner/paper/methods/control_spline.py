"""Direct method with the control as a B-spline, u(t) = b(t) P, and BFGS on P (the basic steps of sections 2.2 and 2.4).

Two gradients. "discrete": J is the Problem's own sum over stages, and the gradient its exact one by the discrete
costate (Eq. 16-19), times b. "continuous": J is the integral behind it, integrated by an adaptive rule to a tolerance
with the gradient of Eq. 7, as the paper did; so J and gradient agree only up to errors of that order.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from planner.base.arguments import choice, count, short_repr
from planner.base.errors import PlannerError
from planner.paper.methods.adjoint import AdjointCost, ContinuousProblem, Integration
from planner.paper.methods.splines import DEGREE, SplineDescent, SplineSpace, bfgs, curve
from planner.problem.problem import Problem
from planner.solvers.engine import acquire_engine, release_engine
from planner.solvers.lq import gradient as discrete_gradient

if TYPE_CHECKING:
    from scipy.interpolate import BSpline

GRADIENTS = ("discrete", "continuous")


@dataclass(frozen=True, eq=False, kw_only=True)
class SplineControls(SplineDescent):
    """Result of solve_by_splines(): the spline is of the controls, (n, nu), and J as the method computes it.

    Attributes:
        us: (N, nu) the controls in the middle of each stage.
        discrete_cost: J of the Problem with `us`.
    """

    us: np.ndarray
    discrete_cost: float


class SplineCost:
    """J of a Problem and its exact gradient as functions of amplitudes P (n, nu), all in a row."""

    def __init__(self, problem: Problem, basis: BSpline) -> None:
        self._problem, self._engine = problem, acquire_engine(problem)
        self.b = basis(problem.dynamics.dt * (np.arange(problem.N) + 0.5))  # (N, n), in the middle of each stage

    def __call__(self, free: np.ndarray) -> tuple[float, np.ndarray]:
        """J and its gradient."""
        us = self.b @ free.reshape(self.b.shape[1], -1)
        J = self._engine.start_from_controls(self._problem.x0, us)
        if not np.isfinite(J):
            return np.inf, np.zeros_like(free)
        xs, us = self._engine.trajectory()
        A, B = self._problem.dynamics.linearize(xs, us)
        return J, (self.b.T @ discrete_gradient(A, B, self._problem.cost.quadratize(xs, us))).ravel()  # Eq. 19

    def close(self) -> None:
        """Hand the engine back."""
        release_engine(self._problem, self._engine)


def solve_by_splines(
    problem: Problem, *, coefficients: int = 17, degree: int = DEGREE, gradient: str = "discrete",
    tolerance: float = 1e-6, gradient_tolerance: float = 1e-9, max_iterations: int = 3000,
) -> SplineControls:  # fmt: skip
    """Controls of least cost among splines.

    Args:
        problem: To solve; the nearest spline to its first guess is the first one.
        coefficients: n, of each control, more than the degree; 17 are the quintics on 12 intervals of section 2.1.
        degree: Of the splines.
        gradient: "discrete" (that of the Problem's own J) or "continuous" (Eq. 7, as the paper).
        tolerance: Of the integrations of "continuous".
        gradient_tolerance: BFGS ends when no component of the gradient is larger, relative to max(1, J of the guess).
        max_iterations: Limit.

    Returns:
        SplineControls. Not converging is its `success`, never an exception.

    Raises:
        PlannerError: An argument out of range; with "continuous" a cost that changes on the way (see
            ContinuousProblem).
    """
    if not isinstance(problem, Problem):
        raise PlannerError(f"problem is {short_repr(problem)}, expected a Problem.")
    degree = count("degree", degree, maximum=9)
    coefficients = count("coefficients", coefficients, minimum=degree + 1, maximum=1000 + degree)
    basis = SplineSpace(coefficients - degree, degree).basis(problem.duration)
    exact = SplineCost(problem, basis)
    first = np.linalg.lstsq(exact.b, problem.first_guess, rcond=None)[0].ravel()
    shape = (coefficients, problem.dynamics.nu)
    cost: Callable[[np.ndarray], tuple[float, np.ndarray]] = exact
    if choice("gradient", gradient, GRADIENTS) == "continuous":
        integral = AdjointCost(ContinuousProblem(problem), basis, problem.x0, Integration(tolerance))

        def continuous(free: np.ndarray) -> tuple[float, np.ndarray]:
            J, by_P = integral(free.reshape(shape))
            return J, by_P.ravel()

        cost = continuous

    free, facts = bfgs(cost, first, gradient_tolerance, max_iterations, scale=max(1.0, abs(cost(first)[0])))
    discrete_cost = exact(free)[0]
    exact.close()
    P = free.reshape(shape)
    return SplineControls(spline=curve(basis, P), us=exact.b @ P, discrete_cost=discrete_cost, **facts)
