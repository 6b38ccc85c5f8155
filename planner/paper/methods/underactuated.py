"""The paper's direct method for underactuated machines (section 2.2): the motion of the driven joints as splines.

The driven joints follow B-splines, which are the control; the other joints, free of forces, follow by the hybrid
dynamics. So the state is only theirs, z = (q, qd) of the free joints, and the forces of the driven joints come from
Eq. 6 by algebra:

    minimize 1/2 c1 |q(t_f) - q_d|^2 + 1/2 c2 |qd(t_f)|^2 + 1/2 integral of r |u|^2 dt     Eq. 5, with 1/2 on every term

by BFGS on the amplitudes, with the gradient of Eq. 7 (see adjoint.py).
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass

import numpy as np

from planner.base.arguments import array, count, number, shown
from planner.base.errors import PlannerError
from planner.kernels.integrators import EULER
from planner.kernels.numba.jit import announce
from planner.kernels.tree import batch as tree_batch
from planner.kernels.tree.memory import TreeMemory
from planner.kernels.tree.model import Model
from planner.model.mechanism import SCREW, Mechanism
from planner.paper.methods.adjoint import AdjointCost, Partials
from planner.paper.methods.spline_basis import SplineBasis
from planner.paper.methods.splines import DEGREE, INTERVALS

SAMPLES = 301  # of the motion that is handed back


class DrivenSystem:
    """Driven joints move as told, the others follow: f, L and phi of Eq. 1, 2 and 5 with exact derivatives.

    Args:
        mechanism: Of hinges and slides.
        driven: Names of the joints whose motion is given.
        goal: (nv,) positions to end at.
        position_weight: On the final |q - goal|^2 / 2.
        velocity_weight: On the final |qd|^2 / 2.
        effort_weight: On |u|^2 / 2, u the forces of the driven joints.

    Attributes:
        nz: Two for each free joint.
        inputs: Number of driven joints.

    Raises:
        PlannerError: An unknown joint, none or all of them driven, or an argument out of range.
    """

    def __init__(
        self, mechanism: Mechanism, driven: Collection[str], goal: np.ndarray, position_weight: float = 200.0,
        velocity_weight: float = 200.0, effort_weight: float = 1.0,
    ) -> None:  # fmt: skip
        if not isinstance(mechanism, Mechanism):
            raise PlannerError(f"mechanism is {shown(mechanism)}, expected a Mechanism.")
        if np.any(mechanism.kind != SCREW):
            raise PlannerError("the mechanism has a ball or free joint, expected hinges and slides alone.")
        if not isinstance(driven, (str, Collection)):
            raise PlannerError(f"driven is {shown(driven)}, expected names of joints.")
        mask = np.zeros(mechanism.nv, dtype=bool)
        for name in (driven,) if isinstance(driven, str) else driven:
            mask[mechanism.joint(name)] = True
        if not mask.any() or mask.all():
            what = "no joint" if not mask.any() else "every joint (see minimize_effort)"
            names = ", ".join(mechanism.joint_names)
            raise PlannerError(f"driven names {what}, expected some of {names} and not all.")
        self.mechanism, self.goal = mechanism, array("goal", goal, (mechanism.nv,))
        self._weights = [
            number("position_weight", position_weight, least=0.0),
            number("velocity_weight", velocity_weight, least=0.0),
        ]
        self._effort = number("effort_weight", effort_weight, above=0.0)
        self.driven, self.free = np.flatnonzero(mask), np.flatnonzero(~mask)
        self.nz, self.inputs = 2 * len(self.free), len(self.driven)
        f, d, nv = self.free, self.driven, mechanism.nv
        self._blocks = [np.ix_(rows, np.concatenate([f, nv + f, d, nv + d, 2 * nv + d])) for rows in (f, d)]
        self._masses = [np.ix_(rows, f) for rows in (f, d)]
        # One model and its scratch for all calls: an integration makes thousands of them, one state at a time.
        self._hybrid, self._inverse = Model(mechanism, mask, actuated=False), Model(mechanism, actuated=False)
        self._memory = [TreeMemory(model, EULER, 0) for model in (self._hybrid, self._inverse)]
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
        misses = (q[0] - self.goal, qd[0])
        phi = sum(0.5 * c * float(miss @ miss) for c, miss in zip(self._weights, misses, strict=True))
        by = [c * miss for c, miss in zip(self._weights, misses, strict=True)]
        phi_z = np.concatenate([by[0][self.free], by[1][self.free]])
        return phi, phi_z, np.concatenate([by[0][self.driven], by[1][self.driven], np.zeros(self.inputs)])


@dataclass(frozen=True, eq=False)
class DrivenMotion:
    """What minimize_effort_underactuated() found.

    Attributes:
        amplitudes: (n, driven) P, one row per basis function.
        knots: (n + degree + 1,) s.
        degree: Of the splines.
        cost: J of the motion.
        first_cost: J of the first guess.
        gradient_norm: Of J by the free amplitudes, as it was computed.
        iterations: Of BFGS.
        evaluations: Of J and its gradient.
        success: Whether BFGS met its tolerance.
        message: Its own words.
        t: (M,) s, samples of the motion.
        q: (M, nv) positions of all joints there.
        qd: (M, nv) velocities.
        tau: (M, nv) forces, zero on the free joints.
    """

    amplitudes: np.ndarray
    knots: np.ndarray
    degree: int
    cost: float
    first_cost: float
    gradient_norm: float
    iterations: int
    evaluations: int
    success: bool
    message: str
    t: np.ndarray
    q: np.ndarray
    qd: np.ndarray
    tau: np.ndarray


class DrivenProblem:
    """J and its gradient as BFGS sees them: by the amplitudes that are free.

    The first two amplitudes of a driven joint are its position and velocity at the start. The arguments are those of
    minimize_effort_underactuated().
    """

    def __init__(
        self, mechanism: Mechanism, start: np.ndarray, goal: np.ndarray, duration: float, *, driven: Collection[str],
        start_velocity: np.ndarray | float = 0.0, position_weight: float = 200.0, velocity_weight: float = 200.0,
        effort_weight: float = 1.0, intervals: int = INTERVALS, degree: int = DEGREE,
        guess: Callable[[np.ndarray], np.ndarray] | None = None, tolerance: float = 1e-6, method: str = "RK45",
    ) -> None:  # fmt: skip
        self.system = DrivenSystem(mechanism, driven, goal, position_weight, velocity_weight, effort_weight)
        self.basis = SplineBasis(duration, intervals, count("degree", degree, least=3, most=9), orders=3)
        nv, d, f = mechanism.nv, self.system.driven, self.system.free
        start = array("start", start, (nv,))
        rate = np.full(nv, start_velocity) if np.isscalar(start_velocity) else start_velocity
        rate = array("start_velocity", rate, (nv,))
        slopes = self.basis.at(0.0)[1]
        self._fixed = np.zeros((self.basis.size, len(d)))
        self._fixed[0] = start[d]
        self._fixed[1] = (rate[d] - slopes[0] * start[d]) / slopes[1]
        self.cost = AdjointCost(self.system, self.basis, np.concatenate([start[f], rate[f]]), tolerance, method)
        self.first = self._nearest(guess, start[d])

    def _nearest(self, guess: Callable[[np.ndarray], np.ndarray] | None, start: np.ndarray) -> np.ndarray:
        """The free amplitudes of the spline nearest to a first motion; by default the joints are held."""
        t = np.linspace(0.0, self.basis.duration, 8 * self.basis.size)
        wanted = np.tile(start, (len(t), 1)) if guess is None else array("guess(t)", guess(t), (len(t), len(start)))
        b = self.basis.matrix(t)
        return np.linalg.lstsq(b[:, 2:], wanted - b @ self._fixed, rcond=None)[0].ravel()

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
    mechanism: Mechanism,
    start: np.ndarray,
    goal: np.ndarray,
    duration: float,
    *,
    driven: Collection[str],
    start_velocity: np.ndarray | float = 0.0,
    position_weight: float = 200.0,
    velocity_weight: float = 200.0,
    effort_weight: float = 1.0,
    intervals: int = INTERVALS,
    degree: int = DEGREE,
    guess: Callable[[np.ndarray], np.ndarray] | None = None,
    tolerance: float = 1e-6,
    method: str = "RK45",
    gradient_tolerance: float = 1e-4,
    max_iterations: int = 500,
) -> DrivenMotion:
    """The motion of some joints, among splines, with which all of them reach a goal with least effort.

    Args:
        mechanism: Of hinges and slides.
        start: (nv,) positions at t = 0, rad or m.
        goal: (nv,) positions to end at, at rest.
        duration: s.
        driven: Names of the joints that have motors; the others move freely.
        start_velocity: (nv,) or a number for all.
        position_weight: On the final |q - goal|^2 / 2; twice the paper's c1.
        velocity_weight: On the final |qd|^2 / 2; twice the paper's c2.
        effort_weight: On |u|^2 / 2.
        intervals: Uniform knot intervals.
        degree: Of the splines, at least 3: accelerations are continuous.
        guess: t (M,) -> positions (M, driven) of a first motion; by default the driven joints are held where they are.
        tolerance: Of the integrations, relative and absolute. Large ones spoil the gradient near convergence.
        method: "RK45" (Matlab's ode45) or "DOP853".
        gradient_tolerance: Where BFGS ends, on the largest component of the gradient.
        max_iterations: Limit.

    Returns:
        A DrivenMotion. Not converging is its `success`, never an exception.

    Raises:
        PlannerError: An argument of a wrong shape or out of range, a joint that is neither hinge nor slide, or none
            or all of the joints driven.
    """
    from scipy.optimize import minimize

    problem = DrivenProblem(
        mechanism, start, goal, duration, driven=driven, start_velocity=start_velocity,
        position_weight=position_weight, velocity_weight=velocity_weight, effort_weight=effort_weight,
        intervals=intervals, degree=degree, guess=guess, tolerance=tolerance, method=method,
    )  # fmt: skip
    first_cost = problem.cost.value(problem.amplitudes(problem.first))
    found = minimize(
        problem, problem.first, jac=True, method="BFGS",
        options={"gtol": number("gradient_tolerance", gradient_tolerance, above=0.0),
                 "maxiter": count("max_iterations", max_iterations)},
    )  # fmt: skip
    P = problem.amplitudes(found.x)
    t = np.linspace(0.0, problem.basis.duration, SAMPLES)
    states = problem.cost.forward(P, t).y[:-1].T
    samples = [problem.system.motion(z, (problem.basis.at(s) @ P).ravel()) for s, z in zip(t, states, strict=True)]
    q, qd, _, tau = (np.concatenate(rows) for rows in zip(*samples, strict=True))
    return DrivenMotion(
        amplitudes=P, knots=problem.basis.knots, degree=degree, cost=float(found.fun), first_cost=first_cost,
        gradient_norm=float(np.linalg.norm(found.jac)), iterations=int(found.nit),
        evaluations=problem.cost.evaluations, success=bool(found.success), message=str(found.message),
        t=t, q=q, qd=qd, tau=tau,
    )  # fmt: skip
