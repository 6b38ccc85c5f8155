"""A FAIL is followed by what to write: on the console, in proof.json and in the report."""

import json

import pytest
from carts import cart

import planner
from planner.cli.console import Console
from planner.cli.results import draw_results, write_proof
from planner.cli.solving import show_fixes
from planner.problem.progress import control_at_bound
from planner.proof.diagnostics import suggested_fixes


@pytest.fixture(scope="module")
def failed():
    """A cart that may use a fortieth of the force that its way takes."""
    plan = planner.solve(cart(control=0.01), max_iterations=200)
    return plan, planner.prove(plan, rollouts=0)


def test_a_fail_says_what_to_write(failed, capsys, tmp_path):
    plan, proof = failed
    found = suggested_fixes(plan, proof)
    show_fixes(found, Console())
    assert f"to pass: {found[0]}\n" in capsys.readouterr().out
    write_proof(plan, proof, tmp_path, "digest", found)
    stored = json.loads((tmp_path / "proof.json").read_text(encoding="utf-8"))["cures"]
    assert (stored[0]["key"], stored[0]["code"], stored[0]["sentence"]) == ("duration", found[0].code, str(found[0]))
    assert stored == json.loads(json.dumps([one.to_dict() for one in found]))
    draw_results(plan, proof, tmp_path, found, False, Console(quiet=True))
    assert "<b>To pass:</b> <code>RigidBodyDynamics" in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_a_plan_that_was_not_replayed_has_fixes_too(failed):
    assert [one.key for one in suggested_fixes(failed[0])][:1] == ["duration"]


def test_a_solve_at_its_limits_names_the_control(failed):
    plan = failed[0]
    assert plan.status is not planner.Status.CONVERGED
    found = control_at_bound(plan.problem, plan.xs, plan.us)
    assert found.values["control"] in plan.message
