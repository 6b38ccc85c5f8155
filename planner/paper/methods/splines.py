"""The paper's direct method for fully actuated robots (section 2.1): joints as B-splines, BFGS on their amplitudes.

    q(t, P) = sum of P_k b_k(t)              a clamped B-spline of each joint over uniform knot intervals
    u(t)    = M(q) qdd + bias(q, qd)         Eq. 6, by the inverse dynamics of Fig. 2
    J(P)    = 1/2 integral of |u|^2 dt       the effort of Eq. 5, by Gauss-Legendre quadrature in every interval
    dJ/dP   = integral of u' (du/dq b + du/dqd b' + M b'') dt     exact, by the recursive sensitivities

The motion starts and ends where it is asked to: the first and the last amplitudes follow from positions and velocities
there, and the others are free.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from planner.base.arguments import array, count, number, shown
from planner.base.errors import PlannerError
from planner.dynamics.algorithms import rnea, rnea_derivatives
from planner.model.mechanism import SCREW, Mechanism

DEGREE, INTERVALS = 5, 12  # the paper's: quintic, 12 uniform knot intervals
NODES = 16  # of the quadrature in each interval: what an adaptive rule finds to 1e-8


@dataclass(frozen=True, eq=False)
class SplineMotion:
    """What minimize_effort() found.

    Attributes:
        amplitudes: (n, nv) P, one row per basis function.
        knots: (n + degree + 1,) s.
        degree: Of the splines.
        effort: J of the motion.
        first_effort: J of the first guess.
        gradient_norm: Of J by the free amplitudes.
        iterations: Of BFGS.
        evaluations: Of J and its gradient.
        success: Whether BFGS met its tolerance.
        message: Its own words.
    """

    amplitudes: np.ndarray
    knots: np.ndarray
    degree: int
    effort: float
    first_effort: float
    gradient_norm: float
    iterations: int
    evaluations: int
    success: bool
    message: str

    def at(self, t: np.ndarray, derivative: int = 0) -> np.ndarray:
        """Positions (..., nv) at times t (...), or a derivative of them."""
        from scipy.interpolate import BSpline

        return BSpline(self.knots, self.amplitudes, self.degree)(t, nu=derivative)


def minimize_effort(
    mechanism: Mechanism,
    start: np.ndarray,
    goal: np.ndarray,
    duration: float,
    *,
    start_velocity: np.ndarray | float = 0.0,
    goal_velocity: np.ndarray | float = 0.0,
    intervals: int = INTERVALS,
    degree: int = DEGREE,
    nodes: int = NODES,
    guess: Callable[[np.ndarray], np.ndarray] | None = None,
    gradient_tolerance: float = 1e-5,
    max_iterations: int = 1000,
) -> SplineMotion:
    """The motion of least effort between two poses, among splines.

    Args:
        mechanism: Of hinges and slides; every joint is driven by a force of its own.
        start: (nv,) positions at t = 0, rad or m.
        goal: (nv,) positions at the end.
        duration: s.
        start_velocity: (nv,) or a number for all.
        goal_velocity: Likewise.
        intervals: Uniform knot intervals.
        degree: Of the splines, at least 3: accelerations are continuous.
        nodes: Of the quadrature in each interval.
        guess: t (M,) -> positions (M, nv) of a first motion; by default the straight one with rest at both ends.
        gradient_tolerance: Where BFGS ends, on the largest component of the gradient.
        max_iterations: Limit.

    Raises:
        PlannerError: An argument of a wrong shape or out of range, or a joint that is neither hinge nor slide.
    """
    if not isinstance(mechanism, Mechanism):
        raise PlannerError(f"mechanism is {shown(mechanism)}, expected a Mechanism.")
    if np.any(mechanism.kind != SCREW):
        raise PlannerError("the mechanism has a ball or free joint, expected hinges and slides alone.")
    nv, duration = mechanism.nv, number("duration", duration, above=0.0)
    degree, intervals = count("degree", degree, least=3, most=9), count("intervals", intervals, least=4, most=1000)
    ends = [array("start", start, (nv,)), array("goal", goal, (nv,))]
    rates = [
        np.full(nv, number(name, value)) if np.isscalar(value) else array(name, value, (nv,))
        for name, value in (("start_velocity", start_velocity), ("goal_velocity", goal_velocity))
    ]
    basis = _Basis(duration, intervals, degree, count("nodes", nodes, most=64))
    fixed = basis.boundary(ends, rates)
    first = basis.nearest(_first(guess, ends, basis.t, duration), fixed)

    def cost(free: np.ndarray) -> tuple[float, np.ndarray]:
        amplitudes = fixed.copy()
        amplitudes[2:-2] = free.reshape(-1, nv)
        effort, gradient = _effort(mechanism, basis, amplitudes)
        return effort, gradient[2:-2].ravel()

    from scipy.optimize import minimize

    found = minimize(
        cost, first[2:-2].ravel(), jac=True, method="BFGS",
        options={"gtol": number("gradient_tolerance", gradient_tolerance, above=0.0),
                 "maxiter": count("max_iterations", max_iterations)},
    )  # fmt: skip
    amplitudes = fixed.copy()
    amplitudes[2:-2] = found.x.reshape(-1, nv)
    return SplineMotion(
        amplitudes=amplitudes, knots=basis.knots, degree=degree, effort=float(found.fun),
        first_effort=_effort(mechanism, basis, first)[0], gradient_norm=float(np.linalg.norm(found.jac)),
        iterations=int(found.nit), evaluations=int(found.nfev), success=bool(found.success), message=str(found.message),
    )  # fmt: skip


class _Basis:
    """B-spline basis functions and their derivatives at the nodes of the quadrature."""

    def __init__(self, duration: float, intervals: int, degree: int, nodes: int) -> None:
        from scipy.interpolate import BSpline

        inside = np.linspace(0.0, duration, intervals + 1)
        self.knots = np.concatenate([np.zeros(degree), inside, np.full(degree, duration)])
        self.degree, self.size = degree, intervals + degree
        points, weights = np.polynomial.legendre.leggauss(nodes)
        half = 0.5 * duration / intervals
        self.t = (inside[:-1, None] + half * (1.0 + points)).ravel()  # (M,)
        self.weights = np.tile(half * weights, intervals)
        unit = BSpline(self.knots, np.eye(self.size), degree)
        self.b = [unit(self.t, nu=k) for k in range(3)]  # (M, n) each
        self._slopes = [unit(t, nu=1) for t in (0.0, duration)]

    def boundary(self, positions: list[np.ndarray], velocities: list[np.ndarray]) -> np.ndarray:
        """Amplitudes (n, nv), zero but for the four that positions and velocities at both ends decide."""
        amplitudes = np.zeros((self.size, len(positions[0])))
        amplitudes[0], amplitudes[-1] = positions
        for slopes, rate, outer, inner in (
            (self._slopes[0], velocities[0], 0, 1), (self._slopes[1], velocities[1], -1, -2),
        ):  # fmt: skip
            amplitudes[inner] = (rate - slopes[outer] * amplitudes[outer]) / slopes[inner]
        return amplitudes

    def nearest(self, motion: np.ndarray, fixed: np.ndarray) -> np.ndarray:
        """Amplitudes (n, nv) of the spline nearest to a motion (M, nv) at the nodes, with the boundary as `fixed`."""
        result = fixed.copy()
        result[2:-2] = np.linalg.lstsq(self.b[0][:, 2:-2], motion - self.b[0] @ fixed, rcond=None)[0]
        return result


def _first(
    guess: Callable[[np.ndarray], np.ndarray] | None, ends: list[np.ndarray], t: np.ndarray, duration: float
) -> np.ndarray:
    """Positions (M, nv) of a first motion."""
    if guess is not None:
        return array("guess(t)", guess(t), (len(t), len(ends[0])))
    s = (t / duration)[:, None]
    return ends[0] + (10.0 * s**3 - 15.0 * s**4 + 6.0 * s**5) * (ends[1] - ends[0])


def _effort(mechanism: Mechanism, basis: _Basis, amplitudes: np.ndarray) -> tuple[float, np.ndarray]:
    """J and its gradient (n, nv) by all amplitudes."""
    q, qd, qdd = (b @ amplitudes for b in basis.b)
    u = rnea(mechanism, q, qd, qdd)
    by = rnea_derivatives(mechanism, q, qd, qdd)
    weighted = basis.weights[:, None] * u
    gradient = np.zeros_like(amplitudes)
    for b, part in zip(basis.b, by, strict=True):  # du/dq, du/dqd, and du/dqdd, which is M
        gradient += b.T @ np.einsum("mi,mij->mj", weighted, part)
    return float(0.5 * np.sum(weighted * u)), gradient
