"""Theorem 2 in numbers: solves from random controls with every update and line search, and their ends.

A converged solve has a small expected reduction by the LQ model, which leaves out the curvature of the dynamics.
Each end is continued to the nearest stationary point. It counts as a local minimum if the exact Hessian of J over all
controls has no negative eigenvalue there and the cost is the same; all others are saddles or plateaus. To second order
in the controls, with dx(n+1) = A dx + B du and z = (x, u),

    J(U + dU) - J(U) = grad J . dU + 1/2 sum dz' H(n) dz + 1/2 dx(N)' Q(N) dx(N)

H(n) are the second derivatives of the Hamiltonian (Eq. 21): of the cost, and of the dynamics times the costate. Here
they are central differences of its exact gradient, for any machine, contacts and stops included. The Riccati sweep
(Eq. 33) eliminates the states and leaves blocks H_uu + B'PB on the diagonal. Elimination keeps the number of negative
eigenvalues (Sylvester's law of inertia), so that of the whole Hessian (N nu, N nu) is the sum over the blocks.
"""

from __future__ import annotations

from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from planner.base.environment import processors
from planner.base.errors import PlannerError
from planner.paper.studies.study import timed
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.solvers import lq
from planner.solvers.multistart import smooth
from planner.solvers.options import SolverOptions
from planner.solvers.slq import solve

SAME_COST_TOLERANCE = 1e-3  # relative; costs that differ by less count as one local minimum
TOLERANCE = 1e-6  # expected reduction of a solve, relative to J; three digits below SAME_COST_TOLERANCE
LAST = 20  # last iterations of a failed solve, whose step lengths are reported


def from_many(problem: Problem, size: float, starts: int, update: str, search: str, limit: int) -> dict[str, Any]:
    """Solve from random controls of an RMS, and record how each solve ends; after `limit` iterations it has failed."""
    options = SolverOptions(
        update=update, line_search=search, max_iterations=limit, expected_reduction_tolerance=TOLERANCE,
        actual_reduction_tolerance=0.0, homotopy=False,
    )  # fmt: skip

    def run(number: int) -> Plan:
        us = size * smooth(np.random.default_rng([0, number]), problem.first_guess.shape)
        return solve(replace(problem, us=us), options)

    pool = ThreadPoolExecutor(processors())
    try:
        plans, took = timed(lambda: list(pool.map(run, range(starts))))
        done = [plan for plan in plans if plan.converged]
        judged = list(pool.map(lambda plan: is_minimum(problem, plan), done))
    finally:
        pool.shutdown(cancel_futures=True)
    failed = [plan for plan in plans if not plan.converged]
    steps = [step for plan in failed if (step := _last_step(plan)) is not None]
    return {
        "update": update, "search": search, "starts": starts, "seconds": took,
        "converged": len(done), "statuses": dict(Counter(plan.status.name for plan in plans)),
        "iterations": [plan.nit for plan in done], "costs": [plan.cost for plan in done],
        "minima": local_minima([plan.cost for plan, good in zip(done, judged, strict=True) if good]),
        "no_minima": sorted(plan.cost for plan, good in zip(done, judged, strict=True) if not good),
        "failed_costs": [plan.cost for plan in failed if np.isfinite(plan.cost)],
        "failed_iterations": [plan.nit for plan in failed],
        "failed_step": float(np.median(steps)) if steps else None,
    }  # fmt: skip


def is_minimum(problem: Problem, plan: Plan) -> bool:
    """Whether the end of a solve is a local minimum to SAME_COST_TOLERANCE."""
    stationary, hessian = minimum_near(problem, plan.us)
    same = SAME_COST_TOLERANCE * abs(plan.cost)
    return hessian.negative == 0 and hessian.expected_reduction <= same and abs(stationary.cost - plan.cost) <= same


def _last_step(plan: Plan) -> float | None:
    """The median of the last step lengths."""
    steps = [line.step for line in plan.history[-LAST - 1 : -1] if line.step > 0.0]
    return float(np.median(steps)) if steps else None


def local_minima(costs: list[float]) -> list[dict[str, float]]:
    """Costs that differ by less than SAME_COST_TOLERANCE, as one, with their number; the lowest first."""
    found: list[dict[str, float]] = []
    for cost in sorted(costs):
        if found and cost - found[-1]["highest"] <= SAME_COST_TOLERANCE * abs(cost):
            found[-1]["count"] += 1
            found[-1]["highest"] = cost
        else:
            found.append({"cost": cost, "highest": cost, "count": 1})
    return [{"cost": one["cost"], "count": one["count"]} for one in found]


STEP = 1e-4  # of the differences, times 1 + |x| or |u|: their error is about 1e-8
ROUNDING = 1e-6  # of the size of a block's terms: smaller negative eigenvalues may be errors of the differences
STATIONARY = 1e-13  # expected reduction, relative to J, at which a point counts as stationary


@dataclass(frozen=True, eq=False)
class Curvature:
    """The Hessian of J at a trajectory."""

    negative: int  # number of its negative eigenvalues
    least: float  # eigenvalue of the blocks, over the size of its block's terms
    direction: np.ndarray | None  # (N, nu) of length one, of negative curvature; None where there is none
    expected_reduction: float  # of J to the minimum of the quadratic; infinite with negative curvature


def curvature(problem: Problem, xs: np.ndarray, us: np.ndarray) -> Curvature:
    """The Hessian of J over the controls at xs (N+1, nx), us (N, nu); states are plain vectors."""
    A, B = problem.dynamics.linearize(xs, us)
    model = problem.cost.quadratize(xs, us)
    H, P = hamiltonian_hessians(problem, xs, us)
    N, ndx, nu = B.shape
    s, K = model.q[N], np.empty((N, nu, ndx))
    negative, least, expected, lowest = 0, np.inf, 0.0, None
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
        expected += 0.5 * float(g @ inverse @ g)
        s = model.q[n] + A[n].T @ s + K[n].T @ g
        P = H[n, :ndx, :ndx] + A[n].T @ P @ A[n] + G_ux.T @ K[n]
        P = 0.5 * (P + P.T)
    if lowest is None:
        return Curvature(0, least, None, expected)
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
    costates = lq.costates(A, problem.cost.quadratize(xs, us))[1:]  # constant while x and u change
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
    """The stationary point next to a solve's end us (N, nu), by at most `most` more iterations, and its Hessian.

    The iterations are Newton's where the dynamics have second derivatives. At the end itself, on a slope beside a
    minimum, the Hessian may still be indefinite.
    """
    tight: dict[str, Any] = {"expected_reduction_tolerance": STATIONARY, "actual_reduction_tolerance": 0.0}
    problem = replace(problem, us=us)
    try:
        plan = solve(problem, hessian="exact", max_iterations=most, **tight)
    except PlannerError:  # dynamics without second derivatives
        plan = solve(problem, max_iterations=most, **tight)
    return plan, curvature(problem, plan.xs, plan.us)
