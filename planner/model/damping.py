"""Joint-space damping of a mechanism: joint dampers, servos and tendons."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from planner.base.errors import PlannerError
from planner.model.tendons import acting_tendons


def damping_matrix(mechanism: Any) -> np.ndarray:
    """Damping matrix (nv, nv) = -d(tau)/d(qd) of dampers, actuators and tendons, N m s/rad and N s/m.

    Without that of the actuators' force laws, which depends on the state.
    """
    actuators = mechanism.actuators
    D = np.diag(np.array(mechanism.damping, dtype=float))
    D -= actuators.moment.T @ (actuators.bias[:, 2:3] * actuators.moment)
    for tendon in acting_tendons(mechanism):
        row = np.zeros(mechanism.nv)
        row[list(tendon.dofs)] = tendon.coefficients
        D += tendon.damping * np.outer(row, row)
    return D


def implicit_damping(mechanism: Any) -> np.ndarray:
    """Diagonal damping (nv,) of an implicit step: the absolute row sums of the damping matrix.

    As a matrix it bounds the damping matrix from above, so damping that couples joints is stable too.
    """
    return np.abs(damping_matrix(mechanism)).sum(axis=1)


def damped_implicitly(mechanism: Any, h: float) -> Any:
    """The mechanism with M + h D in place of M, for MuJoCo's implicitfast step of h s; D is the damping matrix.

    With D diagonal that is a larger armature. MuJoCo's D holds no constraint forces, so neither does this.

    Raises:
        PlannerError: D is not diagonal, negative, or depends on the pose, as that of fluid drag.
    """
    D, why = damping_matrix(mechanism), ""
    own = np.diag(D)
    for i, j in np.argwhere(D - np.diag(own))[:1]:
        why = f"damps {mechanism.joint_of(int(i))} and {mechanism.joint_of(int(j))} together"
    for i in np.flatnonzero(own < 0.0)[:1]:
        why = f"drives {mechanism.joint_of(int(i))} by negative damping"
    if mechanism.drags:
        why = "has fluid drag"
    by_rate = [law for law in mechanism.actuators.laws if law.kind != "affine gain" or law.numbers[1] != 0.0]
    for law in by_rate[:1]:
        why = f"has an actuator, {mechanism.actuators.names[law.actuator]!r}, with a damping that depends on the state"
    if why:
        raise PlannerError(
            f'the integrator "implicitfast" takes damping of single joints and this machine {why}, expected '
            '"rosenbrock", or "rk4".'
        )
    return replace(mechanism, armature=mechanism.armature + h * own)
