"""The study of the dive: its numbers are what its page says, and the table has no empty cell."""

import json

import pytest

from planner.paper.studies.dive import PARTS, SHOWN, STUDY

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def results():
    return STUDY.run()


def test_results_are_json_and_the_dives_converged(results):
    again = json.loads(json.dumps(results))
    assert all(dive["status"] == "CONVERGED" for dive in again["dives"])
    assert all(dive["turn_miss"] < 0.05 for dive in again["dives"])  # rad, the tolerance of the case
    assert all(dive["beyond_ranges"] < 0.02 for dive in again["dives"][: SHOWN + 1])  # rad; a weight is no bound


def test_effort_alone_is_less_and_out_of_range(results):
    """Why the case has a weight on the posture."""
    assert results["effort_alone"]["effort"] < 0.2 * results["dives"][0]["effort"]
    assert results["effort_alone"]["beyond_ranges"] > 0.5


def test_momentum_shows_the_integrators_orders(results):
    for kind, order in (("rk4", 4.0), ("semi-implicit-euler", 1.0)):
        found = results["momentum"]["by_step"][kind]
        assert len(found["change"]) == len(PARTS)
        assert found["orders"][-1] == pytest.approx(order, abs=0.3)
    assert results["momentum"]["mujoco"] < 1e-8


def test_page_rows_and_picture(results, tmp_path):
    page = STUDY.page(results)
    assert page.count("\n| 1.5 |") == 2
    for row in STUDY.rows(results):
        assert all(row)
    STUDY.pictures["dive.png"](results, tmp_path / "dive.png")
    assert (tmp_path / "dive.png").stat().st_size > 20_000  # an empty picture is smaller
