"""The paper's two theorems in numbers: descent (Eq. 39-42) as an identity, convergence (Theorem 2) from many starts.

Theorem 1 says more than that the direction descends; its proof ends in an identity,

    grad J . dU = - sum of dx' Q dx + du' R du - dx(N)' Q(N) dx(N)          Eq. 42

and the sweep has a third expression of the same number, its slope. All three are compared here: on random problems
those of the NumPy sweep, along solves those of the compiled one.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from planner import cases
from planner.cases.hopper import PAPER
from planner.paper.studies.records import table
from planner.paper.studies.study import Row, Study, timed
from planner.paper.studies.table_1 import random_lq, swept
from planner.paper.studies.watched import Sweep, watched
from planner.problem.costs.terms import Quadratic
from planner.problem.plan import Status
from planner.problem.problem import Problem
from planner.solvers import lq
from planner.solvers.multistart import smooth
from planner.solvers.slq import solve
from planner.view.plots.style import RED, SOFT, dress, grid_of, save

RANDOM = 300  # LQ problems
STARTS = 200  # per case, the number
FEW = 20  # starts of the paper's update on the arms, where it stalls at many times the price
SAME = 1e-3  # costs that differ by less, relatively, count as one local minimum
TOLERANCE = 1e-6  # of a solve: the decrease promised, relative to J; three digits below SAME
LAST = 20  # iterations of a solve that failed, whose steps say why


@dataclass(frozen=True)
class Family:
    """A case and its random starts."""

    build: Callable[[], Problem]  # the problem that is solved from many starts
    size: float  # RMS of the random controls, in their unit
    limit: int  # iterations after which a start counts as not converged
    open_loop: tuple[int, int]  # starts with the paper's own update, Eq. 43, and their limit
    along: Callable[[], Problem] | None = None  # the problem along whose solve Eq. 42 is computed; by default build
    most: int = STARTS  # with the feedback update, where they take long


# Arms at 50 stages a second, where 200 solves take seconds. 1 N m is a tenth of what holds the arm out horizontally;
# with 3 most starts whirl through several turns, and end far from everything. 10 in/s moves the piston by inches.
# The human step is its swing: accelerations of the pelvis of the size of their tolerance.
FAMILIES: dict[str, Family] = {
    "hopper": Family(lambda: cases.build("hopper", height=20.0, **PAPER), 10.0, 500, (STARTS, 500)),
    "two-link": Family(lambda: cases.two_link(horizon=100), 1.0, 300, (FEW, 100), cases.two_link),
    "acrobot": Family(lambda: cases.acrobot(horizon=150), 1.0, 600, (FEW, 100), cases.acrobot),
    "human-step": Family(lambda: cases.human_step("swing", cost="study"), 5.0, 300, (FEW, 300), most=50),
}


def theorem_results(
    families: Mapping[str, Family] = FAMILIES, starts: int = STARTS, problems: int = RANDOM
) -> dict[str, Any]:
    """Both theorems in numbers: `starts` of each family with the feedback update, `problems` random LQ problems."""
    found = []
    for name, family in families.items():
        problem = family.build()
        few, limit = family.open_loop
        found.append({
            "case": name, "N": problem.N, "size": family.size,
            "along": _along(family.along() if family.along else problem),
            "feedback": _from_many(problem, family.size, min(starts, family.most), family.limit, "feedback"),
            "open-loop": _from_many(problem, family.size, min(few, starts), limit, "open-loop"),
        })  # fmt: skip
    return {"random": random_identity(problems), "problems": problems, "starts": starts, "cases": found}


def identity_errors(A: np.ndarray, B: np.ndarray, model: Quadratic, step: Sweep) -> tuple[float, float, float]:
    """Eq. 42 for one LQ problem: its right side, and the relative errors of grad . dU and of the sweep's slope.

    The step is the sweep's result for A (N, ndx, ndx), B (N, ndx, nu); its regularisation counts as part of R.
    """
    ndx, nu = B.shape[1:]
    sweep = lq.Sweep(step.K, step.k, np.empty((0, ndx, ndx)), np.empty((0, ndx)), step.slope, 0.5 * step.slope)
    dxs, dus = lq.direction(A, B, sweep)
    R = model.R + step.regularisation * np.eye(nu)
    right = -float(np.einsum("ni,nij,nj->", dxs, model.Q, dxs) + np.einsum("ni,nij,nj->", dus, R, dus))
    left = float(np.sum(step.gradient * dus))  # Eq. 39
    scale = abs(right) or 1.0
    return right, abs(left - right) / scale, abs(step.slope - right) / scale  # Eq. 42


def random_identity(problems: int, seed: int = 0) -> dict[str, Any]:
    """Eq. 42 on random LQ problems (see random_lq)."""
    rng = np.random.default_rng(seed)
    errors = []
    for _ in range(problems):
        A, B, model = random_lq(rng)
        sweep = swept(A, B, model)
        empty = np.empty((0, 0))
        step = Sweep(empty, empty, lq.gradient(A, B, model), sweep.K, sweep.k, sweep.slope, 0.0)
        errors.append(identity_errors(A, B, model, step))
    return _summary(errors)


def _along(problem: Problem) -> dict[str, Any]:
    """Eq. 42 at every iterate that took a step, of a solve from the problem's own first guess."""
    plan, steps = watched(problem)
    errors = []
    for step in steps:
        A, B = problem.dynamics.linearize(step.xs, step.us)
        errors.append(identity_errors(A, B, problem.cost.quadratize(step.xs, step.us), step))
    falls = [line.actual > 0.0 for line in plan.history if line.step > 0.0]
    return _summary(errors) | {
        "N": problem.N, "status": plan.status.name, "iterates": len(errors), "steps": len(falls), "falls": sum(falls),
        "slopes": [right for right, _, _ in errors], "errors": [error for _, error, _ in errors],
    }  # fmt: skip


def _summary(errors: list[tuple[float, float, float]]) -> dict[str, Any]:
    return {
        "largest_slope": max(right for right, _, _ in errors), "gradient_error": max(error for _, error, _ in errors),
        "sweep_error": max(error for _, _, error in errors),
    }  # fmt: skip


def _from_many(problem: Problem, size: float, starts: int, limit: int, update: str) -> dict[str, Any]:
    """Solve from random controls, and record how each solve ends."""

    def run(number: int) -> tuple[str, int, float, float]:  # the last is the median of the last steps
        us = size * smooth(np.random.default_rng([0, number]), problem.first_guess.shape)
        options = {"max_iterations": limit, "decrease_tolerance": TOLERANCE, "gain_tolerance": 0.0}
        plan = solve(replace(problem, us=us), update=update, **options)
        steps = [line.step for line in plan.history[-LAST - 1 : -1] if line.step > 0.0]
        return plan.status.name, plan.nit, plan.cost, float(np.median(steps)) if steps else 0.0

    pool = ThreadPoolExecutor(os.cpu_count())
    try:
        ends, seconds = timed(lambda: list(pool.map(run, range(starts))))
    finally:
        pool.shutdown(cancel_futures=True)
    done = [end for end in ends if end[0] == Status.CONVERGED.name]
    failed = [end for end in ends if end[0] != Status.CONVERGED.name]
    return {
        "starts": starts, "limit": limit, "seconds": seconds,
        "converged": len(done), "statuses": dict(Counter(end[0] for end in ends)),
        "iterations": [end[1] for end in done], "costs": [end[2] for end in done],
        "minima": local_minima([end[2] for end in done]),
        "failed_costs": [end[2] for end in failed if np.isfinite(end[2])],
        "failed_step": float(np.median([end[3] for end in failed])) if failed else None,
    }  # fmt: skip


def local_minima(costs: list[float]) -> list[dict[str, float]]:
    """Costs that differ by less than SAME of themselves, as one; how many ended there, the lowest first."""
    found: list[dict[str, float]] = []
    for cost in sorted(costs):
        if found and cost - found[-1]["highest"] <= SAME * abs(cost):
            found[-1]["count"] += 1
            found[-1]["highest"] = cost
        else:
            found.append({"cost": cost, "highest": cost, "count": 1})
    return [{"cost": one["cost"], "count": one["count"]} for one in found]


def _few(values: list[int]) -> str:
    """Least, median and most."""
    return f"{min(values)} / {np.median(values):.0f} / {max(values)}" if values else "none"


def _minima(entry: dict[str, Any], most: int = 4) -> str:
    """The most frequent local minima."""
    often = sorted(entry["minima"], key=lambda one: -one["count"])[:most]
    listed = ", ".join(f"{one['cost']:.4g} ({one['count']:.0f})" for one in often)
    return f"{len(entry['minima'])}: {listed}" if often else "none"


def _share(entry: dict[str, Any]) -> str:
    return f"{entry['converged']} of {entry['starts']}"


def _iterations(entry: dict[str, Any]) -> str:
    return f" in {_few(entry['iterations'])} iterations" if entry["iterations"] else ""


def _steps(results: dict[str, Any], update: str) -> str:
    """Median of the last steps of the starts that failed, of every case."""
    steps = {case["case"]: case[update]["failed_step"] for case in results["cases"]}
    return "; ".join(f"{case} {'none failed' if step is None else f'{step:.2g}'}" for case, step in steps.items())


def _page(results: dict[str, Any]) -> list[str]:
    along = [{"where": "random", "iterates": results["problems"], **results["random"], "lowered": ""}]
    many = []
    for case in results["cases"]:
        name, found = f"{case['case']}, N = ", case["along"]
        lowered = f"{found['falls']} of {found['steps']}"
        along.append({"where": f"{name}{found['N']}, every iterate", "lowered": lowered, **found})
        for update in ("feedback", "open-loop"):
            entry = case[update]
            ended = ", ".join(f"{count} {name}" for name, count in sorted(entry["statuses"].items()))
            many.append({
                "case": f"{case['case']}, N = {case['N']}", "update": update, "size": case["size"],
                "share": _share(entry), "ended": ended, "few": _few(entry["iterations"]),
                "listed": _minima(entry), **entry,
            })  # fmt: skip
    return [
        "# Theorems 1 and 2 in numbers (section 3.4)", "",
        "![Eq. 42 along solves; iterations and final costs from random starts](theorems.png)", "",
        "## Theorem 1: Eq. 42 as an identity", "",
        "Three numbers must be one: grad J . dU (Eq. 39), minus the sum of squares on the right of Eq. 42, and the",
        "slope that the Riccati sweep returns. Largest relative difference to the sum of squares, and the slope",
        "nearest to zero, which must be negative. At iterates, what remains near the end of a solve is rounding of a",
        "gradient that is nearly zero:", "",
        *table({
            "where": "{where}", "LQ problems": "{iterates}", "grad J . dU": "{gradient_error:.1e}",
            "the sweep's slope": "{sweep_error:.1e}", "slope nearest to zero": "{largest_slope:.1e}",
            "steps that lowered J": "{lowered}",
        }, along), "",
        "## Theorem 2: convergence from random starts", "",
        f"Smooth random controls (six cosines, seeds 0 to {results['starts'] - 1}) of a given RMS; Armijo's rule. A",
        f"solve has converged when the LQ model promises less than {TOLERANCE:g} of the cost. Costs that differ by",
        f"less than {100.0 * SAME:g} % are one local minimum.", "",
        *table({
            "case": "{case}", "update": "{update}", "RMS": "{size:g}", "converged": "{share}", "limit": "{limit}",
            "ended": "{ended}", "iterations: least / median / most": "{few}",
            "local minima: cost (starts)": "{listed}", "s": "{seconds:.1f}",
        }, many), "",
        "Open-loop is Eq. 43 as printed. MAX_ITERATIONS is slow convergence, not divergence: every step lowers the",
        "cost, but the LQ problem leaves out the curvature of the dynamics, and where that is large (a final state far",
        "from the goal, arms that whirl) it promises too much and only short steps are taken; that this is the whole",
        "reason is not shown here, exact second derivatives would tell. Median of the last",
        f"{LAST} step lengths of the starts that failed, where 1 is the LQ problem's own, with the feedback update: "
        f"{_steps(results, 'feedback')}; open-loop: {_steps(results, 'open-loop')}.",
        "NOT_FINITE are starts whose first rollout leaves the range of numbers; Theorem 2 assumes it does not. The",
        "theorem promises a local minimum and says nothing of which: the table shows how many there are.",
    ]  # fmt: skip


def _rows(results: dict[str, Any]) -> list[Row]:
    cases_, random = results["cases"], results["random"]
    worst = max([random["gradient_error"], *(case["along"]["gradient_error"] for case in cases_)])
    falls = sum(case["along"]["falls"] for case in cases_), sum(case["along"]["steps"] for case in cases_)
    iterates_ = sum(case["along"]["iterates"] for case in cases_)

    def ended(update: str) -> str:
        return "; ".join(f"{case['case']} {_share(case[update])}{_iterations(case[update])}" for case in cases_)

    return [
        Row("3.4, Theorem 1, Eq. 42", "The direction descends: grad J . dU = -(sum of squares) < 0",
            f"relative difference at most {worst:.1e} on {results['problems']} random LQ problems and at all "
            f"{iterates_} iterates of {len(cases_)} solves; {falls[0]} of {falls[1]} steps lowered J",
            "it does not differ"),
        Row("3.4, Theorem 2, Eq. 43", "From an arbitrary start U + alpha dU converges to a local minimum",
            f"converged (iterations: least / median / most): {ended('open-loop')}",
            "within a limit of iterations. On the arms the rollout without feedback leaves only tiny steps: it "
            "descends, far too slowly to be of use"),
        Row("3.4, Theorem 2", "The same, with any of the usual line searches",
            f"with the feedback update: {ended('feedback')}. Local minima: "
            + "; ".join(f"{case['case']} {_minima(case['feedback'], 2)}" for case in cases_),
            f"what is missing was still descending at its limit, by short steps: median {_steps(results, 'feedback')}. "
            "Which local minimum is reached depends on the start, of which the theorem says nothing"),
    ]  # fmt: skip


def _draw(results: dict[str, Any], path: Path) -> None:
    """Eq. 42 along solves, iterations and final costs of many starts: one column per case."""
    columns = len(results["cases"])
    figure, grid = grid_of(3, columns, 4.4 * columns, 8.4)
    for column, case in enumerate(results["cases"]):
        top, middle, bottom = grid[:, column]
        first = column == 0
        along, entry = case["along"], case["feedback"]
        dress(top, f"{case['case']}: Eq. 42 along a solve", "relative difference" if first else "", "iteration")
        top.semilogy(np.maximum(along["errors"], 1e-17), ".", color="#0b5aa6", ms=4)
        top.set_ylim(1e-17, 1.0)  # from rounding to nothing in common
        top.locator_params(axis="x", integer=True)
        limit = f"iterations (limit {entry['limit']})"
        dress(middle, f"{_share(entry)} random starts converged", "starts" if first else "", limit)
        if entry["iterations"]:
            middle.hist(entry["iterations"], bins=40, range=(0, max(entry["iterations"])), color="#0b5aa6")
        finite = [cost for cost in (*entry["costs"], *entry["failed_costs"]) if cost > 0.0]
        dress(bottom, f"{len(entry['minima'])} local minima", "starts" if first else "", "final cost J")
        if finite:
            far = max(finite) > 2.0 * min(finite)
            bins = (np.geomspace if far else np.linspace)(0.99 * min(finite), 1.01 * max(finite), 50)
            sets, colours = [entry["costs"], entry["failed_costs"]], ["#0b5aa6", RED]
            bottom.hist(sets, bins=list(bins), stacked=True, color=colours, label=["converged", "not converged"])
            bottom.set_xscale("log" if far else "linear")
            bottom.legend(frameon=False, fontsize=8, labelcolor=SOFT)
    save(figure, path)


STUDY = Study("theorems", "Theorems 1 and 2 in numbers",
              theorem_results, _page, _rows, {"theorems.png": _draw}, seconds=90)  # fmt: skip
