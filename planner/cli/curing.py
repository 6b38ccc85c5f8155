"""What `planner run` does by itself with a plan that failed: it writes the obvious cure, once, and says so."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from copy import copy
from dataclasses import replace

from planner.cases.problem_file import NAME as PROBLEM_FILE
from planner.cases.problem_file.keys import RESOLVED
from planner.cli.console import Console
from planner.cli.problems import ProblemOf, solved
from planner.problem.plan import Plan, Status
from planner.problem.problem import Problem
from planner.proof import Proof
from planner.proof.cures import Cure, cures

OWN = ("dt", "substeps", "integrator", "guess", "starts", "limits.margin", "max_iterations")
"""Keys about how a motion is computed, beside the weights. What the motion is to be stays the user's to say."""


def cured(
    asked: ProblemOf, plan: Plan, proof: Proof | None, end: float, arguments: argparse.Namespace, console: Console,
    prove: Callable[[Plan], Proof],
) -> tuple[Plan, Proof] | None:  # fmt: skip
    """The plan of a problem file with the first cure written into it, and its proof; None where it does not pass.

    No solve begins after `end`, a time of time.monotonic(), and one that runs then is ended.
    """
    found = next(iter(cures(plan, proof)), None)
    if plan.case != PROBLEM_FILE or found is None or found.value is None or not _is_own(found.key):
        return None
    if time.monotonic() > end:
        console.say(f"not tried, for want of time: {found}")
        return None
    console.note(f"the plan does not pass; trying {found}")
    problem, given = asked.problem, arguments
    if found.key == "max_iterations":
        given = copy(arguments)
        given.max_iterations = found.value
    else:
        problem = written(problem, found)
    starts = problem.parameters["starts"]
    other, _ = solved(asked._replace(problem=problem, starts=starts), given, console, end=end)
    if not other.success:
        if other.status is Status.INTERRUPTED and time.monotonic() <= end:
            raise KeyboardInterrupt
        late = "the time for it was over" if other.status is Status.INTERRUPTED else other.status.name
        console.say(f"tried in vain ({late}): {found}")
        return None
    again = prove(other)
    if not again.passed:
        console.say(f"tried in vain ({again.reason}): {found}")
        return None
    console.say(f"written by itself: {found}")
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
    return key in OWN or key.startswith("weights.")
