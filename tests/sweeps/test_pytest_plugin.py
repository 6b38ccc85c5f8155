"""The fixture assert_plan_holds: it passes for a plan that holds, and fails with a sentence for one that does not."""

import shutil
from pathlib import Path

import pytest
from test_stored_model import ARM, forged, loosened, stored_in

import planner
from planner.model.mjcf.text import edited
from planner.sweeps import regression
from planner.sweeps.pytest_plugin import _assert_plan_holds as holds
from planner.sweeps.regression import check, stored_proof

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return stored_in(tmp_path_factory.mktemp("made")).parent


@pytest.fixture
def folder(made, tmp_path):
    return shutil.copytree(made, tmp_path / "plans")


def fails(words: str, *given: object, **more: object) -> None:
    with pytest.raises(pytest.fail.Exception) as raised:
        holds(*given, **more)
    assert words in str(raised.value)


def test_a_plan_that_holds(folder):
    assert holds(folder / "plan.npz").passed
    assert holds(folder / "plan.npz", folder / "arm.xml").passed


@pytest.mark.parametrize(
    ("edits", "words"),
    [
        ({".//geom[@name='arm']": {"mass": "5.05"}}, "mass of body 'link' is 5.05, was 5 (+1 %)"),
        ({".//joint": {"damping": "0.11"}}, "damping of joint 'hinge' is 0.11, was 0.1 (+10 %)"),
        ({".//geom[@name='wall']": {"size": ".05 .05 .3"}}, "size of geom 'wall'"),
    ],
)
def test_a_changed_model(folder, edits, words):
    (folder / "arm.xml").write_text(edited(ARM, edits))
    fails(words, folder / "plan.npz")


def test_what_cannot_be_compared(folder, tmp_path, monkeypatch):
    prove = planner.prove
    monkeypatch.setattr(regression, "prove", lambda plan, **asked: prove(plan, **{"rollouts": 0} | asked))
    (folder / "arm.xml").rename(tmp_path / "arm.xml")
    fails("arm.xml is not there any more", folder / "plan.npz")
    assert holds(folder / "plan.npz", tmp_path / "arm.xml").passed
    fails("is a folder, expected one plan.npz", folder)
    fails("does not exist", folder / "none.npz")
    stored_proof(folder / "plan.npz").unlink()
    fails("proof.json is not there", folder / "plan.npz", tmp_path / "arm.xml")


def test_a_known_failure_does_not_hold(folder):
    """`check` says "as stored" of a plan that failed before and fails again; a test wants PASS."""
    plan = planner.load_plan(folder / "plan.npz")
    plan.us[:] = 0.0
    plan.save(folder / "plan.npz")
    (updated,) = check(folder, update=True)
    assert updated.proof.verdict == "FAIL"
    assert check(folder)[0].passed
    fails("FAIL", folder / "plan.npz")


def test_wide_tolerances_are_named_in_the_test(folder):
    """Whoever loosens a plan's file and stores its numbers anew has to change the test as well."""
    forged(folder / "plan.npz", tolerance=lambda _: 0.9, recipe=loosened)
    check(folder, update=True)
    fails("asks for a tolerance of 0.9 rad, 0.9 rad/s", folder / "plan.npz")
    assert holds(folder / "plan.npz", tolerances={"rad": 0.9, "rad/s": 1.0}).passed
    fails("0.9 rad", folder / "plan.npz", tolerances={"rad": 0.5, "rad/s": 1.0})


def test_pytest_finds_the_fixture_by_its_entry_point():
    text = (ROOT / "pyproject.toml").read_text()
    assert '[project.entry-points.pytest11]\n"planner.sweeps.pytest_plugin" = "planner.sweeps.pytest_plugin"' in text
