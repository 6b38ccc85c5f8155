"""Gradient methods beside SLQ on the same discrete problems (section 3): cost against iterations and against time.

Every method starts from the same first guess, evaluates the same compiled rollouts and derivatives, and has the same
limit of iterations; a method that reaches it counts as not converged.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from planner import cases
from planner.cases.hopper import PAPER
from planner.dynamics.protocol import rollout_states
from planner.paper.methods.gradient_methods import Descended, cost_and_gradient, minimize_by_gradient
from planner.paper.studies.study import Row, Study, row_of, table
from planner.problem.plan import Iteration, Plan
from planner.problem.problem import Problem
from planner.solvers.slq import solve
from planner.view.plots.style import dress, grid_of, save

LIMIT, SHORT = 1000, 200  # iterations, for the documents and otherwise
SHOWN = 160  # points of a curve
DIFFERENCES = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7)  # of controls, in their unit
PROBLEMS: dict[str, Callable[[], Problem]] = {
    "hopper": lambda: cases.build("hopper", height=20.0, **PAPER),
    "two-link": cases.two_link,
    "acrobot": cases.acrobot,
}
# Each method of the figure: a line here is all that another one needs.
SLQ: dict[str, dict[str, Any]] = {
    "SLQ, feedback update": {"update": "feedback"},
    "SLQ, open-loop update": {"update": "open-loop"},
    "SLQ, exact Hessian": {"hessian": "exact"},
}
GRADIENT: dict[str, str] = {"L-BFGS": "l-bfgs", "steepest descent": "steepest-descent"}
COLOURS = ("#0b5aa6", "#c1570a", "#41ab5d", "#7d8590", "#9a6fc9", "#222222")


def gradient_results(problems: Mapping[str, Callable[[], Problem]] = PROBLEMS, limit: int = LIMIT) -> dict[str, Any]:
    """Every method on every problem, with a limit of iterations, as JSON values."""
    found = []
    for name, build in problems.items():
        problem = build()
        methods = {}
        for method, options in SLQ.items():
            solve(problem, max_iterations=1, **options)  # so that nothing is compiled on the clock
            methods[method] = _by_slq(problem, limit, options)
        for method, word in GRADIENT.items():
            minimize_by_gradient(problem, word, max_iterations=1)
            methods[method] = _by_gradient(problem, limit, word)
        found.append({
            "case": name, "N": problem.N, "gradient_error": gradient_error(problem), "methods": methods,
            "growth": growth(problem, solve(problem).us),
        })  # fmt: skip
    return {"limit": limit, "cases": found}


def growth(problem: Problem, us: np.ndarray) -> float:
    """The largest growth of a small change of the start along us (N, nu): the largest norm of A(n) ... A(0)."""
    A, _ = problem.dynamics.linearize(rollout_states(problem.dynamics, problem.x0, us), us)
    flow, most = np.eye(A.shape[1]), 1.0
    for one in A:
        flow = one @ flow
        most = max(most, float(np.linalg.norm(flow, 2)))
    return most


def gradient_error(problem: Problem, directions: int = 5) -> float:
    """The largest relative error of the costate gradient (Eq. 16-19) against differences, in random directions.

    Each direction counts with the difference that fits best: too long ones show the curvature, which on an arm that
    falls is large, and too short ones the rounding of J.
    """
    us, rng = problem.first_guess, np.random.default_rng(0)
    gradient = cost_and_gradient(problem, us)[1]
    worst = 0.0
    for _ in range(directions):
        way = rng.normal(size=us.shape)
        slope, errors = float(np.sum(gradient * way)), []
        for h in DIFFERENCES:
            J = [cost_and_gradient(problem, us + k * h * way)[0] for k in (-2.0, -1.0, 1.0, 2.0)]
            difference = (J[0] - 8.0 * J[1] + 8.0 * J[2] - J[3]) / (12.0 * h)  # of fourth order
            errors.append(abs(difference - slope) / abs(slope))
        worst = max(worst, min(errors))
    return worst


def _by_slq(problem: Problem, limit: int, options: dict[str, Any]) -> dict[str, Any]:
    times = [0.0]
    began = time.perf_counter()

    def note(_: Iteration) -> None:
        times.append(time.perf_counter() - began)

    plan = solve(problem, max_iterations=limit, callback=note, **options)
    seconds = time.perf_counter() - began
    # A line of the history is what was known when the one before it ended.
    points = [(line.iteration, line.cost, at) for line, at in zip(plan.history, times, strict=False)]
    return _entry(plan, seconds, points)


def _by_gradient(problem: Problem, limit: int, word: str) -> dict[str, Any]:
    found = minimize_by_gradient(problem, word, max_iterations=limit)
    points = [(line.iteration, line.cost, line.seconds) for line in found.history]
    return _entry(found, found.history[-1].seconds, points)


def _entry(found: Plan | Descended, seconds: float, points: list[tuple[int, float, float]]) -> dict[str, Any]:
    # As many as can be told apart on a logarithmic axis.
    kept = np.unique(np.r_[0, np.geomspace(1, len(points), SHOWN).astype(int) - 1, len(points) - 1])
    iterations, costs, times = zip(*(points[i] for i in kept), strict=True)
    return {
        "converged": found.success, "status": found.status.name, "iterations": found.nit, "cost": found.cost,
        "gradient_norm": found.gradient_norm, "seconds": seconds,
        "curve": {"iteration": iterations, "cost": costs, "seconds": times},
    }  # fmt: skip


def _page(results: dict[str, Any]) -> list[str]:
    lines = [
        "# Gradient methods beside SLQ (section 3)", "",
        "The same discrete problems, first guesses, rollouts and exact derivatives for all: steepest descent with",
        "Armijo's rule and L-BFGS (SciPy) by the costate gradient of Eq. 16-19, and SLQ with the paper's open-loop",
        "update (Eq. 36), with the feedback update and with exact second derivatives. At most "
        f"{results['limit']} iterations each.", "",
        "![cost against iterations and against time](gradients.png)", "",
    ]  # fmt: skip
    methods = results["cases"][0]["methods"]
    ends = {case["case"]: f"{{{i}[status]}} {{{i}[iterations]}}: {{{i}[cost]:.6g}}"
            for i, case in enumerate(results["cases"])}  # fmt: skip
    lines += [
        "How each ended, its iterations and cost:", "",
        row_of(["method", *ends]), "|---" * (1 + len(ends)) + "|",
        *(row_of([name, *(form.format(*(case["methods"][name] for case in results["cases"]))
                          for form in ends.values())]) for name in methods), "",
    ]  # fmt: skip
    for case in results["cases"]:
        entries = [
            {"method": name, "each": 1e3 * entry["seconds"] / max(entry["iterations"], 1), **entry}
            for name, entry in case["methods"].items()
        ]
        lines += [
            f"## {case['case']}, N = {case['N']}", "",
            *table({
                "method": "{method}", "ended": "{status}", "iterations": "{iterations}", "cost": "{cost:.6g}",
                "norm of the gradient": "{gradient_norm:.1e}", "s": "{seconds:.3g}", "ms an iteration": "{each:.2g}",
            }, entries), "",
            f"Costate gradient against differences: relative error {case['gradient_error']:.1e}. A small change of the",
            f"start grows up to {case['growth']:.0f} times along the plan.", "",
        ]  # fmt: skip
    lines += [
        "NO_DESCENT of L-BFGS at a small gradient is rounding: its line search finds no lower cost any more. Different",
        "final costs of runs that converged are different local minima.",
    ]
    return lines


def _rows(results: dict[str, Any]) -> list[Row]:
    def count(method: str, case: dict[str, Any]) -> str:
        entry = case["methods"][method]
        done = "" if entry["converged"] else f" ({entry['status']})"
        cost, seconds = f"cost {entry['cost']:.4g}", f"{entry['seconds']:.2g} s"
        return f"{case['case']} {cost} after {entry['iterations']} iterations, {seconds}{done}"

    def all_cases(method: str) -> str:
        return f"{method}: " + "; ".join(count(method, case) for case in results["cases"])

    error = max(case["gradient_error"] for case in results["cases"])
    slq, open_loop, exact = SLQ
    return [
        Row("3.1, Eq. 16-19", "The gradient of J comes from the costate recursion",
            f"relative error against differences at most {error:.1e}",
            "it does not differ; what is left is rounding"),
        Row("3.3", "The direction of the LQ problem is not the steepest descent direction",
            ". ".join(map(all_cases, GRADIENT)), "the paper shows no such comparison"),
        Row("3.3, Eq. 36", "U + alpha dU, rolled out without feedback", all_cases(open_loop),
            "it suffices where a small change of the start does not grow much along the motion ("
            + ", ".join(f"{case['case']} {case['growth']:.0f} times" for case in results["cases"])
            + "); on arms that fall only tiny steps lower the cost. Our default rolls out with the gains"),
        Row("3.3, Eq. 37", "The LQ problem has the Hessian of the cost alone (Gauss-Newton)",
            f"with the dynamics' second derivatives too, {all_cases(exact)}",
            "away from a minimum the exact Hessian is indefinite and needs regularization: it pays where "
            "Gauss-Newton is slow, not here (docs/measured.md)"),
        Row("5", '"The algorithm converges quickly to the optimal solution"', all_cases(slq),
            "with the feedback update, to a local minimum; the paper gives neither counts nor times here"),
    ]  # fmt: skip


def _draw(results: dict[str, Any], path: Path) -> None:
    """Cost against iterations (above) and against time (below), one column per problem."""
    from matplotlib.ticker import LogLocator, NullFormatter

    columns = len(results["cases"])
    figure, grid = grid_of(2, columns, 4.4 * columns, 6.4)
    for column, case in enumerate(results["cases"]):
        for row, (key, label) in enumerate((("iteration", "iterations + 1"), ("seconds", "time, s"))):
            axes = grid[row, column]
            title = f"{case['case']}, N = {case['N']}" if row == 0 else ""
            dress(axes, title, "cost J" if column == 0 else "", label)
            for colour, (method, entry) in zip(COLOURS, case["methods"].items(), strict=False):
                curve = entry["curve"]
                # The first guess has no place on a logarithmic axis: one more iteration, or the time of the first.
                x = np.array(curve[key], dtype=float)
                x = x + 1.0 if key == "iteration" else np.maximum(x, x[x > 0.0].min() / 2.0 if np.any(x > 0.0) else 1.0)
                axes.loglog(x, curve["cost"], color=colour, lw=1.4, label=method)
                mark = "o" if entry["converged"] else "x"
                axes.loglog(x[-1:], curve["cost"][-1:], color=colour, marker=mark, ms=5.5, ls="")
            axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axes.yaxis.set_major_formatter("{x:g}")
            axes.yaxis.set_minor_formatter(NullFormatter())
    grid[0, 0].legend(frameon=False, fontsize=8, title="o converged, x not", title_fontsize=8)
    save(figure, path)


STUDY = Study("gradients", "gradient methods beside SLQ",
              partial(gradient_results, limit=SHORT), _page, _rows, {"gradients.png": _draw}, seconds=10,
              full=gradient_results)  # fmt: skip
