"""Figures of made-up plans and proofs: what must be shown is shown, and nothing breaks them."""

import math
import sys
from dataclasses import replace

import numpy as np
import pytest
from fake_plans import APPEARANCE, MODES, N, make_perturbed, make_plan, make_proof, make_replay
from PIL import Image

from planner.base.errors import FileError
from planner.base.measured import Measurement, Section
from planner.proof.error_scales import path_error_bounds
from planner.proof.goal_regulator import GoalRegulator, RegulatedRun
from planner.proof.replays.sampled_gains import Sampling
from planner.view.plots.plan import draw_plan
from planner.view.plots.proof import draw_proof
from planner.view.plots.style import save


@pytest.fixture
def plan():
    return make_plan()


@pytest.fixture
def replay(plan):
    return make_replay(plan)


@pytest.fixture
def proof(plan):
    return make_proof(plan)


@pytest.fixture(scope="module")
def plan_figure():
    """Of a plan and one replay, for tests that change neither; with the replay."""
    replay = make_replay(make_plan())
    return draw_plan(replay.plan, replay), replay


@pytest.fixture(scope="module")
def proof_figure():
    """Of a proof, for tests that change nothing; with the proof."""
    proof = make_proof(make_plan())
    return draw_proof(proof), proof


def titles(figure):
    return [axes.get_title(loc="left") for axes in figure.axes if axes.get_title(loc="left")]


def panel(figure, title):
    return next(axes for axes in figure.axes if axes.get_title(loc="left").startswith(title))


# Plots


def test_the_panels_are_those_of_the_stage_then_force_then_convergence(plan_figure):
    figure, _ = plan_figure
    found = titles(figure)
    assert [found[0], *found[2:]] == ["Height", "Piston", "Contact force in the replay", "Convergence"]
    assert found[1].startswith("height, replay ")
    assert figure.get_suptitle() == APPEARANCE.title


def test_plan_and_replay_are_drawn_as_they_are(plan_figure):
    figure, replay = plan_figure
    simulated, planned = panel(figure, "Height").get_lines()
    np.testing.assert_array_equal(simulated.get_ydata(), replay.xs[:, 0])
    np.testing.assert_array_equal(planned.get_ydata(), replay.plan_xs[:, 0])
    assert simulated.get_linestyle() == "-"
    assert planned.get_linestyle() == "--"


def test_the_difference_is_replay_minus_plan_in_the_unit_it_names(plan_figure):
    figure, replay = plan_figure
    axes = panel(figure, "height, replay")
    assert "10^{-3}" in axes.get_title(loc="left")
    assert axes.get_title(loc="left").endswith("in)")
    np.testing.assert_allclose(axes.get_lines()[0].get_ydata() * 1e-3, 1e-3 * replay.t, atol=1e-12)


def test_replays_with_times_of_their_own_are_drawn_beside_each_other(plan, proof):
    """A controller's periods need not divide a stage, so the replay with gains may have other steps."""
    openly, fed = (proof.replays[mode] for mode in MODES)
    names = ("t", "qpos", "qvel", "act", "xs", "plan_xs", "contact_force", "contact_point")
    parts = {name: getattr(fed, name)[::2] for name in names}
    fewer = replace(fed, **parts, ctrl=fed.ctrl[: (len(fed.t) - 1) // 2])
    proof.replays["feedback"] = fewer
    figure = draw_plan(plan, proof)
    lines = panel(figure, "height, replay").get_lines()
    assert [len(line.get_xdata()) for line in lines[:2]] == [len(openly.t), len(fewer.t)]


def test_controls_are_steps_on_an_axis_of_their_own(plan_figure):
    figure, replay = plan_figure
    (right,) = [axes for axes in figure.axes if axes.get_ylabel() == "flow (in/s)"]
    assert {line.get_drawstyle() for line in right.get_lines()} == {"steps-post"}
    simulated, planned = right.get_lines()
    np.testing.assert_array_equal(planned.get_xdata(), replay.plan.t)
    np.testing.assert_array_equal(planned.get_ydata()[:-1], replay.plan.us[:, 0])
    np.testing.assert_array_equal(simulated.get_xdata(), replay.t)
    np.testing.assert_array_equal(simulated.get_ydata()[:-1], replay.ctrl[:, 0])


def test_stance_is_shaded_in_every_panel_over_time(plan_figure):
    figure, replay = plan_figure
    timed = [axes for axes in figure.axes if axes.get_xlabel() == "time, s" or axes.get_title(loc="left") == "Height"]
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


def test_a_plan_without_a_proof_is_plotted(plan):
    figure = draw_plan(plan, None)
    assert titles(figure) == ["Height", "Piston", "Convergence"]
    (line,) = panel(figure, "Height").get_lines()
    np.testing.assert_array_equal(line.get_ydata(), plan.xs[:, 0])


def test_a_plan_without_a_stage_shows_all_states_and_controls(plan, replay):
    figure = draw_plan(replace(plan, problem=None), replay)
    assert titles(figure) == ["States", "Controls", "Contact force in the replay", "Convergence"]
    assert len(panel(figure, "States").get_lines()) == 6
    assert figure.get_suptitle() == "spring"


def test_states_without_an_appearance_are_drawn_by_unit_with_their_names(plan):
    plan.problem.appearance = None
    figure = draw_plan(plan, None)
    assert titles(figure) == ["States, in", "States, in/s", "Controls", "Convergence"]
    assert [line.get_label() for line in panel(figure, "States, in").get_lines()] == ["height", "piston"]


def test_convergence_shows_the_costs_above_the_last(plan):
    figure = draw_plan(plan, None)
    axes = panel(figure, "Convergence")
    (line,) = axes.get_lines()
    assert axes.get_yscale() == "log"
    np.testing.assert_allclose(line.get_ydata(), [100, 10, 1, 0.1, 0.01, 1e-3, np.nan], rtol=1e-9)
    (gradient,) = next(axes for axes in figure.axes if axes.get_ylabel() == "gradient norm").get_lines()
    np.testing.assert_allclose(gradient.get_ydata(), [line.gradient_norm for line in plan.history])


def test_a_cost_below_the_last_leaves_a_gap_that_no_line_bridges(plan):
    """A multiplier's step may raise the cost again."""
    history = tuple(line._replace(cost=4.0) if k == 2 else line for k, line in enumerate(plan.history))
    (line,) = panel(draw_plan(replace(plan, history=history), None), "Convergence").get_lines()
    assert np.isnan(line.get_ydata()[2])
    assert np.isfinite(line.get_ydata()[[1, 3]]).all()


@pytest.mark.parametrize("length", [0, 1])
def test_a_solve_that_ended_at_once(plan, length):
    figure = draw_plan(replace(plan, history=plan.history[:length]), None)
    figure.draw_without_rendering()
    titles = [axes.get_title(loc="left") or axes.get_title() for axes in figure.axes]
    assert ("Convergence" in titles) == bool(length)  # a recording was not solved: no empty panel


@pytest.mark.parametrize("bad", [math.nan, math.inf, -1e300])
def test_numbers_that_are_not_finite_leave_a_gap(plan, replay, bad):
    xs, plan_xs, ctrl = replay.xs.copy(), replay.plan_xs.copy(), replay.ctrl.copy()
    xs[50:] = plan_xs[40:60] = ctrl[70:] = bad
    history = tuple(line._replace(cost=bad, gradient_norm=bad) for line in plan.history)
    broken = replace(plan, xs=np.full_like(plan.xs, bad), cost=bad, history=history)
    draw_plan(broken, replace(replay, xs=xs, plan_xs=plan_xs, ctrl=ctrl)).draw_without_rendering()
    draw_plan(broken, None).draw_without_rendering()


def test_the_picture_is_a_png_with_ink_in_every_quarter(plan_figure, tmp_path):
    save(plan_figure[0], tmp_path / "plots.png")
    with Image.open(tmp_path / "plots.png") as image:
        assert image.format == "PNG"
        assert image.width >= 1280
        grey = np.asarray(image.convert("L"))
    for half in np.array_split(grey, 2, axis=0):
        for quarter in np.array_split(half, 2, axis=1):
            assert quarter.std() > 10
    assert [path.name for path in tmp_path.iterdir()] == ["plots.png"]


def test_plotting_leaves_the_callers_pyplot_alone_and_knows_its_formats(plan_figure, tmp_path):
    loaded = "matplotlib.pyplot" in sys.modules
    save(plan_figure[0], tmp_path / "plots.svg")
    assert ("matplotlib.pyplot" in sys.modules) == loaded
    assert (tmp_path / "plots.svg").read_text().startswith("<?xml")
    with pytest.raises(FileError, match=r"xyz.*png"):
        save(plan_figure[0], tmp_path / "plots.xyz")
    assert [path.name for path in tmp_path.iterdir()] == ["plots.svg"]


# Both replays of a proof


def test_a_proof_shows_three_curves_the_plan_on_top(plan, proof):
    open_loop, gains, planned = panel(draw_plan(plan, proof), "Height").get_lines()
    np.testing.assert_array_equal(open_loop.get_ydata(), proof.replays["open-loop"].xs[:, 0])
    np.testing.assert_array_equal(gains.get_ydata(), proof.replays["feedback"].xs[:, 0])
    np.testing.assert_array_equal(planned.get_ydata(), proof.replay.plan_xs[:, 0])
    assert open_loop.get_linewidth() > gains.get_linewidth() > planned.get_linewidth()
    assert open_loop.get_zorder() < gains.get_zorder() < planned.get_zorder()
    assert len({line.get_color() for line in (open_loop, gains, planned)}) == 3


def test_the_legend_names_the_three(plan, proof):
    (legend,) = draw_plan(plan, proof).legends
    words = [text.get_text() for text in legend.get_texts()]
    assert words[:3] == ["plan", "replay in MuJoCo, open loop", "replay in MuJoCo, with gains"]


def test_a_replay_that_runs_away_ends_at_the_edge_and_leaves_the_others_their_scale(plan, proof):
    run = proof.replays["open-loop"]
    run.xs[:, 0] += 1e8 * np.maximum(0.0, run.t - 1.0)
    axes = panel(draw_plan(plan, proof), "Height")
    low, high = axes.get_ylim()
    assert high - low < 10.0
    drawn = axes.get_lines()[0].get_ydata()
    assert np.sum(drawn > high) == 1
    assert np.isnan(drawn[-1])
    assert np.isfinite(axes.get_lines()[1].get_ydata()).all()


# proof.png


def lines_of(axes, words):
    return [line for line in axes.get_lines() if line.get_label() == words]


def test_the_panels_of_a_proof(proof_figure):
    figure, _ = proof_figure
    found = titles(figure)
    assert [title.split(",")[0].split(":")[0] for title in found] == [
        "Errors of the replay", "Errors of the replay", "Growth of errors",
        "Order of the open-loop replay as MuJoCo's step is halved",
        "Monte Carlo", "Monte Carlo", "Monte Carlo",
    ]  # fmt: skip


def test_growth_is_drawn_as_measured_and_as_predicted_on_a_log_scale(proof_figure):
    figure, proof = proof_figure
    axes = panel(figure, "Growth")
    assert axes.get_yscale() == "log"
    for mode, words in zip(MODES, ("open loop", "with gains"), strict=True):
        (measured,), (predicted,) = lines_of(axes, words), lines_of(axes, f"{words}, predicted")
        np.testing.assert_array_equal(measured.get_ydata()[1:], proof.errors.measured[mode][1:])
        np.testing.assert_array_equal(predicted.get_ydata()[1:], proof.errors.predicted[mode][1:])
        assert (measured.get_linestyle(), predicted.get_linestyle()) == ("-", "--")
        assert measured.get_color() == predicted.get_color()
    assert axes.get_ylabel() == "largest error / bound"


def test_path_errors_are_shares_of_their_bounds_by_unit_and_name_the_coordinate(proof_figure):
    """The height drifts by 1e-3 in a second; what passes is 1 % of its range, which is 2."""
    figure, proof = proof_figure
    axes = panel(figure, "Errors of the replay, open loop")
    (height,) = lines_of(axes, "height, in")
    run = proof.replays["open-loop"]
    bound = path_error_bounds(run.plan)[0]
    np.testing.assert_allclose(height.get_ydata()[10:], np.abs(run.error[10:, 0]) / bound)
    assert bound == pytest.approx(0.01 * np.ptp(run.plan.xs[:, 0]))
    assert set(lines_of(axes, "bound")[0].get_ydata()) == {1.0}
    assert axes.get_ylabel() == "error / bound"
    assert "component" not in str(axes.get_legend().get_texts())


def test_the_title_says_how_the_gains_act(proof):
    run = proof.replays["feedback"]
    proof.replays["feedback"] = replace(run, sampling=Sampling(2e-3))
    assert "Errors of the replay, with gains at 500 Hz, held, one period late" in titles(draw_proof(proof))


def test_legends_titles_and_labels_cover_nothing(proof_figure):
    """Every curve of the path errors is above the legend; titles and labels do not run into the next panel."""
    figure, _ = proof_figure
    figure.draw_without_rendering()
    for axes in figure.axes[:2]:
        box = axes.get_legend().get_window_extent()
        for line in axes.get_lines():
            heights = axes.transData.transform(np.column_stack([line.get_xdata(), line.get_ydata()]))[:, 1]
            assert np.nanmin(heights) > box.y1
    for axes in figure.axes:
        panel_box, label = axes.get_window_extent(), axes.yaxis.label.get_window_extent()
        assert label.height <= 1.1 * panel_box.height
        assert axes._left_title.get_window_extent().width <= 1.02 * panel_box.width  # the font's rounding


def test_the_hold_of_the_goal_is_a_panel(plan, proof):
    space = plan.space
    hold = GoalRegulator(np.zeros(3), np.zeros(1), np.zeros((1, 3)), space)
    t, xs = np.linspace(2.0, 3.0, 11), 0.01 * np.ones((11, 3))
    proof.held = RegulatedRun(plan, hold, t, xs[:, :2], xs[:, :2], xs[:, 2:], np.zeros((10, 1)), xs, ())
    axes = panel(draw_proof(proof), "Deviations from the goal")
    assert axes.get_xlim() == (2.0, 3.0)
    (rate,) = lines_of(axes, "velocity of height, in/s")
    np.testing.assert_allclose(rate.get_ydata(), 0.01 / path_error_bounds(plan)[1])


def test_other_grounds_are_bars_with_their_peak_forces(proof):
    measured = [
        Measurement(f"{ground}_{part}_{mode}", value, unit)
        for ground, error in (("planned_contact", 0.01), ("default_contact", math.inf))
        for mode in ("open_loop", "feedback")
        for part, value, unit in (
            ("path_distance_error", 1e-6, "m"), ("path_angle_error", error, "rad"), ("peak_force", 3944.0, "N"),
        )
    ]  # fmt: skip
    proof.sections["another_ground"] = Section("contact sensitivity", tuple(measured))
    axes = panel(draw_proof(proof), "Contact sensitivity")
    assert axes.get_xlabel() == "largest error of a path, angle rad"
    assert [label.get_text() for label in axes.get_yticklabels()] == ["planned\ncontact", "default\ncontact"]
    said = [note.get_text() for note in axes.texts]
    assert said.count("peak 3,944 N") == said.count("runs away, peak 3,944 N") == 2


def test_order_is_drawn_beside_the_integrators_slope_with_its_extrapolation(proof_figure):
    figure, proof = proof_figure
    axes = panel(figure, "Order")
    (measured,), (slope,) = lines_of(axes, "measured"), lines_of(axes, "order 4, the integrator's")
    np.testing.assert_array_equal(measured.get_xdata(), proof.convergence.steps[:-1])
    np.testing.assert_array_equal(measured.get_ydata(), proof.convergence.shares)
    np.testing.assert_allclose(slope.get_ydata(), proof.convergence.shares, rtol=1e-12)
    for words in ("observed order 4.01", "5.0123", "1.0e-06", "1.0e-07"):
        assert words in axes.get_xlabel()


def test_a_fan_holds_the_component_that_strays_farthest(proof_figure):
    figure, proof = proof_figure
    axes = panel(figure, "Monte Carlo, open loop")
    assert axes.get_ylabel() == "deviation of height, in"
    (median,) = lines_of(axes, "median")
    np.testing.assert_array_equal(median.get_ydata(), proof.monte_carlo.fans["open-loop"][2, :, 0])
    outer, inner = (np.concatenate([path.vertices[:, 1] for path in band.get_paths()]) for band in axes.collections)
    assert (outer.min(), outer.max()) == pytest.approx((-2.0, 2.0))
    assert (inner.min(), inner.max()) == pytest.approx((-1.0, 1.0))


def test_the_histogram_says_how_many_succeed_and_draws_the_tolerance(proof_figure):
    figure, _ = proof_figure
    axes = panel(figure, "Monte Carlo: end errors")
    words = [text.get_text() for text in axes.get_legend().get_texts()]
    assert words[0].startswith("open loop: 7.5 % succeed (3 of 40, 95 % interval 2.6 to 19.9 %)")
    assert words[1].startswith("with gains: 100.0 % succeed (40 of 40, 95 % interval 91.2 to 100.0 %)")
    (tolerance,) = lines_of(axes, "tolerance 0.1")
    assert set(tolerance.get_xdata()) == {0.1}
    bars = sum(patch.get_height() for patch in axes.patches if type(patch).__name__ == "Rectangle")
    assert bars == 80


def test_panels_that_do_not_apply_are_left_out(proof):
    proof.monte_carlo = None
    assert len(titles(draw_proof(proof))) == 4
    proof.convergence = None
    assert len(titles(draw_proof(proof))) == 3
    proof.monte_carlo = make_perturbed(done=0)
    assert len(titles(draw_proof(proof))) == 3


@pytest.mark.parametrize("bad", [math.nan, math.inf, 0.0, 1e300])
def test_nothing_that_a_proof_measures_breaks_its_figure(proof, bad):
    every = np.full(N + 1, bad)
    proof.errors = replace(proof.errors, measured=dict.fromkeys(MODES, every), predicted=dict.fromkeys(MODES, every))
    proof.convergence = replace(
        proof.convergence, shares=np.full(4, bad), observed=None, extrapolated_cost=bad, end_uncertainty=bad
    )
    rollouts = proof.monte_carlo
    proof.monte_carlo = replace(
        rollouts, end_error=dict.fromkeys(MODES, np.full(40, bad)),
        fans=dict.fromkeys(MODES, np.full((5, N + 1, 3), bad)),
    )  # fmt: skip
    draw_proof(proof).draw_without_rendering()


def test_rollouts_that_exploded_are_counted(proof):
    ends = dict(proof.monte_carlo.end_error)
    ends["feedback"] = np.append(ends["feedback"][:-3], [math.inf] * 3)
    proof.monte_carlo = replace(proof.monte_carlo, end_error=ends)
    words = [text.get_text() for text in panel(draw_proof(proof), "Monte Carlo: end").get_legend().get_texts()]
    assert words[1].endswith(", 3 exploded")
    assert "exploded" not in words[0]
