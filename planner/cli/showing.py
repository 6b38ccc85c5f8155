"""Print a plan, its proof and what to write so that it passes; their facts as JSON values."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from planner.cli.console import Console
from planner.problem.plan import Plan, Status

if TYPE_CHECKING:  # neither proofs nor pictures are imported to print a plan
    from planner.proof import Proof
    from planner.proof.diagnostics import SuggestedFix
    from planner.proof.repair.refinement import Refinement
    from planner.solvers.work import WorkBudget


def refinement_row(line: Refinement) -> dict[str, Any]:
    """A step of a refinement as JSON values."""
    return line._asdict() | {"status": line.status.name}


def plan_facts(plan: Plan) -> dict[str, Any]:
    """A plan as JSON values, without its arrays."""
    return {
        "case": plan.case, "parameters": plan.parameters, "status": plan.status.name, "success": plan.success,
        "message": plan.message, "cost": plan.cost, "gradient_norm": plan.gradient_norm, "iterations": plan.nit,
        "starts": [start._asdict() | {"status": start.status.name} for start in plan.starts], "start": plan.start,
        "relaxation": plan.options.get("relaxation"),
        "horizon": plan.N, "dt": plan.dt, "versions": plan.versions,
        "objective": None if plan.problem is None or plan.problem.objective is None else plan.problem.objective.weights,
    }  # fmt: skip


def show_plan(plan: Plan, seconds: float | None, console: Console, which: str = "") -> None:
    """Print the solve in two lines; `which` names a plan that takes the place of the first, "refined" say."""
    took = "" if seconds is None else f", {1e3 * seconds:.3g} ms"
    which = f"{which} plan, " if which else ""
    console.write_result(
        f"{which}{plan.status.name}: {plan.nit} iterations, cost {plan.cost:.8g}, "
        f"|gradient| {plan.gradient_norm:.2e}{took}"
    )
    if plan.starts:
        converged = sum(start.status is Status.CONVERGED for start in plan.starts)
        console.write_result(f"start {plan.start} of {len(plan.starts)} is the best; {converged} converged")
    if "relaxation" in plan.options:
        solves = len(plan.options["relaxation"]["steps"])
        console.write_result(f"relaxed: {solves} solves, {plan.total_iterations} iterations in all")
    if not plan.success or plan.missed_goals:
        console.write_result(plan.message)
    for key in ("first_guess", "not_finite", "cut"):  # what became of a guess that ran away; what a budget cut
        if key in plan.options and plan.options[key] != plan.status.name:
            console.write_result(f"{key.replace('_', ' ')}: {plan.options[key]}")


def show_work(budget: WorkBudget, console: Console) -> None:
    """Print where the work of a run went, and which limit ended it, if any."""
    console.write_result(f"work: {budget}" + (f"; ended by its {budget.end.name}" if budget.exhausted else ""))


def show_proof(proof: Proof, fixes: Sequence[SuggestedFix], console: Console) -> None:
    """Print every measured number beside its bound, then the verdict."""
    console.write_result()
    console.table(("step", "measured", "value", "bound", ""), proof.rows())
    for section in proof.sections.values():
        if section.not_applicable:
            console.write_result(f"{section.title}: not applicable, {section.not_applicable}")
    for line in proof.monte_carlo.lines() if proof.monte_carlo is not None else ():
        console.write_result(line)
    console.write_result(f"\n{proof.headline}\n{proof.reason}")
    show_fixes(fixes, console)


def show_fixes(fixes: Sequence[SuggestedFix], console: Console) -> None:
    """Print what to write so that a plan passes, the most likely first."""
    for i, one in enumerate(fixes):
        console.write_result(f"{'or' if i else 'to pass'}: {one}")
