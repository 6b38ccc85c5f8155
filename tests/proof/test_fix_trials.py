"""Trials of suggested fixes: which is tried after one that did not pass, and from which plan."""

from dataclasses import replace
from types import SimpleNamespace

from planner.proof.diagnostics import SuggestedFix
from planner.proof.repair import fixes
from planner.proof.repair.fixes import FixTrials


class Trials(FixTrials):
    """Trials whose solves are given: what each returns, in order."""

    def _tried(self, fixes, failed):
        self.solve.append(([(one.key, one.value) for one in fixes], failed))
        return self.prove.pop(0)


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
    assert [plan for _, plan in log] == ["plan", 0, 1]  # each begins at the plan before, MAX_WEIGHTS at most
    assert log[-1][0] == [("weights", 7), ("weights.effort", 0), ("weights.effort", 1)]
    assert trials([None])[1]._first_passing(SuggestedFix("", key="weights", value=7))[1] is None
    log, asked = trials(list(failed))
    assert asked._first_passing(SuggestedFix("", key="dt", value=7))[1] is None
    assert len(log) == 1
