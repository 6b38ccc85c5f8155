"""What `planner run` tries by itself after a FAIL, said beside what came of it, and not after its time."""

import time
from argparse import Namespace
from dataclasses import replace

import pytest

import planner
from planner.cases.problem_file import NAME
from planner.cli import apply_fixes
from planner.cli.console import Console
from planner.proof.diagnostics import SuggestedFix

CURE = SuggestedFix("dt", 0.005, "`dt = 0.005`: at 0.01 s plan and MuJoCo part")


@pytest.fixture
def order():
    """What suggested_fixes() says after the trials."""
    return []


@pytest.fixture
def attempt(monkeypatch, order):
    """A function of `end` and the status of the second solve; returns what came of it."""

    def attempted(end, status, judge, cures=(CURE,)):
        plan = Namespace(case=NAME, status=planner.Status.CONVERGED, success=True)
        other = Namespace(case=NAME, status=status, success=status is planner.Status.CONVERGED)
        asked = Namespace(problem=Namespace(duration=1.0), _replace=lambda **_: None)
        monkeypatch.setattr(apply_fixes, "cures", lambda plan, proof: cures)
        monkeypatch.setattr(apply_fixes, "in_order", lambda plan, proof, found: order.extend(found))
        monkeypatch.setattr(
            apply_fixes, "longer", lambda problem, one: replace(one, value=1.5 * one.value, sentence=f"{1.5 * one.value} s")
        )  # fmt: skip
        monkeypatch.setattr(apply_fixes, "written", lambda problem, cure: Namespace(parameters={"starts": 1}))
        monkeypatch.setattr(apply_fixes, "solved", lambda *_, end, why: (other, 0.0))
        return apply_fixes.apply_fixes(asked, plan, None, end, Namespace(), Console(), judge), other

    return attempted


def fails(_):
    return Namespace(passed=False, reason="it falls.")


def test_a_cure_that_does_not_help_is_said(attempt, capsys):
    found, _ = attempt(time.monotonic() + 60.0, planner.Status.CONVERGED, fails)
    assert found is None
    assert capsys.readouterr().out == f"tried in vain (it falls.): {CURE}\n"


def test_a_cure_that_helps_is_written(attempt, capsys):
    found, other = attempt(time.monotonic() + 60.0, planner.Status.CONVERGED, lambda _: Namespace(passed=True))
    assert found[0] is other
    assert capsys.readouterr().out == f"written by itself: {CURE}\n"


def test_a_cure_of_the_users_own_keys_is_tried_and_not_written(attempt, order, capsys):
    other = SuggestedFix("duration", 2.0, "2.0 s")
    judged = iter([False, False, True])
    found, _ = attempt(
        time.monotonic() + 60.0, planner.Status.CONVERGED,
        lambda _: Namespace(passed=next(judged), reason="it is late; by far"), cures=(other, CURE),
    )  # fmt: skip
    assert found is None
    # first what planner run may write itself, then the duration and a longer one
    lines = [f"tried in vain (it is late ...): {CURE}", "tried in vain (it is late ...): 2.0 s"]
    assert capsys.readouterr().out.splitlines() == lines
    assert [(one.key, one.value, one.sentence) for one in order] == [
        ("duration", 3.0, "3.0 s (tried: with it the plan passes)")
    ]


def test_what_was_tried_in_vain_comes_last_and_says_so(attempt, order, capsys):
    ignore = SuggestedFix("ignore", [], "`ignore = []`")  # which the file would have to be read again for
    attempt(time.monotonic() + 60.0, planner.Status.CONVERGED, fails, cures=(CURE, ignore))
    assert [one.sentence for one in order] == ["`ignore = []`", f"{CURE} (tried: not enough)"]


def test_nothing_is_tried_after_its_time(attempt, capsys):
    assert attempt(time.monotonic() - 1.0, planner.Status.CONVERGED, fails)[0] is None
    assert capsys.readouterr().out == f"not tried, for want of time: {CURE}\n"


def test_a_solve_that_its_time_ends_is_no_ctrl_c(attempt, capsys):
    with pytest.raises(KeyboardInterrupt):
        attempt(time.monotonic() + 60.0, planner.Status.INTERRUPTED, fails)
    seconds = iter([0.0, 2.0, 2.0])
    apply_fixes.time, clock = Namespace(monotonic=lambda: next(seconds)), apply_fixes.time
    try:
        assert attempt(1.0, planner.Status.INTERRUPTED, fails)[0] is None
    finally:
        apply_fixes.time = clock
    assert "tried in vain (the time for it was over)" in capsys.readouterr().out
