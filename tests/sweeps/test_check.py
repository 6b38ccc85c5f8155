"""Stored plans are proved again, and what moved is named."""

import json
import shutil
from dataclasses import replace

import pytest
from commands import QUICK_ARM

import planner
from planner.__main__ import main
from planner.problem.plan import Status
from planner.sweeps import regression
from planner.sweeps.regression import check, stored_proof


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    """Two plans with their proofs."""
    folder = tmp_path_factory.mktemp("plans")
    plan = planner.solve(planner.cases.two_link(**QUICK_ARM))
    proof = json.dumps(planner.prove(plan, rollouts=0).to_dict())
    (folder / "arm").mkdir()
    for path in (folder / "arm" / "plan.npz", folder / "second.npz"):
        stored_proof(plan.save(path)).write_text(proof)
    return folder


@pytest.fixture
def folder(stored, tmp_path):
    """A copy of them to change."""
    return shutil.copytree(stored, tmp_path / "plans")


def change(folder, edit):
    file = folder / "arm" / "proof.json"
    stored = json.loads(file.read_text())
    edit(stored)
    file.write_text(json.dumps(stored))


def test_plans_that_prove_as_stored_pass(folder):
    done = check(folder)
    assert [one.plan.name for one in done] == ["plan.npz", "second.npz"]
    assert all(one.passed and not one.changes for one in done)
    assert main(["check", str(folder), "--quiet"]) == 0


def test_a_figure_that_was_better_is_a_regression(folder, capsys):
    def better(stored):
        stored["refined_open_loop"]["figures"]["end_angle_error"]["value"] = 1e-12

    change(folder, better)
    arm = folder / "arm"
    (moved,) = check(arm)[0].changes
    assert moved.regressed
    assert (moved.step, moved.name, moved.stored) == ("refined_open_loop", "end_angle_error", 1e-12)
    assert main(["check", str(arm), "--quiet"]) == 1
    assert "refined open loop end angle error" in capsys.readouterr().out
    assert main(["check", str(arm), "--quiet", "--update"]) == 0
    assert main(["check", str(arm), "--quiet"]) == 0


def test_a_figure_that_was_worse_has_moved(folder):
    def worse(stored):
        stored["refined_open_loop"]["figures"]["end_angle_error"]["value"] = 1.0

    change(folder, worse)
    (done,) = check(folder / "arm")
    (moved,) = done.changes
    assert not moved.regressed
    assert done.passed


def test_a_verdict_that_was_better_is_a_regression(folder):
    plan = planner.solve(planner.cases.two_link(**QUICK_ARM, integrator="semi-implicit-euler"))
    plan.save(folder / "arm" / "plan.npz")  # the figures beside it are of the plan that passed
    done = check(folder / "arm")[0]
    assert not done.passed
    assert done.changes[0].step == "verdict"
    assert done.changes[0].now == "FAIL (None)"


@pytest.mark.parametrize(
    ("before", "regressed"),
    [
        ({"feasible": False}, False), ({"optimal": False}, False), ({"robustness": "robust"}, True),
        ({"robustness": "fragile"}, False), ({"not_checked": ["no goal was asked for"]}, False),
    ],
)  # fmt: skip
def test_words_of_the_first_line_are_compared(folder, before, regressed):
    """A robust plan that is so no longer is a regression; what is better than stored has moved."""
    change(folder, lambda document: document.update(before))
    (moved,) = check(folder / "arm")[0].changes
    assert (moved.step, moved.name) == ("headline", next(iter(before)).replace("_", " "))
    assert moved.regressed is regressed


SINKS = "a foot of the left leg 2 sinks 0.016 m into the ground"


@pytest.mark.parametrize(
    ("before", "outcome"),
    [
        ([SINKS], []), ([SINKS.replace("0.016", "0.0164")], []), ([SINKS.replace("0.016", "0.015")], []),
        ([SINKS.replace("0.016", "0.03")], [True]), ([SINKS.replace("leg 2", "leg 3")], [True]), ([], [True]),
        ([SINKS, "no goal was asked for"], [False]),
    ],
)  # fmt: skip
def test_phrases_are_compared_by_their_words_and_the_values_in_them(before, outcome):
    """A stored proof was told as changed when a digit of a phrase was another."""
    document = {"verdict": "PASS", "mode": "feedback", "feasible": True, "optimal": True, "robustness": ""}
    changes = regression._changes(document | {"not_checked": before}, document | {"not_checked": [SINKS]}, 0.05)
    assert [one.regressed for one in changes] == outcome


@pytest.mark.parametrize(("before", "regressed"), [("", [True]), ("At its own step.", []), (None, [])])
def test_a_plan_that_the_files_own_step_no_longer_repeats_is_a_regression(before, regressed):
    document = {"verdict": "PASS", "mode": "feedback", "feasible": True, "optimal": True, "robustness": ""}
    now = document | {"not_checked": [], "own_step": "At its own step."}
    stored = document | {"not_checked": []} | ({} if before is None else {"own_step": before})  # None: an older file
    assert [one.regressed for one in regression._changes(stored, now, 0.05)] == regressed


def test_a_plan_that_passes_now_is_no_regression_by_what_is_said_of_the_files_own_step():
    """Of the stored FAIL it had not been said."""
    now = {
        "verdict": "PASS",
        "mode": "feedback",
        "feasible": True,
        "optimal": True,
        "robustness": "",
        "not_checked": [],
    }
    stored = now | {"verdict": "FAIL", "own_step": ""}
    changes = list(regression._changes(stored, now | {"own_step": "At its own step."}, 0.05))
    assert [(one.step, one.regressed) for one in changes] == [("verdict", False)]


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        ("off by 0.98 rad/s", "off by 1 rad/s", True), ("12 mm deep", "13 mm deep", True), ("9.8 %", "10 %", True),
        ("1 m", "2 m", False), ("1 rad", "1 mm", False), ("leg 1 sinks 12 mm", "leg 2 sinks 12 mm", False),
        ("knee 1 of 2 legs", "knee 1 of 3 legs", False), ("arm2.51 is off", "arm2.52 is off", False),
        ("1e-05 N m", "1.04e-05 N m", True), ("100 J", "1.03e+02 J", True), ("axis 1 moves", "axis 1.05 moves", False),
        ("foot 1 slips", "foot 1.0 slips", False),
    ],
)  # fmt: skip
def test_a_number_before_a_unit_is_a_value_and_one_of_a_name_is_a_word(one, other, same):
    """Two digits of 0.98 and 1.0 are `0.98` and `1`, which were told as another phrase."""
    assert regression._same_phrase(one, other, 0.05) is same


def test_a_plan_that_is_no_longer_optimal_is_a_regression(folder):
    """Feasible as before, with the same numbers, but the solve did not converge."""
    plan = planner.load_plan(folder / "arm" / "plan.npz")
    replace(plan, status=Status.MAX_ITERATIONS).save(folder / "arm" / "plan.npz")
    change(folder, lambda document: document["asked"].update(optimal=False))
    changed = {f"{one.step} {one.name}": one for one in check(folder / "arm")[0].changes}
    assert changed["headline optimal"].regressed
    assert (changed["headline optimal"].stored, changed["headline optimal"].now) == ("yes", "no")
    assert "verdict " not in changed  # which feasibility alone decides here
    change(folder, lambda document: [document.pop(name) for name in ("feasible", "optimal", "not_checked")])
    assert not any("headline" in str(one) for one in check(folder / "arm")[0].changes)  # of an older version


def test_a_figure_that_is_no_longer_measured_is_a_regression(folder):
    change(folder, lambda stored: stored["goal"]["figures"].update(height={"value": 1.0, "passed": True}))
    assert not check(folder / "arm")[0].passed


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (lambda folder: (folder / "arm" / "proof.json").unlink(), "its proof.json is not there"),
        (lambda folder: (folder / "arm" / "proof.json").write_text("[]"), "is not a proof"),
        (lambda folder: (folder / "arm" / "plan.npz").write_bytes(b"PK"), "is not a plan"),
        (lambda folder: change(folder, lambda s: s.update(asked=[])), "no usable 'asked'"),
        (lambda folder: change(folder, lambda s: s["asked"].update(rollouts="x")), "rollouts"),
    ],
)
def test_a_damaged_plan_or_proof_is_a_regression_named_in_a_sentence(folder, monkeypatch, edit, words):
    prove = planner.prove
    monkeypatch.setattr(regression, "prove", lambda plan, **asked: prove(plan, **{"rollouts": 0} | asked))
    edit(folder)
    if words == "is not a plan":  # the other plan is still proved
        done, other = check(folder)
        assert other.passed
    else:
        (done,) = check(folder / "arm")
    assert words in done.problem
    assert (done.word, done.passed) == ("not compared", False)


def test_a_proof_without_steps_is_not_compared(folder, capsys):
    def emptied(stored):
        for step in [name for name, value in stored.items() if isinstance(value, dict) and "applicable" in value]:
            del stored[step]

    change(folder, emptied)
    (done,) = check(folder / "arm")
    assert (done.word, done.passed) == ("not compared", False)
    assert "its proof.json has no plan, parity, same step" in done.problem
    assert main(["check", str(folder / "arm"), "--quiet"]) == 1
    said = capsys.readouterr().out
    assert "not compared" in said
    assert "regressed" not in said
    assert main(["check", str(folder / "arm"), "--quiet", "--update"]) == 0
    assert check(folder / "arm")[0].word == "as stored"


def test_wrong_paths_and_tolerances_are_refused_in_one_sentence(tmp_path, capsys):
    for arguments, words in (
        (["check", str(tmp_path / "none")], "does not exist"), (["check", str(tmp_path)], "holds no plans"),
        (["check", str(tmp_path), "--tolerance", "0"], "tolerance"),
    ):  # fmt: skip
        assert main(arguments) == 2
        said = capsys.readouterr().err
        assert words in said
        assert said.count("\n") == 1


def test_a_proof_of_another_plan_is_not_compared(tmp_path, capsys):
    one, other = tmp_path / "one", tmp_path / "other"
    for folder, horizon in ((one, 30), (other, 33)):
        folder.mkdir()
        plan = planner.solve(planner.cases.two_link(**QUICK_ARM | {"horizon": horizon})).save(folder / "plan.npz")
        words = ["prove", str(plan), "--rollouts", "0", "--quiet", "--out", str(folder / "proof.json")]
        assert main(words) in (0, 1)
    shutil.copy(one / "proof.json", other / "proof.json")
    capsys.readouterr()
    assert main(["check", str(tmp_path), "--quiet"]) == 1
    said = capsys.readouterr().out
    assert "proof.json is the proof of another plan file" in said
    assert main(["check", str(other), "--quiet", "--update"]) == 0
    assert main(["check", str(other), "--quiet"]) == 0
