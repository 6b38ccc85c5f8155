"""prove() against the corpus: no right plan fails, no wrong plan passes; all of it is benchmarks/verdicts.py."""

import re

import pytest
import verdicts

from corpus import right, wrong

QUICK_RIGHT = [
    "an arm at the stops of its file", "an arm that is to stay upright", "contacts left out and never touched, loaded",
    "closed fingers that open, 1", "a sum of two angles, 1",
]  # fmt: skip
QUICK_WRONG = [
    "small arm in a model whose damping of joint[@name='j1'] times 1.05", "friction 5 % less",
    "through a cylinder, with a table of contacts", "unconverged, status and numbers made consistent",
    "a tiny machine in coarse steps", "a range that is broken between the knots",
    "a motion that was to return and does not", "a file: its status, digests computed again",
    "own Python through a wall of its twin's file, 1", "a prescribed cart through a wall, 1",
]  # fmt: skip


SLOW = dict.fromkeys(QUICK_RIGHT[:3], pytest.mark.slow)  # 1.5 s and more


@pytest.mark.parametrize("name", [pytest.param(name, marks=SLOW.get(name, ())) for name in QUICK_RIGHT])
def test_a_right_plan_passes(name):
    agrees, said = verdicts.judge_right(name, seed=0)
    assert agrees, said


@pytest.mark.parametrize("name", QUICK_WRONG)
def test_a_wrong_plan_does_not_pass(name):
    agrees, said = verdicts.judge_wrong(name, seed=0)
    assert agrees, said


@pytest.mark.slow
def test_none_right_fails_and_none_wrong_passes(capsys):
    """An eighth of the members, with fixed seeds: all of them take an hour."""
    assert verdicts.main(["--part", "1/8", "--anew", "1"]) == 0, capsys.readouterr().out
    assert re.search(r"right: 0 of \d+ FAIL; wrong: 0 of \d+ PASS", capsys.readouterr().out)
    assert len(right.MEMBERS) >= 120
    assert len(wrong.MEMBERS) >= 300


def test_members_have_names_of_their_own():
    assert not set(right.MEMBERS) & set(wrong.MEMBERS)
