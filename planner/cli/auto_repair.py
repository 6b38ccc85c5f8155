"""What `planner run` does by itself with a plan that does not pass: planner.proof.repair, told on the console."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial

from planner.cli import results
from planner.cli.console import Console
from planner.cli.problems import ProblemOf, iterations_of, solved
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.proof import Proof, prove
from planner.proof.repair import Repaired, Step, Tools, repair
from planner.proof.repair.clearance import ClearanceRefinement
from planner.proof.repair.fixes import FixTrial
from planner.proof.repair.refinement import Refined, Refinement

Store = Callable[[Plan, tuple[Refinement, ...]], None]
_OUTCOMES = {
    "applied": "applied automatically", "passes": "tried, PASS; left to you",
    "not tried": "not tried, for want of work",
    "fails": "tried, still FAIL", "refused": "tried, refused", "not solved": "tried, not solved",
}  # fmt: skip


def auto_repair(
    asked: ProblemOf, plan: Plan, proof: Proof | None, path: tuple[Refinement, ...], arguments: argparse.Namespace,
    console: Console, *, resumed: bool, store: Store,
) -> Repaired:  # fmt: skip
    """The plan that passes or that is best known; `store` gets each plan that takes the place of the one before."""

    def solve_again(problem: Problem, max_iterations: int, purpose: str) -> tuple[Plan, int]:
        again = asked._replace(problem=problem, starts=problem.parameters["starts"])
        given = argparse.Namespace(**vars(arguments) | {"max_iterations": max_iterations})
        plan, _ = solved(again, given, console, purpose=purpose)
        return plan, iterations_of(plan)

    def keep(plan: Plan, which: str, path: tuple[Refinement, ...]) -> None:
        store(plan, path)
        results.show_plan(plan, None, console, which)

    options = {name: getattr(arguments, name) for name in ("update", "line_search", "hessian")}
    judge = partial(prove, rollouts=0, hold_seconds=arguments.hold)
    tools = Tools(solve_again, judge, options, arguments.max_iterations, partial(_show, console), keep)
    return repair(asked.problem, plan, proof, path, tools, resumed=resumed)


def _show(console: Console, step: Step) -> None:
    if isinstance(step, Refinement):
        if step.seconds == step.seconds:  # NaN is the failed plan's
            console.write_progress(f"solved again at a finer step:\n{Refinement.header()}\n{step}")
    elif isinstance(step, Refined):
        console.write_result(f"refinements: {len(step.path) - 1}; {step.reason}")
    elif isinstance(step, ClearanceRefinement):
        console.write_result("\n".join(f"planned again: {note}" for note in step.notes))
    elif isinstance(step, FixTrial) and step.outcome == "begins":
        console.write_progress(f"the plan does not pass; trying {step.fix}")
    else:
        reason = f" ({step.reason})" if step.reason else ""
        console.write_result(f"{_OUTCOMES[step.outcome]}{reason}: {step.fix}")
