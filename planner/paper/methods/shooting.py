"""Indirect shooting (section 2.1): the initial costate with which the Hamiltonian system ends where it should.

    dx/dt = f(x, u),   dlambda/dt = -H_x,   u from H_u = 0              (Eq. 1, 3, 4)
    x(0) = x0,         lambda(t_f) = phi_x(x(t_f))

Unknown is lambda(0), nx numbers, found by scipy.optimize.root. Where f is affine in u and L is quadratic, H_u = 0 gives
u = u_ref - R^-1 f_u' lambda. The flow preserves volume, so for every direction that it contracts it stretches another:
that is why the method is known to fail on longer horizons, and what `sensitivity` measures.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from planner.base.arguments import array, choice, count, number, short_repr
from planner.base.errors import PlannerError
from planner.paper.methods.adjoint import ContinuousProblem
from planner.problem.problem import Problem

ROOTS = ("hybr", "lm", "krylov", "df-sane")  # of scipy.optimize.root
FOUND = 1e-6  # of the scale: the residual of a costate that is said to be found
_LARGEST = 1e8  # of any state or costate: a flow beyond has run away
_MAX_RATES = 3_000  # of one flow
_DIFFERENCE = 1e-5  # of an initial costate, relative


class _Away(Exception):
    """A flow has run away, or needs more steps than are worth it."""


@dataclass(frozen=True, eq=False)
class Extremal:
    """Result of shoot().

    Attributes:
        costate0: (nx,) lambda(0).
        residual: Norm of lambda(t_f) - phi_x(x(t_f)).
        scale: Norm of phi_x(x(t_f)), or 1 where that is less.
        evaluations: Flows that were integrated.
        success: Whether the residual is below 1e-6 of the scale.
        message: Words of the root finder.
        t: (N+1,) s, the knots of the problem.
        xs: (N+1, nx) states there; NaN where the flow runs away.
        costates: (N+1, nx) likewise.
        us: (N, nu) controls at the start of each stage.
    """

    costate0: np.ndarray
    residual: float
    scale: float
    evaluations: int
    success: bool
    message: str
    t: np.ndarray
    xs: np.ndarray
    costates: np.ndarray
    us: np.ndarray


class HamiltonianFlow:
    """States and costates of a problem from the start on, u being that of H_u = 0, integrated to a tolerance.

    Raises:
        PlannerError: A cost that is no TrackingCost of constant weights on the way, or dynamics not affine in u.
    """

    def __init__(self, problem: Problem, tolerance: float = 1e-8) -> None:
        if not isinstance(problem, Problem):
            raise PlannerError(f"problem is {short_repr(problem)}, expected a Problem.")
        self.system = ContinuousProblem(problem)
        self._tolerance = number("tolerance", tolerance, minimum=3e-14, maximum=0.1)
        self._inverse = np.linalg.inv(self.system.R)
        self.evaluations = 0  # flows integrated so far
        x, zero = self.system.x0, np.zeros(self.system.inputs)
        other = np.linspace(1.0, 2.0, self.system.inputs)
        if not np.allclose(self.system.f.partials(x, zero)[1], self.system.f.partials(x, other)[1], rtol=1e-6):
            raise PlannerError("the control's effect df/du depends on the control, expected dynamics affine in it.")

    def control(self, x: np.ndarray, costate: np.ndarray) -> np.ndarray:
        """U (nu,) of H_u = 0."""
        f_u = self.system.f.partials(x, self.system.u_ref)[1]
        return self.system.u_ref - self._inverse @ (f_u.T @ costate)

    def rates(self, y: np.ndarray) -> np.ndarray:
        """d(x, lambda)/dt (2 nx,)."""
        x, costate = y[: len(y) // 2], y[len(y) // 2 :]
        u = self.control(x, costate)
        f_x, _ = self.system.f.partials(x, u)
        H_x = self.system.Q @ (x - self.system.x_ref) + f_x.T @ costate  # Eq. 3
        return np.concatenate([self.system.f(x, u), -H_x])  # Eq. 1, 4

    def integrate(self, costate0: np.ndarray, times: np.ndarray) -> np.ndarray:
        """States and costates (M, 2 nx) at times (M,); NaN where the flow runs away."""
        from scipy.integrate import solve_ivp

        self.evaluations += 1
        calls = 0

        def rates(_: float, y: np.ndarray) -> np.ndarray:
            nonlocal calls
            calls += 1
            if calls > _MAX_RATES or not np.abs(y).max() < _LARGEST:
                raise _Away
            return self.rates(y)

        y0 = np.concatenate([self.system.x0, costate0])
        options = {"method": "DOP853", "rtol": self._tolerance, "atol": self._tolerance}
        try:
            found = solve_ivp(rates, (0.0, float(times[-1])), y0, t_eval=times, **options)
        except _Away:
            return np.full((len(times), len(y0)), np.nan)
        return found.y.T if found.success else np.full((len(times), len(y0)), np.nan)

    def miss(self, end: np.ndarray) -> tuple[np.ndarray, float]:
        """lambda(t_f) - phi_x (nx,) of an end (2 nx,), and the scale of phi_x."""
        x, costate = np.split(end, 2)
        phi_x = self.system.final(x, self.system.u_ref)[1]
        return costate - phi_x, max(1.0, float(np.linalg.norm(phi_x)))

    def sensitivity(self, costate0: np.ndarray, times: np.ndarray) -> np.ndarray:
        """d(x, lambda)(t) / d lambda(0), (M, 2 nx, nx) at increasing times (M,), by central differences of flows."""
        columns = []
        for direction in np.eye(len(costate0)):
            h = _DIFFERENCE * max(1.0, float(np.abs(costate0).max()))
            ends = [self.integrate(costate0 + side * h * direction, times) for side in (1.0, -1.0)]
            columns.append((ends[0] - ends[1]) / (2.0 * h))
        return np.stack(columns, axis=2)


def shoot(
    problem: Problem, costate0: Any, *, root: str = "hybr", tolerance: float = 1e-8, max_evaluations: int = 100
) -> Extremal:
    """Look for an extremal of a problem by indirect shooting.

    Args:
        problem: With a TrackingCost of constant weights on the way, and dynamics affine in the control.
        costate0: (nx,) first guess of lambda(0).
        root: Method of scipy.optimize.root.
        tolerance: Of the integrations, relative and absolute.
        max_evaluations: Flows at most, about.

    Returns:
        An Extremal. Not finding one is its `success`, never an exception.

    Raises:
        PlannerError: An argument of a wrong shape or out of range, or a problem of another form.
    """
    from scipy.optimize import root as find_root

    flow = HamiltonianFlow(problem, tolerance)
    guess = array("costate0", costate0, (flow.system.nz,))
    method, most = choice("root", root, ROOTS), count("max_evaluations", max_evaluations)
    best: tuple[float, np.ndarray] = (np.inf, guess)
    span = np.array([0.0, problem.duration])

    def residual(candidate: np.ndarray) -> np.ndarray:
        nonlocal best
        if flow.evaluations >= most:
            raise StopIteration
        end = flow.integrate(candidate, span)[-1]
        if not np.all(np.isfinite(end)):
            return np.full(len(guess), _LARGEST)  # a wall: the root finder has to turn round
        miss, scale = flow.miss(end)
        size = float(np.linalg.norm(miss)) / scale
        if size < best[0]:
            best = size, candidate.copy()
        if size < 0.1 * FOUND:
            raise StopIteration
        return miss

    try:
        message = str(find_root(residual, guess, method=method).message)
    except StopIteration:
        message = "found" if best[0] < FOUND else f"not found with {most} flows"
    except (ValueError, np.linalg.LinAlgError) as error:  # a root finder that began where flows run away
        message = str(error)
    evaluations = flow.evaluations
    t = problem.dynamics.dt * np.arange(problem.N + 1)
    xs, costates = np.split(flow.integrate(best[1], t), 2, axis=1)
    with np.errstate(invalid="ignore"):
        us = np.array([flow.control(x, costate) for x, costate in zip(xs[:-1], costates[:-1], strict=True)])
    miss, scale = flow.miss(np.concatenate([xs[-1], costates[-1]]))
    return Extremal(
        costate0=best[1], residual=float(np.linalg.norm(miss)), scale=scale, evaluations=evaluations,
        success=bool(best[0] < FOUND), message=" ".join(message.split()), t=t, xs=xs, costates=costates, us=us,
    )  # fmt: skip
