"""What poses of a task satisfy, as residuals of inverse kinematics: constraints of the problem, and feet on the ground.

Constraints are on positions, angles and distances, at a stage, at rest. A goal is part of the cost, so a goal that
contradicts a constraint would be missed without a message.

Feet are the contacts that bear load at the start: where they stay, where else they may stand, and what they carry. A
machine that stands and of which a goal moves one foot stands on the others: their contacts stay, and its centre of mass
is above their middle (quasi-static balance).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from planner.dynamics import RigidBodyDynamics
from planner.dynamics.contacts import contact_forces
from planner.dynamics.kinematics import LinkPlaces, center_of_mass, center_of_mass_jacobian, frame_pose
from planner.model.capabilities import stands_on_ground
from planner.model.mechanism import Frame, Mechanism
from planner.problem.constraints.clearance import PairClearanceFunction
from planner.problem.constraints.constraint import Constraint
from planner.problem.constraints.constraint_stack import ConstraintStack, StackEntry
from planner.problem.constraints.quantities import KernelResidual
from planner.problem.costs.penalty_terms import Velocity

POSE_TOLERANCE = 1e-3  # m or rad, violation of a constraint in addition to its tolerance at which the search ends
ResidualAndJacobian = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Of a configuration (nq,): r (R,) over its tolerances, and its Jacobian (R, nv)."""
FOOT_SCALE = 1e-3  # m that a foot on the ground is targeted by a residual of 1: less than a plan's goals resolve
BALANCE_SCALE = 0.01  # m that the centre of mass is off by a residual of 1: small beside a sole


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
        x[: self._mechanism.nq], x[self._mechanism.velocities] = q, 0.0
        value = part.function.values(x[None], np.zeros((1, 0)), n)[0]
        r = np.maximum(value - high, 0.0) - np.maximum(low - value, 0.0)
        J = part.function.derivatives(x[None], np.zeros((1, 0)), n)[0][0][:, : self._mechanism.nv]
        scale = POSE_TOLERANCE + part.constraint.allowed()
        return r / scale, np.where(r[:, None] != 0.0, J, 0.0) / scale


@dataclass(frozen=True, eq=False)
class Feet:
    """The contacts that bear load at the start.

    Attributes:
        mechanism: The machine.
        links: (C,) of each contact.
        frames: (C,) with the contact's centre as origin.
        places: (C, 3) m, the centres at the start.
        normals: (C, 3) of their planes.
        center: (3,) m, the centre of mass at the start.
        carry: Whether they carry the machine, and not only parts of it.
    """

    mechanism: Mechanism
    links: np.ndarray
    frames: tuple[Frame, ...]
    places: np.ndarray
    normals: np.ndarray
    center: np.ndarray
    carry: bool

    def _displacements(self, q: np.ndarray, which: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(K, 3) displacements over FOOT_SCALE of contacts `which` (K,), and their Jacobians (K, 3, nv)."""
        at = LinkPlaces(self.mechanism, q)  # once for all contacts
        here = np.array([at.pose(self.frames[k])[0, :3, 3] for k in which])
        J = np.array([at.jacobian(self.frames[k])[0, :3] for k in which])
        return (here - self.places[which]) / FOOT_SCALE, J / FOOT_SCALE

    def fixed(self, q: np.ndarray, which: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Residuals of contacts, all by default, that stay where they are."""
        away, J = self._displacements(q, np.arange(len(self.links)) if which is None else which)
        return away.ravel(), J.reshape(-1, self.mechanism.nv)

    def on_ground(self, q: np.ndarray, which: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Residuals of contacts, all by default, that may be elsewhere on their planes."""
        which = np.arange(len(self.links)) if which is None else which
        away, J = self._displacements(q, which)
        n = self.normals[which]
        return np.einsum("ka,ka->k", n, away), np.einsum("ka,kaj->kj", n, J)

    def stepped(self, targeted: np.ndarray) -> ResidualAndJacobian:
        """Residuals of feet: those of the contacts `targeted` (C,) bool stand elsewhere, the others where they are."""
        stay, step = np.flatnonzero(~targeted), np.flatnonzero(targeted)
        return both(partial(self.fixed, which=stay), partial(self.on_ground, which=step))

    def lifted(self, targeted: np.ndarray) -> ResidualAndJacobian:
        """Residuals of feet: those of the contacts `targeted` (C,) bool are in the air, the others carry the machine.

        Its centre of mass stays as high as at the start, so that the feet in the air reach the ground from there.
        """
        stay = np.flatnonzero(~targeted)
        n, middle = self.normals[stay[0]], self.places[stay].mean(axis=0)
        above = middle + n * (n @ (self.center - middle))

        def balance(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            away, J = center_of_mass(self.mechanism, q) - above, center_of_mass_jacobian(self.mechanism, q)
            return away / BALANCE_SCALE, J / BALANCE_SCALE

        return both(partial(self.fixed, which=stay), balance)


def feet_of(mechanism: Mechanism, q: np.ndarray) -> Feet | None:
    """The feet at q (nq,); None where no contact bears load."""
    if not mechanism.contacts:
        return None
    loaded = np.flatnonzero(contact_forces(mechanism, q, np.zeros(mechanism.nv)).forces.any(axis=1))
    if not loaded.size:
        return None
    frames = [Frame.at(mechanism.contacts[k].link, mechanism.contacts[k].centre) for k in loaded]
    return Feet(
        mechanism, np.array([frame.link for frame in frames]), tuple(frames),
        np.array([frame_pose(mechanism, q, frame)[:3, 3] for frame in frames]),
        np.array([mechanism.contacts[k].plane.normal for k in loaded]), center_of_mass(mechanism, q),
        stands_on_ground(mechanism),
    )  # fmt: skip
