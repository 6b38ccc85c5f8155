"""A machine at rest that nothing pushes from outside: its centre of mass stays, whatever its joints do."""

from __future__ import annotations

import numpy as np

from planner.dynamics import RigidBodyDynamics
from planner.dynamics.kinematics import center_of_mass, center_of_mass_jacobian
from planner.model.capabilities import floating_dofs, roots
from planner.model.mjcf.prescribed_joints import prescribed_dofs_of
from planner.problem.tasks.pose_constraints import ResidualAndJacobian

CENTER_SCALE = 1e-3  # m, displacement of the centre of mass of a residual of 1


def undamped_floating_dofs(dynamics: RigidBodyDynamics, x0: np.ndarray) -> np.ndarray:
    """(nv,) bool, of bases in a state (nx,) at rest that no force from outside acts on, weight and drag included."""
    mechanism = dynamics.mechanism
    falls = np.any(mechanism.gravity) and mechanism.gravcomp_mass.sum() < mechanism.mass.sum() * (1.0 - 1e-9)
    if falls or mechanism.drags or np.any(x0[mechanism.velocities]):
        return np.zeros(mechanism.nv, dtype=bool)
    floating = floating_dofs(mechanism) & (mechanism.damping == 0.0) & (mechanism.armature == 0.0)
    return floating if not floating[prescribed_dofs_of(dynamics)].any() else np.zeros_like(floating)


def kept_center_of_mass(dynamics: RigidBodyDynamics, x0: np.ndarray) -> ResidualAndJacobian | None:
    """Displacement of the centre of mass of a pose (nq,) from that of the start (nx,), and its Jacobian; scaled.

    None where something pushes the machine, it cannot move as a whole in space, or it is not alone.
    """
    mechanism, floating = dynamics.mechanism, undamped_floating_dofs(dynamics, x0)
    slides = floating & ~np.any(mechanism.S[:, :3] != 0.0, axis=1)
    if slides.sum() < 3 or len(set(roots(mechanism).tolist())) > 1:
        return None
    before = center_of_mass(mechanism, x0[: mechanism.nq])

    def displaced(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        r, J = center_of_mass(mechanism, q) - before, center_of_mass_jacobian(mechanism, q)
        return r / CENTER_SCALE, J / CENTER_SCALE

    return displaced
