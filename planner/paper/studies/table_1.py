"""The paper's Table 1 as printed, beside the sweep that is used here, on random LQ problems.

The table inverts I + B R^-1 B' P at every stage (Eq. 31) and gives controls through the costate (Eq. 25, 28, 30); the
sweep factorizes R + B'PB and gives gains. With gradients q, r in place of offsets: u_o = -R^-1 r, -Q x_o = q.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.paper.studies.study import Row, Study, timed
from planner.problem.costs.terms import Quadratic
from planner.solvers import lq

PROBLEMS = 300


def table_one(A: np.ndarray, B: np.ndarray, model: Quadratic) -> tuple[np.ndarray, np.ndarray]:
    """Table 1, line by line, of A (N, ndx, ndx) and B (N, ndx, nu): dxs (N+1, ndx) and dus (N, nu) from dx(0) = 0."""
    N, ndx, nu = B.shape
    P, s = np.empty((N + 1, ndx, ndx)), np.empty((N + 1, ndx))
    M, S, u_o = np.empty((N, ndx, ndx)), np.empty((N, ndx, ndx)), np.empty((N, nu))
    P[N], s[N] = model.Q[N], model.q[N]  # Eq. 29
    for n in reversed(range(N)):
        S[n] = B[n] @ np.linalg.solve(model.R[n], B[n].T)
        u_o[n] = -np.linalg.solve(model.R[n], model.r[n])
        M[n] = np.linalg.inv(np.eye(ndx) + S[n] @ P[n + 1])  # Eq. 31
        forward = A[n].T @ P[n + 1] @ M[n]
        P[n] = model.Q[n] + forward @ A[n]  # Eq. 33
        s[n] = A[n].T @ s[n + 1] - forward @ S[n] @ s[n + 1] + forward @ B[n] @ u_o[n] + model.q[n]  # Eq. 34
    dxs, dus = np.zeros((N + 1, ndx)), np.empty((N, nu))
    for n in range(N):
        v = M[n] @ (B[n] @ u_o[n] - S[n] @ s[n + 1])  # Eq. 32
        dxs[n + 1] = M[n] @ A[n] @ dxs[n] + v  # Eq. 30
        costate = P[n + 1] @ dxs[n + 1] + s[n + 1]  # Eq. 28
        dus[n] = u_o[n] - np.linalg.solve(model.R[n], B[n].T @ costate)  # Eq. 25
    return dxs, dus


def random_lq(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, Quadratic]:
    """A, B and a cost of 1 to 20 stages, 1 to 8 states and 1 to 4 controls, with Q of any rank."""
    N, ndx, nu = (int(rng.integers(1, most + 1)) for most in (20, 8, 4))
    roots = rng.normal(size=(N + 1, ndx, int(rng.integers(1, ndx + 1))))
    controls = rng.normal(size=(N, nu, nu))
    model = Quadratic(
        Q=roots @ roots.swapaxes(1, 2), q=rng.normal(size=(N + 1, ndx)),
        R=controls @ controls.swapaxes(1, 2) + 0.1 * np.eye(nu), r=rng.normal(size=(N, nu)),
    )  # fmt: skip
    return rng.normal(size=(N, ndx, ndx)) / np.sqrt(ndx), rng.normal(size=(N, ndx, nu)), model


def table_results(problems: int = PROBLEMS) -> dict[str, Any]:
    """The largest relative difference between the controls of both, and their times."""
    rng, worst, seconds = np.random.default_rng(0), 0.0, {"table": 0.0, "sweep": 0.0}
    for _ in range(problems):
        A, B, model = random_lq(rng)
        (_, printed), by_table = timed(lambda: table_one(A, B, model))  # noqa: B023
        (_, dus), by_sweep = timed(lambda: lq.direction(A, B, swept(A, B, model)))  # noqa: B023
        seconds = {"table": seconds["table"] + by_table, "sweep": seconds["sweep"] + by_sweep}
        worst = max(worst, float(np.abs(printed - dus).max() / np.abs(dus).max()))
    return {"problems": problems, "difference": worst, "seconds": seconds}


def swept(A: np.ndarray, B: np.ndarray, model: Quadratic) -> lq.Sweep:
    """The Riccati sweep of an LQ problem whose R is positive definite."""
    sweep = lq.riccati(A, B, model)
    assert sweep is not None  # R is positive definite
    return sweep


def _page(results: dict[str, Any]) -> list[str]:
    return [
        "# Table 1 as printed (section 3.2)", "",
        f"Controls of {results['problems']} random LQ problems by Table 1, line by line, and by the sweep of",
        f"`planner/solvers/lq.py`: they differ by at most {results['difference']:.1e} of the largest control.",
    ]  # fmt: skip


def _rows(results: dict[str, Any]) -> list[Row]:
    return [
        Row("3.2, Table 1, Eq. 22-34", "The LQ tracking problem by a Riccati sweep, with M(n) = [I + B R^-1 B' P]^-1",
            f"the same controls to {results['difference']:.1e} on {results['problems']} random problems",
            "it does not differ; M(n) is not formed, since a Cholesky factor of R + B'PB does the same")
    ]  # fmt: skip


STUDY = Study("table", "Table 1 as printed", table_results, _page, _rows)
