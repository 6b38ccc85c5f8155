"""Stick figures, paths and charts: what is drawn where, in numbers, and what cannot be drawn."""

import numpy as np
import pytest
from contact_machines import leg

from planner.base.errors import FileError, PlannerError
from planner.model.mechanism import Mechanism
from planner.problem.appearance import (
    Band,
    Chart,
    Charts,
    CurveData,
    Paths,
    PoseSequence,
    Stick,
    StickFigures,
    Trace,
    View,
)
from planner.view.plots.case_pictures import (
    FRONT,
    SIDE,
    TOP,
    axes_of,
    draw_charts,
    draw_paths,
    draw_stick_figures,
    frame_points,
    projected,
)
from planner.view.plots.style import save

LEG = Stick((0, 1), "leg", hue=0)


def walk(label="planned", dashed=False, lift=0.0, samples=11):
    """A leg of 1 m whose foot goes forward by half a metre, and comes nearer to the middle."""
    s = np.linspace(0.0, 1.0, samples)
    foot = np.stack([0.5 * s, 0.2 * (1.0 - s), np.full(samples, lift)], axis=1)
    hip = foot + np.array([0.0, 0.0, 1.0])
    return PoseSequence(label, np.stack([hip, foot], axis=1), dashed)


def poses(motions, sticks=(LEG,), count=2, ground=0.0):
    return StickFigures("", motions, sticks, ("",) * count, ground)


def lines(axes):
    return [np.stack([line.get_xdata(), line.get_ydata()], axis=1) for line in axes.get_lines()]


# Projections


def test_side_front_and_top_are_what_they_are_called():
    point = np.array([1.0, 2.0, 3.0])  # ahead, left, up
    np.testing.assert_allclose(projected(point, SIDE), [1.0, 3.0], atol=1e-12)
    np.testing.assert_allclose(projected(point, FRONT), [2.0, 3.0], atol=1e-12)  # who faces us has left at our right
    np.testing.assert_allclose(projected(point, TOP), [1.0, 2.0], atol=1e-12)


@pytest.mark.parametrize("view", [SIDE, FRONT, TOP, View(37.0, -20.0), View(-110.0, 45.0)])
def test_axes_of_a_view_are_of_length_one_and_across_each_other(view):
    right, up = axes_of(view)
    np.testing.assert_allclose([right @ right, up @ up, right @ up], [1.0, 1.0, 0.0], atol=1e-12)
    assert right[2] == pytest.approx(0.0, abs=1e-12)  # the horizon is level


def test_points_of_frames_are_those_of_the_machine():
    machine = Mechanism.from_mjcf(leg())
    x = machine.home.copy()
    x[0] = 0.4
    points = frame_points(machine, np.stack([machine.home, x]), ("trunk", "shank"))
    np.testing.assert_allclose(points[0], [[0.0, 0.0, 0.75], [0.0, 0.0, 0.40]], atol=1e-12)
    np.testing.assert_allclose(points[1] - points[0], np.tile([0.4, 0.0, 0.0], (2, 1)), atol=1e-12)
    with pytest.raises(PlannerError, match="frame is 'toe'"):
        frame_points(machine, x[None], ("toe",))


# Stick figures


def test_each_pose_has_its_own_place_and_keeps_what_the_dashed_one_is_off():
    figure = draw_stick_figures(poses([walk(), walk("normal", True, lift=0.1)], count=3))
    side, front = figure.axes
    drawn = lines(side)
    assert len(drawn) == 3 + 3 + 1  # poses of both, the ground
    solid, dashed = drawn[:3], drawn[3:6]
    middles = [pose[:, 0].mean() for pose in solid]
    assert np.diff(middles) == pytest.approx([middles[1]] * 2)  # equally far from each other
    assert middles[1] > 0.0
    for pose, other in zip(solid, dashed, strict=True):
        np.testing.assert_allclose(pose[:, 1], [1.0, 0.0], atol=1e-12)
        np.testing.assert_allclose(other - pose, np.tile([0.0, 0.1], (2, 1)), atol=1e-12)
    np.testing.assert_allclose(drawn[6][:, 1], 0.0)  # the ground
    assert [line.get_linestyle() for line in side.get_lines()[:6]] == ["-"] * 3 + ["--"] * 3
    assert len(lines(front)) == 7
    # the views stand below each other
    assert side.get_xlim() == front.get_xlim()
    assert (side.get_title(loc="left"), front.get_title(loc="left")) == ("side", "front")
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels == ["planned", "normal", "leg"]


def test_poses_are_at_equal_times_whatever_the_samples_are():
    coarse, fine = (draw_stick_figures(poses([walk(samples=n)], count=4), (FRONT,)).axes[0] for n in (2, 31))
    for a, b in zip(lines(coarse), lines(fine), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-12)


def test_no_ground_is_drawn_from_above():
    figure = draw_stick_figures(poses([walk()]), (TOP,))
    assert len(lines(figure.axes[0])) == 2


def test_a_stick_figure_that_stands_still_can_be_drawn(tmp_path):
    still = PoseSequence("still", np.zeros((1, 2, 3)))
    save(draw_stick_figures(StickFigures("", [still], [LEG], ("0 %", "100 %"), title="still")), tmp_path / "still.png")
    assert (tmp_path / "still.png").stat().st_size > 1000


@pytest.mark.parametrize(
    ("motions", "sticks", "count", "words"),
    [
        ([walk()], [Stick((0, 2))], 2, "join points up to 2 of 'planned', expected 0 to 1"),
        ([walk()], [Stick((-1, 0))], 2, "expected 0 to 1"),
        ([walk()], [LEG], 1, "poses"),
        ([], [LEG], 2, "nothing to draw"),
        ([PoseSequence("flat", np.zeros((5, 2)))], [LEG], 2, r"points of 'flat' has shape \(5, 2\)"),
        ([PoseSequence("none", np.zeros((0, 2, 3)))], [LEG], 2, "'none' has no samples"),
        ([PoseSequence("lost", np.full((2, 2, 3), np.nan))], [LEG], 2, "expected finite"),
    ],
)
def test_wrong_stick_figures_are_refused(motions, sticks, count, words):
    with pytest.raises(PlannerError, match=words):
        draw_stick_figures(poses(motions, sticks, count))


# Paths


def test_paths_are_to_one_scale_and_begin_with_a_dot():
    points = np.array([[0.0, 0.0, 0.9], [0.1, 0.02, 0.95]])
    figure = draw_paths(Paths("", [Trace("planned", points), Trace("normal", 0.5 * points, True)]))
    side, front, top = figure.axes
    np.testing.assert_allclose(lines(side)[0], [[0.0, 900.0], [100.0, 950.0]], atol=1e-9)
    np.testing.assert_allclose(lines(side)[1], [[0.0, 900.0]], atol=1e-9)
    np.testing.assert_allclose(lines(front)[0][:, 0], [0.0, 20.0], atol=1e-9)
    np.testing.assert_allclose(lines(top)[0], [[0.0, 0.0], [100.0, 20.0]], atol=1e-9)
    assert (side.get_xlabel(), side.get_ylabel(), top.get_ylabel()) == ("x, mm", "z, mm", "y, mm")
    spans = [np.ptp(axes.get_xlim()) for axes in figure.axes] + [np.ptp(axes.get_ylim()) for axes in figure.axes]
    np.testing.assert_allclose(spans, spans[0])


def test_a_path_that_is_a_point_can_be_drawn(tmp_path):
    figure = draw_paths(Paths("", [Trace("point", np.zeros((2, 3)))]))
    save(figure, tmp_path / "point.svg")
    assert (tmp_path / "point.svg").exists()
    with pytest.raises(PlannerError, match="nothing to draw"):
        draw_paths(Paths("", []))
    with pytest.raises(FileError, match="no picture format"):
        save(figure, tmp_path / "point.docx")


# Charts


def test_charts_share_colours_and_one_legend():
    t = np.linspace(0.0, 100.0, 5)
    knee = Chart(
        "knee", "deg", [CurveData("right", t), CurveData("left", -t), CurveData("right, planned", t + 1.0, True,
        of="right")],
        Band("normal", np.zeros(5), 5.0), [(0.0, 60.0)],
    )  # fmt: skip
    force = Chart("force", "N", [CurveData("left", np.array([0.0, 1.0, np.nan, 1e80, 0.0]))])
    figure = draw_charts(Charts("", t, [knee, force], "% of cycle", span_label="stance"))
    first, second = figure.axes
    colour = {line.get_label(): line.get_color() for line in first.get_lines()}
    assert colour["right"] == colour["right, planned"] != colour["left"]
    assert second.get_lines()[0].get_color() == colour["left"]
    assert np.isnan(second.get_lines()[0].get_ydata()[2:4]).all()  # gaps
    edges = first.collections[0].get_datalim(first.transData).intervaly
    np.testing.assert_allclose(edges, [-5.0, 5.0])
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels == ["normal", "right", "left", "right, planned", "stance"]
    assert first.get_xlim() == (0.0, 100.0)


def test_a_curve_may_have_times_of_its_own(tmp_path):
    t, own = np.linspace(0.0, 1.0, 3), np.linspace(0.0, 1.0, 7)
    figure = draw_charts(Charts("", t, [Chart("a", "N", [CurveData("replay", own, t=own)])], title="a"))
    np.testing.assert_array_equal(figure.axes[0].get_lines()[0].get_xdata(), own)
    save(figure, tmp_path / "charts.png")
    assert (tmp_path / "charts.png").exists()


@pytest.mark.parametrize(
    ("charts", "words"),
    [
        ([], "0 charts"),
        ([Chart("a", "N", [CurveData("short", np.zeros(2))])], r"values of 'short' has shape \(2,\), expected \(3,\)"),
        ([Chart("a", "N", [], Band("normal", np.zeros(4), 1.0))], "band of 'a'"),
        ([Chart("a", "N", [], Band("normal", np.zeros(3), np.zeros(4)))], "spread"),
        ([Chart("a", "N", [CurveData(str(i), np.zeros(3)) for i in range(9)])], "9 curves, expected at most 8"),
    ],
)
def test_wrong_charts_are_refused(charts, words):
    with pytest.raises(PlannerError, match=words):
        draw_charts(Charts("", np.arange(3.0), charts))
