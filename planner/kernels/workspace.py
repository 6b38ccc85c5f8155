"""The memory of one solve, allocated once: nothing is allocated inside iterations."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from planner.kernels.jit import jit
from planner.kernels.lanes import WIDTH, lane_array, padded

# Outcomes of one iteration
ACCEPTED, CONVERGED, INDEFINITE, NO_STEP = 0, 1, 2, 3


class Workspace(NamedTuple):
    """Arrays of one solve; nz = nu + nx, NZ = nz padded to whole lanes. Rows ordered z = (u | x)."""

    xs: np.ndarray  # (N+1, nx)
    us: np.ndarray  # (N, nu)
    Q: np.ndarray  # (N+1, nx, nx)
    R: np.ndarray  # (N, nu, nu)
    x_ref: np.ndarray  # (N+1, nx)
    u_ref: np.ndarray  # (N, nu)
    W: np.ndarray  # (N+1, nz, NZ) diag(R, Q)
    l: np.ndarray  # (N+1, NZ) gradients of the stage costs
    F: np.ndarray  # (N, nx, NZ) = (B | A)
    K: np.ndarray  # (N, nu, NZ), gains in the columns of x
    k: np.ndarray  # (N, nu)
    dus: np.ndarray  # (N, nu) the LQ problem's own controls
    gradient: np.ndarray  # (N, nu) Eq. 19
    H: np.ndarray  # (2, nz, NZ)
    G: np.ndarray  # (nx, NZ)
    h: np.ndarray  # (2 NZ,)
    costate: np.ndarray  # (2 NZ,)
    dx: np.ndarray  # (2, nx)
    knots: np.ndarray  # (nz + nx, 8)
    X8: np.ndarray  # ((N+1) nx, 8) the eight candidates
    U8: np.ndarray  # (N nu, 8)
    J8: np.ndarray  # (1, 8)
    S8: np.ndarray  # (1, 8)
    alpha: np.ndarray  # (1, 8)
    bracket: np.ndarray  # (3,)
    out: np.ndarray  # (5,) gradient norm, slope, step, expected decrease, cost after


def workspace(Q: np.ndarray, R: np.ndarray, x_ref: np.ndarray, u_ref: np.ndarray) -> Workspace:
    """Memory for a tracking cost with Q (N+1, nx, nx), R (N, nu, nu) and its references."""
    N, nu, nx = R.shape[0], R.shape[1], Q.shape[1]
    nz, NZ = nu + nx, padded(nu + nx)
    W = lane_array(N + 1, nz, NZ)
    W[:N, :nu, :nu] = R
    W[:, nu:, nu:nz] = Q
    return Workspace(
        xs=np.zeros((N + 1, nx)), us=np.zeros((N, nu)), Q=Q.copy(), R=R.copy(), x_ref=x_ref.copy(),
        u_ref=u_ref.copy(), W=W, l=lane_array(N + 1, NZ), F=lane_array(N, nx, NZ), K=lane_array(N, nu, NZ),
        k=np.zeros((N, nu)),
        dus=np.zeros((N, nu)), gradient=np.zeros((N, nu)), H=lane_array(2, nz, NZ), G=lane_array(nx, NZ),
        h=lane_array(2 * NZ), costate=lane_array(2 * NZ), dx=np.zeros((2, nx)), knots=lane_array(nz + nx, WIDTH),
        X8=lane_array((N + 1) * nx, WIDTH), U8=lane_array(N * nu, WIDTH), J8=lane_array(1, WIDTH),
        S8=lane_array(1, WIDTH), alpha=lane_array(1, WIDTH), bracket=np.zeros(3), out=np.zeros(5),
    )  # fmt: skip


@jit
def accept(w, lane):
    """Make candidate `lane` the nominal trajectory."""
    N, nu, nx = w.us.shape[0], w.us.shape[1], w.xs.shape[1]
    for n in range(N + 1):
        for i in range(nx):
            w.xs[n, i] = w.X8[n * nx + i, lane]
    for n in range(N):
        for i in range(nu):
            w.us[n, i] = w.U8[n * nu + i, lane]
