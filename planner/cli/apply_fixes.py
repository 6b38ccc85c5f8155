"""What `planner run` does by itself with a plan that failed: it tries the cures and writes one that passes.

A cure about how the motion is computed is written. One about what the motion is to be, like a longer duration, is only
tried, so that what is said first leads to a PASS.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, replace

from planner.base.errors import PlannerError
from planner.cases.problem_file import NAME as PROBLEM_FILE
from planner.cases.problem_file.keys import RESOLVED
from planner.cli.console import Console
from planner.cli.problems import ProblemOf, solved
from planner.problem.plan import Plan, Status
from planner.problem.problem import Problem
from planner.proof import Proof
from planner.proof.cures import Cure, cures, in_order, longer

AUTOMATIC_KEYS = ("dt", "substeps", "integrator", "guess", "starts", "limits.margin", "max_iterations")
"""Keys about how a motion is computed, beside the weights. What the motion is to be stays the user's to say."""
READ_AGAIN = ("contacts", "ignore", "model", "start")  # keys for which the file would have to be read again
LADDER = 6  # durations, each half as long again: up to 7.6 times


def apply_fixes(
    asked: ProblemOf, plan: Plan, proof: Proof | None, end: float, arguments: argparse.Namespace, console: Console,
    prove: Callable[[Plan], Proof],
) -> tuple[Plan, Proof] | None:  # fmt: skip
    """The plan of a problem file with a cure of OWN written into it, and its proof; None where none passes.

    Cures of other keys are tried too, and not written: one that passes is what cures() says first from then on. Those
    that were tried in vain come last. No solve begins after `end`, a time of time.monotonic(), and one that runs then
    is ended.
    """
    found = cures(plan, proof)
    if plan.case != PROBLEM_FILE or any(one.value is None for one in found):
        return None
    trial = _Trial(asked, end, arguments, console, prove)
    vain: list[Cure] = []
    for one in sorted(found, key=lambda one: not _is_own(one.key)):
        if one.key in READ_AGAIN:
            continue
        if time.monotonic() > end:
            console.write_result(f"not tried, for want of time: {one}")
            break
        passed, better = trial.passing(one)
        if better is None:
            vain.append(one)
        elif _is_own(one.key):
            console.write_result(f"written by itself: {passed}")
            return better
        else:
            passed = replace(passed, sentence=f"{passed.sentence} (tried: with it the plan passes)")
            in_order(plan, proof, (passed, *(other for other in found if other is not one and other not in vain)))
            return None
    tried = tuple(replace(one, sentence=f"{one.sentence} (tried: not enough)") for one in found if one in vain)
    in_order(plan, proof, (*(one for one in found if one not in vain), *tried))
    return None


@dataclass(frozen=True)
class _Trial:
    """Solves and proves with a cure."""

    asked: ProblemOf
    end: float
    arguments: argparse.Namespace
    console: Console
    prove: Callable[[Plan], Proof]

    def passing(self, cure: Cure) -> tuple[Cure, tuple[Plan, Proof] | None]:
        """The cure, a longer duration where the one that it says is not enough; and what passes with it, or None."""
        for _ in range(LADDER if cure.key == "duration" else 1):
            better = self._tried(cure)
            if better is not None or cure.key != "duration" or time.monotonic() > self.end:
                return cure, better
            cure = longer(self.asked.problem, cure)
        return cure, None

    def _tried(self, found: Cure) -> tuple[Plan, Proof] | None:
        self.console.write_progress(f"the plan does not pass; trying {found}")
        problem, given = self.asked.problem, self.arguments
        if found.key == "max_iterations":
            given = copy(given)
            given.max_iterations = found.value
        else:
            try:
                problem = written(problem, found)
            except PlannerError as error:
                self.console.write_result(f"tried in vain ({error}): {found}")
                return None
        starts = problem.parameters["starts"]
        other, _ = solved(self.asked._replace(problem=problem, starts=starts), given, self.console, end=self.end,
                          why=", a trial of this cure")  # fmt: skip
        if not other.success:
            if other.status is Status.INTERRUPTED and time.monotonic() <= self.end:
                raise KeyboardInterrupt
            late = "the time for it was over" if other.status is Status.INTERRUPTED else other.status.name
            self.console.write_result(f"tried in vain ({late}): {found}")
            return None
        again = self.prove(other)
        if not again.passed:
            first, *more = again.reason.split("; ")
            self.console.write_result(f"tried in vain ({first}{' ...' if more else ''}): {found}")
            return None
        return other, again


def written(problem: Problem, cure: Cure) -> Problem:
    """The problem of a file with a cure in it, which its parameters say."""
    assert problem.recipe is not None  # of a problem file
    table = {name: value for name, value in problem.parameters.items() if name != RESOLVED}
    again = problem.recipe.build(**cure.applied(table)) if problem.recipe.build else problem
    assert again.recipe is not None
    resolved = again.parameters[RESOLVED]
    reasons = resolved["reasons"] | {cure.key: f"written by planner run: {cure.sentence}"}
    table = again.parameters | {RESOLVED: resolved | {"reasons": reasons}}
    return replace(again, recipe=replace(again.recipe, parameters=table))


def _is_own(key: str) -> bool:
    return key in AUTOMATIC_KEYS or key.startswith("weights.")
