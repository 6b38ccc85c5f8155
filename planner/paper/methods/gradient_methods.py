"""Gradient methods on the discrete problem, beside SLQ: steepest descent and L-BFGS with the costate gradient (3.1).

J is a function of the controls U alone, the states being what they roll out to (Eq. 9, 10). One rollout gives J, one
costate sweep backward its gradient (Eq. 16-19), at the price of an iteration of SLQ or less. These methods do
not see the LQ problem, so they need many more iterations (section 3.3 of the paper).

    steepest-descent    U - t grad, t halved from twice the last one until Armijo's rule holds
    l-bfgs              quasi-Newton from the last ten gradients (scipy.optimize)
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from planner.base.arguments import choice, count, number, short_repr
from planner.base.errors import PlannerError
from planner.kernels.lq.line_search import ARMIJO_C1
from planner.kernels.lq.workspace import INDEFINITE
from planner.problem.plan import Status
from planner.problem.problem import Problem
from planner.solvers.engine import acquire_engine, release_engine

METHODS = ("l-bfgs", "steepest-descent")

_SHORTEST = 2.0**-60  # of the first trial step: below it, rounding decides
_CORRECTIONS = 10  # gradients that L-BFGS remembers, SciPy's own default
# SciPy is told this times the steepest rise for an infinite cost: its interpolation then takes a tenth of the step.
_STEEP = 4.0
_MU_LEAST, _MU_MOST, _MU_FACTOR = 1e-6, 1e10, 10.0  # of a sweep, as in solve(); the gradient does not depend on it


class GradientIteration(NamedTuple):
    """One iteration. Cost and gradient are those after it."""

    iteration: int  # counted from 0, the first guess
    cost: float  # J of Eq. 9
    gradient_norm: float  # Euclidean norm of Eq. 19
    evaluations: int  # rollouts so far
    seconds: float  # since the start

    def __str__(self) -> str:
        return (
            f"{self.iteration:5d}  {self.cost:15.8g}  {self.gradient_norm:9.2e}  {self.evaluations:11d}  "
            f"{self.seconds:9.3f}"
        )


@dataclass(frozen=True, eq=False)
class Descended:
    """Result of minimize_by_gradient().

    Attributes:
        method: One of METHODS.
        xs: (N+1, nx) states.
        us: (N, nu) controls.
        cost: J of Eq. 9.
        gradient_norm: Norm of Eq. 19.
        status: How it ended.
        history: One Descent per iteration, the first guess first.
        evaluations: Rollouts.
    """

    method: str
    xs: np.ndarray
    us: np.ndarray
    cost: float
    gradient_norm: float
    status: Status
    history: tuple[GradientIteration, ...]
    evaluations: int

    @property
    def nit(self) -> int:
        """Number of iterations (as in SciPy)."""
        return max(len(self.history) - 1, 0)

    @property
    def success(self) -> bool:
        """Whether the gradient fell below its tolerance (as in SciPy)."""
        return self.status is Status.CONVERGED

    @property
    def message(self) -> str:
        """The status in a sentence (as in SciPy)."""
        return self.status.value


def cost_and_gradient(problem: Problem, us: np.ndarray) -> tuple[float, np.ndarray]:
    """J of controls us (N, nu) and its gradient (N, nu), Eq. 16-19.

    Where the rollout is not finite the gradient is zero.
    """
    objective = _Objective(problem)
    cost = objective.cost(us)
    gradient = objective.gradient() if math.isfinite(cost) else np.zeros_like(us)
    release_engine(problem, objective.engine)
    return cost, gradient


def minimize_by_gradient(
    problem: Problem, method: str = "l-bfgs", *, max_iterations: int = 1000, gradient_tolerance: float = 1e-6,
    callback: Callable[[GradientIteration], object] | None = None,
) -> Descended:  # fmt: skip
    """Optimize a motion by its gradient alone, from the problem's first guess.

    Args:
        problem: To solve.
        method: "l-bfgs" or "steepest-descent".
        max_iterations: Limit.
        gradient_tolerance: Stop when the norm of Eq. 19 falls below this (Eq. 20).
        callback: Called with each Descent. It may raise StopIteration to end the search.

    Returns:
        A Descended. Not converging is its status, never an exception; Ctrl-C returns the best so far.

    Raises:
        PlannerError: An argument that is none of the choices or out of range.
    """
    if not isinstance(problem, Problem):
        raise PlannerError(f"problem is {short_repr(problem)}, expected a Problem.")
    search = _METHODS[choice("method", method, METHODS)]
    count("max_iterations", max_iterations)
    number("gradient_tolerance", gradient_tolerance, minimum=0.0)
    if callback is not None and not callable(callback):
        raise PlannerError(f"callback is {short_repr(callback)}, expected a function of one line of progress.")
    walk = _Walk(_Objective(problem), problem.first_guess, gradient_tolerance, callback)
    try:
        status = walk.begin() or search(walk, max_iterations)
    except KeyboardInterrupt:
        status = Status.INTERRUPTED
    walk.objective.cost(walk.us)
    xs, us = walk.objective.engine.trajectory()
    release_engine(problem, walk.objective.engine)
    last = walk.history[-1]
    return Descended(
        method, xs, us, last.cost, last.gradient_norm, status, tuple(walk.history), walk.objective.evaluations
    )


class _Objective:
    """J and its gradient on an engine of its own, to be given back."""

    def __init__(self, problem: Problem) -> None:
        self._x0, self.engine, self.evaluations = problem.x0, acquire_engine(problem), 0

    def cost(self, us: np.ndarray) -> float:
        """J of controls (N, nu): one rollout."""
        self.evaluations += 1
        return self.engine.start_from_controls(self._x0, us)

    def gradient(self) -> np.ndarray:
        """The gradient (N, nu) where cost() was asked last; of a sweep, only the costate is wanted."""
        mu, fresh, largest = 0.0, True, self.engine.largest_control_weight
        while self.engine.sweep(mu * largest, fresh).kind == INDEFINITE and mu < _MU_MOST:
            mu, fresh = max(_MU_LEAST, _MU_FACTOR * mu), False
        return self.engine.gradient()


class _Walk:
    """Where a search is, and its history."""

    def __init__(
        self,
        objective: _Objective,
        us: np.ndarray,
        tolerance: float,
        callback: Callable[[GradientIteration], object] | None,
    ) -> None:
        self.objective, self.us, self.history = objective, us.copy(), list[GradientIteration]()
        self.cost = self.norm = math.nan
        self.gradient = np.zeros_like(us)
        self._tolerance, self._callback, self._began = tolerance, callback, time.perf_counter()

    def begin(self) -> Status | None:
        """Evaluate the first guess; a status where it is the end already."""
        cost = self.objective.cost(self.us)
        if math.isfinite(cost):
            return self.step(self.us, cost, self.objective.gradient())
        self.step(self.us, cost, np.full_like(self.us, math.nan))
        return Status.NOT_FINITE

    def step(self, us: np.ndarray, cost: float, gradient: np.ndarray) -> Status | None:
        """Go on from here; CONVERGED or INTERRUPTED where it is the end."""
        self.us, self.cost, self.gradient = us, cost, gradient
        self.norm = float(np.linalg.norm(gradient))
        seconds = time.perf_counter() - self._began
        self.history.append(GradientIteration(len(self.history), cost, self.norm, self.objective.evaluations, seconds))
        try:
            if self._callback is not None:
                self._callback(self.history[-1])
        except StopIteration:
            return Status.INTERRUPTED
        return Status.CONVERGED if self.norm <= self._tolerance else None  # Eq. 20


def _steepest_descent(walk: _Walk, limit: int) -> Status:
    """U - t grad J, with t by backtracking."""
    step = 0.5 / walk.norm  # the first trial moves all controls together by 1
    for _ in range(limit):
        trial = 2.0 * step
        shortest = _SHORTEST * trial
        while True:
            us = walk.us - trial * walk.gradient
            cost = walk.objective.cost(us)
            if -math.inf < cost <= walk.cost - ARMIJO_C1 * trial * walk.norm**2 and cost < walk.cost:  # Armijo
                break
            trial *= 0.5
            if trial < shortest:
                return Status.NO_DESCENT
        step = trial
        done = walk.step(us, cost, walk.objective.gradient())
        if done is not None:
            return done
    return Status.MAX_ITERATIONS


def _l_bfgs(walk: _Walk, limit: int) -> Status:
    """SciPy's, told to stop by our rule alone."""
    from scipy.optimize import OptimizeResult, minimize

    shape = walk.us.shape
    last = walk.us, walk.cost, walk.gradient
    done: Status | None = None

    def evaluate(flat: np.ndarray) -> tuple[float, np.ndarray]:
        nonlocal last
        us = flat.reshape(shape).copy()
        if not np.array_equal(us, last[0]):
            cost = walk.objective.cost(us)
            if math.isfinite(cost):
                last = us, cost, walk.objective.gradient()
            else:  # SciPy's interpolation needs a number, and of a size that does not shrink the step to nothing
                rise = _STEEP * walk.norm * float(np.linalg.norm(us - walk.us))
                last = us, walk.cost + rise, np.zeros(shape)
        return last[1], last[2].ravel()

    def heed(intermediate_result: OptimizeResult) -> None:
        nonlocal done
        evaluate(intermediate_result.x)  # nearly always what was evaluated last
        done = walk.step(*last)
        if done is not None:
            raise StopIteration

    options = {"maxiter": limit, "maxfun": 100 * limit, "maxcor": _CORRECTIONS, "gtol": 0.0, "ftol": 0.0}
    found = minimize(evaluate, walk.us.ravel(), jac=True, method="L-BFGS-B", callback=heed, options=options)
    if done is not None:
        return done
    return Status.MAX_ITERATIONS if found.status == 1 else Status.NO_DESCENT


_METHODS: dict[str, Callable[[_Walk, int], Status]] = {"l-bfgs": _l_bfgs, "steepest-descent": _steepest_descent}
