"""Pictures of the human step: what is folded over a cycle, that its curves say what was measured."""

import numpy as np
import pytest

import planner
from planner.cases import human_step
from planner.cases.human_step.measures import measures, robot_wrench, vertical_force
from planner.cases.human_step.pictures import by_cycle
from planner.cases.human_step.walker import LEG
from planner.problem.appearance import Charts, Paths, StickFigures
from planner.view.plots.case_pictures import CASE_PICTURES, case_pictures, draw_case_picture
from planner.view.plots.style import save


@pytest.fixture(scope="module", params=["swing", "cycle"])
def shown(request):
    """The step, a plan of it that is not finished, and its pictures by file."""
    plan = planner.solve(human_step(request.param), max_iterations=3)
    return plan.problem.appearance.pictures.args[0], plan, case_pictures(plan, None)


def test_a_line_over_two_cycles_is_folded_at_heel_strikes():
    t = np.linspace(0.9, 2.1, 7)  # 0.9, 1.1, 1.3 .. 2.1: neither 1 nor 2 is a sample
    percent, values = by_cycle(t, t)
    gaps = np.flatnonzero(np.isnan(values))
    assert len(gaps) == 2
    for gap, cycle in zip(gaps, (1.0, 2.0), strict=True):
        np.testing.assert_allclose(percent[gap - 1 : gap + 2], [100.0, 100.0, 0.0], atol=1e-9)
        np.testing.assert_allclose(values[[gap - 1, gap + 1]], cycle, atol=1e-9)
    known = np.isfinite(values)
    np.testing.assert_allclose(
        values[known] - percent[known] / 100.0, np.round(values[known] - percent[known] / 100.0), atol=1e-9
    )


def test_a_whole_cycle_has_no_gap_but_at_its_end():
    percent, values = by_cycle(np.linspace(0.0, 1.0, 11), np.arange(11.0))
    assert np.flatnonzero(np.isnan(values)).tolist() == [11]
    np.testing.assert_allclose(percent[:11], 10.0 * np.arange(11.0), atol=1e-9)


def curve(chart, label):
    (found,) = [curve for curve in chart.curves if curve.label == label]
    return found


def chart_of(charts, title, unit=""):
    (found,) = [chart for chart in charts.charts if chart.title == title and unit in chart.ylabel]
    return found


def test_one_picture_of_each_kind(shown, tmp_path):
    step, _, pictures = shown
    assert {type(picture): name for name, picture in pictures.items()} == CASE_PICTURES
    if len(step.walker.legs) < 2:
        return  # a picture takes most of a second, and the step of one leg has the same kinds
    for name, picture in pictures.items():
        save(draw_case_picture(picture), tmp_path / name)
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")


def test_the_charts_say_what_was_measured(shown):
    """The same numbers as the proof's and the robot's, of every leg, at the knots."""
    step, plan, pictures = shown
    charts, found = pictures[CASE_PICTURES[Charts]], measures(step, plan.xs)
    m = step.walker.mechanism
    for side in step.walker.legs:
        hip = curve(chart_of(charts, "Hip over the normal gait's"), side)
        swinging = (hip.t >= 62.0) & np.isfinite(hip.values)
        assert hip.values[swinging].max() == pytest.approx(1e3 * found.hip_lift[side], rel=1e-3)
        for joint in LEG:
            chart = chart_of(charts, joint.replace("_", " ").capitalize())
            drawn = curve(chart, side).values
            angle = np.degrees(plan.xs[:, m.joint(f"{side}_{joint}").start])
            assert np.nanmax(drawn) == pytest.approx(angle.max(), abs=1e-9)
            # the band is as wide as the cost lets the joint go, and normal gait is in its middle
            away = angle - np.interp(step.leg_time(side) * 100.0, charts.t, chart.band.mean)
            inside = step.leg_time(side) > 1e-3  # 1 is 0 of the next cycle
            assert np.sqrt(np.mean(away[inside] ** 2)) == pytest.approx(found.rms[f"{side}_{joint}"], rel=0.03)
            assert chart.band.spread == pytest.approx(10.0 if joint in ("hip_rotation", "ankle") else 5.0)
        if step.walker.belt:
            force = vertical_force(step, plan.xs[:, : m.nq], plan.xs[:, m.nq :], side)
            assert np.nanmax(curve(chart_of(charts, "Belt on a foot, upwards"), side).values) == force.max()
    wrench = robot_wrench(plan.problem.dynamics, plan.xs, plan.us)
    for unit, names, first in (("force", "xyz", 0), ("moment", ("tilt", "list", "rotation"), 3)):
        for k, name in enumerate(names, start=first):
            drawn = curve(chart_of(charts, "Robot on the pelvis", unit), name).values
            np.testing.assert_array_equal(drawn[np.isfinite(drawn)][: len(wrench)], wrench[:, k])


def test_poses_and_path_are_the_plan_and_the_normal_gait(shown):
    step, plan, pictures = shown
    poses, path = pictures[CASE_PICTURES[StickFigures]], pictures[CASE_PICTURES[Paths]]
    first = step.walker.mechanism.joint("pelvis_x").start
    optimized, normal = path.traces
    np.testing.assert_array_equal(optimized.points, plan.xs[:, first : first + 3])
    np.testing.assert_array_equal(normal.points, step.states[:, first : first + 3])
    assert [motion.dashed for motion in poses.motions] == [False, True]
    # the middle between the hips is where the pelvis is
    np.testing.assert_allclose(poses.motions[0].points[:, :2].mean(axis=1), optimized.points, atol=1e-12)
    assert len(poses.sticks) == 1 + len(step.walker.legs)


def test_a_case_without_pictures_of_its_own():
    plan = planner.solve(planner.cases.two_link(), max_iterations=1)
    assert case_pictures(plan, None) == {}
