"""Constraints on the poses of a task: on positions, angles and distances, at a stage, at rest.

A goal is part of the cost, so a goal that contradicts a constraint would be missed without a message.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from planner.dynamics import RigidBodyDynamics
from planner.problem.constraints.clearance import PairClearanceFunction
from planner.problem.constraints.constraint import Constraint
from planner.problem.constraints.constraint_stack import ConstraintStack, StackEntry
from planner.problem.constraints.quantities import KernelResidual
from planner.problem.costs.penalty_terms import Velocity

POSE_TOLERANCE = 1e-3  # m or rad, violation of a constraint in addition to its tolerance at which the search ends
ResidualAndJacobian = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Of a configuration (nq,): r (R,) over its tolerances, and its Jacobian (R, nv)."""


def both(one: ResidualAndJacobian, other: ResidualAndJacobian) -> ResidualAndJacobian:
    """The residuals of both, one's first."""

    def joined(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        (r, J), (s, K) = one(q), other(q)
        return np.concatenate([r, s]), np.vstack([J, K])

    return joined


class PoseConstraints:
    """Constraint violations of poses of a machine.

    Args:
        constraints: Of the problem; those of velocities, controls and user functions are ignored.
        dynamics: The machine.
        x0: (nx,) start.
        N: Stages.

    Raises:
        PlannerError: As planner.problem.constraints.constraint_stack.ConstraintStack.
    """

    def __init__(self, constraints: Sequence[Constraint], dynamics: RigidBodyDynamics, x0: np.ndarray, N: int) -> None:
        self._rows = ConstraintStack(constraints, dynamics, x0, np.zeros((N, dynamics.nu)), 1.0)
        self._x0, self._mechanism = x0, dynamics.mechanism
        self._parts = [
            part for part in self._rows.parts
            if isinstance(part.function, KernelResidual) and not isinstance(part.function, PairClearanceFunction)
            and not isinstance(part.constraint.of, Velocity)
        ]  # fmt: skip

    def at(self, stage: int) -> ResidualAndJacobian | None:
        """Violations of a pose q (nq,) at a stage over their tolerances: r (R,) and J (R, nv). None without any."""
        parts = [part for part in self._parts if np.isfinite(self._bounds(part, stage)).any()]
        if not parts:
            return None

        def violation(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            found = [self._violation(part, stage, q) for part in parts]
            return np.concatenate([one[0] for one in found]), np.concatenate([one[1] for one in found])

        return violation

    def violated(self, stage: int, q: np.ndarray) -> StackEntry | None:
        """The constraint that a pose (nq,) violates most; None for none."""
        worst = max(self._parts, key=lambda part: float(np.abs(self._violation(part, stage, q)[0]).max()), default=None)
        return None if worst is None or np.abs(self._violation(worst, stage, q)[0]).max() <= 1.0 else worst

    def _bounds(self, part: StackEntry, stage: int) -> np.ndarray:
        """(2, R) in the constraint's unit."""
        side = self._rows.specified_lower, self._rows.specified_upper
        return np.stack([one[stage, part.columns] / self._rows.scale[part.columns] for one in side])

    def _violation(self, part: StackEntry, stage: int, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        (low, high), x, n = self._bounds(part, stage), self._x0.copy(), np.array([stage])
        x[: self._mechanism.nq], x[self._mechanism.nq : self._mechanism.nq + self._mechanism.nv] = q, 0.0
        value = part.function.values(x[None], np.zeros((1, 0)), n)[0]
        r = np.maximum(value - high, 0.0) - np.maximum(low - value, 0.0)
        J = part.function.derivatives(x[None], np.zeros((1, 0)), n)[0][0][:, : self._mechanism.nv]
        scale = POSE_TOLERANCE + part.constraint.allowed()
        return r / scale, np.where(r[:, None] != 0.0, J, 0.0) / scale
