"""What is printed: at a terminal the last line of progress, of a proof each step by the number nearest to its bound."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
from carts import cart

import planner
from planner import cases
from planner.base.measured import Measurement, Section
from planner.cli import solving
from planner.cli.console import Console
from planner.cli.results import show_proof
from planner.cli.solving import show_plan

FINE = Section("plan", (Measurement("warnings", 0.0, bound=0.0), Measurement("far", 0.1, "m", 1.0),
                        Measurement("near", 0.8, "rad", 1.0), Measurement("shown", 7.0)))  # fmt: skip
WRONG = Section("goal", (Measurement("near", 0.9, "m", 1.0), Measurement("miss", 2.0, "m", 1.0),
                         Measurement("warnings", 3.0, bound=0.0)))  # fmt: skip
SHOWN = Section("growth", (Measurement("rate", 3.0, "1/s"),))


def test_a_step_is_told_by_its_failures_or_the_number_nearest_to_its_bound():
    assert FINE.judged_rows() == [("plan", "near", "0.8 rad", "1", "ok")]
    assert [row[1:] for row in WRONG.judged_rows()] == [("miss", "2 m", "1", "FAIL"), ("warnings", "3", "0", "FAIL")]
    assert SHOWN.judged_rows() == []


@pytest.mark.parametrize("verbose", [False, True])
def test_a_proof_is_printed_by_steps_or_whole(verbose, capsys):
    sections = {one.title: one for one in (FINE, WRONG, SHOWN)}
    rows = [row for one in sections.values() for row in one.rows()]
    words = {"headline": "FAIL", "reason": "missed.", "own_step": "At its own step."}
    proof = SimpleNamespace(sections=sections, rows=lambda: rows, monte_carlo=None, **words)
    show_proof(proof, [], Console(verbose=verbose))  # pyright: ignore
    printed = capsys.readouterr().out
    assert ("nearest to its bound" in printed) is not verbose
    assert ("growth" in printed) is verbose
    assert printed.count("FAIL") == 3  # of two rows, and the verdict
    assert len(printed.splitlines()) == (15 if verbose else 10)
    assert printed.endswith("FAIL\nmissed.\nAt its own step.\n")  # a line of its own


def test_a_line_of_progress_takes_the_place_of_the_last_one_at_a_terminal(capsys):
    console = Console()
    console.live = True
    for text in ("head\nfirst, longer", "second"):
        console.write_passing(text)
    console.write_progress("other")
    console.progress("film")(2, 2)
    assert capsys.readouterr().err == "head\n\rfirst, longer\rsecond       \nother\n\rfilm: 2/2\n"


@pytest.mark.parametrize("console", [Console(), Console(verbose=True)])
def test_in_a_log_each_line_of_progress_is_its_own(console, capsys):
    console.live = console.verbose
    for text in ("first", "second"):
        console.write_passing(text)
    assert capsys.readouterr().err == "first\nsecond\n"


@pytest.mark.parametrize(("shortest", "said"), [(1.0, True), (0.9, False)])
def test_a_search_that_ends_at_the_shortest_duration_says_so(shortest, said, capsys):
    problem = cart(N=20, duration=1.0)
    plan = replace(planner.solve(problem), options={"durations": [shortest, 3.0]})
    show_plan(plan, None, Console())
    assert ("write a shorter one" in capsys.readouterr().out) is said


def test_what_an_iteration_takes_is_said_with_the_first_solve_only(monkeypatch):
    said = []
    problem = cases.two_link(horizon=10)
    monkeypatch.setattr(solving, "work_of_stage", lambda problem: 154.4 / problem.N)
    monkeypatch.setattr(solving, "solve", lambda *_, **__: None)
    console = SimpleNamespace(write_progress=said.append, iteration=None, row=None)
    asked = SimpleNamespace(
        problem=problem, starts=1, seed=0, notes=(), durations=None, phase_times={}, solved=lambda *_, **__: None
    )
    names = ("hessian", "update", "line_search", "max_iterations")
    arguments = SimpleNamespace(case="two-link", rank="cost", **dict.fromkeys(names))
    solving.solved(asked, arguments, console)
    solving.solved(asked, arguments, console, purpose=", with a suggested fix")
    assert [line for line in said if "takes" in line] == ["an iteration takes about 150 s"]
