"""Figures and pages of made-up plans: what must be shown is shown, and nothing breaks them."""

import base64
import math
import re
import sys
from dataclasses import replace
from html.parser import HTMLParser
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from planner.errors import FileError
from planner.figures import Figure, Section
from planner.plan import Iteration, Plan, Status
from planner.plots import draw_plan, plot_plan
from planner.replay import Replay
from planner.report import write_report
from planner.stage import Panel, Stage
from planner.twin import Twin

STAGE = Stage(
    "A mass on a spring",
    plots=(
        Panel("Height", "height (in)", states=((0, "height"),), difference=True),
        Panel("Piston", "piston (in)", states=((2, "piston"),), controls=((0, "flow (in/s)"),)),
    ),
)
N, SUBSTEPS, DT = 20, 5, 0.1


def states(t):
    """Three made-up states: height, its rate, piston."""
    return np.stack([np.sin(3 * t), 3 * np.cos(3 * t), 0.2 * t], axis=-1)


@pytest.fixture
def plan():
    t = np.linspace(0.0, N * DT, N + 1)
    history = [Iteration(n, 5.0 + 10.0 ** (2 - n), 10.0 ** (1 - n), 1.0, 1.0, 1.0, 0.0) for n in range(6)]
    history.append(Iteration(6, 5.0, 1e-6, 0.0, 0.0, 0.0, 0.0))
    twin = Twin("<mujoco model='a & b'/>", np.eye(3), np.zeros(3), np.eye(3)[None], np.zeros((1, 3)))
    return Plan(
        t, states(t), np.linspace(0.2, 1.0, N)[:, None], np.zeros((N, 1, 3)), 5.0, 1e-6,
        Status.CONVERGED, tuple(history), problem=SimpleNamespace(stage=STAGE), case="spring", twin=twin,
        parameters={"height": 20.0, "horizon": 200, "integrator": "rk4"}, made_with={"planner": "0.1.0"},
    )  # fmt: skip


@pytest.fixture
def replay(plan):
    t = np.linspace(0.0, N * DT, N * SUBSTEPS + 1)
    xs = states(t)
    xs[:, 0] += 1e-3 * t
    force = np.maximum(0.0, -xs[:, 0])
    return Replay(
        plan, plan.twin, False, "RK4", t, xs[:, :2], xs[:, :2], xs[:, 2:],
        np.repeat(plan.us, SUBSTEPS, axis=0), xs, states(t), force, np.full((len(t), 3), np.nan), SUBSTEPS,
    )  # fmt: skip


def proof_of(verdict="PASS", mode="open-loop", **sections):
    every = {
        "parity": Section("parity", (Figure("mass_matrix", 3e-14, "", 1e-10, "256 states"),)),
        "same_step": Section("same step", not_applicable="Contact <is> solved otherwise."),
        "refined_open_loop": Section("refined, open loop", (Figure("end_state", 2e-3, "in", 1e-2),)),
        "refined_feedback": Section("refined, with feedback", (Figure("growth_rate", 1.5, "1/s"),)),
        "goal": Section("goal", (Figure("height_error", 0.1, "%", 0.2),)),
    } | sections
    return SimpleNamespace(verdict=verdict, mode=mode, reason="Within every bound.", sections=every)


def titles(figure):
    return [axes.get_title(loc="left") for axes in figure.axes if axes.get_title(loc="left")]


def panel(figure, title):
    return next(axes for axes in figure.axes if axes.get_title(loc="left").startswith(title))


# Plots


def test_the_panels_are_those_of_the_stage_then_force_then_convergence(plan, replay):
    figure = draw_plan(plan, replay)
    found = titles(figure)
    assert [found[0], *found[2:]] == ["Height", "Piston", "Contact force in the replay", "Convergence"]
    assert found[1].startswith("height, replay ")
    assert figure.get_suptitle() == STAGE.title


def test_plan_and_replay_are_drawn_as_they_are(plan, replay):
    simulated, planned = panel(draw_plan(plan, replay), "Height").get_lines()
    np.testing.assert_array_equal(simulated.get_ydata(), replay.xs[:, 0])
    np.testing.assert_array_equal(planned.get_ydata(), replay.plan_xs[:, 0])
    assert simulated.get_linestyle() == "-"
    assert planned.get_linestyle() == "--"


def test_the_difference_is_replay_minus_plan_in_the_unit_it_names(plan, replay):
    axes = panel(draw_plan(plan, replay), "height, replay")
    assert "10^{-3}" in axes.get_title(loc="left")
    assert axes.get_title(loc="left").endswith("in)")
    np.testing.assert_allclose(axes.get_lines()[0].get_ydata() * 1e-3, 1e-3 * replay.t, atol=1e-12)


def test_controls_are_steps_on_an_axis_of_their_own(plan, replay):
    figure = draw_plan(plan, replay)
    (right,) = [axes for axes in figure.axes if axes.get_ylabel() == "flow (in/s)"]
    assert {line.get_drawstyle() for line in right.get_lines()} == {"steps-post"}
    simulated, planned = right.get_lines()
    np.testing.assert_array_equal(planned.get_xdata(), plan.t)
    np.testing.assert_array_equal(planned.get_ydata()[:-1], plan.us[:, 0])
    np.testing.assert_array_equal(simulated.get_xdata(), replay.t)
    np.testing.assert_array_equal(simulated.get_ydata()[:-1], replay.ctrl[:, 0])


def test_stance_is_shaded_in_every_panel_over_time(plan, replay):
    figure = draw_plan(plan, replay)
    timed = [axes for axes in figure.axes if axes.get_xlabel() == "time (s)" or axes.get_title(loc="left") == "Height"]
    assert len(timed) == 4
    touching = replay.t[replay.contact_force > 0]
    for axes in timed:
        (shade,) = axes.collections
        times = np.concatenate([path.vertices[:, 0] for path in shade.get_paths()])
        assert times.min() == touching.min()
        assert times.max() == touching.max()


def test_without_contact_there_is_no_force_panel(plan, replay):
    figure = draw_plan(plan, replace(replay, contact_force=np.zeros_like(replay.t)))
    assert "Contact force in the replay" not in titles(figure)
    assert not any(axes.collections for axes in figure.axes)


def test_a_plan_alone(plan):
    figure = draw_plan(plan, None)
    assert titles(figure) == ["Height", "Piston", "Convergence"]
    (line,) = panel(figure, "Height").get_lines()
    np.testing.assert_array_equal(line.get_ydata(), plan.xs[:, 0])


def test_a_plan_without_a_stage_shows_all_states_and_controls(plan, replay):
    figure = draw_plan(replace(plan, problem=None), replay)
    assert titles(figure) == ["States", "Controls", "Contact force in the replay", "Convergence"]
    assert len(panel(figure, "States").get_lines()) == 6
    assert figure.get_suptitle() == "spring"


def test_convergence_shows_the_costs_above_the_last(plan):
    figure = draw_plan(plan, None)
    axes = panel(figure, "Convergence")
    (line,) = axes.get_lines()
    assert axes.get_yscale() == "log"
    np.testing.assert_allclose(line.get_ydata(), [100, 10, 1, 0.1, 0.01, 1e-3], rtol=1e-9)
    (gradient,) = next(axes for axes in figure.axes if axes.get_ylabel() == "gradient norm").get_lines()
    np.testing.assert_allclose(gradient.get_ydata(), [line.gradient_norm for line in plan.history])


@pytest.mark.parametrize("length", [0, 1])
def test_a_solve_that_ended_at_once(plan, tmp_path, length):
    plot_plan(replace(plan, history=plan.history[:length]), None, tmp_path / "plots.png")


@pytest.mark.parametrize("bad", [math.nan, math.inf, -1e300])
def test_what_is_not_finite_leaves_a_gap(plan, replay, tmp_path, bad):
    xs, plan_xs, ctrl = replay.xs.copy(), replay.plan_xs.copy(), replay.ctrl.copy()
    xs[50:] = plan_xs[40:60] = ctrl[70:] = bad
    history = tuple(line._replace(cost=bad, gradient_norm=bad) for line in plan.history)
    broken = replace(plan, xs=np.full_like(plan.xs, bad), cost=bad, history=history)
    plot_plan(broken, replace(replay, xs=xs, plan_xs=plan_xs, ctrl=ctrl), tmp_path / "plots.png")
    plot_plan(broken, None, tmp_path / "alone.png")
    assert (tmp_path / "plots.png").stat().st_size > 0


def test_the_picture_is_a_png_with_ink_in_every_quarter(plan, replay, tmp_path):
    plot_plan(plan, replay, tmp_path / "plots.png")
    with Image.open(tmp_path / "plots.png") as image:
        assert image.format == "PNG"
        assert image.width >= 1280
        grey = np.asarray(image.convert("L"))
    for half in np.array_split(grey, 2, axis=0):
        for quarter in np.array_split(half, 2, axis=1):
            assert quarter.std() > 10
    assert [path.name for path in tmp_path.iterdir()] == ["plots.png"]


def test_plotting_leaves_the_callers_pyplot_alone(plan, tmp_path):
    loaded = "matplotlib.pyplot" in sys.modules
    plot_plan(plan, None, tmp_path / "plots.svg")
    assert ("matplotlib.pyplot" in sys.modules) == loaded
    assert (tmp_path / "plots.svg").read_text().startswith("<?xml")


def test_an_unknown_picture_format_is_one_sentence(plan, tmp_path):
    with pytest.raises(FileError, match=r"no picture format 'xyz'; expected one of .*png"):
        plot_plan(plan, None, tmp_path / "plots.xyz")
    assert list(tmp_path.iterdir()) == []


# Report


class Page(HTMLParser):
    """Reads a page: its text, the sources of its media, its tags; fails when tags are not closed in order."""

    VOID = frozenset({"meta", "img"})

    def __init__(self, text):
        super().__init__()
        self.open, self.tags, self.sources, self.words = [], [], [], []
        self.feed(text)
        self.close()
        assert self.open == []
        self.text = re.sub(r"\s+", " ", " ".join(self.words))

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.sources += [value for name, value in attrs if name in ("src", "href")]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if "style" not in self.open:
            self.words.append(data)


def page_of(plan, proof, folder, note=""):
    return Page(write_report(plan, proof, folder, note).read_text(encoding="utf-8"))


def test_the_verdict_comes_first_then_figures_pictures_video_parameters(plan, tmp_path):
    Image.new("RGB", (4, 4)).save(tmp_path / "strip.png")
    text = page_of(plan, proof_of(), tmp_path, "Not asked for.").text
    expected = (
        "PASS", "open-loop", "Within every bound.", "Proof", "Mass matrix", "3e-14", "≤ 1e-10", "pass",
        "Contact <is> solved otherwise.", "0.002 in", "1.5 1/s", "shown", "Pictures", "Video",
        "Not asked for.", "Solver", Status.CONVERGED.value, "Parameters of the case spring", "height", "20",
        "rk4", "0.1.0", "<mujoco model='a & b'/>",
    )  # fmt: skip
    place = text.index("PASS", text.index("A mass on a spring"))
    for words in expected:
        place = text.index(words, place)
    assert "FAIL" not in text


def test_a_figure_beyond_its_bound_is_marked_by_word_and_colour(plan, tmp_path):
    section = Section("goal", (Figure("height_error", math.inf, "%", 0.2), Figure("speed", math.nan, "", 1.0)))
    page = write_report(plan, proof_of("FAIL", None, goal=section), tmp_path).read_text(encoding="utf-8")
    assert page.count('<span class="word fail">FAIL</span>') == 3  # the section and both figures
    assert '<div class="verdict fail"' in page
    assert "∞\N{NO-BREAK SPACE}%" in page
    assert "undefined" in page


def test_a_plan_without_a_proof_fails_and_says_why(plan, tmp_path):
    broken = replace(plan, status=Status.NOT_FINITE, cost=math.nan, gradient_norm=math.inf, history=())
    text = page_of(broken, None, tmp_path).text
    assert "FAIL" in text
    assert "PASS" not in text
    assert Status.NOT_FINITE.value in text
    assert "nothing is proven" in page_of(plan, None, tmp_path).text


def test_a_proof_of_a_plan_that_did_not_converge_says_both(plan, tmp_path):
    text = page_of(replace(plan, status=Status.MAX_ITERATIONS), proof_of(), tmp_path).text
    assert f"The solver did not converge: {Status.MAX_ITERATIONS.value}" in text


def test_pictures_and_video_are_embedded_byte_for_byte(plan, tmp_path):
    data = {"strip.png": b"strip", "plots.png": b"plots", "video.mp4": bytes(range(256))}
    for name, content in data.items():
        (tmp_path / name).write_bytes(content)
    page = page_of(plan, proof_of(), tmp_path, note="never shown")
    embedded = [source.partition(";base64,") for source in page.sources]
    assert [kind for kind, _, _ in embedded] == ["data:image/png", "data:image/png", "data:video/mp4"]
    assert [base64.b64decode(text) for _, _, text in embedded] == list(data.values())
    assert "never shown" not in page.text
    assert "script" not in page.tags
    assert "link" not in page.tags


def test_all_text_is_escaped(plan, tmp_path):
    evil = '<script>alert("1")</script>&amp;'
    section = Section(evil, (Figure(evil, 1.0, evil, 2.0, evil),))
    proof = proof_of("PASS", evil, goal=section, same_step=Section(evil, not_applicable=evil))
    proof.reason = evil
    marked = replace(
        plan, case=evil, parameters={evil: evil, "list": [evil]}, made_with={evil: evil},
        problem=SimpleNamespace(stage=Stage(evil)), twin=replace(plan.twin, mjcf=evil),
    )  # fmt: skip
    page = page_of(marked, proof, tmp_path, evil)
    assert "script" not in page.tags
    assert page.text.count(evil) >= 12


def test_a_plan_read_without_its_problem(plan, tmp_path):
    bare = replace(plan, problem=None, case=None, parameters={}, twin=None)
    text = page_of(bare, proof_of(), tmp_path).text
    assert "Parameters" not in text
    assert "MJCF" not in text


def test_a_name_that_is_no_unicode(plan, tmp_path):
    assert page_of(replace(plan, parameters={"file": "a\udcffb"}), None, tmp_path)


def test_a_missing_folder_is_one_sentence(plan, tmp_path):
    with pytest.raises(FileError, match="missing' does not exist"):
        write_report(plan, proof_of(), tmp_path / "missing")
