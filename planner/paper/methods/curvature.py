"""The Hessian of J over the controls at a trajectory: whether a stationary point is a minimum or a saddle.

To second order in the controls, with dx(n+1) = A dx + B du and z = (x, u),

    J(U + dU) - J(U) = grad J . dU + 1/2 sum dz' H(n) dz + 1/2 dx(N)' Q(N) dx(N)

H(n) are the second derivatives of the Hamiltonian (Eq. 21): of the cost, and of the dynamics times the costate. Here
they are central differences of its exact gradient, which any machine has, with contact and stops too. The Riccati sweep
(Eq. 33) eliminates the states and leaves blocks H_uu + B'PB on the diagonal. Elimination keeps the number of negative
eigenvalues (Sylvester's law of inertia), so that of the whole Hessian (N nu, N nu) is the sum over the blocks.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from planner.base.errors import PlannerError
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.solvers import lq
from planner.solvers.slq import solve

STEP = 1e-4  # of the differences, times 1 + |x| or |u|: their error is about 1e-8
ROUNDING = 1e-6  # of the size of a block's terms: an eigenvalue this little below zero may be the differences'
DONE = 1e-13  # decrease promised, relative to J, at which a point counts as stationary


@dataclass(frozen=True, eq=False)
class Curvature:
    """The Hessian of J at a trajectory."""

    negative: int  # number of its negative eigenvalues
    least: float  # eigenvalue of the blocks, over the size of its block's terms
    direction: np.ndarray | None  # (N, nu) of length one, along which J bends down; None where nothing does
    promised: float  # decrease of J to the bottom of the quadratic; infinite where J bends down


def curvature(problem: Problem, xs: np.ndarray, us: np.ndarray) -> Curvature:
    """The Hessian of J over the controls at xs (N+1, nx), us (N, nu); states are plain vectors."""
    A, B = problem.dynamics.linearize(xs, us)
    model = problem.cost.quadratize(xs, us)
    H, P = hamiltonian_hessians(problem, xs, us)
    N, ndx, nu = B.shape
    s, K = model.q[N], np.empty((N, nu, ndx))
    negative, least, promised, lowest = 0, np.inf, 0.0, None
    for n in reversed(range(N)):
        carried = B[n].T @ P @ B[n]
        G, G_ux = H[n, ndx:, ndx:] + carried, H[n, ndx:, :ndx] + B[n].T @ P @ A[n]
        size = float(np.abs(H[n, ndx:, ndx:]).max() + np.abs(carried).max())
        values, vectors = np.linalg.eigh(G)
        relative = values / size
        negative += int(np.sum(relative < -ROUNDING))
        if relative[0] < min(least, -ROUNDING):
            lowest = n, vectors[:, 0]
        least = min(least, float(relative[0]))
        inverse = (vectors / np.where(np.abs(relative) > ROUNDING, values, ROUNDING * size)) @ vectors.T
        g = model.r[n] + B[n].T @ s
        K[n] = -inverse @ G_ux
        promised += 0.5 * float(g @ inverse @ g)
        s = model.q[n] + A[n].T @ s + K[n].T @ g
        P = H[n, :ndx, :ndx] + A[n].T @ P @ A[n] + G_ux.T @ K[n]
        P = 0.5 * (P + P.T)
    if lowest is None:
        return Curvature(0, least, None, promised)
    return Curvature(negative, least, _along(A, B, K, *lowest), np.inf)


def _along(A: np.ndarray, B: np.ndarray, K: np.ndarray, stage: int, du: np.ndarray) -> np.ndarray:
    """(N, nu) a block's eigenvector (nu,) at its stage, and afterwards what the sweep makes of it; of length one."""
    dus, dx = np.zeros(K.shape[:2]), np.zeros(A.shape[1])
    for n in range(stage, len(A)):
        dus[n] = du if n == stage else K[n] @ dx
        dx = A[n] @ dx + B[n] @ dus[n]
    return dus / np.linalg.norm(dus)


def hamiltonian_hessians(problem: Problem, xs: np.ndarray, us: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """H (N, ndx+nu, ndx+nu) of the stages in z = (x, u), and Q (ndx, ndx) of the end."""
    A, _ = problem.dynamics.linearize(xs, us)
    costates = lq.costates(A, problem.cost.quadratize(xs, us))[1:]  # held while x and u change
    (N, nu), ndx = us.shape, xs.shape[1]
    H, Q = np.empty((N, ndx + nu, ndx + nu)), np.empty((ndx, ndx))

    def gradients(x: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        A, B = problem.dynamics.linearize(x, u)
        model = problem.cost.quadratize(x, u)
        by_x = model.q[:-1] + np.einsum("nij,ni->nj", A, costates)
        by_u = model.r + np.einsum("nij,ni->nj", B, costates)
        return np.concatenate([by_x, by_u], axis=1), model.q[-1]

    for j in range(ndx + nu):
        x, u = xs.copy(), us.copy()
        moved = x[:, j] if j < ndx else u[:, j - ndx]
        step, start = STEP * (1.0 + np.abs(moved)), moved.copy()
        moved[:] = start + step
        up, up_end = gradients(x, u)
        moved[:] = start - step
        down, down_end = gradients(x, u)
        H[:, :, j] = (up - down) / (2.0 * step[:N, None])
        if j < ndx:
            Q[:, j] = (up_end - down_end) / (2.0 * step[-1])
    return 0.5 * (H + H.swapaxes(1, 2)), 0.5 * (Q + Q.T)


def minimum_near(problem: Problem, us: np.ndarray, most: int = 300) -> tuple[Plan, Curvature]:
    """The stationary point beside a solve's end us (N, nu), by at most so many more iterations, and its Hessian.

    Newton's where the machine has second derivatives. The end itself is off it by what its solve left undone, and on a
    steep slope beside a minimum the Hessian may still be indefinite.
    """
    near = replace(problem, us=us)
    try:
        plan = solve(
            near,
            hessian="exact",
            max_iterations=most,
            expected_reduction_tolerance=DONE,
            actual_reduction_tolerance=0.0,
        )
    except PlannerError:  # contacts and stops have none
        plan = solve(near, max_iterations=most, expected_reduction_tolerance=DONE, actual_reduction_tolerance=0.0)
    return plan, curvature(problem, plan.xs, plan.us)
