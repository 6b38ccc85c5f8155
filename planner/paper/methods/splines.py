"""The paper's direct method for fully actuated robots (section 2.1): joints as B-splines, BFGS on their amplitudes.

    q(t, P) = sum of P_k b_k(t)              a clamped B-spline of each joint over uniform knot intervals
    u(t)    = M(q) qdd + bias(q, qd)         Eq. 6, by the inverse dynamics of Fig. 2
    J(P)    = 1/2 integral of |u|^2 dt       the effort of Eq. 5, by Gauss-Legendre quadrature in every interval
    dJ/dP   = integral of u' (du/dq b + du/dqd b' + M b'') dt     exact, by the recursive sensitivities

Positions and velocities at both ends decide the two first and the two last amplitudes; BFGS moves the others. As Eq. 5
is printed, the end is soft, c1 |q(t_f) - q_d|^2 + c2 |qd(t_f)|^2, and BFGS moves the last two as well; and the paper's
quadrature is an adaptive Simpson rule.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from planner.base.arguments import array, count, number, short_repr
from planner.base.errors import PlannerError
from planner.dynamics.algorithms import rnea, rnea_derivatives
from planner.model.mechanism import SCREW, Mechanism
from planner.problem.initial_guess import minimum_jerk

if TYPE_CHECKING:
    from scipy.interpolate import BSpline

DEGREE, INTERVALS = 5, 12  # the paper's: quintic, 12 uniform knot intervals
ROUNDING = 1e-14  # relative, of the integral over an interval
NODES = 16  # of the quadrature in each interval; agrees with an adaptive rule to 1e-8

Guess = Callable[[np.ndarray], np.ndarray]
"""Times (M,) -> positions (M, joints) of a first motion."""


@dataclass(frozen=True)
class Boundary:
    """Both ends of a motion.

    Attributes:
        start: (nv,) positions at t = 0, rad or m.
        goal: (nv,) positions at the end.
        duration: s.
        start_velocity: (nv,) or a number for all joints.
        goal_velocity: Likewise.
    """

    start: Any
    goal: Any
    duration: float
    start_velocity: Any = 0.0
    goal_velocity: Any = 0.0

    def ends(self, mechanism: Mechanism) -> np.ndarray:
        """(2, 2, nv): positions and velocities at the start, positions and velocities at the goal.

        Raises:
            PlannerError: A wrong shape, a duration out of range, or a joint that is neither hinge nor slide.
        """
        if not isinstance(mechanism, Mechanism):
            raise PlannerError(f"mechanism is {short_repr(mechanism)}, expected a Mechanism.")
        if np.any(mechanism.kind != SCREW):
            raise PlannerError("the mechanism has a ball or free joint, expected hinges and slides alone.")
        number("duration", self.duration, greater_than=0.0)
        values = {name: getattr(self, name) for name in ("start", "start_velocity", "goal", "goal_velocity")}
        nv = mechanism.nv
        for name, value in values.items():
            scalar = name.endswith("velocity") and np.isscalar(value)
            values[name] = np.full(nv, number(name, value)) if scalar else array(name, value, (nv,))
        return np.reshape(list(values.values()), (2, 2, nv))


@dataclass(frozen=True)
class SplineSpace:
    """Clamped splines over uniform knot intervals.

    Attributes:
        intervals: Uniform knot intervals.
        degree: Of the polynomials.
    """

    intervals: int = INTERVALS
    degree: int = DEGREE

    def basis(self, duration: float, *, least_degree: int = 1) -> BSpline:
        """The n = intervals + degree basis functions from 0 to the duration, s: a curve with values (..., n).

        Raises:
            PlannerError: An argument out of range.
        """
        from scipy.interpolate import BSpline

        duration = number("duration", duration, greater_than=0.0)
        intervals = count("intervals", self.intervals, maximum=1000)
        degree = count("degree", self.degree, minimum=least_degree, maximum=9)
        breaks = np.linspace(0.0, duration, intervals + 1)
        knots = np.concatenate([np.zeros(degree), breaks, np.full(degree, duration)])
        return BSpline(knots, np.eye(intervals + degree), degree)


@dataclass(frozen=True, eq=False, kw_only=True)
class SplineDescent:
    """Result of BFGS on the amplitudes of splines.

    Attributes:
        spline: The curve: amplitudes `c` (n, columns), knots `t` (n + degree + 1,) s and degree `k`; spline(t, nu)
            is its value, or its derivative of order nu, at times t.
        costs: (iterations + 1,) J of the first guess and after every iteration.
        gradient_norm: Norm of the gradient of J by the free amplitudes.
        evaluations: Number of evaluations of J and its gradient.
        success: Whether BFGS met its tolerance.
        message: SciPy's message.
    """

    spline: BSpline
    costs: np.ndarray
    gradient_norm: float
    evaluations: int
    success: bool
    message: str

    @property
    def cost(self) -> float:
        """J at the end."""
        return float(self.costs[-1])

    @property
    def first_cost(self) -> float:
        """J of the first guess."""
        return float(self.costs[0])

    @property
    def iterations(self) -> int:
        """Iterations of BFGS."""
        return len(self.costs) - 1


@dataclass(frozen=True, eq=False, kw_only=True)
class SplineMotion(SplineDescent):
    """Result of minimize_effort(): the spline is of all joints, (n, nv), and J the effort and the cost of a soft end.

    Attributes:
        effort: 1/2 integral of |u|^2 dt alone.
    """

    effort: float


def minimize_effort(
    mechanism: Mechanism, boundary: Boundary, *, space: SplineSpace | None = None, nodes: int = NODES,
    guess: Guess | None = None, gradient_tolerance: float = 1e-5, max_iterations: int = 1000,
    end_weights: tuple[float, float] | None = None, simpson: float | None = None,
) -> SplineMotion:  # fmt: skip
    """The motion of least effort between two poses, among splines.

    Args:
        mechanism: Of hinges and slides; every joint is driven by a force of its own.
        boundary: Positions and velocities at both ends, and the duration.
        space: The splines, of degree 3 at least (accelerations are continuous); quintics on 12 intervals by default.
        nodes: Of the quadrature in each interval.
        guess: t (M,) -> positions (M, nv) of a first motion; by default straight, at rest at both ends.
        gradient_tolerance: BFGS ends when no component of the gradient is larger.
        max_iterations: Limit.
        end_weights: c1 and c2 of Eq. 5, by which the goal is a cost; by default it is met exactly.
        simpson: Tolerance of an adaptive Simpson rule in place of the Gauss-Legendre nodes.

    Raises:
        PlannerError: An argument of a wrong shape or out of range, or a joint that is neither hinge nor slide.
    """
    ends, space = boundary.ends(mechanism), space or SplineSpace()
    count("intervals", space.intervals, minimum=4, maximum=1000)
    quadrature = Quadrature(space.basis(boundary.duration, least_degree=3), nodes)
    basis, t = quadrature.basis, quadrature.t
    (start, _), goal = ends
    soft = end_weights is not None
    fixed = end_amplitudes(basis, ends[0], None if soft else goal)
    moved = slice(2, None if soft else -2)
    weights = array("end_weights", end_weights if soft else (0.0, 0.0), (2,)).tolist()
    c1, c2 = (number("end weight", c, minimum=0.0) for c in weights)
    last = np.array([basis(boundary.duration, nu=order) for order in range(2)])  # (2, n)
    s = (t / boundary.duration)[:, None]
    straight = start + minimum_jerk(s)[0] * (goal[0] - start)
    motion = straight if guess is None else array("guess(t)", guess(t), straight.shape)
    first = nearest_amplitudes(basis(t), motion, fixed, moved)
    if simpson is not None:
        simpson = number("simpson", simpson, minimum=1e-12)

    def whole(free: np.ndarray) -> np.ndarray:
        amplitudes = fixed.copy()
        amplitudes[moved] = free.reshape(-1, fixed.shape[1])
        return amplitudes

    def cost(free: np.ndarray) -> tuple[float, np.ndarray]:
        amplitudes = whole(free)
        effort, gradient = effort_of(mechanism, quadrature, amplitudes, simpson)
        weighted = np.array([[c1], [c2]]) * (miss := last @ amplitudes - goal)
        gradient = gradient + 2.0 * last.T @ weighted
        return effort + float(np.sum(weighted * miss)), gradient[moved].ravel()  # Eq. 5

    free, facts = bfgs(cost, first, gradient_tolerance, max_iterations)
    amplitudes = whole(free)
    effort = effort_of(mechanism, quadrature, amplitudes, simpson)[0]
    return SplineMotion(spline=curve(basis, amplitudes), effort=effort, **facts)


class Quadrature:
    """Gauss-Legendre nodes in every knot interval, and the basis functions there."""

    def __init__(self, basis: BSpline, nodes: int) -> None:
        points, weights = np.polynomial.legendre.leggauss(count("nodes", nodes, maximum=64))
        breaks = basis.t[basis.k : -basis.k]
        half = 0.5 * (breaks[-1] - breaks[0]) / (len(breaks) - 1)
        self.basis = basis
        self.t = (breaks[:-1, None] + half * (1.0 + points)).ravel()  # (M,) s
        self.weights = np.tile(half * weights, len(breaks) - 1)  # (M,) s
        self.b = [basis(self.t, nu=order) for order in range(3)]  # basis functions and derivatives, (M, n) each


def effort_of(
    mechanism: Mechanism, quadrature: Quadrature, amplitudes: np.ndarray, simpson: float | None = None
) -> tuple[float, np.ndarray]:
    """J and its gradient (n, nv) by all amplitudes (n, nv), by Gauss or, to a tolerance, by Simpson."""

    def rates(b: list[np.ndarray]) -> np.ndarray:
        """dJ/dt and the gradient's, (M, 1 + n nv), where the basis functions and their derivatives are b (M, n)."""
        q, qd, qdd = (one @ amplitudes for one in b)
        u = rnea(mechanism, q, qd, qdd)
        by = rnea_derivatives(mechanism, q, qd, qdd)  # du/dq, du/dqd, and du/dqdd, which is M
        gradient = sum(one[:, :, None] * np.einsum("mi,mij->mj", u, part)[:, None]
                       for one, part in zip(b, by, strict=True))  # fmt: skip
        return np.column_stack([0.5 * np.sum(u * u, axis=1), np.reshape(gradient, (len(u), -1))])

    basis = quadrature.basis
    if simpson is None:
        J, *gradient = quadrature.weights @ rates(quadrature.b)
    else:
        at = lambda t: rates([basis(t, nu=order) for order in range(3)])  # noqa: E731
        J, *gradient = adaptive_simpson(at, basis.t[basis.k : -basis.k], simpson)
    return float(J), np.reshape(gradient, amplitudes.shape)


def adaptive_simpson(f: Callable[[np.ndarray], np.ndarray], breaks: np.ndarray, tolerance: float) -> np.ndarray:
    """The integral (K,) of f, t (M,) -> (M, K), between the first and the last of some breaks.

    An interval is halved until the difference of Simpson's rule on it and on its halves, over 15, which is the error,
    is below its share of the tolerance in every component.
    """
    a, b = breaks[:-1], breaks[1:]
    ends, middle, total = [f(a), f(b)], f(0.5 * (a + b)), 0.0
    while len(a):
        h, m = (b - a)[:, None], 0.5 * (a + b)
        left, right = f(0.5 * (a + m)), f(0.5 * (m + b))
        whole, both = ends[0] + ends[1], ends[0] + ends[1] + 4.0 * (left + right) + 2.0 * middle
        halves = h / 12.0 * both
        error = (halves - h / 6.0 * (whole + 4.0 * middle)) / 15.0
        enough = np.maximum(tolerance * h / (breaks[-1] - breaks[0]), ROUNDING * np.abs(halves))
        done = ~(np.abs(error) > enough).any(axis=1)  # what is not finite stays so in its halves
        total = total + (halves + error)[done].sum(axis=0)
        go = ~done
        ends = [np.concatenate([ends[0][go], middle[go]]), np.concatenate([middle[go], ends[1][go]])]
        a, b = np.concatenate([a[go], m[go]]), np.concatenate([m[go], b[go]])
        middle = np.concatenate([left[go], right[go]])
    return np.asarray(total)


def curve(basis: BSpline, amplitudes: np.ndarray) -> BSpline:
    """The spline with amplitudes (n, columns)."""
    from scipy.interpolate import BSpline

    return BSpline(basis.t, amplitudes, basis.k)


def end_amplitudes(basis: BSpline, start: np.ndarray, goal: np.ndarray | None = None) -> np.ndarray:
    """Amplitudes (n, columns), zero but for those that positions and velocities (2, columns) at the ends decide."""
    amplitudes = np.zeros((len(basis.c), start.shape[1]))
    for end, t, outer, inner in ((start, basis.t[0], 0, 1), (goal, basis.t[-1], -1, -2)):
        if end is not None:
            slopes, amplitudes[outer] = basis(t, nu=1), end[0]
            amplitudes[inner] = (end[1] - slopes[outer] * end[0]) / slopes[inner]
    return amplitudes


def nearest_amplitudes(b: np.ndarray, motion: np.ndarray, fixed: np.ndarray, free: slice) -> np.ndarray:
    """The free amplitudes, in a row, of the spline nearest to a motion (M, columns) where the basis is b (M, n)."""
    return np.linalg.lstsq(b[:, free], motion - b @ fixed, rcond=None)[0].ravel()


def bfgs(
    cost: Callable[[np.ndarray], tuple[float, np.ndarray]], first: np.ndarray, gradient_tolerance: float,
    max_iterations: int, scale: float = 1.0,
) -> tuple[np.ndarray, dict[str, Any]]:  # fmt: skip
    """Minimize J/scale by BFGS, and return the minimizer and the fields of a SplineDescent but its spline.

    The cost is a function of the free amplitudes that returns J and its gradient. BFGS ends when no component of the
    gradient of J/scale is larger than its tolerance.
    """
    from scipy.optimize import minimize

    costs = [cost(first)[0]]

    def scaled(free: np.ndarray) -> tuple[float, np.ndarray]:
        J, gradient = cost(free)
        return J / scale, gradient / scale

    with np.errstate(invalid="ignore", over="ignore"):  # a line search may step to where J is infinite
        found = minimize(
            scaled, first, jac=True, method="BFGS",
            callback=lambda intermediate_result: costs.append(scale * float(intermediate_result.fun)),
            options={"gtol": number("gradient_tolerance", gradient_tolerance, greater_than=0.0),
                     "maxiter": count("max_iterations", max_iterations)},
        )  # fmt: skip
    return found.x, {
        "costs": np.array(costs), "gradient_norm": scale * float(np.linalg.norm(found.jac)),
        "evaluations": int(found.nfev), "success": bool(found.success), "message": str(found.message),
    }  # fmt: skip
