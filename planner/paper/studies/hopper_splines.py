"""The hopper by B-splines and BFGS (section 2.4), which the paper could not make converge.

The problem is the paper's discretized one (semi-implicit Euler, N = 50; see cases.hopper.PAPER). Once with the exact
gradient of that very sum by the discrete costate (Eq. 16-19), once as in sections 2.2 and 2.3: J integrated
adaptively and its gradient by Eq. 7. Both from controls of zero; SLQ beside them.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from planner.cases.hopper import PAPER, hopper
from planner.paper.methods.adjoint import AdjointCost, ContinuousProblem, Integration
from planner.paper.methods.spline_inputs import SplineControls, SplineCost, solve_by_splines
from planner.paper.methods.splines import DEGREE, SplineSpace
from planner.paper.studies.study import (
    Row,
    Study,
    descent_record,
    draw_errors,
    errors_at,
    errors_table,
    plan_record,
    table,
    timed,
)
from planner.problem.problem import Problem
from planner.solvers.slq import solve
from planner.view.plots.style import INK, dress, panels_of, save

HEIGHTS = (1.0, 10.0, 20.0, 50.0)  # in
COEFFICIENTS = (8, 17, 32)  # of the quintic splines; 17 are those of section 2.1
DRAWN = (20.0, 17)  # height and coefficients of the curves
# height and tolerance of the paper's own way
ADJOINT: tuple[tuple[float, float], ...] = ((1.0, 1e-3), (20.0, 1e-3), (20.0, 1e-6), (50.0, 1e-3))
ADJOINT_ITERATIONS = 25
SHORT: dict[str, Any] = {"most": 8, "tried": ADJOINT[1:3], "heights": (1.0, 20.0, 50.0)}  # not for the documents
TOLERANCES = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-8)
REFERENCE = 1e-11
FLAT = 0.02  # of J: by less it hardly falls in an iteration
REACHED = 0.01  # of SLQ's cost: a minimum among splines may lie so much above it, or anywhere below


def _problem(height: float) -> Problem:
    return hopper(height=height, **PAPER)  # type: ignore[arg-type]


def _space(coefficients: int) -> SplineSpace:
    return SplineSpace(coefficients - DEGREE)


def hessian(problem: Problem, coefficients: int, amplitudes: np.ndarray) -> np.ndarray:
    """Second derivatives (n, n) of J by the amplitudes (n, 1), by central differences of the exact gradient."""
    cost, P = SplineCost(problem, _space(coefficients).basis(problem.duration)), amplitudes.ravel()
    h = 1e-5 * max(1.0, float(np.abs(P).max()))
    rows = [(cost(P + h * e)[1] - cost(P - h * e)[1]) / (2.0 * h) for e in np.eye(len(P))]
    cost.close()
    return 0.5 * (np.array(rows) + np.array(rows).T)


def _exact(height: float, coefficients: int) -> tuple[dict[str, Any], SplineControls]:
    problem = _problem(height)
    found, seconds = timed(lambda: solve_by_splines(problem, coefficients=coefficients))
    eigenvalues = np.linalg.eigvalsh(hessian(problem, coefficients, found.spline.c))
    return {
        "height": height, "coefficients": coefficients, **_record(found, seconds),
        "largest_eigenvalue": float(eigenvalues[-1]), "smallest_eigenvalue": float(eigenvalues[0]),
        "condition": float(eigenvalues[-1] / eigenvalues[0]) if eigenvalues[0] > 0.0 else None,
    }, found  # fmt: skip


def _record(found: SplineControls, seconds: float) -> dict[str, Any]:
    return {**descent_record(found), "discrete_cost": found.discrete_cost, "seconds": seconds}


def _adjoint(height: float, tolerance: float, most: int) -> dict[str, Any]:
    found, seconds = timed(lambda: solve_by_splines(
        _problem(height), coefficients=DRAWN[1], gradient="continuous", tolerance=tolerance,
        max_iterations=most,
    ))  # fmt: skip
    return {"height": height, "tolerance": tolerance, "costs": found.costs.tolist(), **_record(found, seconds)}


def _gradient_errors(amplitudes: np.ndarray) -> list[dict[str, Any]]:
    """Errors of the gradient of Eq. 7 by tolerance, at zero controls and along the hop of the exact gradient."""
    problem = _problem(DRAWN[0])
    basis, system = _space(DRAWN[1]).basis(problem.duration), ContinuousProblem(problem)

    def at(P: np.ndarray, tolerance: float) -> tuple[float, np.ndarray]:
        return AdjointCost(system, basis, problem.x0, Integration(tolerance))(P)

    return [
        errors_at(name, at(P, REFERENCE), [at(P, tolerance) for tolerance in TOLERANCES])
        for name, P in (("no control", 0.0 * amplitudes), ("the hop found", amplitudes))
    ]


def _run(
    most: int = ADJOINT_ITERATIONS, tried: tuple[tuple[float, float], ...] = ADJOINT,
    heights: tuple[float, ...] = HEIGHTS,
) -> dict[str, Any]:  # fmt: skip
    plans, exact, curve, drawn = [], [], [], np.zeros((DRAWN[1], 1))
    for height in heights:
        plan = solve(_problem(height), update="open-loop", max_iterations=2000)
        plans.append({"height": height, **plan_record(plan), "costs": [line.cost for line in plan.history]})
        for coefficients in COEFFICIENTS:
            row, found = _exact(height, coefficients)
            exact.append(row)
            if (height, coefficients) == DRAWN:
                curve, drawn = found.costs.tolist(), found.spline.c
    return {
        "slq": plans, "exact": exact, "adjoint": [_adjoint(*case, most) for case in tried], "curve": curve,
        "limit": most, "drawn": list(DRAWN), "tolerances": list(TOLERANCES), "gradient_errors": _gradient_errors(drawn),
        "reference": REFERENCE,
    }  # fmt: skip


def _slq_cost(results: dict[str, Any], height: float) -> float:
    return next(p["cost"] for p in results["slq"] if p["height"] == height)


def _page(results: dict[str, Any]) -> list[str]:
    exact = [
        {
            **r, "slq": _slq_cost(results, r["height"]), "ended": "yes" if r["success"] else r["message"],
            "conditioned": "indefinite" if r["condition"] is None else f"{r['condition']:.0e}",
        }
        for r in results["exact"]
    ]  # fmt: skip
    return [
        "## The hopper by B-splines (section 2.4)", "",
        "The paper's problem (semi-implicit Euler, N = 50, q_fin = 1000), u(t) a quintic B-spline, from zero,",
        "by BFGS.", "",
        "![cost by iteration, error of the gradient](hopper_splines.png)", "",
        f"As in 2.2 and 2.3: J by an adaptive rule, its gradient by Eq. 7, {results['drawn'][1]} coefficients, at most",
        f"{results['limit']} iterations. J is then an integral, not SLQ's sum; the last column is that sum.", "",
        *table({
            "height, in": "{height:g}", "tolerance": "{tolerance:g}", "J from": "{costs[0]:.4g}", "J to": "{cost:.4g}",
            "iterations": "{iterations}", "evaluations": "{evaluations}", "BFGS says": "{message}",
            "s": "{seconds:.1f}", "the sum": "{discrete_cost:.4g}",
        }, results["adjoint"]), "",
        "With the exact gradient of the discretized J (Eq. 16-19 times the basis functions):", "",
        *table({
            "height, in": "{height:g}", "coefficients": "{coefficients}", "J": "{cost:.1f}", "J of SLQ": "{slq:.1f}",
            "iterations": "{iterations}", "converged": "{ended}", "condition of the Hessian": "{conditioned}",
            "s": "{seconds:.2f}",
        }, exact), "",
        f"Relative error of Eq. 7 at height {results['drawn'][0]:g} against one at {results['reference']:g}:", "",
        *errors_table(results["gradient_errors"], results["tolerances"]), "", _conclusion(results), "",
    ]  # fmt: skip


def _plateau(results: dict[str, Any], stuck: list[dict[str, Any]]) -> str:
    """What the descents by Eq. 7 that do not converge have in common; nothing where J still falls at their ends."""
    if any(r["costs"][-2] > (1.0 + FLAT) * r["costs"][-1] for r in stuck):
        return "J still falls there. With --full they go on to a plateau."
    worst = results["gradient_errors"][-1]["relative_errors"]
    return (
        "With tight and loose tolerances they come to the same plateau, where J hardly falls any more. "
        f"The exact gradient leaves such a plateau after tens of iterations; a gradient that is off by {worst[1]:.0e} "
        f"(at {results['tolerances'][1]:g}) does not. We did not try whether a tight tolerance leaves it after "
        "hundreds of iterations: that takes minutes."
    )


def _conclusion(results: dict[str, Any]) -> str:
    exact, adjoint = results["exact"], results["adjoint"]
    converged, stuck = [r for r in exact if r["success"]], [r for r in adjoint if not r["success"]]
    conditions = [r["condition"] for r in exact if r["condition"] is not None]
    near = [r for r in exact if r["cost"] < (1.0 + REACHED) * _slq_cost(results, r["height"])]
    counts = [r["iterations"] for r in exact]
    lost = [r for r in stuck if "precision loss" in r["message"]]
    return (
        f"With the exact gradient {len(converged)} of {len(exact)} converge, in {min(counts)} to {max(counts)} "
        f"iterations; SLQ needs {min(p['iterations'] for p in results['slq'])} to "
        f"{max(p['iterations'] for p in results['slq'])}. {len(near)} of them end within {100 * REACHED:g} % of SLQ's "
        "cost or below it. They are slow because the Hessian by the amplitudes has a condition of "
        f"{min(conditions):.0e} to {max(conditions):.0e}. By Eq. 7 {len(stuck)} of {len(adjoint)} do not converge: "
        f"{len(lost)} end in a line search that finds no step, the others at our limit of {results['limit']} "
        f"iterations. {_plateau(results, stuck)}"
    )


def _rows(results: dict[str, Any]) -> list[Row]:
    exact, adjoint = results["exact"], results["adjoint"]
    return [
        Row("2.4", "The hopper by B-splines and Eq. 7 would not converge, with much tweaking",
            "; ".join(f"height {r['height']:g} at {r['tolerance']:g}: J {r['costs'][0]:.3g} to {r['cost']:.3g}, "
                      f"{'converged' if r['success'] else 'not converged'}" for r in adjoint)
            + f" ({sum(r['seconds'] for r in adjoint):.0f} s)",
            _conclusion(results)),
        Row("2.4", "The same splines with the exact gradient of the discretized cost: not tried",
            f"{sum(r['success'] for r in exact)} of {len(exact)} converge, in {min(r['iterations'] for r in exact)} "
            f"to {max(r['iterations'] for r in exact)} iterations ({sum(r['seconds'] for r in exact):.0f} s)",
            "J and gradient agree to rounding; the basis alone was not what failed"),
    ]  # fmt: skip


def _draw(results: dict[str, Any], path: Path) -> None:
    """Cost by iteration for both gradients and SLQ, and the error of Eq. 7 against tolerance."""
    figure, (costs, errors) = panels_of(2)
    height, coefficients = results["drawn"]
    dress(costs, f"Hop to {height:g} in, {coefficients} coefficients", "cost J", "iteration, counted from 1")
    plan = next(p for p in results["slq"] if p["height"] == height)
    costs.loglog(1 + np.arange(len(plan["costs"])), plan["costs"], color=INK, label="SLQ")
    costs.loglog(1 + np.arange(len(results["curve"])), results["curve"], label="splines, exact gradient of the sum")
    adjoint = [r for r in results["adjoint"] if r["height"] == height]
    for width, r in zip((4.0, 1.2), adjoint, strict=False):  # they lie on each other
        label = f"splines, Eq. 7 at {r['tolerance']:g} (not converged)" if not r["success"] else "splines, Eq. 7"
        costs.loglog(1 + np.arange(len(r["costs"])), r["costs"], marker=".", ms=4, lw=width, label=label)
    costs.legend(frameon=False, fontsize=8)
    title = "Gradient of Eq. 7 with touchdowns on the way"
    draw_errors(errors, title, results["gradient_errors"], results["tolerances"])
    errors.legend(frameon=False, fontsize=8)
    save(figure, path)


STUDY = Study("hopper-splines", "the hopper by B-splines (2.4)",
              partial(_run, **SHORT), _page, _rows, {"hopper_splines.png": _draw}, seconds=15,
              full=_run)  # fmt: skip
