"""Trials of suggested fixes: which is tried after one that did not pass, and from which plan."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from problem_files import arm, cured, tried

import planner
from planner.base.measured import Quantity
from planner.problem.plan import Status
from planner.proof.diagnostics import SuggestedFix, suggested_fixes
from planner.proof.repair import Tools, fixes, repair
from planner.proof.repair.fixes import FixTrial, FixTrials
from planner.proof.repair.refinement import refine
from planner.solvers.work import WorkBudget, work_of_proof, work_of_stage


class Trials(FixTrials):
    """Trials whose solves are given: what each returns, in order."""

    def _tried(self, fixes, failed):
        self.solve.append(([(one.key, one.value) for one in fixes], failed))
        done = self.prove.pop(0)
        return done if isinstance(done, tuple) else (done, None)


def trials(results):
    log = []
    return log, Trials(None, "plan", log, results, None, SimpleNamespace(exhausted=False), 10, lambda _: None)


def test_a_longer_duration_is_tried_also_where_a_shorter_one_was_not_solved(monkeypatch):
    monkeypatch.setattr(fixes, "longer", lambda _, one: replace(one, value=1.5 * one.value))
    passed = SimpleNamespace(passed=True)
    log, asked = trials([None, SimpleNamespace(passed=False), passed])
    found, done = asked._first_passing(SuggestedFix("", key="duration", value=2.0))
    assert done is passed
    assert found.value == 4.5
    assert [tried for tried, _ in log] == [[("duration", 2.0)], [("duration", 3.0)], [("duration", 4.5)]]


def test_weights_are_raised_from_the_plan_that_still_lacks_them(monkeypatch):
    def suggested(plan, proof):
        return (SuggestedFix("", key="dt", value=0.1), SuggestedFix("", key="weights.effort", value=plan))

    monkeypatch.setattr(fixes, "suggested_fixes", suggested)
    failed = [SimpleNamespace(passed=False, plan=k, proof=None) for k in range(9)]
    log, asked = trials(list(failed))
    assert asked._first_passing(SuggestedFix("", key="weights", value=7))[1] is None
    assert [plan for _, plan in log] == [
        "plan",
        *range(fixes.MAX_WEIGHTS - 1),
    ]  # each begins at the plan before
    assert log[2][0] == [("weights", 7), ("weights.effort", 0), ("weights.effort", 1)]
    assert trials([None])[1]._first_passing(SuggestedFix("", key="weights", value=7))[1] is None
    log, asked = trials(list(failed))
    assert asked._first_passing(SuggestedFix("", key="dt", value=7))[1] is None
    assert len(log) == 1


def test_a_trial_that_its_work_cut_is_undecided_and_no_longer_duration_is_tried():
    log, asked = trials([(None, Status.WORK_LIMIT), SimpleNamespace(passed=True)])
    found, done = asked._first_passing(SuggestedFix("", key="duration", value=2.0))
    assert done is None
    assert len(log) == 1
    assert found.tried == "undecided"


def test_what_was_tried_last_is_said_to_fail(monkeypatch):
    monkeypatch.setattr(fixes, "longer", lambda _, one: replace(one, value=1.5 * one.value))
    _, asked = trials([(None, Status.NO_DESCENT), (None, Status.NOT_FINITE), SimpleNamespace(passed=True)])
    found, done = asked._first_passing(SuggestedFix("", key="duration", value=2.0))
    assert done is None  # a solve that runs away does so in a longer time, too
    assert (found.value, found.tried) == (3.0, "fails")


@pytest.mark.parametrize("key", ["optimal", "goal"])
def test_a_finding_without_a_value_does_not_keep_the_fixes_before_it_from_being_tried(key):
    passed = SimpleNamespace(passed=True)
    _, asked = trials([passed])
    asked.budget.before_proof = lambda _: SimpleNamespace(exhausted=False)
    found = (SuggestedFix("", key="duration", value=2.0), SuggestedFix("", key=key))
    assert [one.tried for one in asked.run(found)[1]] == ["passes", ""]


def test_no_trial_begins_that_could_not_solve_anything(tmp_path):
    """What is left of the work is for a few iterations: less than a trial takes, and more than nothing."""
    problem = arm(tmp_path, weights={"final_position": 20})
    plan, proof = tried(problem)

    def solve(problem, max_iterations, purpose, budget):
        raise AssertionError("a trial began")

    steps, judge = [], partial(planner.prove, rollouts=0)
    work = WorkBudget(work_of_proof(problem) + 2 * 5 * problem.N * work_of_stage(problem))  # half of 10 iterations
    repair(problem, plan, proof, (), Tools(solve, judge, {}, 1000, steps.append, lambda *_: None), budget=work)
    assert [one.outcome for one in steps if isinstance(one, FixTrial)] == ["not tried"]


@pytest.mark.slow
def test_a_fix_whose_plan_then_has_too_long_a_step_goes_on_at_a_finer_one(tmp_path):
    """Neither the fix alone nor finer steps alone make it pass."""
    problem = arm(tmp_path, weights={"final_position": 20}, integrator='"euler"')
    plan, proof = tried(problem)
    assert proof is not None
    assert not tried(cured(problem, suggested_fixes(plan, proof)[0]))[1].passed
    assert len(refine(plan, proof).path) == 1

    def solve(problem, max_iterations, purpose, budget):
        return planner.solve(problem, max_iterations=max_iterations, budget=budget)

    steps, judge = [], partial(planner.prove, rollouts=0)
    tools = Tools(solve, judge, {}, 1000, steps.append, lambda *_: None)
    done = repair(problem, plan, proof, (), tools)
    assert done.proof is not None
    assert done.proof.passed
    assert [line.integrator for line in done.path] == ["euler", "rk4"]
    assert steps[-1].outcome == "applied"


@pytest.mark.parametrize(("key", "value", "follows"), [("dt", 0.005, True), ("starts", 2, False)])
def test_a_shorter_stage_is_tried_from_the_plan(tmp_path, key, value, follows):
    """Not from the first guess: what was hard to find, as a contact, is not to be found again."""
    problem = arm(tmp_path, weights={"final_position": 20}, dt=0.01)
    plan, _ = tried(problem)
    guesses = []

    def solve(problem, max_iterations, purpose, budget):
        guesses.append(problem)
        return replace(plan, status=Status.MAX_ITERATIONS)

    tools = Trials(problem, plan, solve, None, None, WorkBudget(1000.0), 10, lambda _: None)
    FixTrials._tried(tools, [SuggestedFix("guess_runs_away", key=key, value=value)], plan)
    (begun,) = guesses
    repeated = np.repeat(plan.us, begun.N // plan.N, axis=0)
    # Tracked, so not those controls to the bit; the file's own guess holds the arm and is far off.
    near = np.abs(begun.first_guess - repeated).max() <= 0.1 * np.abs(plan.us).max()
    assert near == follows


def margin(value):
    values = {
        "joint": "elbow",
        "excess": Quantity(0.1, "rad"),
        "limit": Quantity(2.0, "rad"),
        "time": Quantity(1.0, "s"),
    }
    return SuggestedFix("range_exceeded", values, key="limits.margin", value=value, written=f"limits.margin = {value}")


@pytest.mark.parametrize(
    ("values", "solves", "reasons"),
    [
        ([0.06], 0, ["SAME_PROBLEM"]),  # rad: the default, a hundredth of the range
        ([0.09, 0.09], 1, ["SAME_PLAN", "SAME_PROBLEM"]),  # the arm stays far from its stops
    ],
)
def test_what_leads_to_a_problem_or_a_plan_that_was_tried_is_not_tried_again(tmp_path, values, solves, reasons):
    ends = {"gravity": 0.0, "elbow": 'range="-3 3"', "shoulder": 'range="-3 3"'}
    problem = arm(tmp_path, weights={"final_position": 1}, limits={"position": '"model"'}, model=ends)
    plan, began, steps = planner.solve(problem), [], []

    def solve(problem, max_iterations, purpose, budget):
        began.append(problem)
        return planner.solve(problem, max_iterations=max_iterations, budget=budget)

    def prove(plan):
        raise AssertionError("a plan was proved again")

    asked = FixTrials(problem, plan, solve, prove, None, WorkBudget(60.0), 1000, steps.append)
    better, found = asked.run(tuple(map(margin, values)))
    assert better is None
    assert [one.tried for one in found] == ["fails"] * len(values)
    assert len(began) == solves
    assert [one.reason for one in steps if one.outcome == "fails"] == [getattr(fixes, name) for name in reasons]
