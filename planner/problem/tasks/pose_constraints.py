"""What poses of a task satisfy, as residuals of inverse kinematics: constraints, feet on the ground, momentum.

Constraints are on positions, angles and distances, at a stage, at rest. A goal is part of the cost, so a goal that
contradicts a constraint would be missed without a message.

Feet are the contacts that bear load at the start: where they stay, where else they may stand, and what they carry. A
machine that stands and of which a goal moves one foot stands on the others: their contacts stay, and its centre of mass
is above their middle (quasi-static balance).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from planner.dynamics import RigidBodyDynamics
from planner.dynamics.contacts import contact_forces
from planner.dynamics.inverse_kinematics import POSTURE_WEIGHT, Target, integrate_base, residuals
from planner.dynamics.kinematics import LinkPlaces, center_of_mass, center_of_mass_jacobian, frame_pose, jacobian
from planner.dynamics.resting_poses import along_plane
from planner.kernels.tree.mechanism_table import chain_of
from planner.model.capabilities import floating_dofs, roots, stands_on_ground
from planner.model.mechanism import Frame, Mechanism
from planner.model.mjcf.prescribed_joints import prescribed_dofs_of
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


class Stance(NamedTuple):
    """A machine displaced along the ground, before its legs meet what is left of its targets."""

    q: np.ndarray  # (nq,)
    feet: Feet  # with the places to which they go


def carried_stance(
    feet: Feet, steps: frozenset[int], start: np.ndarray, q: np.ndarray, targets: Sequence[Target]
) -> Stance | None:
    """The stance of the start carried along to targets; None where no foot steps, or none can be carried.

    Feet go to a goal with their machine: it is displaced and turned along the ground as a whole, its joints as they
    are, to where its frames are nearest to their targets, and there the feet that step have the stance of the start.
    What a target asks for besides, a height or a lean, is left to the legs.

    Args:
        feet: The feet at the start.
        steps: Links of the feet that step; the others stay where they are.
        start: (nq,) the configuration there.
        q: (nq,) the configuration of the joints.
        targets: Of frames.
    """
    mechanism, stepping = feet.mechanism, np.isin(feet.links, list(steps))
    base = _base_dofs(mechanism, feet.links[stepping])
    if not base.any():
        return None
    trunk, n = Frame(int(np.flatnonzero(base)[-1]), np.eye(4)), feet.normals[stepping][0]
    ways = np.eye(mechanism.nv)[:, base]
    ways = ways @ along_plane(mechanism, start, ways, np.array([trunk.link]), n)
    if not ways.shape[1]:
        return None
    pad = np.zeros(mechanism.space.nx - mechanism.nq)
    away = mechanism.space.difference(np.append(start, pad), np.append(q, pad))[: mechanism.nv]
    joints = integrate_base(mechanism, q, np.where(base, away, 0.0))  # the base where it was at the start
    turns = POSTURE_WEIGHT * (n @ jacobian(mechanism, start, trunk)[3:] @ ways)  # it turns only where that is asked for

    def errors(s: np.ndarray) -> np.ndarray:
        at, found = integrate_base(mechanism, joints, ways @ s), [turns @ s]
        for one in targets:
            r, _, angles = residuals(mechanism, at, one)
            found.extend(r / np.where(angles, one.turn_scale, one.metre_scale))
        return np.array(found)

    from scipy.optimize import least_squares  # 0.4 s that `planner run` need not pay

    displacement = ways @ least_squares(errors, np.zeros(ways.shape[1])).x
    there, places = integrate_base(mechanism, start, displacement), feet.places.copy()
    for k in np.flatnonzero(stepping):
        places[k] = frame_pose(mechanism, there, feet.frames[k])[:3, 3]
    return Stance(integrate_base(mechanism, joints, displacement), replace(feet, places=places))


def _base_dofs(mechanism: Mechanism, links: np.ndarray) -> np.ndarray:
    """(nv,) bool, the degrees of freedom that carry all the links (C,) and that no actuator drives; none of no link."""
    carry = np.full(mechanism.nv, bool(len(links)))
    for link in np.unique(links):
        carry &= np.isin(np.arange(mechanism.nv), chain_of(mechanism.parent, int(link)))
    return carry & ~mechanism.directly_actuated


CENTER_SCALE = 1e-3  # m, displacement of the centre of mass of a residual of 1
LEVEL = 1e-9  # of gravity: the part along a slide that is none


def undamped_floating_dofs(dynamics: RigidBodyDynamics, x0: np.ndarray) -> np.ndarray:
    """(nv,) bool, of bases in a state (nx,) at rest that no force from outside acts on, weight and drag included."""
    mechanism = dynamics.mechanism
    floating = floating_dofs(mechanism) & (mechanism.damping == 0.0) & (mechanism.armature == 0.0)
    lifted = mechanism.gravcomp_mass.sum() >= mechanism.mass.sum() * (1.0 - 1e-9)
    along = np.abs(_axes(mechanism, floating) @ mechanism.gravity).max(initial=0.0)
    falls = not lifted and along > LEVEL * np.linalg.norm(mechanism.gravity)
    if falls or mechanism.drags or np.any(x0[mechanism.velocities]) or floating[prescribed_dofs_of(dynamics)].any():
        return np.zeros(mechanism.nv, dtype=bool)
    return floating


def kept_center_of_mass(dynamics: RigidBodyDynamics, x0: np.ndarray) -> ResidualAndJacobian | None:
    """Displacement of the centre of mass of a pose (nq,) from that of the start (nx,), and its Jacobian; scaled.

    Whatever its joints do it stays, of a machine at rest that nothing pushes from outside: along the slides that move
    the machine as a whole, of a free joint in all of space. None where something pushes it, or it is not alone.
    """
    mechanism = dynamics.mechanism
    axes = _axes(mechanism, undamped_floating_dofs(dynamics, x0))
    if not len(axes) or len(set(roots(mechanism).tolist())) > 1:
        return None
    before = center_of_mass(mechanism, x0[: mechanism.nq])

    def displaced(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        r, J = center_of_mass(mechanism, q) - before, center_of_mass_jacobian(mechanism, q)
        return axes @ r / CENTER_SCALE, axes @ J / CENTER_SCALE

    return displaced


def _axes(mechanism: Mechanism, dofs: np.ndarray) -> np.ndarray:
    """(K, 3) directions, in the world, of the slides among degrees of freedom (nv,) bool of bases."""
    q, slides = mechanism.home[: mechanism.nq], np.flatnonzero(dofs & ~np.any(mechanism.S[:, :3] != 0.0, axis=1))
    frames = [frame_pose(mechanism, q, Frame.at(int(i), np.zeros(3)))[:3, :3] for i in slides]
    return np.reshape([R @ mechanism.S[i, 3:] for R, i in zip(frames, slides, strict=True)], (-1, 3))
