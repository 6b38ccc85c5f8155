"""The paper's two theorems in numbers: descent (Eq. 39-42) as an identity, convergence (Theorem 2) from many starts.

Theorem 1 says more than that the direction descends; its proof ends in an identity,

    grad J . dU = - sum of dx' Q dx + du' R du - dx(N)' Q(N) dx(N)          Eq. 42

and the sweep has a third expression of the same number, its slope. All three are compared here: on random problems
those of the NumPy sweep, along solves those of the compiled one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from planner import cases
from planner.base.errors import PlannerError
from planner.cases.hopper import PAPER
from planner.dynamics import CompiledDynamics, Dynamics, ResidualDynamics
from planner.model.space import space_of
from planner.paper.studies.many_starts import LAST, SAME_COST_TOLERANCE, TOLERANCE, from_many
from planner.paper.studies.study import Row, Study, table
from planner.paper.studies.table_1 import random_lq, swept
from planner.problem.costs.terms import Quadratic
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.solvers import lq
from planner.solvers.options import LINE_SEARCHES, SolverOptions
from planner.solvers.slq import solve
from planner.view.plots.style import RED, SOFT, dress, grid_of, save

RANDOM, FEW_RANDOM = 300, 100  # LQ problems, for the documents and otherwise
UPDATES = ("open-loop", "feedback")  # that of Eq. 43, and ours
STARTS = 200  # per case with the feedback update and Armijo's rule, for the documents
SHORT = 2  # starts otherwise
LIMIT, SHORT_LIMIT = 2000, 100  # iterations of every solve, after which it has failed; for the documents, and otherwise


@dataclass(frozen=True)
class Family:
    """A case and its random starts; every solve has the same limit of iterations."""

    build: Callable[[], Problem]  # the problem that is solved from many starts
    size: float  # RMS of the random controls, in their unit
    few: int  # starts of the paper's own update, Eq. 43, and of the other line searches
    along: Callable[[], Problem] | None = None  # the problem along whose solve Eq. 42 is computed; by default build
    most: int = STARTS  # with the feedback update and Armijo's rule, where they take long
    rules: tuple[str, ...] = LINE_SEARCHES  # of the line search


# Arms at 50 stages a second, where 200 solves take a minute. 1 N m is a tenth of what holds the arm out horizontally;
# with 3 most starts whirl through several turns, and end far from everything. 10 in/s moves the piston by inches.
# The human step is its swing: accelerations of the pelvis of the size of their tolerance. Wolfe's rule is not compiled
# for arms, where an iteration takes 0.1 s.
ON_ARMS = tuple(rule for rule in LINE_SEARCHES if rule != "wolfe")
FAMILIES: dict[str, Family] = {
    "hopper": Family(lambda: cases.build("hopper", height=20.0, **PAPER), 10.0, STARTS),
    "two-link": Family(lambda: cases.two_link(horizon=100), 1.0, 10, cases.two_link, rules=ON_ARMS),
    "acrobot": Family(lambda: cases.acrobot(horizon=150), 1.0, 5, cases.acrobot, most=50, rules=ON_ARMS),
    "human-step": Family(lambda: cases.human_step("swing", cost="study"), 5.0, 10, most=50),
}
QUICK = {name: replace(family, rules=("armijo", "goldstein") if name == "human-step" else family.rules)
         for name, family in FAMILIES.items()}  # fmt: skip


def theorem_results(
    families: Mapping[str, Family] = QUICK, starts: int = SHORT, problems: int = FEW_RANDOM, limit: int = SHORT_LIMIT
) -> dict[str, Any]:
    """Both theorems in numbers: at most `starts` of each family, `problems` random LQ problems."""
    found = []
    for name, family in families.items():
        problem = family.build()
        runs = []
        for update in UPDATES:
            for search in family.rules:
                many = family.most if (update, search) == ("feedback", "armijo") else family.few
                runs.append(from_many(problem, family.size, min(many, starts), update, search, limit))
        found.append({
            "case": name, "N": problem.N, "size": family.size,
            "along": _along(family.along() if family.along else problem), "runs": runs,
        })  # fmt: skip
    return {"random": random_identity(problems), "problems": problems, "starts": starts, "limit": limit, "cases": found}


def full_theorem_results() -> dict[str, Any]:
    """The results for the documents. A function of its own: a process that computes it imports it by its name."""
    return theorem_results(FAMILIES, STARTS, RANDOM, LIMIT)


def identity_errors(A: np.ndarray, B: np.ndarray, model: Quadratic, step: RecordedSweep) -> tuple[float, float, float]:
    """Eq. 42 for one LQ problem: its right side, and the relative errors of grad . dU and of the sweep's slope.

    The step is the sweep's result for A (N, ndx, ndx), B (N, ndx, nu); its regularization counts as part of R.
    """
    ndx, nu = B.shape[1:]
    sweep = lq.Sweep(step.K, step.k, np.empty((0, ndx, ndx)), np.empty((0, ndx)), step.slope, 0.5 * step.slope)
    dxs, dus = lq.direction(A, B, sweep)
    R = model.R + step.regularization * np.eye(nu)
    right = -float(np.einsum("ni,nij,nj->", dxs, model.Q, dxs) + np.einsum("ni,nij,nj->", dus, R, dus))
    left = float(np.sum(step.gradient * dus))  # Eq. 39
    scale = abs(right) or 1.0
    return right, abs(left - right) / scale, abs(step.slope - right) / scale  # Eq. 42


def random_identity(problems: int) -> dict[str, Any]:
    """Eq. 42 on random LQ problems (see random_lq)."""
    rng = np.random.default_rng(0)
    errors = []
    for _ in range(problems):
        A, B, model = random_lq(rng)
        sweep = swept(A, B, model)
        empty = np.empty((0, 0))
        step = RecordedSweep(empty, empty, lq.gradient(A, B, model), sweep.K, sweep.k, sweep.slope, 0.0)
        errors.append(identity_errors(A, B, model, step))
    return _summary(errors)


def _along(problem: Problem) -> dict[str, Any]:
    """Eq. 42 at every iterate that took a step, of a solve from the problem's own first guess."""
    plan, steps = record_solve(problem)
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


def _few(values: list[int]) -> str:
    """Least, median and most."""
    return f"{min(values)} / {np.median(values):.0f} / {max(values)}" if values else "none"


def _minima(entry: dict[str, Any]) -> str:
    """The number of local minima, and the two most frequent of them."""
    often = sorted(entry["minima"], key=lambda one: -one["count"])[:2]
    listed = ", ".join(f"{one['cost']:.4g} ({one['count']:.0f})" for one in often)
    return f"{len(entry['minima'])}: {listed}" if often else "none"


def _run_of(case: dict[str, Any], update: str) -> dict[str, Any]:
    """The starts by Armijo's rule."""
    return next(run for run in case["runs"] if (run["update"], run["search"]) == (update, "armijo"))


def _counted(case: dict[str, Any], update: str) -> str:
    """Starts and ends of an update by all line searches, as numbers that anyone can count."""
    runs = [run for run in case["runs"] if run["update"] == update]
    starts, converged = (sum(run[key] for run in runs) for key in ("starts", "converged"))
    minima = converged - sum(len(run["no_minima"]) for run in runs)
    return f"{case['case']}: {starts} starts by {len(runs)} rules, {converged} converged, {minima} local minima"


def _steps(results: dict[str, Any], update: str) -> str:
    """Median of the last steps of the starts that failed by Armijo's rule, of every case where some did."""
    steps = {case["case"]: _run_of(case, update)["failed_step"] for case in results["cases"]}
    return ", ".join(f"{case} {step:.2g}" for case, step in steps.items() if step is not None) or "none failed"


def _page(results: dict[str, Any]) -> list[str]:
    along = [{"where": "random", "iterates": results["problems"], **results["random"], "lowered": ""}]
    many = []
    for case in results["cases"]:
        name, found = f"{case['case']}, N = ", case["along"]
        lowered = f"{found['falls']} of {found['steps']}"
        along.append({"where": f"{name}{found['N']}, every iterate", "lowered": lowered, **found})
        for run in case["runs"]:
            many.append({
                "case": f"{case['case']}, N = {case['N']}", "size": case["size"],
                "few": _few(run["iterations"]), "listed": _minima(run), "none": len(run["no_minima"]), **run,
            })  # fmt: skip
    return [
        "# Theorems 1 and 2 in numbers (section 3.4)", "",
        "![Eq. 42 along solves; iterations and final costs from random starts](theorems.png)", "",
        "Theorem 1. Three numbers must be one: grad J . dU (Eq. 39), minus the sum of squares on the right of Eq. 42,",
        "and the slope that the Riccati sweep returns. Largest relative difference to the sum of squares:", "",
        *table({
            "where": "{where}", "LQ problems": "{iterates}", "grad J . dU": "{gradient_error:.1e}",
            "the sweep's slope": "{sweep_error:.1e}", "slope nearest to zero": "{largest_slope:.1e}",
            "steps that lowered J": "{lowered}",
        }, along), "",
        "Theorem 2. Smooth random controls (six cosines, seeds from 0 on) of a given RMS; at most",
        f"{results['limit']} iterations;",
        f"converged: the LQ model promises less than {TOLERANCE:g} of J. A local minimum: Newton's method, started at",
        f"the end, comes to a stationary point of the same cost (to {100.0 * SAME_COST_TOLERANCE:g} %) at which the",
        "exact Hessian of J over all controls has no negative eigenvalue. Costs that differ by less are one minimum.",
        "Open-loop is Eq. 43. All other starts reached the limit while J still fell, by short steps: the median of",
        f"their last {LAST} by Armijo's rule, where 1 is the LQ problem's own, is {_steps(results, 'open-loop')} "
        f"(open-loop) and {_steps(results, 'feedback')} (feedback).", "",
        *table({
            "case": "{case}", "update": "{update}", "line search": "{search}", "RMS": "{size:g}", "starts": "{starts}",
            "converged": "{converged}", "no minima": "{none}", "iterations: least / median / most": "{few}",
            "local minima: cost (starts)": "{listed}",
        }, many),
    ]  # fmt: skip


def _rows(results: dict[str, Any]) -> list[Row]:
    cases_, random = results["cases"], results["random"]
    worst = max([random["gradient_error"], *(case["along"]["gradient_error"] for case in cases_)])
    falls = sum(case["along"]["falls"] for case in cases_), sum(case["along"]["steps"] for case in cases_)
    iterates_ = sum(case["along"]["iterates"] for case in cases_)
    return [
        Row("3.4, Theorem 1, Eq. 42", "The direction descends: grad J . dU = -(sum of squares) < 0",
            f"relative difference at most {worst:.1e} on {results['problems']} random LQ problems and at all "
            f"{iterates_} iterates of {len(cases_)} solves; {falls[0]} of {falls[1]} steps lowered J",
            "it does not differ"),
        Row("3.4, Theorem 2, Eq. 43",
            "From an arbitrary start U + alpha dU converges to a local minimum, by any of the usual line searches",
            f"within {results['limit']} iterations: " + "; ".join(_counted(case, "open-loop") for case in cases_),
            "the theorem has no limit of iterations; the other starts were still descending. On the arms only short "
            f"steps lower J, since the rollout has no feedback (median {_steps(results, 'open-loop')})"),
        Row("3.4, Theorem 2", "The same with a feedback update: not in the paper",
            "; ".join(_counted(case, "feedback") for case in cases_) + ". Different local minima by Armijo's rule: "
            + "; ".join(f"{case['case']} {_minima(_run_of(case, 'feedback'))}" for case in cases_),
            "which local minimum is reached depends on the start; the theorem does not say which"),
    ]  # fmt: skip


def _draw(results: dict[str, Any], path: Path) -> None:
    """Eq. 42 along solves, iterations and final costs of many starts: one column per case."""
    columns = len(results["cases"])
    figure, grid = grid_of(3, columns, 4.4 * columns, 8.4)
    for column, case in enumerate(results["cases"]):
        top, middle, bottom = grid[:, column]
        first = column == 0
        along, entry = case["along"], _run_of(case, "feedback")
        dress(top, f"{case['case']}: Eq. 42 along a solve", "relative difference" if first else "", "iteration")
        top.semilogy(np.maximum(along["errors"], 1e-17), ".", color="#0b5aa6", ms=4)
        top.set_ylim(1e-17, 1.0)  # from rounding to nothing in common
        top.locator_params(axis="x", integer=True)
        share, limit = f"{entry['converged']} of {entry['starts']}", f"iterations (limit {results['limit']})"
        dress(middle, f"{share} random starts converged", "starts" if first else "", limit)
        if entry["iterations"]:
            middle.hist(entry["iterations"], bins=40, range=(0, max(entry["iterations"])), color="#0b5aa6")
        finite = [cost for cost in (*entry["costs"], *entry["failed_costs"]) if cost > 0.0]
        dress(bottom, f"{len(entry['minima'])} local minima", "starts" if first else "", "final cost J")
        if finite:
            wide = max(finite) > 2.0 * min(finite)
            bins = (np.geomspace if wide else np.linspace)(0.99 * min(finite), 1.01 * max(finite), 50)
            sets, colours = [entry["costs"], entry["failed_costs"]], ["#0b5aa6", RED]
            bottom.hist(sets, bins=list(bins), stacked=True, color=colours, label=["converged", "not converged"])
            bottom.set_xscale("log" if wide else "linear")
            bottom.legend(frameon=False, fontsize=8, labelcolor=SOFT)
    save(figure, path)


STUDY = Study("theorems", "Theorems 1 and 2 in numbers",
              theorem_results, _page, _rows, {"theorems.png": _draw}, seconds=60,
              full=full_theorem_results)  # fmt: skip


class RecordedSweep(NamedTuple):
    """Result of the compiled sweep for one trajectory."""

    xs: np.ndarray  # (N+1, nx)
    us: np.ndarray  # (N, nu)
    gradient: np.ndarray  # (N, nu), Eq. 19
    K: np.ndarray  # (N, nu, ndx)
    k: np.ndarray  # (N, nu)
    slope: float  # of J along the direction
    regularization: float  # added to R


class _RecordingDynamics:
    """Compiled dynamics that note workspace and slope whenever a line search begins."""

    def __init__(self, dynamics: Any) -> None:
        known = (Dynamics, CompiledDynamics, ResidualDynamics)
        kinds = known if isinstance(dynamics, ResidualDynamics) else known[:2]
        names = {name for kind in kinds for name in dir(kind) if not name.startswith("_")}
        for name in names - {"search"}:
            setattr(self, name, getattr(dynamics, name))
        self.space = space_of(dynamics)
        self._dynamics = dynamics
        self.sweeps: list[RecordedSweep] = []

    def search(self, w: Any, memory: Any, rule: int, feedback: bool, cost: float, slope: float) -> tuple[float, float]:
        """Line search from w.xs, w.us; see CompiledDynamics.search."""
        if slope < 0.0:  # which is not so where the first guess or an extrapolation is rolled out
            K = w.K[:, :, w.first : w.first + w.ndx].copy()
            self.sweeps.append(RecordedSweep(w.xs.copy(), w.us.copy(), w.gradient.copy(), K, w.k.copy(), slope, 0.0))
        return self._dynamics.search(w, memory, rule, feedback, cost, slope)


def record_solve(problem: Problem, **options: Any) -> tuple[Plan, list[RecordedSweep]]:
    """Solve with options of solve(), and return with the plan the LQ problem of every step that was taken.

    The problem has compiled dynamics and a cost whose R + B'PB is positive definite throughout. Its LQ problems are the
    paper's: none has a weight on changes of the states.
    """
    if not isinstance(problem.dynamics, CompiledDynamics):
        raise PlannerError("the problem's dynamics are not compiled, expected RigidBodyDynamics or HopperDynamics.")
    dynamics = _RecordingDynamics(problem.dynamics)
    printed = SolverOptions(max_short_steps=LIMIT)  # more than there are
    plan = solve(replace(problem, dynamics=dynamics, twin=None, requirements=None), printed, **options)
    lines = zip(plan.history, dynamics.sweeps, strict=False)  # the last line is the plan, where nothing is searched
    return plan, [step._replace(regularization=line.regularization) for line, step in lines if line.step > 0.0]
