"""repair(): try to make a plan pass, in this order, until it passes or the work budget is exhausted.

    1. going on            with a solve that its share of the work has cut: continued.py
    2. finer steps         RK4 in place of Euler, half the stage: refinement.py
    3. saddles             a stationary point that is no minimum is left along its lowest curvature: continued.py
    4. suggested fixes     of how the motion is computed, with finer steps where only these are then wrong; the first
                           that passes is applied. Then those that change the motion itself, which are only reported:
                           fixes.py
    5. clearance           larger where shapes collide in MuJoCo, smaller where only their fits do: clearance.py

All solves and proofs share one budget of work (solvers.work), so that the result is the same on a machine of any speed
and load.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

from planner.problem.plan import Plan, Status
from planner.problem.problem import Problem
from planner.proof.diagnostics import SuggestedFix, standing_goal, suggested_fixes
from planner.proof.diagnostics.suggested_fix import of_file
from planner.proof.repair.clearance import ClearanceRefinement, refine_clearance
from planner.proof.repair.continued import Resumption, SaddleStep, leave_saddles, resumed
from planner.proof.repair.fixes import FixTrial, FixTrials, Solve
from planner.proof.repair.refinement import Refined, Refinement, refine
from planner.proof.verdict import Proof
from planner.solvers.work import DEFAULT_WORK, WorkBudget

Step = Resumption | Refinement | Refined | SaddleStep | FixTrial | ClearanceRefinement
"""What is reported of a repair: a solve that went on, each refinement and their end, saddles, each trial of a fix,
changes of clearance."""


class Repaired(NamedTuple):
    """The passing plan, or the best one."""

    plan: Plan
    proof: Proof | None
    path: tuple[Refinement, ...]  # the refinements of this plan
    fixes: tuple[SuggestedFix, ...]  # suggested fixes, if it does not pass


@dataclass(frozen=True)
class Tools:
    """Functions and options of a repair.

    Attributes:
        solve: Solves with the failed plan's settings.
        prove: Judges a plan.
        options: Of the solves of refinements: update, line_search, hessian.
        max_iterations: Of each solve.
        report: Called with each Step; it may raise KeyboardInterrupt.
        store: Called with each plan that replaces the previous one, its name and its refinements.
    """

    solve: Solve
    prove: Callable[[Plan], Proof]
    options: dict[str, Any]
    max_iterations: int
    report: Callable[[Step], object]
    store: Callable[[Plan, str, tuple[Refinement, ...]], object]


def repair(
    problem: Problem, plan: Plan, proof: Proof | None, path: tuple[Refinement, ...], tools: Tools, *,
    again: bool = False, budget: WorkBudget | None = None,
) -> Repaired:  # fmt: skip
    """Repair a plan that does not pass.

    Args:
        problem: The plan's, as it was built from its file.
        plan: It did not pass.
        proof: Its proof; None where it cannot be replayed.
        path: Refinements that were made before.
        tools: What to solve and prove with.
        again: The plan is of a run that goes on, which tried the fixes then; refinements are made again.
        budget: Of the repair; by default DEFAULT_WORK.
    """
    work = WorkBudget(DEFAULT_WORK) if budget is None else budget

    def refined(plan: Plan, proof: Proof) -> Refined:
        return refine(
            plan, proof, budget=work.part("finer steps"), prove=tools.prove, callback=tools.report,
            max_iterations=tools.max_iterations, **tools.options,
        )  # fmt: skip

    longer = None if again or path else resumed(
        problem, plan, work, tools.max_iterations, **tools.options
    )  # fmt: skip
    if longer is not None:
        tools.report(longer)
        work.charge_proof(problem)
        plan, proof = longer.plan, tools.prove(longer.plan)
        tools.store(plan, "continued", path)
    before = plan
    if proof is not None and not proof.passed and not path and not standing_goal(plan, problem, proof):
        done = refined(plan, proof)
        if done.plan.status is Status.INTERRUPTED:
            raise KeyboardInterrupt  # the next run begins an interrupted refinement again
        if len(done.path) > 1:
            tools.report(done)
        if done.plan is not plan:
            plan, proof, path = done.plan, done.proof, done.path
            tools.store(plan, "refined", path)
    if proof is not None and not proof.passed:
        better, judged = leave_saddles(
            plan, proof, work.part("saddles"), tools.prove, tools.max_iterations, tools.report, **tools.options
        )  # fmt: skip
        if better is not plan:
            plan, proof, path = better, judged, ()
            tools.store(plan, "repaired", path)
    found = suggested_fixes(plan, proof)
    if again or (proof is not None and proof.passed):
        return Repaired(plan, proof, path, found)
    if of_file(problem) and problem.periodic is None:  # a cycle takes many solves
        trials = FixTrials(problem, plan, tools.solve, tools.prove, refined, work, tools.max_iterations, tools.report,
                           (plan, before))  # fmt: skip
        better, found = trials.run(found)
        if better is not None:
            plan, proof, path = better.plan, better.proof, better.path if better.path[1:] else ()
            tools.store(plan, "repaired", path)
    if proof is not None and not proof.passed:
        wider = refine_clearance(
            plan, proof, budget=work.part("clearance"), prove=tools.prove, max_iterations=tools.max_iterations
        )  # fmt: skip
        if wider.changes:
            plan, proof, path = wider.plan, wider.proof, ()
            tools.report(wider)
            tools.store(plan, "other clearance", path)
            found = suggested_fixes(plan, proof)
    return Repaired(plan, proof, path, found)
