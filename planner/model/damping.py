"""Joint-space damping of a mechanism: joint dampers, servos and tendons."""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.model.tendons import acting_tendons


def damping_matrix(mechanism: Any) -> np.ndarray:
    """Damping matrix (nv, nv) = -d(tau)/d(qd) of dampers, actuators and tendons, N m s/rad and N s/m."""
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
