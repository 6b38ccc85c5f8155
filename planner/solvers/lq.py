"""The LQ subproblem for the reader, in NumPy: it drives a user's own dynamics and is the twin of the kernels.

Around a trajectory (3.2, 3.3):

    minimize    sum 1/2 dx'Q dx + q'dx + 1/2 du'R du + r'du + du'S dx  + the same at the end
    subject to  dx(n+1) = A(n) dx(n) + B(n) du(n),  dx(0) = 0                               (Eq. 35, 38)

with the gradients q = Q (x - x_ref), r = R (u - u_ref) in place of the paper's offsets. Deviations dx have ndx numbers;
only differences of states know whether these are plain vectors (see model.space). The paper has no S: it stands beside
B'PA wherever that does, and the gradient (Eq. 18) never sees it.

Where the states are a guess of their own, stage n ends a gap g(n) from the next state and Eq. 38 gains it:
dx(n+1) = A(n) dx(n) + B(n) du(n) + g(n). Before its gap the value gradient s(n+1) is s(n+1) + P(n+1) g(n).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from planner.kernels.lq.state_dependent_bounds import AT_BOUND
from planner.problem.control_bounds import StepBounds
from planner.problem.costs.terms import Quadratic
from planner.solvers.box import box_minimum


class Sweep(NamedTuple):
    """The solution of the LQ problem: du = k + K dx, its value 1/2 dx'P dx + s'dx + ..., and its slope."""

    K: np.ndarray  # (N, nu, ndx)
    k: np.ndarray  # (N, nu)
    P: np.ndarray  # (N+1, ndx, ndx)
    s: np.ndarray  # (N+1, ndx)
    slope: float  # of J along the direction (Eq. 42); without bounds minus twice the decrease promised
    value: float  # of the LQ model at its minimum: minus the decrease promised
    held: np.ndarray | None = None  # (N, nu) controls at their lower (-1) and upper (1) bounds; None without bounds
    rows: tuple[np.ndarray, ...] = ()  # Hessians (N, nu, nu), (N, nu, ndx) and gradients (N, nu) of controls, with held


def costates(A: np.ndarray, quadratic: Quadratic) -> np.ndarray:
    """Lambda (N+1, ndx) of Eq. 16, 17."""
    costate = np.empty_like(quadratic.q)
    costate[-1] = quadratic.q[-1]  # Eq. 17
    for n in reversed(range(len(A))):
        costate[n] = quadratic.q[n] + A[n].T @ costate[n + 1]  # Eq. 16
    return costate


def gradient(A: np.ndarray, B: np.ndarray, quadratic: Quadratic) -> np.ndarray:
    """Gradient (N, nu) of J with respect to the controls, Eq. 18, 19."""
    return quadratic.r + np.einsum("nxu,nx->nu", B, costates(A, quadratic)[1:])  # Eq. 18


def reduced_gradient(A: np.ndarray, B: np.ndarray, quadratic: Quadratic, bounds: StepBounds | None) -> np.ndarray:
    """The gradient (N, nu) where controls that their bounds hold move along them as the state does.

    It is that of Eq. 18 but for bounds that depend on the state: the costate gains d bound/dx times what pushes.
    """
    if bounds is None or bounds.lower_by_x is None or bounds.upper_by_x is None:
        return gradient(A, B, quadratic)
    found, costate = np.empty_like(quadratic.r), quadratic.q[-1]
    for n in reversed(range(len(A))):
        found[n] = g = quadratic.r[n] + B[n].T @ costate  # Eq. 18
        low, high = _pushing(bounds.lower[n], bounds.upper[n], g)
        costate = quadratic.q[n] + A[n].T @ costate  # Eq. 16
        costate += np.where(low, g, 0.0) @ bounds.lower_by_x[n] + np.where(high, g, 0.0) @ bounds.upper_by_x[n]
    return found


def _pushing(lower: np.ndarray, upper: np.ndarray, gradient: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Whether controls are at their lower, or upper, bounds and a gradient pushes against these."""
    return (lower >= -AT_BOUND) & (gradient > 0.0), (upper <= AT_BOUND) & (gradient < 0.0)


def projected(gradient: np.ndarray, bounds: StepBounds | None) -> np.ndarray:
    """A gradient (N, nu) without what pushes against a bound that the control is at: zero at a minimum."""
    if bounds is None:
        return gradient
    low, high = _pushing(bounds.lower, bounds.upper, gradient)
    return np.where(low | high, 0.0, gradient)


def riccati(
    A: np.ndarray,
    B: np.ndarray,
    quadratic: Quadratic,
    mu: float = 0.0,
    bounds: StepBounds | None = None,
    second: np.ndarray | None = None,
    gaps: np.ndarray | None = None,
    held: np.ndarray | None = None,
) -> Sweep | None:
    """Backward sweep, Eq. 31-34 with a Cholesky factorization of R + B'PB + mu I instead of Eq. 31's inverse.

    With bounds each stage's k is the minimum over its box; clamped controls have no gains, or those that follow their
    bounds where these depend on the state (see kernels.lq.bounded_riccati).

    Args:
        A: (N, ndx, ndx).
        B: (N, ndx, nu).
        quadratic: Of the cost.
        mu: Regularization, added to R.
        bounds: Of k.
        second: (N, ndx+nu, ndx+nu) second-order terms of the dynamics in z = (x, u), added to each stage's Hessian.
        gaps: (N, ndx) between the stages; none by default. With them slope and value are no longer those of J.
        held: (N, nu) controls that are held at their lower (-1) and upper (1) bounds while the others are free, in
            place of the box of each stage (see solvers.active_set).

    Returns:
        The solution, or None when R + B'PB + mu I (with the control block of second) is not positive definite.
    """
    N, ndx, nu = B.shape
    K, k = np.empty((N, nu, ndx)), np.zeros((N, nu))
    P, s = np.empty((N + 1, ndx, ndx)), np.empty((N + 1, ndx))
    P[N], s[N] = quadratic.Q[N], quadratic.q[N]  # Eq. 29
    slope, value, none = 0.0, 0.0, np.zeros((ndx + nu, ndx + nu))
    rows = np.zeros((N, nu, nu)), np.zeros((N, nu, ndx)), np.zeros((N, nu))
    now = np.zeros((N, nu))
    for n in reversed(range(N)):
        BtP = B[n].T @ P[n + 1]
        T = none if second is None else second[n]
        H, H_ux = quadratic.R[n] + BtP @ B[n] + T[ndx:, ndx:] + mu * np.eye(nu), BtP @ A[n] + T[ndx:, :ndx]
        s_end = s[n + 1] if gaps is None else s[n + 1] + P[n + 1] @ gaps[n]
        h = quadratic.r[n] + B[n].T @ s_end
        if quadratic.S is not None:
            H_ux = H_ux + quadratic.S[n]
        s_x, follows, more = quadratic.q[n] + A[n].T @ s_end, None, 0.0
        try:
            if bounds is not None:
                if held is None:
                    k[n], clamped = box_minimum(H, h, bounds.lower[n], bounds.upper[n])
                else:
                    k[n], clamped = (
                        np.select([held[n] < 0, held[n] > 0], [bounds.lower[n], bounds.upper[n]]),
                        held[n] != 0,
                    )
                    rows[0][n], rows[1][n], rows[2][n] = H, H_ux, h
                now[n] = np.where(clamped, np.where(k[n] <= bounds.lower[n], -1.0, 1.0), 0.0)
                value += float(h @ k[n] + 0.5 * k[n] @ H @ k[n])
                kc = np.where(clamped, k[n], 0.0)  # a constant to what is left
                h, s_x = h + H @ kc, s_x + H_ux.T @ kc
                if bounds.lower_by_x is not None and bounds.upper_by_x is not None:  # the bounds move with the state
                    along = np.where((k[n] <= bounds.lower[n])[:, None], bounds.lower_by_x[n], bounds.upper_by_x[n])
                    follows = np.where(clamped[:, None], along, 0.0)
                    along = follows.T @ H_ux
                    s_x, more = s_x + follows.T @ h, along + along.T + follows.T @ H @ follows
                    H_ux = H_ux + H @ follows
                h = np.where(clamped, 0.0, h)
                H_ux = np.where(clamped[:, None], 0.0, H_ux)
                H = np.where(clamped[:, None] | clamped, np.diag(clamped.astype(float)), H)
            U = np.linalg.cholesky(H).T
        except np.linalg.LinAlgError:
            return None
        if np.isnan(U).any():  # NumPy lets a NaN through
            return None
        Y = np.linalg.solve(U.T, H_ux)
        y = np.linalg.solve(U.T, h)
        K[n] = -np.linalg.solve(U, Y)
        if follows is not None:
            K[n] += follows
        if bounds is None or held is not None:
            k[n] -= np.linalg.solve(U, y)
        if held is not None:
            value -= 0.5 * float(y @ y)
        P[n] = quadratic.Q[n] + A[n].T @ P[n + 1] @ A[n] + T[:ndx, :ndx] - Y.T @ Y  # Eq. 33
        P[n] += more
        P[n] = 0.5 * (P[n] + P[n].T)
        s[n] = s_x - Y.T @ y  # Eq. 34
        slope -= float(y @ y)  # Eq. 42
    if bounds is None or gaps is not None:
        return Sweep(K, k, P, s, slope, 0.5 * slope if bounds is None else value)
    _, dus = direction(A, B, Sweep(K, k, P, s, slope, value), bounds)
    slope = float(np.sum(gradient(A, B, quadratic) * dus))
    return Sweep(K, k, P, s, slope, value, now, rows if held is not None else ())


def direction(
    A: np.ndarray, B: np.ndarray, sweep: Sweep, bounds: StepBounds | None = None, gaps: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """The LQ problem's own forward pass: dxs (N+1, ndx), dus (N, nu), Eq. 25, 30.

    With bounds, what leads out of one that the control is at follows it: so the clipped controls set out.
    """
    N, ndx, nu = B.shape
    dxs, dus = np.zeros((N + 1, ndx)), np.empty((N, nu))
    for n in range(N):
        dus[n] = sweep.k[n] + sweep.K[n] @ dxs[n]  # Eq. 25
        if bounds is not None:
            floor = 0.0 if bounds.lower_by_x is None else bounds.lower_by_x[n] @ dxs[n]
            ceiling = 0.0 if bounds.upper_by_x is None else bounds.upper_by_x[n] @ dxs[n]
            dus[n] = np.where((bounds.lower[n] >= -AT_BOUND) & (dus[n] < floor), floor, dus[n])
            dus[n] = np.where((bounds.upper[n] <= AT_BOUND) & (dus[n] > ceiling), ceiling, dus[n])
        dxs[n + 1] = A[n] @ dxs[n] + B[n] @ dus[n] + (0.0 if gaps is None else gaps[n])  # Eq. 30
    return dxs, dus
