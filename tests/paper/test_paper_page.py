"""`planner paper`: studies in turn, one table without an empty row, files that are all there or not at all."""

import json
import os
import pickle
import signal
from dataclasses import replace

import numpy as np
import pytest

from planner import cases
from planner.__main__ import main
from planner.base.errors import PlannerError
from planner.cases.hopper import PAPER
from planner.cli import paper as command
from planner.paper.studies import page as pages
from planner.paper.studies.many_starts import local_minima
from planner.paper.studies.page import complete, page, run_studies, table_rows
from planner.paper.studies.study import Row, Study
from planner.paper.studies.table_1 import random_lq, table_one, table_results
from planner.paper.studies.theorem import STUDY as THEOREMS
from planner.paper.studies.theorem import Family, identity_errors, random_identity, record_solve
from planner.solvers import lq
from planner.sweeps.processes import LocalProcesses
from tests.solves import hopper, swing

ROW = Row("2.1", "9.9", "10 | 11", "masses")


def draw(results, path):
    path.write_text(f"picture of {results['number']}")


def seven():
    return {"number": 7}


def sentence(results):
    return [f"### Number {results['number']}"]


def one_row(results):
    return [ROW]


def study(name="one", rows=(ROW,), results=lambda: {"number": 7}):
    lines = ["### Head", "", "#### Below", "", "![p](one.png)"]
    return Study(name, f"about {name}", results, lambda _: lines, lambda _: list(rows), {f"{name}.png": draw})


def fails():
    raise PlannerError("no data, expected some.")


# The page


def test_rows_are_sorted_by_section(tmp_path):
    done = run_studies([study(rows=(ROW._replace(where="4"), ROW))], tmp_path)
    rows = table_rows(done)
    assert [row.where for row in rows] == ["2.1", "4"]
    assert complete(done, rows)
    assert not complete(done, [*rows, ROW._replace(why=" ")])


def test_studies_in_processes_of_their_own_come_in_the_order_of_the_page(tmp_path):
    short = Study("short", "about", seven, sentence, one_row, {"short.png": draw}, seconds=1.0)
    failed = Study("failed", "about", fails, sentence, one_row, seconds=2.0)
    lines = []
    with LocalProcesses(1) as executor:
        done = run_studies([short, failed], tmp_path, lines.append, executor)
    assert [(one.study.name, one.results, one.problem) for one in done] == [
        ("short", {"number": 7}, ""), ("failed", None, "no data, expected some."),
    ]  # fmt: skip
    assert (tmp_path / "short.png").exists()
    assert [line.partition(":")[0] for line in lines] == ["1/2 failed", "2/2 short"]  # the longest begins first


def test_page_has_headings_links_and_cells_in_order(tmp_path):
    done = run_studies([study(), study("two")], tmp_path)
    text = page(done, table_rows(done), "../pictures/", True)
    assert "10 \\| 11" in text
    assert text.count("\n## Head\n\n### Below\n") == 2
    assert "](../pictures/one.png)" in text
    assert "![about two](../pictures/two.png)" in text  # which its text leaves out
    assert (tmp_path / "one.png").read_text() == "picture of 7"


def test_a_section_ends_with_the_first_table_and_the_page_says_where_the_others_are(tmp_path):
    both = ["# Head", "", "words", "", "| a |", "|---|", "| 1 |", "", "later", "", "| b |", "|---:|", "| 2 |"]
    one = replace(study(), lines=lambda _: both)
    text = page(run_studies([one], tmp_path), [], "x/", True)
    section = text[text.index("## Head") :]
    assert section.split("\n") == [
        "## Head", "", "words", "", "| a |", "|---|", "| 1 |", "", "![about one](x/one.png)", "",
    ]  # fmt: skip
    assert "[one](x/one.md)" in text
    assert "later" in one.page({})


def test_a_study_that_fails_is_a_row(tmp_path):
    lines = []
    done = run_studies([study(results=fails), study("two")], tmp_path, lines.append)
    rows = table_rows(done)
    assert ("one", "about one", "failed", "no data, expected some.") in rows
    assert not complete(done, rows)
    assert "no data" in page(done, rows, "", False)
    assert any("no data" in line for line in lines)


def test_catalogue():
    names = [one.name for one in pages.STUDIES]
    assert len(set(names)) == len(names)
    pictures = [name for one in pages.STUDIES for name in one.pictures]
    assert len(set(pictures)) == len(pictures)
    with pytest.raises(PlannerError, match=f"expected one of: {', '.join(names)}"):
        pages.chosen(["hopper", "flight"])


# The command


@pytest.fixture
def small(monkeypatch):
    """The command with one small study."""

    def use(*studies):
        for module in (command, pages):
            monkeypatch.setattr(module, "STUDIES", studies)
        monkeypatch.setattr(command, "processors", lambda: 1)  # lambdas cannot go to another process

    return use


def test_the_page_goes_into_a_checkout_or_beside_us(small, tmp_path, monkeypatch, capsys):
    small(study())
    monkeypatch.chdir(tmp_path)
    assert main(["paper", "--quiet"]) == 0
    files = {"paper-results.md", "paper-results.json", "one.md", "one.json", "one.png"}
    assert {file.name for file in (tmp_path / "paper").iterdir()} == files
    (tmp_path / "docs").mkdir()
    (tmp_path / "renders").mkdir()
    (tmp_path / "pyproject.toml").write_text('[project]\nname = "another"\n')
    assert main(["paper", "--quiet"]) == 0
    assert list((tmp_path / "docs").iterdir()) == []
    (tmp_path / "pyproject.toml").write_text('[project]\nname = "slq-planner"\n')
    assert main(["paper", "--quiet"]) == 0  # the documents have the full numbers
    assert list((tmp_path / "docs").iterdir()) == []
    capsys.readouterr()
    assert main(["paper", "--full", "--quiet", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["rows"][0] == ROW._asdict()
    assert all((tmp_path / name).is_file() for name in document["files"])
    assert [file.name for file in (tmp_path / "docs").iterdir()] == ["paper-results.md"]
    assert {file.name for file in (tmp_path / "renders/gallery/paper").iterdir()} == files - {"paper-results.md"}
    assert "](../renders/gallery/paper/one.png)" in (tmp_path / "docs" / "paper-results.md").read_text()


def test_a_failed_study_shows_in_the_exit_code(small, tmp_path):
    small(study(results=fails), study("two"))
    assert main(["paper", "--quiet", "--out", str(tmp_path / "p")]) == 1
    assert "no data" in (tmp_path / "p" / "paper-results.md").read_text()
    assert main(["paper", "one", "--quiet", "--out", str(tmp_path / "q")]) == 2
    assert not (tmp_path / "q").exists()


def test_studies_are_chosen_by_name(small, tmp_path, capsys):
    small(study(), study("two"))
    assert main(["paper", "two", "--quiet", "--json", "--out", str(tmp_path)]) == 0
    assert json.loads(capsys.readouterr().out)["number"] == 7  # of a single study, the results themselves
    assert {file.name for file in tmp_path.iterdir()} == {"two.md", "two.json", "two.png"}
    assert main(["paper", "three", "--quiet", "--out", str(tmp_path / "q")]) == 2
    assert "expected one of: one, two" in capsys.readouterr().err
    assert main(["paper", "two", "--proofs", "--out", str(tmp_path / "q")]) == 2
    assert not (tmp_path / "q").exists()


def test_full_numbers_where_a_study_has_them(tmp_path):
    both = replace(study(), full=lambda: {"number": 8})
    assert [run_studies([both], tmp_path, full=full)[0].results for full in (False, True)] == [
        {"number": 7}, {"number": 8},
    ]  # fmt: skip


def test_a_page_goes_on_where_it_was_stopped(small, tmp_path):
    """Another call of the same kind does not run what was finished; one for the documents does."""
    began = []

    def count():
        began.append("one")
        return {"number": 7}

    def stop():
        raise KeyboardInterrupt

    place = ["--quiet", "--out", str(tmp_path / "p")]
    small(replace(study(results=count), seconds=20.0), study("two", results=stop))
    assert main(["paper", *place]) == 130
    assert main(["paper", "--full", *place]) == 130
    assert (len(began), [path.name for path in (tmp_path / "p").iterdir()]) == (2, [".unfinished"])
    small(study(results=count), study("two"))
    assert main(["paper", *place]) == 0
    assert len(began) == 2
    assert (tmp_path / "p" / "one.png").read_text() == "picture of 7"
    assert not (tmp_path / "p" / ".unfinished").exists()


def test_an_interrupt_in_a_solve_writes_nothing(small, tmp_path, monkeypatch):
    """solve() takes Ctrl-C for its own and returns what it has, which must not become a number of the page."""

    def interrupted():
        from planner import solve

        def send(_):
            os.kill(os.getpid(), signal.SIGINT)

        return {"number": solve(hopper(), callback=send).cost}

    small(study("two", results=interrupted), study("one"))
    before = signal.getsignal(signal.SIGINT)
    assert main(["paper", "--quiet", "--out", str(tmp_path / "p")]) == 130
    assert list(tmp_path.iterdir()) == []
    assert signal.getsignal(signal.SIGINT) is before


# Table 1 and the theorems


def test_table_one_solves_the_lq_problem():
    """Against the stationarity of the LQ problem itself: r + R du + B' costate = 0 (Eq. 18, 25)."""
    rng = np.random.default_rng(1)
    for _ in range(20):
        A, B, model = random_lq(rng)
        dxs, dus = table_one(A, B, model)
        q = model.q + np.einsum("nij,nj->ni", model.Q, dxs)
        r = model.r + np.einsum("nij,nj->ni", model.R, dus)
        stationary = lq.gradient(A, B, model._replace(q=q, r=r))
        np.testing.assert_allclose(stationary, 0.0, atol=1e-7 * max(1.0, np.abs(dus).max()))
    assert table_results(20)["difference"] < 1e-8


def test_eq_42_and_that_it_can_fail():
    found = random_identity(50)
    assert found["largest_slope"] < 0.0
    assert max(found["gradient_error"], found["sweep_error"]) < 1e-10
    problem = cases.two_link(horizon=40)
    plan, steps = record_solve(problem)
    assert len(steps) == sum(line.step > 0.0 for line in plan.history)
    assert plan.cost == pytest.approx(cost_of(problem, plan.us), rel=1e-12)
    step = steps[0]
    np.testing.assert_array_equal(step.us, problem.first_guess)
    A, B = problem.dynamics.linearize(step.xs, step.us)
    model = problem.cost.quadratize(step.xs, step.us)
    right, by_gradient, by_sweep = identity_errors(A, B, model, step)
    assert right < 0.0
    assert max(by_gradient, by_sweep) < 1e-8
    assert identity_errors(A, B, model, step._replace(gradient=1.01 * step.gradient))[1] == pytest.approx(0.01, rel=0.1)
    with pytest.raises(PlannerError, match="not compiled"):
        record_solve(swing())


def cost_of(problem, us):
    from tests.solves import rollout

    return problem.cost.value(*rollout(problem, us))


def test_local_minima_are_told_apart_at_a_thousandth():
    found = local_minima([2.0, 1.0, 1.0005, 1.01, 2.0001])
    assert [(one["cost"], one["count"]) for one in found] == [(1.0, 2), (1.01, 1), (2.0, 2)]


def test_theorems_on_a_small_family(tmp_path):
    family = Family(lambda: cases.build("hopper", **{**PAPER, "height": 1.0}), 1.0, 3)
    results = THEOREMS.run({"hop": family}, starts=6, problems=5)
    (case,) = results["cases"]
    runs = {(run["update"], run["search"]): run for run in case["runs"]}
    assert set(runs) == {(u, s) for u in ("feedback", "open-loop") for s in ("armijo", "exact", "wolfe", "goldstein")}
    many = runs.pop(("feedback", "armijo"))
    assert many["converged"] == 6
    assert sum(one["count"] for one in many["minima"]) + len(many["no_minima"]) == 6
    assert all(run["starts"] == 3 for run in runs.values())
    assert case["along"]["falls"] == case["along"]["steps"] > 0
    assert case["along"]["gradient_error"] < 1e-10
    again = THEOREMS.run({"hop": family}, starts=6, problems=5)["cases"][0]["runs"]
    assert [run["costs"] for run in again] == [run["costs"] for run in case["runs"]]
    assert "hop" in THEOREMS.page(results)
    assert all(cell for row in THEOREMS.rows(results) for cell in row)
    THEOREMS.pictures["theorems.png"](results, tmp_path / "t.png")
    assert (tmp_path / "t.png").stat().st_size > 10_000


def test_one_study_as_a_command(tmp_path, capsys):
    assert main(["paper", "table", "--quiet", "--json", "--out", str(tmp_path / "p")]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["difference"] < 1e-8
    assert {path.name for path in (tmp_path / "p").iterdir()} == {"table.md", "table.json"}


@pytest.mark.parametrize("study", pages.STUDIES, ids=lambda study: study.name)
def test_a_study_can_be_sent_to_a_process(study):
    """As `planner paper` does with all of them."""
    assert pickle.loads(pickle.dumps(study)).name == study.name
