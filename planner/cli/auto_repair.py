"""What `planner run` does by itself with a plan that does not pass: finer steps, the first cure, more room."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial

from planner.cli import results
from planner.cli.apply_fixes import apply_fixes
from planner.cli.console import Console
from planner.cli.problems import ProblemOf
from planner.problem.plan import Plan, Status
from planner.proof import Proof, prove
from planner.proof.clearance_refinement import refine_clearance
from planner.proof.cures.balance import standing_goal
from planner.proof.refinement import Refinement, refine

SECONDS = 40.0  # for all that is tried after a FAIL; a proof is never cut
Keep = Callable[[Plan, tuple[Refinement, ...]], None]


def auto_repair(
    asked: ProblemOf, plan: Plan, proof: Proof | None, path: tuple[Refinement, ...], arguments: argparse.Namespace,
    console: Console, *, resumed: bool, keep: Keep,
) -> tuple[Plan, Proof | None, tuple[Refinement, ...]]:  # fmt: skip
    """The plan that passes or that is best known, its proof, and the refinements that led to it.

    A plan that a run goes on with (`resumed`) was mended then, but for refinements, which are made whole.
    `keep` stores each plan that takes the place of the one before.
    """
    end = time.monotonic() + SECONDS
    judge = partial(prove, rollouts=0, hold_seconds=arguments.hold)
    if proof is not None and not path:
        plan, proof, path = _refined(plan, proof, end, arguments, console, judge)
        if path:
            keep(plan, path)
    if resumed or (proof is not None and proof.passed):
        return plan, proof, path
    better = apply_fixes(asked, plan, proof, end, arguments, console, judge)
    if better is not None:
        plan, proof, path = *better, ()
        keep(plan, path)
        results.show_plan(plan, None, console, "mended")
    if proof is not None and not proof.passed:
        left = max(0.0, end - time.monotonic())
        wider = refine_clearance(plan, proof, seconds=left, prove=judge, max_iterations=arguments.max_iterations)
        if wider.notes:
            plan, proof, path = wider.plan, wider.proof, ()
            console.write_result("\n".join(f"planned again: {note}" for note in wider.notes))
            keep(plan, path)
            results.show_plan(plan, None, console, "wider")
    return plan, proof, path


def _refined(
    plan: Plan,
    proof: Proof,
    end: float,
    arguments: argparse.Namespace,
    console: Console,
    judge: Callable[[Plan], Proof],
) -> tuple[Plan, Proof, tuple[Refinement, ...]]:
    """Solve a failed plan again at finer steps; returns it unchanged where the step is no cause or nothing helps."""
    if plan.problem is not None and standing_goal(plan, plan.problem, proof):
        return plan, proof, ()
    lines: list[Refinement] = []

    def show(line: Refinement) -> None:
        lines.append(line)
        if len(lines) == 2:  # the first is the failed plan
            console.write_progress("the proof fails at a finer step; solving again with dt / 2")
            console.write_progress(f"{Refinement.header()}\n{lines[0]}")
        if len(lines) > 1:
            console.write_progress(str(line))

    began = time.monotonic()
    done = refine(plan, proof, seconds=max(0.0, end - began), callback=show, update=arguments.update, prove=judge,
                  line_search=arguments.line_search, hessian=arguments.hessian,
                  max_iterations=arguments.max_iterations)  # fmt: skip
    if len(done.path) == 1:
        return plan, proof, ()
    if done.plan.status is Status.INTERRUPTED:
        raise KeyboardInterrupt  # the next run begins an interrupted refinement again
    console.write_result(f"refinements: {len(done.path) - 1}, in {time.monotonic() - began:.1f} s; {done.reason}")
    results.show_plan(done.plan, None, console, "refined")
    return done.plan, done.proof, done.path
