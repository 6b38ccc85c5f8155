"""The curves of the page: right as pictures, and in a browser hovering, clicking and the film move one cursor."""

import json
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fake_plans import make_plan, make_proof

import planner
from planner.view.plots.time_series import sides_of
from planner.view.render.encoder import Encoder
from planner.view.report import page as page_module
from planner.view.report.curves import HEIGHT, WIDTH, interactive, thinned
from planner.view.report.page import write_report

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
with_browser = pytest.mark.skipif(BROWSER is None, reason="no Chromium: apt-get install chromium")


def data_of(html):
    return json.loads(re.search(r'id="curves">(.*?)</script>', html, re.S)[1])


def test_thinning_keeps_ends_and_peaks():
    t = np.linspace(0.0, 1.0, 5001)
    values = np.sin(40.0 * t)
    values[3333], values[10:20] = 7.0, np.nan
    few = thinned(t, values)
    assert len(few) < 300
    assert (few[0], few[-1]) == (0, 5000)
    assert values[few].max() == 7.0
    assert values[few].min() == np.nanmin(values)
    assert np.isfinite(values[few]).all()
    assert np.all(np.diff(few) > 0)
    np.testing.assert_array_equal(thinned(t[:50], t[:50]), np.arange(50))  # few are all kept


def test_every_curve_is_there_with_its_unit():
    plan = make_plan()
    data = data_of(interactive(plan, make_proof(plan)))
    assert data["units"] == ["in", "in", "in/s"]  # a chart has one unit: piston and flow are two
    labels = [[(line["label"], line["kind"]) for line in chart] for chart in data["charts"]]
    assert labels[0] == [("height", "plan"), ("height", "open"), ("height", "gains")]
    assert labels[2] == [("flow (in/s)", kind) for kind in ("plan", "open", "gains")]
    height = data["charts"][0][0]
    np.testing.assert_allclose(np.interp(height["t"], plan.t, plan.xs[:, 0]), height["y"], atol=0.2)
    assert (data["start"], data["end"]) == (0.0, pytest.approx(2.0))


def test_the_pictures_show_the_values_without_a_script():
    """The plan's line through its own samples, in the units of the drawing: y falls as the value rises."""
    plan = make_plan()
    html = interactive(plan, None)
    points = re.search(r'<polyline class="plan"[^>]*points="([^"]*)"', html)[1]
    xy = np.array([list(map(float, point.split(","))) for point in points.split()])
    assert np.all((xy >= 0) & (xy <= [WIDTH, HEIGHT]))
    assert np.all(np.diff(xy[:, 0]) > 0)
    value = np.interp(np.linspace(0, 1, len(xy)), np.linspace(0, 1, len(plan.t)), plan.xs[:, 0])
    assert np.corrcoef(xy[:, 1], value)[0, 1] < -0.999
    assert "height (in)" in html
    assert "time, s" in html


def test_bounds_are_drawn_where_the_plan_comes_near_them():
    """Of a torque that needs nearly all of what it may, and not of one that needs a tenth."""
    free = planner.solve(planner.cases.two_link(horizon=50))
    most = np.abs(free.us).max(axis=0) * [1.05, 10.0]
    plan = replace(free, problem=replace(free.problem, limits=planner.Limits(control=(-most, most))))
    assert 'class="bound"' not in interactive(free, None)
    at = [sides_of(plan, index, stepwise=True) for index in range(2)]
    drawn = [np.isfinite(side).all() for side in (*at[0][:2], *at[1][:2])]
    assert any(drawn[:2])
    assert not any(drawn[2:])
    assert interactive(plan, None).count('class="bound"') == sum(drawn)


def test_names_cannot_end_the_block_or_the_page():
    plan = make_plan()
    object.__setattr__(plan.problem.appearance.plots[0], "title", "</script><b>x")
    try:
        html = interactive(plan, None)
    finally:
        object.__setattr__(plan.problem.appearance.plots[0], "title", "Height")
    assert "</script><b>" not in html
    assert "&lt;/script&gt;" in html
    assert "<" not in re.search(r'id="curves">(.*?)</script>', html, re.S)[1]


def test_a_large_film_stays_beside_the_page(tmp_path, monkeypatch):
    (tmp_path / "video.mp4").write_bytes(b"x" * 100)
    plan = make_plan()
    assert 'src="data:video/mp4' in write_report(plan, make_proof(plan), tmp_path).read_text()
    monkeypatch.setattr(page_module, "_EMBEDDED", 99)
    text = write_report(plan, make_proof(plan), tmp_path).read_text()
    assert 'src="video.mp4"' in text
    assert "beside this page" in text


DRIVER = """
<script>addEventListener("load", () => setTimeout(async () => {
  document.querySelectorAll("details").forEach(one => { one.open = true; });
  const say = (name, value) => document.body.setAttribute("data-" + name, value);
  const film = document.querySelector("video"), svg = document.querySelector("svg[data-chart]");
  const box = svg.getBoundingClientRect(), at = part => box.left + box.width * part;
  const told = () => document.getElementById("now").value + " | " + svg.parentNode.querySelector("output").textContent;
  const move = part => svg.dispatchEvent(new PointerEvent("pointermove", {clientX: at(part)}));
  say("before", told());
  move(PART); say("hover", told());
  say("cursors", [...document.querySelectorAll(".cursor")].map(one => one.getAttribute("x1")).join(" "));
  svg.dispatchEvent(new PointerEvent("pointerleave"));
  await new Promise(done => setTimeout(done, 300));
  say("left", told());
  svg.dispatchEvent(new MouseEvent("click", {clientX: at(PART)}));
  say("seek", film.currentTime);
  film.currentTime = 0.5;
  film.dispatchEvent(new Event("seeked"));  // at once: the decoder knows nothing of a browser's virtual time
  say("film", told());
  const slider = document.getElementById("time");
  slider.value = 1.2; slider.dispatchEvent(new Event("input"));
  say("slider", film.currentTime);
  say("done", "yes");
}, 300));</script>
"""


def dom_of(page: Path, *flags: str) -> str:
    command = [
        BROWSER, "--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", "--window-size=1200,2000",
        "--host-resolver-rules=MAP * ~NOTFOUND", f"--user-data-dir={page.parent / 'profile'}", *flags, "--dump-dom",
        "--virtual-time-budget=4000", page.as_uri(),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=90, check=True)
    assert [line for line in done.stderr.splitlines() if "CONSOLE" in line] == []
    return done.stdout


@with_browser
def test_hovering_clicking_and_the_film_share_a_cursor(tmp_path):
    plan = make_plan()
    with Encoder(tmp_path / "video.mp4", 64, 36, 10, "video.mp4") as encoder:
        for grey in np.linspace(30, 220, 30):
            encoder.write(np.full((36, 64, 3), int(grey), np.uint8))
    path = write_report(plan, make_proof(plan), tmp_path)
    data = data_of(path.read_text())
    left, _, across, _ = data["box"]
    part = (left + 0.5 * across) / data["width"]  # the middle of two seconds: t = 1
    text = path.read_text().replace("</body>", DRIVER.replace("PART", repr(part)) + "</body>")
    (tmp_path / "driven.html").write_text(text)
    body = re.search(r"<body[^>]*>", dom_of(tmp_path / "driven.html"))[0]
    said = dict(re.findall(r'data-(\w+)="([^"]*)"', body))
    assert said.get("done") == "yes", said
    assert said["before"].startswith("t = 0.000 s | height")
    assert said["hover"].startswith("t = 1.000 s")
    # what is shown is the plan's own value, with its unit
    shown = float(re.search(r"plan ([^,]*),", said["hover"])[1].replace("\N{MINUS SIGN}", "-"))
    assert shown == pytest.approx(np.interp(1.0, plan.t, plan.xs[:, 0]), abs=1e-3)
    assert said["hover"].endswith(" in")
    assert set(said["cursors"].split()) == {said["cursors"].split()[0]}  # one time in all charts
    assert said["left"].startswith("t = 0.000 s")  # back where the film is
    speed = data["speed"]
    assert float(said["seek"]) == pytest.approx(1.0 / speed, abs=0.02)
    assert said["film"].startswith(f"t = {0.5 * speed:.3f} s")
    assert float(said["slider"]) == pytest.approx(1.2 / speed, abs=0.02)


@with_browser
def test_without_scripts_the_curves_are_there_and_no_empty_control(tmp_path):
    plan = make_plan()
    text = write_report(plan, make_proof(plan), tmp_path).read_text()
    bare = re.sub(r"<script>.*?</script>", "", text, flags=re.S)
    (tmp_path / "bare.html").write_text(bare)
    dom = dom_of(tmp_path / "bare.html")
    assert dom.count("<polyline") >= 9
    assert 'type="range"' not in dom


def test_a_curve_leaves_its_unit_to_the_axis():
    """The hopper's flow, in/s shares its panel with the piston, in."""
    plan = planner.solve(planner.cases.hopper())
    text = interactive(plan, None)
    assert ">flow</span>" in text
    assert "flow, in/s</span>" not in text
    assert ">flow, in/s</text>" in text
