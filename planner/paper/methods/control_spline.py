"""Direct method with the control as a B-spline, u(t) = b(t) P, and BFGS on P (the basic steps of sections 2.2 and 2.4).

Two gradients. "discrete": J is the Problem's own sum over stages, and the gradient its exact one by the discrete
costate (Eq. 16-19), times b. "continuous": J is the integral behind it, integrated by an adaptive rule to a tolerance
with the gradient of Eq. 7, as the paper did; so J and gradient agree only up to errors of that order.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from planner.base.arguments import choice, count, number, shown
from planner.base.errors import PlannerError
from planner.paper.methods.adjoint import AdjointCost
from planner.paper.methods.continuous import ContinuousProblem
from planner.paper.methods.spline_basis import SplineBasis
from planner.paper.methods.splines import DEGREE
from planner.problem.problem import Problem
from planner.solvers.engine import borrow, give_back
from planner.solvers.lq import gradient as discrete_gradient

GRADIENTS = ("discrete", "continuous")


@dataclass(frozen=True, eq=False)
class SplineControls:
    """What solve_by_splines() found.

    Attributes:
        amplitudes: (n, nu) P.
        knots: (n + degree + 1,) s.
        us: (N, nu) the controls in the middle of each stage.
        cost: J as the method computed it.
        discrete_cost: J of the Problem with `us`.
        gradient_norm: Of J by P, as computed.
        costs: (iterations + 1,) J after every iteration.
        iterations: Of BFGS.
        evaluations: Of J and its gradient.
        success: Whether BFGS met its tolerance.
        message: Its own words.
    """

    amplitudes: np.ndarray
    knots: np.ndarray
    us: np.ndarray
    cost: float
    discrete_cost: float
    gradient_norm: float
    costs: np.ndarray
    iterations: int
    evaluations: int
    success: bool
    message: str


class SplineCost:
    """J of a Problem and its exact gradient as functions of amplitudes P (n, nu), all in a row.

    Attributes:
        b: (N, n) basis functions in the middle of each stage.
        evaluations: How often it was called.
    """

    def __init__(self, problem: Problem, basis: SplineBasis) -> None:
        self._problem, self._engine = problem, borrow(problem)
        self.b = basis.matrix(problem.dynamics.dt * (np.arange(problem.N) + 0.5))
        self.evaluations = 0

    def __call__(self, free: np.ndarray) -> tuple[float, np.ndarray]:
        """J and its gradient."""
        self.evaluations += 1
        us = self.b @ free.reshape(self.b.shape[1], -1)
        J = self._engine.start(self._problem.x0, us)
        if not np.isfinite(J):
            return np.inf, np.zeros_like(free)
        xs, us = self._engine.trajectory()
        A, B = self._problem.dynamics.linearize(xs, us)
        return J, (self.b.T @ discrete_gradient(A, B, self._problem.cost.quadratize(xs, us))).ravel()  # Eq. 19

    def close(self) -> None:
        """Hand the engine back."""
        give_back(self._problem, self._engine)


def solve_by_splines(
    problem: Problem, *, coefficients: int = 17, degree: int = DEGREE, gradient: str = "discrete",
    tolerance: float = 1e-6, gradient_tolerance: float = 1e-9, max_iterations: int = 3000,
) -> SplineControls:  # fmt: skip
    """Controls of least cost among splines.

    Args:
        problem: What to solve; its first guess is brought to the nearest spline.
        coefficients: n, of each control, more than the degree; 17 are the quintics on 12 intervals of section 2.1.
        degree: Of the splines.
        gradient: "discrete" (that of the Problem's own J) or "continuous" (Eq. 7, as the paper).
        tolerance: Of the integrations of "continuous".
        gradient_tolerance: Where BFGS ends: the largest component of the gradient relative to max(1, J of the guess).
        max_iterations: Limit.

    Returns:
        SplineControls. Not converging is its `success`, never an exception.

    Raises:
        PlannerError: An argument out of range; with "continuous" a cost that changes on the way (see
            ContinuousProblem).
    """
    from scipy.optimize import minimize

    if not isinstance(problem, Problem):
        raise PlannerError(f"problem is {shown(problem)}, expected a Problem.")
    degree = count("degree", degree, most=9)
    coefficients = count("coefficients", coefficients, least=degree + 1, most=1000 + degree)
    basis = SplineBasis(problem.duration, coefficients - degree, degree)
    exact = SplineCost(problem, basis)
    first = np.linalg.lstsq(exact.b, problem.first_guess, rcond=None)[0].ravel()
    shape = (basis.size, problem.dynamics.nu)
    cost = exact
    if choice("gradient", gradient, GRADIENTS) == "continuous":
        cost = _Continuous(AdjointCost(ContinuousProblem(problem), basis, problem.x0, tolerance), shape)
    scale = max(1.0, abs(cost(first)[0]))
    seen: list[float] = []

    def scaled(free: np.ndarray) -> tuple[float, np.ndarray]:
        J, by_P = cost(free)
        return J / scale, by_P / scale

    with np.errstate(invalid="ignore", over="ignore"):  # a line search may step to where J is infinite
        found = minimize(
            scaled, first, jac=True, method="BFGS",
            callback=lambda intermediate_result: seen.append(scale * float(intermediate_result.fun)),
            options={"gtol": number("gradient_tolerance", gradient_tolerance, above=0.0),
                     "maxiter": count("max_iterations", max_iterations)},
        )  # fmt: skip
    evaluations, discrete_cost = cost.evaluations, exact(found.x)[0]
    exact.close()
    P = found.x.reshape(shape)
    return SplineControls(
        amplitudes=P, knots=basis.knots, us=exact.b @ P, cost=scale * float(found.fun), discrete_cost=discrete_cost,
        gradient_norm=scale * float(np.linalg.norm(found.jac)), costs=np.array([cost(first)[0], *seen]),
        iterations=int(found.nit), evaluations=evaluations, success=bool(found.success), message=str(found.message),
    )  # fmt: skip


class _Continuous:
    """AdjointCost as BFGS sees it."""

    def __init__(self, cost: AdjointCost, shape: tuple[int, int]) -> None:
        self._cost, self._shape = cost, shape

    @property
    def evaluations(self) -> int:
        return self._cost.evaluations

    def __call__(self, free: np.ndarray) -> tuple[float, np.ndarray]:
        J, by_P = self._cost(free.reshape(self._shape))
        return J, by_P.ravel()
