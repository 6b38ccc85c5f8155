"""A FAIL is followed by what to write: on the console, in proof.json and in the report."""

import json

import pytest
from carts import cart

import planner
from planner.cli.console import Console
from planner.cli.results import draw_results, show_cures, show_verdict, write_proof
from planner.proof.diagnostics import suggested_fixes


@pytest.fixture(scope="module")
def failed():
    """A cart that may use a fortieth of the force that its way takes."""
    plan = planner.solve(cart(control=0.01), max_iterations=200)
    return plan, planner.prove(plan, rollouts=0)


def test_a_fail_says_what_to_write(failed, capsys, tmp_path):
    plan, proof = failed
    assert not proof.passed
    first = suggested_fixes(plan, proof)[0]
    assert first.key == "duration"
    assert "RigidBodyDynamics(..., dt=" in first.sentence
    show_verdict(proof, Console())
    assert f"to pass: {first}\n" in capsys.readouterr().out
    write_proof(plan, proof, tmp_path, "digest")
    stored = json.loads((tmp_path / "proof.json").read_text(encoding="utf-8"))
    assert stored["cures"][0] == first.to_dict()
    draw_results(plan, proof, tmp_path, False, Console(quiet=True))
    assert "To pass: `RigidBodyDynamics" in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_a_plan_that_was_not_replayed_says_it_too(failed, capsys):
    show_cures(failed[0], None, Console())
    assert capsys.readouterr().out.startswith("to pass: `")


def test_a_solve_that_hangs_on_its_limits_says_on_which(failed):
    assert failed[0].status is not planner.Status.CONVERGED
    assert "control 0 is at its bound in" in failed[0].message or "'" in failed[0].message
    assert "raise max_iterations" not in failed[0].message
