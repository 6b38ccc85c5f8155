"""The page of a plan in a browser without a network: it complains of nothing, and one screen shows what matters."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from chromium import WITHOUT_WEBGL, browse, with_browser
from fake_plans import make_plan, make_proof
from pages import Page
from PIL import Image

from planner.view.plots.plan import draw_plan
from planner.view.plots.proof import draw_proof
from planner.view.plots.style import save
from planner.view.render.encoder import Encoder
from planner.view.report.page import write_report

SLIDES = """<mujoco><worldbody><body><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
  <joint type="slide"/><joint type="slide" axis="1 0 0"/></body></worldbody></mujoco>"""


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """A whole page, with a film of three grey frames."""
    plan, tmp_path = make_plan(), tmp_path_factory.mktemp("page")
    plan = replace(plan, twin=replace(plan.twin, mjcf=SLIDES))
    proof = make_proof(plan)
    save(draw_plan(plan, proof), tmp_path / "plots.png")
    save(draw_proof(proof), tmp_path / "proof.png")
    Image.new("RGB", (192, 54), "steelblue").save(tmp_path / "strip.png")
    with Encoder(tmp_path / "video.mp4", 64, 36, 10, "video.mp4") as encoder:
        for grey in (60, 120, 180):
            encoder.write(np.full((36, 64, 3), grey, np.uint8))
    return write_report(plan, proof, tmp_path)


@with_browser
def test_a_browser_shows_the_verdict_and_complains_of_nothing(page):
    dom, console = browse(page, *WITHOUT_WEBGL, "--dump-dom")
    assert console == []
    assert re.search(r'<div class="verdict pass"[^>]*><strong>PASS</strong><span>\(open-loop\); feasible', dom)
    assert dom.count("<img ") == 2  # the page draws the curves of plots.png
    assert dom.count("<video ") == 1


@with_browser
@pytest.mark.parametrize(("width", "height"), [(1400, 900), (1280, 800)])
@pytest.mark.parametrize("reason", ["Within every bound.", "; ".join(["planned angle miss 1.7 rad"] * 60)])
def test_one_screen_has_verdict_film_controls_and_what_was_not_checked(tmp_path, width, height, reason):
    plan = make_plan()
    plan = replace(plan, twin=replace(plan.twin, mjcf=SLIDES))
    proof = make_proof(plan)
    proof.reason, proof.remarks = reason, ("planned without contacts of 2 pairs (tested in your file)",) * 8
    film = np.full((720, 1280, 3), 100, np.uint8)
    with Encoder(tmp_path / "video.mp4", 1280, 720, 10, "video.mp4") as encoder:
        encoder.write(film)
    page = write_report(plan, proof, tmp_path)
    measure = """<script>addEventListener("load", () => setTimeout(() => {
      document.body.dataset.ends = JSON.stringify([".verdict", "video", ".motion input", ".notes"].map(
        one => document.querySelector(one).getBoundingClientRect().bottom)); }, 500));</script></body>"""
    page.write_text(page.read_text(encoding="utf-8").replace("</body>", measure), encoding="utf-8")
    dom, _ = browse(page, *WITHOUT_WEBGL, f"--window-size={width},{height}", "--virtual-time-budget=4000", "--dump-dom")
    ends = json.loads(re.search(r'data-ends="([^"]*)"', dom)[1])
    assert 0.0 < max(ends) < height - 87.0  # which headless Chromium counts as its own frame
    assert ends[1] > 400.0  # the film is no stamp


@with_browser
def test_the_test_would_see_what_a_browser_complains_of(tmp_path):
    (tmp_path / "broken.html").write_text("<script>console.error('broken'); nothing()</script>")
    _, console = browse(tmp_path / "broken.html", *WITHOUT_WEBGL, "--dump-dom")
    assert any("broken" in line for line in console)
    assert any("nothing is not defined" in line for line in console)


@with_browser
@pytest.mark.parametrize(("width", "flag"), [(1100, ""), (390, "--force-dark-mode")])
def test_the_verdict_is_seen_first_in_light_and_in_dark(page, tmp_path, width, flag):
    shot = tmp_path / "shot.png"
    _, console = browse(
        page, *WITHOUT_WEBGL, f"--window-size={width},4000", f"--screenshot={shot}", *filter(None, [flag])
    )
    assert console == []
    picture = np.asarray(Image.open(shot).convert("RGB")).astype(int)
    assert picture.shape == (4000, width, 3)
    tint, paper = ((22, 48, 31), (23, 25, 28)) if flag else ((229, 244, 234), (255, 255, 255))
    tinted = np.abs(picture - tint).max(axis=-1) <= 2
    assert tinted[:400].sum() > 0.15 * width * 100  # the card of the verdict
    assert not tinted[600:].any()
    assert (np.abs(picture - paper).max(axis=-1) <= 2).mean() > 0.2
    assert picture[400:1000].std() > 10  # there is more than the verdict


def test_the_page_asks_for_nothing_outside_itself(page):
    text = page.read_text(encoding="utf-8")
    assert all(source.startswith("data:") for source in Page(text).sources)
    assert not re.search(r"url\(|@import|<link|<script[^>]* src|srcset|<iframe", text)
