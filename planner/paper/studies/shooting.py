"""Indirect shooting on the two-link arm (section 2.1), and why it fails: how the end of a flow depends on its start.

The paper: "because the costate equations are not stable and highly sensitive to the initial conditions, the shooting
method failed when applied to this problem". Here scipy's root finder starts from several costates, the last of them
that of SLQ's optimum; and the same from zero on shorter horizons.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from planner.cases.two_link import two_link
from planner.paper.methods.shooting import HamiltonianFlow, shoot
from planner.paper.studies.study import Row, Study, table, timed
from planner.problem.plan import Plan
from planner.solvers.lq import costates
from planner.solvers.slq import solve
from planner.view.plots.style import HUES, RED, dress, panels_of, save

DURATION = 2.0  # s, section 2.1
HORIZONS = (0.1, 0.25, 0.5, 1.0, 2.0)  # s
FROM_ZERO = (0.1, 0.25, 0.5)  # those of them on which shooting starts from zero
TIMES = np.linspace(0.05, DURATION, 40)  # s, along the optimum of 2 s
MAX_FLOWS, FEW_FLOWS = 60, 25  # a root that takes more is not found: for the documents, and otherwise
TOLERANCE = 1e-9  # of the flows whose differences are taken
LOOSER = 1e-7  # of those of the root finder


def optimal_costate(plan: Plan) -> np.ndarray:
    """lambda(0), (nx,), of a plan by the discrete costate equation (Eq. 16, 17)."""
    problem = plan.problem
    assert problem is not None  # it was solved here
    A, _ = problem.dynamics.linearize(plan.xs, plan.us)
    return costates(A, problem.cost.quadratize(plan.xs, plan.us))[0]


def shooting_jacobian(flow: HamiltonianFlow, sensitivity: np.ndarray) -> np.ndarray:
    """The miss by lambda(0), (nx, nx), of a sensitivity (2 nx, nx) of the end: what the root finder has to invert."""
    by_x, by_costate = np.split(sensitivity, 2)
    zero = flow.system.final(np.zeros(len(by_x)), flow.system.u_ref)[1]
    weights = [flow.system.final(e, flow.system.u_ref)[1] - zero for e in np.eye(len(by_x))]
    return by_costate - np.array(weights).T @ by_x


def _tried(duration: float, name: str, guess: np.ndarray, optimum: np.ndarray, most: int) -> dict[str, Any]:
    problem = two_link(duration=duration)
    found, seconds = timed(lambda: shoot(problem, guess, max_evaluations=most, tolerance=LOOSER))
    return {
        "duration": duration, "guess": name, "success": found.success,
        "relative_residual": found.residual / found.scale,
        "flows": found.evaluations, "message": found.message, "seconds": seconds,
        "costate0": found.costate0.tolist(), "distance_of_guess": float(np.linalg.norm(guess - optimum)),
    }  # fmt: skip


def _horizon(duration: float) -> dict[str, Any]:
    """Sensitivity of a horizon's own optimum."""
    plan = solve(two_link(duration=duration))
    flow, start = HamiltonianFlow(two_link(duration=duration), TOLERANCE), optimal_costate(plan)
    sensitivity = flow.sensitivity(start, np.array([duration]))[0]
    jacobian = shooting_jacobian(flow, sensitivity)
    return {
        "duration": duration, "cost": plan.cost, "costate0": start.tolist(),
        "norm": float(np.linalg.norm(sensitivity[len(start) :], 2)),
        "condition": float(np.linalg.cond(sensitivity[len(start) :])),
        "jacobian_norm": float(np.linalg.norm(jacobian, 2)), "jacobian_condition": float(np.linalg.cond(jacobian)),
    }  # fmt: skip


def _run(most: int = MAX_FLOWS) -> dict[str, Any]:
    problem = two_link(duration=DURATION)
    plan = solve(problem)
    optimum = optimal_costate(plan)
    rng = np.random.default_rng(0)
    guesses = {
        "zero": np.zeros(4), "small random": 0.1 * rng.normal(size=4), "SLQ's costate and 1 % of it": 1.01 * optimum,
        "SLQ's costate": optimum,
    }  # fmt: skip
    flow = HamiltonianFlow(problem, TOLERANCE)
    along = flow.sensitivity(optimum, TIMES)
    return {
        "optimum": optimum.tolist(), "slq": {"cost": plan.cost, "iterations": plan.nit},
        "attempts": [_tried(DURATION, name, guess, optimum, most) for name, guess in guesses.items()],
        "horizons": [_horizon(duration) for duration in HORIZONS],
        "from_zero": [
            _tried(T, "zero", np.zeros(4), optimal_costate(solve(two_link(duration=T))), MAX_FLOWS) for T in FROM_ZERO
        ],
        "limit": most,
        "t": TIMES.tolist(), "norm": [float(np.linalg.norm(S[4:], 2)) for S in along],
        "condition": [float(np.linalg.cond(S[4:])) for S in along],
    }  # fmt: skip


def _page(results: dict[str, Any]) -> list[str]:
    attempts = [a | {"found": "yes" if a["success"] else "no"} for a in (*results["attempts"], *results["from_zero"])]
    return [
        "## Indirect shooting (section 2.1)", "",
        "Two-link arm, x and lambda integrated forward with H_u = 0 (Eq. 3, 4), lambda(0) by `scipy.optimize.root`;",
        f"found means that lambda(t_f) is phi_x to 1e-6 of it. At most {results['limit']} flows on 2 s, {MAX_FLOWS} on",
        "shorter horizons.", "",
        "![sensitivity of the final costate](shooting_sensitivity.png)", "",
        *table({
            "t_f, s": "{duration:g}", "first guess of lambda(0)": "{guess}",
            "off the optimum by": "{distance_of_guess:.3g}", "found": "{found}",
            "relative residual": "{relative_residual:.1e}", "flows": "{flows}", "s": "{seconds:.1f}",
        }, attempts), "",
        "The final costate by the initial one, at each horizon's own optimum; the last columns are of the whole miss,",
        "lambda(t_f) - phi_x(x(t_f)), which is what has to become zero:", "",
        *table({
            "t_f, s": "{duration:g}", "norm of d lambda(t_f) / d lambda(0)": "{norm:.3g}",
            "condition": "{condition:.2g}",
            "norm of d miss / d lambda(0)": "{jacobian_norm:.3g}", "condition of it": "{jacobian_condition:.2g}",
        }, results["horizons"]), "", _conclusion(results), "",
    ]  # fmt: skip


def _conclusion(results: dict[str, Any]) -> str:
    found = [a["guess"] for a in results["attempts"] if a["success"]]
    missed = [a["guess"] for a in results["attempts"] if not a["success"]]
    short = [f"{a['duration']:g}" for a in results["from_zero"] if a["success"]]
    worst = max(results["condition"])
    first, last = results["horizons"][0], results["horizons"][-1]
    return (
        f"On 2 s it fails from {', '.join(missed) or 'none'} and works from {', '.join(found) or 'none'}; from zero "
        f"it works for t_f = {', '.join(short) or 'none'} s. A change of lambda(0) grows {results['norm'][-1]:.0f} "
        f"times in 2 s, and the miss changes by {last['jacobian_norm']:.1e} times as much "
        f"({first['jacobian_norm']:.1e} times in {first['duration']:g} s). Condition numbers reach {worst:.0e} on the "
        "way. The flow is still accurate enough. Shooting fails because a root finder converges only from a small "
        "region about the solution."
    )


def _rows(results: dict[str, Any]) -> list[Row]:
    found = [a["guess"] for a in results["attempts"] if a["success"]]
    return [
        Row("2.1", "Indirect shooting on the fully actuated arm failed",
            f"fails from {len(results['attempts']) - len(found)} of {len(results['attempts'])} guesses "
            f"({sum(a['seconds'] for a in results['attempts']):.0f} s), works from {', '.join(found) or 'none'}",
            _conclusion(results)),
        Row("2.1", "The costate equations are highly sensitive to the initial conditions (no number)",
            f"norm {results['norm'][-1]:.2g} and condition {results['condition'][-1]:.1e} after 2 s, "
            f"condition up to {max(results['condition']):.0e}",
            "the flow preserves volume: what it contracts in one direction it stretches in another"),
    ]  # fmt: skip


def _draw(results: dict[str, Any], path: Path) -> None:
    """Sensitivity of the final costate to the initial one, along one optimum and by horizon."""
    figure, (along, horizons) = panels_of(2)
    dress(along, "Along the optimum of 2 s: d lambda(t) / d lambda(0)", "condition, norm", "time, s")
    along.semilogy(results["t"], results["condition"], label="condition number")
    along.semilogy(results["t"], results["norm"], label="norm")
    along.legend(frameon=False, fontsize=8)
    dress(horizons, "Each horizon's own optimum", "condition, norm", "horizon, s")
    durations = [h["duration"] for h in results["horizons"]]
    for name, label in (
        ("jacobian_condition", "condition of d miss / d lambda(0)"),
        ("condition", "condition of d lambda(t_f) / d lambda(0)"),
        ("jacobian_norm", "norm of d miss / d lambda(0)"),
    ):  # fmt: skip
        horizons.semilogy(durations, [h[name] for h in results["horizons"]], marker="o", ms=4, label=label)
    for a in results["from_zero"]:
        marker, colour = ("o", HUES[2][1]) if a["success"] else ("x", RED)
        horizons.plot(a["duration"], 1.0, ls="", ms=8, marker=marker, color=colour)
    horizons.text(
        durations[-1], 1.0, "shooting from zero: circle found, cross not", ha="right", va="center", fontsize=7.5
    )
    horizons.legend(frameon=False, fontsize=8, loc="center right", bbox_to_anchor=(1.0, 0.3))
    save(figure, path)


STUDY = Study("shooting", "indirect shooting, and why it fails (2.1)",
              partial(_run, FEW_FLOWS), _page, _rows, {"shooting_sensitivity.png": _draw}, seconds=12,
              full=_run)  # fmt: skip
