"""Quasilinearization and neighbouring extremals (section 3.3), from which the paper tells SLQ apart.

Both linearize the costate equations too and solve a two-point boundary problem. Quasilinearization is Newton's method
on Eq. 10, 16 and 18 with states, controls and costates as unknowns: every iteration solves, by the sweep,

    dx(n+1) = A dx + B du + g,   lambda(n) = q + Q dx + A' lambda(n+1) + W_xx dx + W_ux' du,   0 = r + ... (Eq. 18)

with the defects g and the second derivatives W of lambda' f; it takes full steps. SLQ leaves W out, keeps the dynamics
(g = 0) and searches along a line; with hessian="exact" it has W. At a minimum the gains of a sweep with W are the
neighbouring-optimal feedback of ref. [18]: u = us + K (x - xs) is the optimal control from another start, but for terms
of second order. The gains of Eq. 31, which a plan keeps, leave W out: they stabilize, and are not that feedback.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from planner import cases
from planner.cases.hopper import PAPER
from planner.dynamics import Dynamics
from planner.dynamics.protocol import rollout_states
from planner.paper.studies.study import Row, Study, plan_record, table
from planner.problem.costs.terms import Quadratic
from planner.problem.problem import Problem
from planner.solvers import lq
from planner.solvers.slq import solve
from planner.view.plots.style import HUES, SOFT, dress, panels_of, save

LIMIT = 100  # iterations of quasilinearization
CONVERGED = 1e-8  # of the largest change of a control over the largest control
PROBLEMS: dict[str, Callable[[], Problem]] = {
    **{f"hopper, {h:g} in": lambda h=h: cases.build("hopper", **{**PAPER, "height": h}) for h in (1.0, 20.0, 50.0)},
    "two-link": cases.two_link,
    "acrobot": cases.acrobot,
}
STARTS = tuple(10.0**-k for k in range(1, 5))  # rad and rad/s, how far another start is
DIFFERENCE = 1e-5  # of states and controls, for W


class Linear(NamedTuple):
    """The solution of a linear two-point boundary problem."""

    dxs: np.ndarray  # (N+1, nx)
    dus: np.ndarray  # (N, nu)
    costates: np.ndarray  # (N+1, nx)
    K: np.ndarray  # (N, nu, nx)


def boundary_problem(A: np.ndarray, B: np.ndarray, model: Quadratic, defects: np.ndarray) -> Linear:
    """Eq. 22 to 25 with mixed terms S and defects (N, nx), by the sweep of Eq. 28; the Hessian may be indefinite."""
    N, nx, nu = B.shape
    S = np.zeros((N, nu, nx)) if model.S is None else model.S
    K, k = np.empty((N, nu, nx)), np.empty((N, nu))
    P, s = model.Q.copy(), model.q.copy()
    for n in reversed(range(N)):
        after = s[n + 1] + P[n + 1] @ defects[n]
        H, G = model.R[n] + B[n].T @ P[n + 1] @ B[n], S[n] + B[n].T @ P[n + 1] @ A[n]
        K[n], k[n] = -np.linalg.solve(H, G), -np.linalg.solve(H, model.r[n] + B[n].T @ after)
        P[n] += A[n].T @ P[n + 1] @ A[n] + G.T @ K[n]
        s[n] += A[n].T @ after + G.T @ k[n]
    dxs, dus = np.zeros((N + 1, nx)), np.empty((N, nu))
    for n in range(N):
        dus[n] = k[n] + K[n] @ dxs[n]
        dxs[n + 1] = A[n] @ dxs[n] + B[n] @ dus[n] + defects[n]
    return Linear(dxs, dus, np.einsum("nij,nj->ni", P, dxs) + s, K)


def curvature(dynamics: Dynamics, xs: np.ndarray, us: np.ndarray, costates: np.ndarray) -> np.ndarray:
    """Second derivatives (N, nx + nu, nx + nu) of costates(n+1)' f(x, u), by differences of the Jacobians."""
    nx, h = xs.shape[1], DIFFERENCE

    def gradient(dx: np.ndarray, du: np.ndarray) -> np.ndarray:
        A, B = dynamics.linearize(xs + dx, us + du)
        return np.concatenate([np.einsum("nij,ni->nj", M, costates[1:]) for M in (A, B)], axis=1)

    ways = [(e[:nx], e[nx:]) for e in h * np.eye(nx + us.shape[1])]
    rows = np.stack([(gradient(dx, du) - gradient(-dx, -du)) / (2.0 * h) for dx, du in ways], axis=1)
    return 0.5 * (rows + rows.swapaxes(1, 2))


def with_curvature(model: Quadratic, W: np.ndarray) -> Quadratic:
    """The quadratic cost and the second derivatives of the dynamics."""
    nx = model.Q.shape[1]
    Q = model.Q.copy()
    Q[:-1] += W[:, :nx, :nx]
    return model._replace(Q=Q, R=model.R + W[:, nx:, nx:], S=W[:, nx:, :nx])


def quasilinearize(problem: Problem) -> dict[str, Any]:
    """Newton's method on Eq. 10, 16, 18 from the problem's first guess, with full steps; the size of every one."""
    dynamics, us = problem.dynamics, problem.first_guess.copy()
    xs = rollout_states(dynamics, problem.x0, us)
    A, B = dynamics.linearize(xs, us)
    costates, sizes = lq.costates(A, problem.cost.quadratize(xs, us)), list[float]()
    with np.errstate(all="ignore"):
        while len(sizes) < LIMIT and (not sizes or CONVERGED < sizes[-1] < np.inf):
            A, B = dynamics.linearize(xs, us)
            model = with_curvature(problem.cost.quadratize(xs, us), curvature(dynamics, xs, us, costates))
            defects = dynamics.step(xs[:-1], us) - xs[1:]
            if not (model.finite and np.isfinite(defects).all()):
                sizes.append(np.inf)
                break
            step = boundary_problem(A, B, model, defects)
            xs, us, costates = xs + step.dxs, us + step.dus, step.costates
            size = float(np.abs(step.dus).max() / max(1e-9, np.abs(us).max()))
            sizes.append(size if np.isfinite(size) and np.abs(xs).max() < 1e6 else np.inf)
    converged = sizes[-1] <= CONVERGED
    cost = problem.cost.value(rollout_states(dynamics, problem.x0, us), us) if converged else None
    return {"iterations": len(sizes), "converged": converged, "ran_away": sizes[-1] == np.inf, "cost": cost,
            "sizes": [size if np.isfinite(size) else None for size in sizes]}  # fmt: skip


def neighbours() -> dict[str, Any]:
    """Controls that feedback gives from other starts, against those of the plan that is optimal from there."""
    tight = {"hessian": "exact", "gradient_tolerance": 1e-11, "expected_reduction_tolerance": 0.0}
    problem = cases.two_link()
    plan = solve(problem, **tight)
    dynamics, (A, B) = problem.dynamics, problem.dynamics.linearize(plan.xs, plan.us)
    model, defects = problem.cost.quadratize(plan.xs, plan.us), np.zeros_like(plan.xs[1:])
    whole = with_curvature(model, curvature(dynamics, plan.xs, plan.us, lq.costates(A, model)))
    gains = {"with W": boundary_problem(A, B, whole, defects).K, "without": boundary_problem(A, B, model, defects).K}
    way = np.random.default_rng(0).normal(size=len(problem.x0))
    found = []
    for size in STARTS:
        x0 = problem.x0 + size * way / np.linalg.norm(way)
        best = solve(replace(problem, x0=x0, us=plan.us), **tight)
        record = {"start": size, "change": _rms(best.us - plan.us)}
        for name, K in gains.items():
            x, us = x0, np.empty_like(plan.us)
            for n in range(plan.N):
                us[n] = plan.us[n] + K[n] @ (x - plan.xs[n])
                x = dynamics.step(x[None], us[n][None])[0]
            record[name] = _rms(us - best.us)
        found.append(record)
    kept = {name: _rms(solve(problem, hessian="exact").K - K) / _rms(K) for name, K in gains.items()}
    return {"case": "two-link", "starts": found, "kept": kept}


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _run(problems: Mapping[str, Callable[[], Problem]] = PROBLEMS) -> dict[str, Any]:
    found = []
    for name, build in problems.items():
        problem = build()
        found.append({
            "case": name, "newton": quasilinearize(problem), "exact": plan_record(solve(problem, hessian="exact")),
            "slq": plan_record(solve(problem, max_iterations=2000)),
        })  # fmt: skip
    return {"cases": found, "neighbours": neighbours(), "limit": LIMIT}


def _ended(newton: dict[str, Any]) -> str:
    if newton["converged"]:
        return f"{newton['iterations']} iterations, J {newton['cost']:.6g}"
    return f"ran away after {newton['iterations']}" if newton["ran_away"] else f"not within {newton['iterations']}"


def _orders(results: dict[str, Any]) -> dict[str, float]:
    starts = results["neighbours"]["starts"]
    first, last = starts[1], starts[-1]
    decades = np.log10(first["start"] / last["start"])
    return {name: float(np.log10(first[name] / last[name]) / decades) for name in ("with W", "without")}


def _page(results: dict[str, Any]) -> list[str]:
    orders, kept = _orders(results), results["neighbours"]["kept"]
    return [
        "## Quasilinearization and neighbouring extremals (section 3.3)", "",
        "Quasilinearization: Newton's method on states, controls and costates, full steps, from the rollout of SLQ's",
        "first guess. SLQ with exact Hessians has the same second derivatives, a rollout and a line search.", "",
        *table({
            "problem": "{case}", "quasilinearization": "{ended}",
            "SLQ, exact Hessian": "{exact[iterations]} iterations", "J": "{exact[cost]:.6g}",
            "SLQ": "{slq[iterations]} iterations", "its J": "{slq[cost]:.6g}",
        }, ({**one, "ended": _ended(one["newton"])} for one in results["cases"])), "",
        "Neighbouring extremals: from another start, the gains of the sweep at the two-link plan, with and without",
        "the second derivatives W of the dynamics, against the plan solved again from there (RMS, N m). The errors",
        f"fall with order {orders['with W']:.2f} and {orders['without']:.2f}. A plan keeps the gains without W, those",
        f"of Eq. 31, also with `hessian=\"exact\"` (relative difference {kept['without']:.0e}; to those with W "
        f"{kept['with W']:.2f}).", "",
        "![steps of quasilinearization, and errors of feedback](extremals.png)", "",
        *table({"start off by": "{start:g}", "optimal controls change by": "{change:.1e}", "gains with W: error":
                "{with W:.1e}", "gains without W: error": "{without:.1e}"}, results["neighbours"]["starts"]),
    ]  # fmt: skip


def _rows(results: dict[str, Any]) -> list[Row]:
    orders, found, last = _orders(results), results["cases"], results["neighbours"]["starts"][-1]
    return [
        Row("3.3, [3]", "Quasilinearization linearizes the adjoint equations too (no example)",
            "; ".join(f"{one['case']}: {_ended(one['newton'])}, SLQ {one['slq']['iterations']}" for one in found),
            "full Newton steps on states and costates: quick near a solution, no descent far from one, and to any "
            "stationary point"),
        Row("3.3, [18]", "Neighbouring extremals do so too (no example)",
            f"gains with the dynamics' second derivatives are that feedback: from another start their controls are off "
            f"by order {orders['with W']:.2f}; the gains of Eq. 31, which a plan keeps, by order "
            f"{orders['without']:.2f}: {last['without'] / last['change']:.0%} of the change",
            "two-link arm; the paper's LQ problem leaves the second derivatives out, and its gains still stabilize"),
    ]  # fmt: skip


def _draw(results: dict[str, Any], path: Path) -> None:
    """Size of the steps of quasilinearization by iteration, and errors of feedback by the distance of the start."""
    figure, (steps, errors) = panels_of(2)
    dress(steps, "Quasilinearization, full steps", "largest change of a control, relative", "iteration")
    for hue, one in zip(HUES, results["cases"], strict=False):
        sizes = [np.nan if size is None else size for size in one["newton"]["sizes"]]
        steps.semilogy(
            1 + np.arange(len(sizes)), np.clip(sizes, 1e-13, 1e6), marker=".", color=hue[1], label=one["case"]
        )
    steps.axhline(CONVERGED, color=SOFT, lw=0.8, ls=":")
    dress(errors, "Feedback from another start, two-link arm", "RMS of controls, N m", "start off by")
    starts = results["neighbours"]["starts"]
    labels = {"change": "change of the optimal controls", "without": "error of gains without W",
              "with W": "error of gains with W"}  # fmt: skip
    for hue, (key, label) in zip(HUES, labels.items(), strict=False):
        errors.loglog(*([one[k] for one in starts] for k in ("start", key)), "o-", ms=4, color=hue[1], label=label)
    for axes in (steps, errors):
        axes.legend(frameon=False, fontsize=8)
    save(figure, path)


STUDY = Study("extremals", "quasilinearization and neighbouring extremals (3.3)",
              _run, _page, _rows, {"extremals.png": _draw}, seconds=10)  # fmt: skip
