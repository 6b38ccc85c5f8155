"""The paper's direct methods whose inputs are B-splines and whose states are integrated (sections 2.2 and 2.4).

Of any Problem the control is the spline, u(t) = b(t) P, and BFGS moves P. Two gradients. "discrete": J is the Problem's
own sum over stages, and the gradient its exact one by the discrete costate (Eq. 16-19), times b. "continuous": J is the
integral behind it, integrated by an adaptive rule to a tolerance with the gradient of Eq. 7, as the paper did; so J and
gradient agree only up to errors of that order.

Of underactuated machines the driven joints follow splines; the other joints, free of forces, follow by the hybrid
dynamics. So the state is only theirs, z = (q, qd) of the free joints, and the forces of the driven joints come from
Eq. 6 by algebra:

    minimize 1/2 c1 |q(t_f) - q_d|^2 + 1/2 c2 |qd(t_f)|^2 + 1/2 integral of r |u|^2 dt     Eq. 5, with 1/2 on every term

by BFGS on the amplitudes, with the gradient of Eq. 7 (see adjoint.py).
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from planner.base.arguments import array, choice, count, number, short_repr
from planner.base.errors import PlannerError
from planner.kernels.integrators import KNOWN_INTEGRATORS
from planner.kernels.numba.jit import announce
from planner.kernels.tree import batch as tree_batch
from planner.kernels.tree.mechanism_table import Model
from planner.kernels.tree.memory import TreeMemory
from planner.model.mechanism import Mechanism
from planner.paper.methods.adjoint import AdjointCost, ContinuousProblem, Integration, Partials
from planner.paper.methods.splines import (
    DEGREE,
    Boundary,
    Guess,
    SplineDescent,
    SplineSpace,
    bfgs,
    curve,
    end_amplitudes,
    nearest_amplitudes,
)
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
    cost: Callable[[np.ndarray], tuple[float, np.ndarray]] = exact
    if choice("gradient", gradient, GRADIENTS) == "continuous":
        cost = AdjointCost(ContinuousProblem(problem), basis, problem.x0, Integration(tolerance))
    free, facts = bfgs(cost, first, gradient_tolerance, max_iterations, scale=max(1.0, abs(cost(first)[0])))
    discrete_cost = exact(free)[0]
    exact.close()
    P = free.reshape(coefficients, -1)
    return SplineControls(spline=curve(basis, P), us=exact.b @ P, discrete_cost=discrete_cost, **facts)


SAMPLES = 301  # of the motion in the result
GRADIENT = 1e-4  # BFGS ends when no component of the gradient is larger


@dataclass(frozen=True)
class DrivenWeights:
    """Weights of the cost (Eq. 5), each on half a sum of squares.

    Attributes:
        position: On the final distance of the joints from the goal; twice the paper's c1.
        velocity: On the final velocities; twice the paper's c2.
        effort: On the forces of the driven joints.

    Raises:
        PlannerError: A weight out of range.
    """

    position: float = 200.0
    velocity: float = 200.0
    effort: float = 1.0

    def __post_init__(self) -> None:
        number("position weight", self.position, minimum=0.0)
        number("velocity weight", self.velocity, minimum=0.0)
        number("effort weight", self.effort, greater_than=0.0)


class DrivenSystem:
    """The driven joints follow inputs, the others move freely: f, L and phi of Eq. 1, 2 and 5 with exact derivatives.

    The state z has two numbers for each free joint. The arguments are those of minimize_effort_underactuated().
    """

    orders = 3  # positions, velocities and accelerations of the driven joints

    def __init__(
        self, mechanism: Mechanism, boundary: Boundary, driven: Collection[str], weights: DrivenWeights | None = None
    ) -> None:
        self.start, self.goal = boundary.ends(mechanism)
        if not isinstance(driven, (str, Collection)):
            raise PlannerError(f"driven is {short_repr(driven)}, expected names of joints.")
        mask = np.zeros(mechanism.nv, dtype=bool)
        for name in (driven,) if isinstance(driven, str) else driven:
            mask[mechanism.joint(name)] = True
        if not mask.any() or mask.all():
            what = "no joint" if not mask.any() else "every joint (see minimize_effort)"
            names = ", ".join(mechanism.joint_names)
            raise PlannerError(f"driven names {what}, expected some of {names} and not all.")
        self.mechanism, weights = mechanism, weights or DrivenWeights()
        self._weights, self._effort = (weights.position, weights.velocity), weights.effort
        self.driven, self.free = np.flatnonzero(mask), np.flatnonzero(~mask)
        self.nz, self.inputs = 2 * len(self.free), len(self.driven)
        f, d, nv = self.free, self.driven, mechanism.nv
        self._blocks = [np.ix_(rows, np.concatenate([f, nv + f, d, nv + d, 2 * nv + d])) for rows in (f, d)]
        self._masses = [np.ix_(rows, f) for rows in (f, d)]
        # One model and its scratch for all calls: an integration makes thousands of them, one state at a time.
        self._hybrid, self._inverse = Model(mechanism, mask, actuated=False), Model(mechanism, actuated=False)
        self._memory = [TreeMemory(model, KNOWN_INTEGRATORS["euler"], 0) for model in (self._hybrid, self._inverse)]
        for kernel in (tree_batch.forward, tree_batch.derivatives):
            announce(kernel)

    def whole(self, z: np.ndarray, w: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Positions, velocities and inputs (1, nv) of all joints from those of the free and of the driven."""
        q, qd, inputs = np.zeros((3, 1, self.mechanism.nv))
        half = len(self.free)
        q[0, self.free], qd[0, self.free] = z[:half], z[half:]
        q[0, self.driven], qd[0, self.driven], inputs[0, self.driven] = w.reshape(3, -1)
        return q, qd, inputs

    def motion(self, z: np.ndarray, w: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Positions, velocities, accelerations and forces (1, nv) of all joints."""
        q, qd, inputs = self.whole(z, w)
        qdd, tau = np.empty_like(inputs), np.empty_like(inputs)
        tree_batch.forward(self._hybrid.table, self._memory[0].table, q, qd, inputs, qdd, tau)
        return q, qd, qdd, tau

    def rates(self, z: np.ndarray, w: np.ndarray) -> tuple[np.ndarray, float]:
        """dz/dt (nz,) and L."""
        _, qd, qdd, tau = self.motion(z, w)
        u = tau[0, self.driven]
        return np.concatenate([qd[0, self.free], qdd[0, self.free]]), 0.5 * self._effort * float(u @ u)

    def partials(self, z: np.ndarray, w: np.ndarray) -> Partials:
        """Derivatives of both, by the recursive sensitivities."""
        q, qd, qdd, tau = self.motion(z, w)
        nv, half = self.mechanism.nv, len(self.free)
        M, by_q, by_qd = np.empty((3, 1, nv, nv))
        tree_batch.derivatives(self._inverse.table, self._memory[1].table, q, qd, qdd, M, by_q, by_qd)
        by = np.concatenate([by_q[0], by_qd[0], M[0]], axis=1)
        # M_ff dqdd_f = -(dtau_f), and the forces of the driven joints feel that acceleration too. Columns: z, then w.
        qdd_f = -np.linalg.solve(M[0][self._masses[0]], by[self._blocks[0]])
        u = by[self._blocks[1]] + M[0][self._masses[1]] @ qdd_f
        f = np.zeros((self.nz, u.shape[1]))
        f[:half, half : self.nz] = np.eye(half)
        f[half:] = qdd_f
        L = self._effort * tau[0, self.driven] @ u
        return Partials(f[:, : self.nz], f[:, self.nz :], L[: self.nz], L[self.nz :])

    def final(self, z: np.ndarray, w: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """Phi, and its derivatives by z (nz,) and w (3 inputs,)."""
        q, qd, _ = self.whole(z, w)
        misses = (q[0] - self.goal[0], qd[0] - self.goal[1])
        phi = sum(0.5 * c * float(miss @ miss) for c, miss in zip(self._weights, misses, strict=True))
        by = [c * miss for c, miss in zip(self._weights, misses, strict=True)]
        phi_z = np.concatenate([by[0][self.free], by[1][self.free]])
        return phi, phi_z, np.concatenate([by[0][self.driven], by[1][self.driven], np.zeros(self.inputs)])


@dataclass(frozen=True, eq=False, kw_only=True)
class DrivenMotion(SplineDescent):
    """Result of minimize_effort_underactuated(): the spline is of the driven joints, (n, driven).

    Attributes:
        t: (301,) s.
        q: (301, nv) positions of all joints.
        qd: (301, nv) velocities.
        tau: (301, nv) forces, zero on the free joints.
    """

    t: np.ndarray
    q: np.ndarray
    qd: np.ndarray
    tau: np.ndarray


class DrivenProblem:
    """J and its gradient by the free amplitudes, as BFGS needs them.

    Position and velocity at the start decide the first two amplitudes of a driven joint. The arguments are those of
    minimize_effort_underactuated().
    """

    def __init__(
        self, mechanism: Mechanism, boundary: Boundary, driven: Collection[str], *,
        weights: DrivenWeights | None = None, space: SplineSpace | None = None, guess: Guess | None = None,
        integration: Integration | None = None,
    ) -> None:  # fmt: skip
        self.system = DrivenSystem(mechanism, boundary, driven, weights)
        self.basis = (space or SplineSpace()).basis(boundary.duration, least_degree=3)
        start, d = self.system.start, self.system.driven
        self._fixed = end_amplitudes(self.basis, start[:, d])
        self.cost = AdjointCost(self.system, self.basis, start[:, self.system.free].ravel(), integration)
        t = np.linspace(0.0, boundary.duration, 8 * len(self._fixed))
        held = np.tile(start[0, d], (len(t), 1))
        motion = held if guess is None else array("guess(t)", guess(t), held.shape)
        self.first = nearest_amplitudes(self.basis(t), motion, self._fixed, slice(2, None))

    def amplitudes(self, free: np.ndarray) -> np.ndarray:
        """All of P (n, driven)."""
        P = self._fixed.copy()
        P[2:] = free.reshape(-1, P.shape[1])
        return P

    def __call__(self, free: np.ndarray) -> tuple[float, np.ndarray]:
        """J and its gradient by the free amplitudes."""
        J, gradient = self.cost(self.amplitudes(free))
        return J, gradient[2:].ravel()


def minimize_effort_underactuated(
    mechanism: Mechanism, boundary: Boundary, driven: Collection[str], *, weights: DrivenWeights | None = None,
    space: SplineSpace | None = None, guess: Guess | None = None, integration: Integration | None = None,
    max_iterations: int = 500,
) -> DrivenMotion:  # fmt: skip
    """Find splines of the driven joints with which all joints reach a goal with least effort (section 2.2).

    Args:
        mechanism: Of hinges and slides.
        boundary: Start, goal and duration; the goal counts by the weights.
        driven: Names of the joints that have motors; the others move freely.
        weights: Of goal and effort; by default 200, 200 and 1.
        space: The splines, of degree 3 at least (accelerations are continuous); quintics on 12 intervals by default.
        guess: t (M,) -> positions (M, driven) of a first motion; by default the driven joints stay where they are.
        integration: Of states and costates; by default RK45 to 1e-6.
        max_iterations: Limit; BFGS ends earlier when no component of the gradient is larger than 1e-4.

    Returns:
        A DrivenMotion. Not converging is its `success`, never an exception.

    Raises:
        PlannerError: An argument of a wrong shape or out of range, a joint that is neither hinge nor slide, or none
            or all of the joints driven.
    """
    problem = DrivenProblem(
        mechanism, boundary, driven, weights=weights, space=space, guess=guess, integration=integration
    )
    free, facts = bfgs(problem, problem.first, GRADIENT, max_iterations)
    P, t = problem.amplitudes(free), np.linspace(0.0, boundary.duration, SAMPLES)
    states = problem.cost.forward(P, t).y[:-1].T
    samples = [problem.system.motion(z, problem.cost.inputs(s, P)) for s, z in zip(t, states, strict=True)]
    q, qd, _, tau = (np.concatenate(rows) for rows in zip(*samples, strict=True))
    return DrivenMotion(spline=curve(problem.basis, P), t=t, q=q, qd=qd, tau=tau, **facts)
