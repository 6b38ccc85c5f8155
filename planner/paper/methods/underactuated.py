"""The paper's direct method for underactuated machines (section 2.2): the motion of the driven joints as splines.

The driven joints follow B-splines, which are the control; the other joints, free of forces, follow by the hybrid
dynamics. So the state is only theirs, z = (q, qd) of the free joints, and the forces of the driven joints come from
Eq. 6 by algebra:

    minimize 1/2 c1 |q(t_f) - q_d|^2 + 1/2 c2 |qd(t_f)|^2 + 1/2 integral of r |u|^2 dt     Eq. 5, with 1/2 on every term

by BFGS on the amplitudes, with the gradient of Eq. 7 (see adjoint.py).
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from planner.base.arguments import array, number, short_repr
from planner.base.errors import PlannerError
from planner.kernels.integrators import KNOWN_INTEGRATORS
from planner.kernels.numba.jit import announce
from planner.kernels.tree import batch as tree_batch
from planner.kernels.tree.mechanism_table import Model
from planner.kernels.tree.memory import TreeMemory
from planner.model.mechanism import Mechanism
from planner.paper.methods.adjoint import AdjointCost, Integration, Partials
from planner.paper.methods.splines import (
    Boundary,
    Guess,
    SplineDescent,
    SplineSpace,
    bfgs,
    curve,
    end_amplitudes,
    nearest_amplitudes,
)

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
