"""A machine at rest that nothing pushes from outside: its centre of mass stays, whatever its joints do.

Of a free joint in all of space, of a base on slides along these: nothing acts on the whole machine there.
"""

from __future__ import annotations

import numpy as np

from planner.dynamics import RigidBodyDynamics
from planner.dynamics.kinematics import center_of_mass, center_of_mass_jacobian, frame_pose
from planner.model.capabilities import floating_dofs, roots
from planner.model.mechanism import Frame, Mechanism
from planner.model.mjcf.prescribed_joints import prescribed_dofs_of
from planner.problem.tasks.pose_constraints import ResidualAndJacobian

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

    Along the slides that move the machine as a whole. None where something pushes it, or it is not alone.
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
