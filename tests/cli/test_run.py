"""`planner run` from end to end: refined where the step was too coarse, and resumed where it was interrupted."""

import json
import math

import commands
import pytest
from carts import write

import planner
from planner.__main__ import main
from planner.base.data_files import json_text
from planner.cases.plan_file import load_plan
from planner.cases.problem_file import load
from planner.cli import running as run_command
from planner.cli.results import refinement_row
from planner.cli.running import MARK, _refinement_of, run_folder
from planner.proof.repair.refinement import Refinement
from planner.solvers.work import WorkBudget, work_of_proof

ARM = ["run", *commands.ARM, "--no-video", "--quiet"]
EULER = [*ARM, "--integrator", "semi-implicit-euler"]


def document(capsys):
    return json.loads(capsys.readouterr().out)


def test_a_plan_that_fails_by_its_step_is_refined_until_it_passes(tmp_path, capsys):
    assert main([*EULER, "--rollouts", "0", "--json", "--out", str(tmp_path / "o")]) == 0
    said = document(capsys)
    path = said["refinement"]
    assert [line["verdict"] for line in path][:1] == ["FAIL"]
    assert path[-1]["verdict"] == said["proof"]["verdict"] == "PASS"
    assert path[0]["integrator"] == "semi-implicit-euler"
    assert path[-1]["integrator"] == "rk4"
    assert json.loads((tmp_path / "o" / "proof.json").read_text())["refinement"] == path
    assert load_plan(tmp_path / "o" / "plan.npz").parameters["integrator"] == "rk4"
    report = (tmp_path / "o" / "report.html").read_text()
    assert "planner run two-link --duration 0.6 --horizon 30 --integrator semi-implicit-euler" in report


def test_a_plan_that_passes_although_its_steps_are_coarse_exits_with_0(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("planner.solvers.slq.is_unresolved", lambda plan: True)
    assert main([*ARM, "--rollouts", "0", "--json", "--out", str(tmp_path / "o")]) == 0
    said = document(capsys)
    assert said["plan"]["status"] == "UNRESOLVED"
    assert said["proof"]["headline"].startswith("PASS (open-loop), though half as long stages are predicted to move")
    report = ["report", str(tmp_path / "o" / "plan.npz"), "--rollouts", "0", "--no-video", "--json"]
    assert main([*report, "--out", str(tmp_path / "r")]) == 0


def test_not_refined_when_told_so(tmp_path, capsys):
    assert main([*EULER, "--no-refine", "--rollouts", "0", "--json", "--out", str(tmp_path / "o")]) == 1
    said = document(capsys)
    assert said["refinement"] == []
    assert said["proof"]["verdict"] == "FAIL"


def test_interrupted_pictures_are_drawn_by_the_next_run(tmp_path, capsys, monkeypatch):
    words = [*ARM, "--rollouts", "0", "--json", "--out", str(tmp_path / "o")]
    with monkeypatch.context() as patch:
        patch.setattr(run_command.results, "draw_results", lambda *_, **__: (_ for _ in ()).throw(KeyboardInterrupt))
        assert main(words) == 130
        assert "the same command continues from there" in capsys.readouterr().err
    assert {"plan.npz", "proof.json", MARK} == {file.name for file in (tmp_path / "o").iterdir()}
    monkeypatch.setattr("planner.cli.solving.solve", lambda *_, **__: pytest.fail("it solved again"))
    assert main(words) == 0
    assert document(capsys)["resumed"]
    assert (tmp_path / "o" / "report.html").is_file()


def test_a_refinement_that_was_interrupted_is_done_by_the_next_run(tmp_path, capsys, monkeypatch):
    words = [*EULER, "--rollouts", "0", "--json", "--out", str(tmp_path / "o")]
    with monkeypatch.context() as patch:
        patch.setattr("planner.proof.repair.refine", lambda *_, **__: (_ for _ in ()).throw(KeyboardInterrupt))
        assert main(words) == 130
    capsys.readouterr()
    assert main(words) == 0
    said = document(capsys)
    assert said["resumed"]
    assert [line["verdict"] for line in said["refinement"]] == ["FAIL", "PASS"]


def test_a_film_that_was_interrupted_is_made_by_the_next_run(tmp_path, capsys, monkeypatch):
    words = [*ARM, "--rollouts", "0", "--json", "--out", str(tmp_path / "o")]
    with monkeypatch.context() as patch:
        patch.setattr("planner.cli.results.draw_proof", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        assert main(words) == 130
    assert (tmp_path / "o" / MARK).is_file()
    before = (tmp_path / "o" / "plots.png").stat().st_mtime_ns
    capsys.readouterr()
    assert main(words) == 0
    assert document(capsys)["resumed"]
    assert (tmp_path / "o" / "plots.png").stat().st_mtime_ns == before
    assert (tmp_path / "o" / "proof.png").is_file()


def test_another_problem_begins_anew(tmp_path):
    """The mark of an unfinished run is of that run alone."""
    outputs = ("plan.npz", "proof.json")
    with run_folder(tmp_path / "o", outputs, {"height": 1}) as folder:
        folder.begin("plan.npz", lambda file: file.write_text("plan"), seconds=3.0)  # and never ends
    with run_folder(tmp_path / "o", outputs, {"height": 1}) as folder:
        assert folder.finished == {"plan.npz"}
        assert folder.notes == {"seconds": 3.0}
    with run_folder(tmp_path / "o", outputs, {"height": 2}) as folder:
        assert not folder.finished
        (tmp_path / "o" / "proof.json").write_text("of the older plan")
        folder.begin("plan.npz", lambda file: file.write_text("another"))
        assert not (tmp_path / "o" / "proof.json").exists()
        folder.end()
    assert [file.name for file in (tmp_path / "o").iterdir()] == ["plan.npz"]


def test_a_failure_before_the_plan_leaves_no_folder(tmp_path):
    with pytest.raises(ValueError, match="x"), run_folder(tmp_path / "a" / "b", ("plan.npz",), {}):
        raise ValueError("x")
    assert list(tmp_path.iterdir()) == []


def test_a_plan_that_cannot_be_written_leaves_older_files(tmp_path):
    (tmp_path / "proof.json").write_text("older")

    def full(_):
        raise OSError(28, "No space left on device")

    outputs = ("plan.npz", "proof.json")
    with (
        run_folder(tmp_path, outputs, {}) as folder,
        pytest.raises(planner.base.errors.FileError, match="no space left"),
    ):
        folder.begin("plan.npz", full)
    assert [file.name for file in tmp_path.iterdir()] == ["proof.json"]


@pytest.mark.parametrize("mark", ["", "[]", '{"run": 3}', "{" * 99999])
def test_a_broken_mark_is_no_mark(tmp_path, mark):
    (tmp_path / MARK).write_text(mark)
    (tmp_path / "plan.npz").write_text("plan")
    with run_folder(tmp_path, ("plan.npz",), {}) as folder:
        assert not folder.began


def test_a_goal_that_cannot_be_held_is_refused_before_any_work(tmp_path, capsys):
    assert main(["run", "hopper", "--hold", "5", "--out", str(tmp_path / "o")]) == 2
    assert "equilibrium" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_one_rollout_is_shown(tmp_path, capsys):
    plan = planner.solve(load(write(tmp_path)).problem).save(tmp_path / "plan.npz")
    assert main(["prove", str(plan), "--rollouts", "4", "--json", "--quiet"]) == 0
    carlo = document(capsys)["proof"]["monte_carlo"]
    for mode, found in carlo["modes"].items():
        case = found["worst"][0]
        words = ["prove", str(plan), "--replay-rollout", str(case), "--mode", mode, "--json"]
        assert main(words) == 0
        assert document(capsys)["replay_rollout"]["end_error"] == found["end_error"][case]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--perturb", "weight=1"], "--perturb is 'weight', expected one of: mass"),
        (["--perturb", "mass=x"], "--perturb mass is 'x', expected a number"),
        (["--perturb", "mass=-1"], "mass"),
        (["--rollouts", "-1"], "--rollouts: '-1' is not a whole number"),
        (["--replay-rollout", "-1"], "--replay-rollout: '-1' is not a whole number"),
        (["--hold", "-1"], "hold"),
        (["--mode", "closed"], "'closed'"),
    ],
)
def test_wrong_flags_of_a_proof_are_one_sentence(tmp_path, capsys, words, said):
    plan = planner.solve(planner.cases.two_link(horizon=20)).save(tmp_path / "plan.npz")
    assert main(["prove", str(plan), "--quiet", *words]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    "command", ["run", *(pytest.param(one, marks=pytest.mark.slow) for one in ("prove", "report"))]
)
def test_the_verdict_is_printed_before_what_is_only_shown(tmp_path, capsys, monkeypatch, command):
    """A note with the verdict, then a line for each of the other steps, then the table and, once, the verdict."""
    order = []
    from planner.cli.console import Console

    say, note = Console.write_result, Console.write_progress
    monkeypatch.setattr(Console, "write_result", lambda self, text="": (order.append(text.strip()), say(self, text)))
    monkeypatch.setattr(Console, "write_progress", lambda self, text: (order.append(text.strip()), note(self, text)))
    problem = write(tmp_path)
    plan = planner.solve(load(problem).problem).save(tmp_path / "plan.npz")
    words = {
        "run": ["run", str(problem), "--no-video", "--out", str(tmp_path / "o")],
        "prove": ["prove", str(plan)], "report": ["report", str(plan), "--no-video", "--out", str(tmp_path / "o")],
    }  # fmt: skip
    assert main([*words[command], "--rollouts", "4"]) == 0
    starts = (
        "before the perturbed simulations: PASS (open-loop); feasible, optimal, robustness: pending",
        "What is measured now does not change PASS",
        "the slowest rate", "contact sensitivity", "step  ",
        "PASS (open-loop); feasible, optimal, robustness: undecided\n",
    )  # fmt: skip
    seen = [line for line in order if "not applicable" not in line]
    places = [[i for i, line in enumerate(seen) if line.startswith(start)] for start in starts]
    assert [len(found) for found in places] == [1] * 6
    assert places[0][0] < places[1][0] < places[2][0] < places[3][0] < places[4][0] < places[5][-1]
    assert "perturbed simulations: " in capsys.readouterr().err


def test_without_rollouts_nothing_is_waited_for(tmp_path, capsys):
    plan = planner.solve(planner.cases.two_link(**commands.QUICK_ARM)).save(tmp_path / "plan.npz")
    assert main(["prove", str(plan), "--rollouts", "0", "--json"]) == 0
    printed = capsys.readouterr()
    proof = json.loads(printed.out)["proof"]
    words = {name: proof[name] for name in ("headline", "feasible", "optimal", "robustness", "not_checked")}
    headline = "PASS (open-loop); feasible, optimal"
    assert words == {"headline": headline, "feasible": True, "optimal": True, "robustness": "", "not_checked": []}
    assert "What is measured now" not in printed.err
    assert printed.err.count(headline) == 1  # with --json the table is there


# Budgets


def test_a_run_ends_with_its_work_and_says_where_it_went(tmp_path, capsys):
    """Half of so little work are a few iterations; the proof uses up the rest, so that no repair begins."""
    words = [*ARM, "--rollouts", "0", "--json", "--work", "0.001"]
    for name in ("o", "again"):
        assert main([*words, "--out", str(tmp_path / name)]) == 1
    said, same = (json.loads((tmp_path / name / "proof.json").read_text()) for name in ("o", "again"))
    assert said["budget"]["exhausted"] == "WORK_LIMIT"
    assert said["budget"]["work"] == 0.001
    assert set(said["budget"]["spent"]) == {"first solve", "proofs"}
    assert said["verdict"] == "FAIL"
    assert "cut by its WORK_LIMIT" in said["headline"]
    assert "work" in {one["key"] for one in said["cures"]}
    assert said["budget"] == same["budget"]
    assert (load_plan(tmp_path / "o" / "plan.npz").us == load_plan(tmp_path / "again" / "plan.npz").us).all()
    assert "work: " in capsys.readouterr().err


def test_a_run_whose_time_is_over_draws_nothing_more(tmp_path, capsys):
    assert main([*ARM, "--json", "--budget", "1e-6", "--out", str(tmp_path / "o")]) == 1
    said = document(capsys)
    assert said["plan"]["status"] == said["budget"]["exhausted"] == "TIME_LIMIT"
    assert said["files"] == ["plan.npz", "proof.json", "report.html"]
    assert said["proof"]["asked"]["rollouts"] == 0


def test_a_refinement_comes_back_from_the_notes_of_an_unfinished_run():
    """The plan before it has no seconds of its own, and JSON has no such number."""
    first = Refinement("rk4", 0.01, 100, 9, 0.02, planner.Status.CONVERGED, "FAIL", None, 4.0, math.nan)
    row = json.loads(json_text(refinement_row(first)))
    assert row["seconds"] is None
    assert str(_refinement_of(row)) == str(first)


def test_what_a_plan_bears_is_not_measured_of_one_that_was_not_solved(tmp_path, capsys):
    words = [*ARM, "--json", "--no-video", "--work", "0.001"]
    assert main([*words, "--out", str(tmp_path / "o")]) == 1
    proof = json.loads((tmp_path / "o" / "proof.json").read_text())
    for name in ("perturbed", "controller", "another_ground"):
        assert "the solve did not succeed" in str(proof[name])
    assert "perturbed simulations" not in capsys.readouterr().err


def test_what_a_plan_bears_is_not_measured_where_the_work_does_not_reach():
    """The steps after a verdict are some thirty replays, which a work of one proof does not pay."""
    plan = planner.solve(planner.cases.two_link(horizon=50))
    proof = planner.prove(plan, rollouts=0)
    for proofs, said in ((0.0, True), (1.0, True), (3.0, False)):
        budget = WorkBudget(proofs * work_of_proof(plan.problem))
        assert bool(run_command._missing(plan, proof, budget)) is said


def test_work_of_a_problem_file(tmp_path, capsys):
    words = ["run", str(write(tmp_path, work="0.001")), "--no-video", "--quiet", "--rollouts", "0", "--json"]
    assert main([*words, "--out", str(tmp_path / "o")]) == 1
    assert document(capsys)["budget"]["work"] == 0.001
