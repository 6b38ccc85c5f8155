"""The LQ subproblem in NumPy, for user-defined dynamics and costs. kernels.lq is the compiled version.

Around a trajectory (3.2, 3.3):

    minimize    sum 1/2 dx'Q dx + q'dx + 1/2 du'R du + r'du + du'S dx  + the same at the end
    subject to  dx(n+1) = A(n) dx(n) + B(n) du(n),  dx(0) = 0                               (Eq. 35, 38)

with the gradients q = Q (x - x_ref), r = R (u - u_ref) in place of the paper's offsets. Deviations dx (ndx,) are
tangent vectors for states with quaternions. The paper has no S: it is added to B'PA, and the gradient (Eq. 18) does
not contain it.

In multiple shooting stage n has a defect g(n), its end minus the next state, and Eq. 38 becomes
dx(n+1) = A(n) dx(n) + B(n) du(n) + g(n). The value gradient before the defect is s(n+1) + P(n+1) g(n).
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np

from planner.kernels.lq.active_set import MULTIPLIER_ROUNDING, ROUNDING
from planner.kernels.lq.state_dependent_bounds import AT_BOUND
from planner.problem.constraints.trajectory_constraints import BoundPenalties, StateBounds, sides_of
from planner.problem.control_bounds import StepBounds
from planner.problem.costs.terms import Quadratic

MAX_NEWTON_STEPS = 100  # of one box QP
MIN_STEP = 1e-10  # of its line search: smaller steps only change rounding errors
ARMIJO_C1 = 0.1  # of its line search (N&W 3.1)
MAX_GRADIENT = 1e12
"""Norm of Eq. 19 above which rounding hides the slope g'du of bounded directions. Its open-loop costates grow along
motions that only feedback makes stable. The change of the convex model stands for the slope, which is below it.
"""


class Sweep(NamedTuple):
    """The solution of the LQ problem: du = k + K dx, the cost-to-go 1/2 dx'P dx + s'dx, and its slope."""

    K: np.ndarray  # (N, nu, ndx)
    k: np.ndarray  # (N, nu)
    P: np.ndarray  # (N+1, ndx, ndx)
    s: np.ndarray  # (N+1, ndx)
    slope: float  # of J along the direction (Eq. 42); without bounds minus twice the expected reduction
    value: float  # of the LQ problem at its minimum: minus the expected reduction
    active_bounds: np.ndarray | None = (
        None  # (N, nu) -1 at the lower bound, 1 at the upper, 0 free; None without bounds
    )
    by_controls: tuple[np.ndarray, ...] = ()  # with an active set: H (N, nu, nu), H_ux (N, nu, ndx), gradient (N, nu)


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
    """The gradient (N, nu) with state-dependent bounds: controls at such bounds change with the state.

    As Eq. 18, but the costate gains d bound/dx times the gradient of the controls at their bounds.
    """
    if bounds is None or bounds.lower_by_x is None or bounds.upper_by_x is None:
        return gradient(A, B, quadratic)
    reduced, costate = np.empty_like(quadratic.r), quadratic.q[-1]
    for n in reversed(range(len(A))):
        reduced[n] = g = quadratic.r[n] + B[n].T @ costate  # Eq. 18
        low, high = _blocked(bounds.lower[n], bounds.upper[n], g)
        costate = quadratic.q[n] + A[n].T @ costate  # Eq. 16
        costate += np.where(low, g, 0.0) @ bounds.lower_by_x[n] + np.where(high, g, 0.0) @ bounds.upper_by_x[n]
    return reduced


def _blocked(lower: np.ndarray, upper: np.ndarray, gradient: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Whether controls (nu,) are at active lower, or upper, bounds: descent would violate them."""
    return (lower >= -AT_BOUND) & (gradient > 0.0), (upper <= AT_BOUND) & (gradient < 0.0)


def projected(gradient: np.ndarray, bounds: StepBounds | None) -> np.ndarray:
    """The projected gradient (N, nu): zero for controls at active bounds."""
    if bounds is None:
        return gradient
    low, high = _blocked(bounds.lower, bounds.upper, gradient)
    return np.where(low | high, 0.0, gradient)


def riccati(
    A: np.ndarray, B: np.ndarray, quadratic: Quadratic, mu: float = 0.0, bounds: StepBounds | None = None,
    second: np.ndarray | None = None, defects: np.ndarray | None = None, active_bounds: np.ndarray | None = None,
) -> Sweep | None:  # fmt: skip
    """Backward sweep, Eq. 31-34 with a Cholesky factorization of R + B'PB + mu I instead of Eq. 31's inverse.

    With bounds each stage's k solves a box QP (Tassa, Mansard and Todorov 2014); controls at their bounds have zero
    gains, or the derivatives of state-dependent bounds.

    Args:
        A: (N, ndx, ndx).
        B: (N, ndx, nu).
        quadratic: Quadratic model of the cost.
        mu: Regularization, added to R.
        bounds: Bounds of k, or None.
        second: (N, ndx+nu, ndx+nu) second-order terms of the dynamics in z = (x, u), added to each stage's Hessian.
        defects: (N, ndx) between the stages; none by default. With them slope and value are not those of J.
        active_bounds: (N, nu) controls that are fixed at their lower (-1) and upper (1) bounds while the others are
            free, in place of the box QP of each stage.

    Returns:
        The solution, or None when R + B'PB + mu I (with the control block of second) is not positive definite.
    """
    N, ndx, nu = B.shape
    K, k = np.empty((N, nu, ndx)), np.zeros((N, nu))
    P, s = np.empty((N + 1, ndx, ndx)), np.empty((N + 1, ndx))
    P[N], s[N] = quadratic.Q[N], quadratic.q[N]  # Eq. 29
    slope, value, none = 0.0, 0.0, np.zeros((ndx + nu, ndx + nu))
    by_controls = np.zeros((N, nu, nu)), np.zeros((N, nu, ndx)), np.zeros((N, nu))
    active = np.zeros((N, nu))
    for n in reversed(range(N)):
        BtP = B[n].T @ P[n + 1]
        T = none if second is None else second[n]
        H, H_ux = quadratic.R[n] + BtP @ B[n] + T[ndx:, ndx:] + mu * np.eye(nu), BtP @ A[n] + T[ndx:, :ndx]
        s_end = s[n + 1] if defects is None else s[n + 1] + P[n + 1] @ defects[n]
        h = quadratic.r[n] + B[n].T @ s_end
        if quadratic.S is not None:
            H_ux = H_ux + quadratic.S[n]
        s_x, follows, more = quadratic.q[n] + A[n].T @ s_end, None, 0.0
        try:
            if bounds is not None:
                if active_bounds is None:
                    k[n], at_bound = solve_box_qp(H, h, bounds.lower[n], bounds.upper[n])
                else:
                    at_lower, at_upper = active_bounds[n] < 0, active_bounds[n] > 0
                    k[n] = np.select([at_lower, at_upper], [bounds.lower[n], bounds.upper[n]])
                    at_bound = active_bounds[n] != 0
                    by_controls[0][n], by_controls[1][n], by_controls[2][n] = H, H_ux, h
                active[n] = np.where(at_bound, np.where(k[n] <= bounds.lower[n], -1.0, 1.0), 0.0)
                value += float(h @ k[n] + 0.5 * k[n] @ H @ k[n])
                kc = np.where(at_bound, k[n], 0.0)  # constant for the free controls
                h, s_x = h + H @ kc, s_x + H_ux.T @ kc
                if bounds.lower_by_x is not None and bounds.upper_by_x is not None:  # the bounds depend on the state
                    along = np.where((k[n] <= bounds.lower[n])[:, None], bounds.lower_by_x[n], bounds.upper_by_x[n])
                    follows = np.where(at_bound[:, None], along, 0.0)
                    along = follows.T @ H_ux
                    s_x, more = s_x + follows.T @ h, along + along.T + follows.T @ H @ follows
                    H_ux = H_ux + H @ follows
                h = np.where(at_bound, 0.0, h)
                H_ux = np.where(at_bound[:, None], 0.0, H_ux)
                H = np.where(at_bound[:, None] | at_bound, np.diag(at_bound.astype(float)), H)
            U = np.linalg.cholesky(H).T
        except np.linalg.LinAlgError:
            return None
        if np.isnan(U).any():  # NumPy's cholesky accepts NaN
            return None
        Y = np.linalg.solve(U.T, H_ux)
        y = np.linalg.solve(U.T, h)
        K[n] = -np.linalg.solve(U, Y)
        if follows is not None:
            K[n] += follows
        if bounds is None or active_bounds is not None:
            k[n] -= np.linalg.solve(U, y)
        if active_bounds is not None:
            value -= 0.5 * float(y @ y)
        P[n] = quadratic.Q[n] + A[n].T @ P[n + 1] @ A[n] + T[:ndx, :ndx] - Y.T @ Y  # Eq. 33
        P[n] += more
        P[n] = 0.5 * (P[n] + P[n].T)
        s[n] = s_x - Y.T @ y  # Eq. 34
        slope -= float(y @ y)  # Eq. 42
    if bounds is None or defects is not None:
        return Sweep(K, k, P, s, slope, 0.5 * slope if bounds is None else value)
    _, dus = direction(A, B, Sweep(K, k, P, s, slope, value), bounds)
    g = gradient(A, B, quadratic)
    slope = float(np.sum(g * dus)) if np.linalg.norm(g) < MAX_GRADIENT else value
    return Sweep(K, k, P, s, slope, value, active, by_controls if active_bounds is not None else ())


def direction(
    A: np.ndarray, B: np.ndarray, sweep: Sweep, bounds: StepBounds | None = None, defects: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """The LQ problem's own forward pass: dxs (N+1, ndx), dus (N, nu), Eq. 25, 30.

    With bounds, a control at its bound stays there if its change would violate it, as in clipped rollouts.
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
        dxs[n + 1] = A[n] @ dxs[n] + B[n] @ dus[n] + (0.0 if defects is None else defects[n])  # Eq. 30
    return dxs, dus


def solve_box_qp(H: np.ndarray, h: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Minimize 1/2 k'H k + h'k over lower <= k <= upper by projected Newton steps from 0 (Bertsekas 1982).

    Args:
        H: (nu, nu) symmetric.
        h: (nu,).
        lower: (nu,) at most 0.
        upper: (nu,) at least 0.

    Returns:
        k (nu,), and whether each component is clamped (nu,).

    Raises:
        numpy.linalg.LinAlgError: H is not positive definite where k is free.
    """
    k, clamped, full = np.zeros_like(h), np.zeros(len(h), dtype=bool), False
    for _ in range(MAX_NEWTON_STEPS):
        g = h + H @ k
        before, clamped = clamped, ((k <= lower) & (g > 0.0)) | ((k >= upper) & (g < 0.0))
        if full and np.array_equal(before, clamped):
            break
        free, d = np.flatnonzero(~clamped), np.zeros_like(h)
        L = np.linalg.cholesky(H[np.ix_(free, free)])
        if np.isnan(L).any():  # NumPy's cholesky accepts NaN
            raise np.linalg.LinAlgError("a matrix that is not a number")
        d[free] = -np.linalg.solve(L.T, np.linalg.solve(L, g[free]))
        step = 1.0
        while True:
            wanted = k + step * d
            into = np.clip(wanted, lower, upper)
            full, moved = step == 1.0 and np.array_equal(into, wanted), into - k
            slope = float(g @ moved)
            if full or slope + 0.5 * float(moved @ H @ moved) <= ARMIJO_C1 * slope or step < MIN_STEP:
                break
            step *= 0.5
        if step < MIN_STEP:  # converged to rounding
            break
        k = into
    return k, clamped


class StatePenalties(NamedTuple):
    """Penalties of state bounds along a trajectory."""

    ranges: StateBounds
    penalties: BoundPenalties
    xs: np.ndarray  # (N+1, nx)


def solve_active_set(
    A: np.ndarray, B: np.ndarray, quadratic: Quadratic, mu: float, bounds: StepBounds | None, second: np.ndarray | None,
    penalized: StatePenalties | None, active_bounds: np.ndarray, max_sets: int,
) -> tuple[Sweep | None, np.ndarray]:  # fmt: skip
    """The LQ problem with bounds of controls and one-sided penalties of states, by an active set (N&W 16.5).

    Sweeps are repeated with the bounds and penalties active along the last direction, until these do not change.

    Args:
        A: (N, ndx, ndx).
        B: (N, ndx, nu).
        quadratic: Quadratic model of the cost with the active penalties.
        mu: Regularization, added to R.
        bounds: Bounds of the control steps, or None.
        second: (N, ndx+nu, ndx+nu) added to the Hessians, or None.
        penalized: The penalties, or None.
        active_bounds: (N, nu) the bounds to begin with: -1 lower, 1 upper, 0 free.
        max_sets: Limit of the sweeps.

    Returns:
        The sweep, with slope and value of the penalized cost; None where the sets cycle or a sweep is not definite.
        And the last active bounds.
    """
    model, more_cost, more_slope, e, sides = quadratic, 0.0, 0.0, None, None
    if penalized is not None:
        e = penalized.ranges.deviations(penalized.xs)
        sides = sides_of(penalized.penalties, e)
    for _ in range(max_sets):
        sweep = riccati(A, B, model, mu, bounds, second, active_bounds=active_bounds if bounds is not None else None)
        if sweep is None:
            return None, active_bounds
        dxs, dus = direction(A, B, sweep)
        after = active_bounds if bounds is None else _next_active_bounds(sweep, bounds, active_bounds, dxs, dus)
        same = np.array_equal(after, active_bounds)
        if penalized is not None and e is not None and sides is not None:
            after_sides = penalized.ranges.next_sides(penalized.penalties, e, dxs, sides)
            same = same and np.array_equal(after_sides, sides)
            changed = partial(penalized.ranges.with_active_sides, penalized.penalties, quadratic, penalized.xs)
            _, more_cost, more_slope = changed(sides, dxs)
            if not same:
                sides = after_sides
                model, _, _ = changed(sides, dxs)
        if same:
            return sweep._replace(slope=sweep.slope + more_slope, value=sweep.value + more_cost), active_bounds
        active_bounds = after
    return None, active_bounds


def _next_active_bounds(
    sweep: Sweep, bounds: StepBounds, active_bounds: np.ndarray, dxs: np.ndarray, dus: np.ndarray
) -> np.ndarray:
    """The next active bounds (N, nu): -1 lower, 1 upper, 0 free."""
    lower_bound, upper = bounds.lower, bounds.upper
    if bounds.lower_by_x is not None and bounds.upper_by_x is not None:
        lower_bound = lower_bound + np.einsum("nij,nj->ni", bounds.lower_by_x, dxs[:-1])
        upper = upper + np.einsum("nij,nj->ni", bounds.upper_by_x, dxs[:-1])
    parts = [
        sweep.by_controls[2][:, :, None],
        sweep.by_controls[0] * dus[:, None, :],
        sweep.by_controls[1] * dxs[:-1, None, :],
    ]
    multiplier = sum(part.sum(axis=2) for part in parts)
    size = sum(np.abs(part).sum(axis=2) for part in parts)
    slack = ROUNDING * (1.0 + np.abs(dus))
    free = np.where(dus < lower_bound - slack, -1.0, np.where(dus > upper + slack, 1.0, 0.0))
    wrong = (np.abs(multiplier) > MULTIPLIER_ROUNDING * size) & (active_bounds * multiplier > 0.0)
    return np.where(active_bounds == 0.0, free, np.where(wrong, 0.0, active_bounds))
