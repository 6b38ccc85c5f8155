"""Solve and prove with the suggested fixes of a failed plan, then at finer steps if need be, until one passes."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from planner.base.errors import PlannerError
from planner.base.files import digest_of
from planner.problem.joint_limits import json_value
from planner.problem.plan import Plan, Status
from planner.problem.problem import Problem
from planner.proof.diagnostics import SuggestedFix, longer, suggested_fixes
from planner.proof.diagnostics.suggested_fix import ITERATIONS
from planner.proof.repair.refinement import Refined
from planner.proof.verdict import Proof
from planner.solvers.gains import warm_start
from planner.solvers.work import WorkBudget

AUTOMATIC_KEYS = ("dt", "substeps", "integrator", "guess", "starts", "limits.margin", ITERATIONS)
"""Keys about the computation, in addition to the weights. Keys that change the task itself are the user's to set."""
NOT_TRIED = ("contacts", "durations", "gait", "ignore", "model", "start", "work")  # read or search anew, want more work
FROM_THE_PLAN = ("weights", "limits", "dt", "substeps", "integrator")  # of these, trials begin at the plan that failed
SHARE = 0.5  # of the work that is left, at most, for the trial of a fix
MIN_ITERATIONS = 20  # of a trial: fewer solve nothing that failed
MAX_DURATIONS = 6  # maximum number tried, each 1.5 times the last: up to 7.6 times
MAX_WEIGHTS = 5  # maximum number tried, each what the plan before suggests
SAME = 1e-9  # of the largest control and state: plans that differ by less are one
SAME_PROBLEM, SAME_PLAN = "its problem is one that was tried", "its plan is one that was tried"
_RESOLVED = "resolved"  # key of a problem file's table: default choices and their reasons

Solve = Callable[[Problem, int, str, WorkBudget], Plan]
"""A solve of (problem, most iterations, what it is for, its budget)."""


class FixTrial(NamedTuple):
    """A suggested fix and the result of its trial."""

    fix: SuggestedFix
    outcome: str  # begins, applied, passes, refused, not solved, fails, or not tried
    reason: str = ""  # of the refusal, the status or the FAIL


@dataclass(frozen=True)
class FixTrials:
    """Trials of a problem file's suggested fixes.

    Fixes of AUTOMATIC_KEYS come first, and the first that passes is applied. Those of other keys are tried and only
    reported. Those of FROM_THE_PLAN begin at the plan that has converged without them, if its stage is theirs or a
    multiple of it.
    """

    problem: Problem
    failed: Plan
    solve: Solve
    prove: Callable[[Plan], Proof]
    refine: Callable[[Plan, Proof], Refined]
    budget: WorkBudget
    max_iterations: int
    report: Callable[[FixTrial], object]
    before: Sequence[Plan] = ()  # plans of this problem that did not pass, with all finer steps
    _solved: list[str] = field(default_factory=list)  # of each trial, what its solve depended on

    def run(self, found: tuple[SuggestedFix, ...]) -> tuple[Refined | None, tuple[SuggestedFix, ...]]:
        """The plan and proof that passed with a fix applied, or None; and the updated fixes, failed ones last."""
        failed: list[tuple[SuggestedFix, SuggestedFix]] = []  # with what was tried for each last
        for one in sorted(found, key=lambda one: not is_automatic(one.key)):
            if one.key in NOT_TRIED or one.value is None:
                continue
            if self.budget.before_proof(self.problem).exhausted:
                self.report(FixTrial(one, "not tried"))
                break
            try:
                last, better = self._first_passing(one)
            except _OutOfWorkError:  # a cheaper one may still be tried
                self.report(FixTrial(one, "not tried"))
                continue
            if better is None:
                failed.append((one, last))
            elif is_automatic(one.key):
                self.report(FixTrial(last, "applied"))
                return better, ()
            else:
                self.report(FixTrial(last, "passes"))
                rest = [other for other in found if other is not one and not any(other is of for of, _ in failed)]
                return None, (replace(last, tried="passes"), *rest)
        rest = [one for one in found if not any(one is of for of, _ in failed)]
        return None, (*rest, *(last for _, last in failed))

    def _first_passing(self, one: SuggestedFix) -> tuple[SuggestedFix, Refined | None]:
        """The fix, with a longer duration or other weights if need be; and the passing plan and proof or None.

        One that did not pass is the last that was tried, and says how it ended.
        """
        fixes, failed, tried = [one], self.failed, replace(one, tried="fails")
        for left in reversed(range({"duration": MAX_DURATIONS, "weights": MAX_WEIGHTS}.get(_kind(one), 1))):
            try:
                done, status = self._tried(fixes, failed)
            except _OutOfWorkError:
                if fixes == [one]:
                    raise
                break
            if done is not None and done.passed:
                return fixes[-1], done
            undecided = status in (Status.WORK_LIMIT, Status.TIME_LIMIT)
            tried = replace(fixes[-1], tried="undecided" if undecided else "fails")
            if self.budget.exhausted or not left or undecided or status is Status.NOT_FINITE:
                break
            if one.key == "duration":
                fixes = [longer(self.problem, fixes[-1])]
            elif (more := self._more_weight(done)) is not None:
                fixes, failed = [*fixes, more[0]], more[1]
            else:
                break
        return tried, None

    @staticmethod
    def _more_weight(done: Refined | None) -> tuple[SuggestedFix, Plan] | None:
        """Larger weights that a failed trial asks for, and its plan."""
        if done is None:
            return None
        found = suggested_fixes(done.plan, done.proof)
        return next(((one, done.plan) for one in found if _kind(one) == "weights"), None)

    def _tried(self, fixes: list[SuggestedFix], failed: Plan) -> tuple[Refined | None, Status | None]:
        """The plan and proof of a trial of the last of some fixes, after finer steps, and the status of its solve.

        None for what there is not.
        """
        one, problem, asked = fixes[-1], self.problem, self.max_iterations
        if one.key == ITERATIONS:
            asked = one.value
        else:
            try:
                problem = with_fixes(problem, fixes)
                if _kind(one) in FROM_THE_PLAN and failed.converged and problem.N % failed.N == 0:
                    problem = replace(problem, us=warm_start(failed, problem))
            except PlannerError as error:
                self.report(FixTrial(one, "refused", str(error)))
                return None, None
        if (which := _mark(problem, asked)) in {_mark(self.problem, self.max_iterations), *self._solved}:
            self.report(FixTrial(one, "fails", SAME_PROBLEM))
            return None, None
        share = 1.0 if one.code == "infeasible" else SHARE  # a duration that a relaxation has passed in
        budget = self.budget.part("suggested fixes", share).before_proof(problem)
        if budget.iterations(problem, MIN_ITERATIONS) < MIN_ITERATIONS:
            raise _OutOfWorkError
        self._solved.append(which)
        self.report(FixTrial(one, "begins"))
        plan = self.solve(problem, asked, ", with a suggested fix", budget)
        if plan.status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        if not plan.converged:
            self.report(FixTrial(one, "not solved", plan.status.name))
            return None, plan.status
        if any(_is_same(plan, other) for other in (failed, *self.before)):
            self.report(FixTrial(one, "fails", SAME_PLAN))
            return None, plan.status
        self.budget.charge_proof(problem)
        done = self.refine(plan, self.prove(plan))
        if not done.passed:
            self.report(FixTrial(one, "fails", done.proof.reason))
        return done, plan.status


def _mark(problem: Problem, max_iterations: int) -> str:
    """What decides a solve: the file's table, its limits as bounds and ranges, the most iterations.

    Two values of a key may come to the same: a margin is at most a share of a range, and widened to start and goal.
    """
    resolved = {name: part for name, part in problem.parameters.get(_RESOLVED, {}).items() if name != "reasons"}
    limits = problem.limits and replace(problem.limits, margin=None)
    table = {**problem.parameters, _RESOLVED: resolved, "limits": limits and limits.to_dict()}
    sides = [side for one in (problem.bounds, problem.ranges) if one for side in (one.lower, one.upper)]
    content = [json.dumps(json_value(table), sort_keys=True, default=repr), str(max_iterations)]
    return digest_of("".join(content).encode() + b"".join(array.tobytes() for array in sides))


def _is_same(plan: Plan, other: Plan) -> bool:
    """Whether two plans are one motion, but for rounding of their solves: what is proved of them is equal."""
    pairs = ((plan.us, other.us), (plan.xs, other.xs))
    if plan.dt != other.dt or any(a.shape != b.shape for a, b in pairs):
        return False
    return all(np.allclose(a, b, rtol=0.0, atol=SAME * float(np.abs(b).max(initial=0.0))) for a, b in pairs)


def _kind(one: SuggestedFix) -> str:
    """What a fix changes: its table, or its key."""
    return one.key.partition(".")[0]


class _OutOfWorkError(Exception):
    """What is left of the budget is too little for a trial."""


def with_fixes(problem: Problem, fixes: Sequence[SuggestedFix]) -> Problem:
    """The problem of a file with fixes in its table, and their reasons among those of the defaults."""
    assert problem.recipe is not None  # of a problem file
    table = {name: value for name, value in problem.parameters.items() if name != _RESOLVED}
    for one in fixes:
        table = one.applied(table)
    again = problem.recipe.build(**table) if problem.recipe.build else problem
    assert again.recipe is not None
    resolved = again.parameters[_RESOLVED]
    reasons = resolved["reasons"] | {one.key: f"applied automatically by planner run: {one.sentence}" for one in fixes}
    table = again.parameters | {_RESOLVED: resolved | {"reasons": reasons}}
    return replace(again, recipe=replace(again.recipe, parameters=table))


def is_automatic(key: str) -> bool:
    """Whether a repair may apply a fix of this key by itself."""
    return key in AUTOMATIC_KEYS or key.partition(".")[0] == "weights"
