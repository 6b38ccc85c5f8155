"""What results show of themselves: figures, the HTML of a notebook, films."""

import base64
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from commands import QUICK_ARM
from matplotlib.figure import Figure

import planner
from planner.problem.plan import Status


@pytest.fixture(scope="module")
def proof():
    return planner.prove(planner.solve(planner.cases.two_link(**QUICK_ARM)), rollouts=0)


class Words(HTMLParser):
    """The text of a page; every element that is opened is closed."""

    def __init__(self, page):
        super().__init__()
        self.text, self.open = "", []
        self.feed(page)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        if tag != "img":
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


def test_plan_replay_and_proof_have_figures(proof):
    for result in (proof.replay.plan, proof.replay, proof):
        figure = result.plot()
        assert isinstance(figure, Figure)
        assert len(figure.axes) > 2


def test_a_notebook_shows_the_verdict_and_a_picture(proof):
    for result, words in (
        (proof.replay.plan, "CONVERGED two-link: "), (proof.replay, "Replay"), (proof, "PASS (open-loop)")
    ):  # fmt: skip
        page = result._repr_html_()
        assert words in Words(page).text
        (picture,) = re.findall(r'src="data:image/png;base64,([^"]+)"', page)
        assert base64.b64decode(picture)[1:4] == b"PNG"
        assert len(page) < 400_000
        assert "http" not in page


def test_what_failed_is_shown_and_text_is_escaped(proof):
    plan = proof.replay.plan
    failed = replace(plan, status=Status.NOT_FINITE, problem=None, xs=np.full_like(plan.xs, np.nan))
    assert "NOT_FINITE" in Words(failed._repr_html_()).text
    odd = replace(proof, reason="<script>alert(1)</script>")
    assert "<script" not in odd._repr_html_()


@pytest.mark.slow
@pytest.mark.render
def test_a_replay_is_filmed(proof, tmp_path):
    path = proof.replay.film(tmp_path / "a.mp4", width=160, height=120, fps=5)
    assert path.read_bytes()[4:8] == b"ftyp"


def test_films_and_their_options_are_those_of_render_video(proof, tmp_path):
    with pytest.raises(planner.PlannerError, match="mp4"):
        proof.film(tmp_path / "a.avi")
    with pytest.raises(planner.PlannerError, match="fps is 0"):
        proof.replay.film(tmp_path / "a.mp4", fps=0)
