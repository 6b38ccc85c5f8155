"""LQR gains: along a trajectory, and at an equilibrium."""

from __future__ import annotations

import numpy as np

from planner.problem.costs.terms import Quadratic
from planner.solvers import lq


def tracking_gains(A: np.ndarray, B: np.ndarray, Q: np.ndarray, R: np.ndarray) -> np.ndarray | None:
    """Gains K (N, nu, ndx) of u = K[n] x for the sum of x'Qx/2 + u'Ru/2 over N stages and x'Qx/2 at the end.

    Args:
        A: (N, ndx, ndx).
        B: (N, ndx, nu).
        Q: (N+1, ndx, ndx).
        R: (N, nu, nu).

    Returns:
        None where R + B'PB is not positive definite, or gains are not finite.
    """
    sweep = lq.riccati(A, B, Quadratic(Q, np.zeros(Q.shape[:2]), R, np.zeros(R.shape[:2])))
    return sweep.K if sweep is not None and np.isfinite(sweep.K).all() else None


def regulator_gains(A: np.ndarray, B: np.ndarray, Q: np.ndarray, R: np.ndarray) -> np.ndarray | None:
    """Gains K (nu, ndx) of u = K x over infinitely many stages, by the discrete algebraic Riccati equation.

    Returns:
        None where no gains make A + BK stable.
    """
    from scipy.linalg import LinAlgError, solve_discrete_are  # 0.2 s of import, only when needed

    try:
        P = solve_discrete_are(A, B, Q, R)
        K = -np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
        stable = np.abs(np.linalg.eigvals(A + B @ K)).max() < 1.0
    except (LinAlgError, ValueError):
        return None
    return K if stable else None
