"""The study of the human step: what its numbers say is so, its page has no empty cell, its pictures are drawn."""

import json

import numpy as np
import pytest

from planner.cases import human_step
from planner.paper.studies import step_run as step_study
from planner.paper.studies.step_page import STUDY
from planner.paper.studies.step_run import feedforward_alone, first_within
from planner.solvers.slq import solve

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def results():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(step_study, "CYCLES", 1)
        return step_study.step_results((20, 2), {"feedback": 100, "open-loop": 30, "feedforward alone": 2})


def test_numbers_are_json_and_the_page_has_no_empty_cell(results):
    results = json.loads(json.dumps(results))
    rows = STUDY.rows(results)
    assert len(rows) == 5  # one for each thing that section 2.3 says
    assert all(cell.strip() for row in rows for cell in row)
    page = STUDY.page(results)
    for word in ("feedforward alone", "step_fig5.png", "step_cycle.png", "step_methods.png"):
        assert word in page


def test_the_rows_of_the_step_study_are_so(results):
    """Hip hiking, a foot that is clear, stance and swing together: section 7 of the study."""
    swing, lowest = results["swing"], results["without_clearance"]
    assert 0.045 < swing["hip_lift"]["right"] < 0.065
    assert lowest["hip_lift"]["right"] < 0.015
    cycle = results["updates"]["cycle"]["feedback"]
    assert cycle["status"] == "CONVERGED"
    assert cycle["costs"][0] > 800.0
    assert cycle["cost"] < 43.5
    assert results["cycle"]["replay_deg"]["open-loop"] < 0.7
    assert results["cycle"]["replay_deg"]["feedback"] < 0.35
    few = results["splines"][0]
    assert few["parameters"] == 30
    assert few["costs"][-1] < few["costs"][0]
    assert few["cost"] > results["updates"]["swing"]["feedback"]["cost"]  # splines are fewer than stages


def test_the_papers_update_arrives_where_the_feedback_one_does(results):
    """Eq. 36 with the LQ problem's own states: on the swing the same minimum."""
    swing = results["updates"]["swing"]
    assert swing["open-loop"]["status"] == "CONVERGED"
    assert swing["open-loop"]["cost"] == pytest.approx(swing["feedback"]["cost"], rel=1e-4)


def test_forgetting_the_states_of_the_lq_problem_is_far_worse():
    """After five iterations of a cycle: the study's own open-loop update, which was this, was stuck at 264 after 40."""
    problem = human_step(cost="study")
    costs = feedforward_alone(problem, 5)
    assert len(costs) == 6
    assert np.all(np.diff(costs) < 0.0)  # it descends
    assert costs[-1] > 2.0 * solve(problem, update="open-loop", max_iterations=5).cost


def test_first_within():
    costs = [100.0, 10.4, 10.05, 10.0]
    assert [first_within(costs, share) for share in (0.05, 0.01, 0.001)] == [1, 2, 3]


def test_the_pictures_of_the_step_study_are_drawn(results, tmp_path):
    assert len(STUDY.pictures) == 3
    for name, draw in STUDY.pictures.items():
        path = tmp_path / name
        draw(results, path)
        assert path.stat().st_size > 10_000
