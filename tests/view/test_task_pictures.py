"""Pictures of tasks: goals, paths and frames in films and strips, misses and bounds in plots."""

from dataclasses import replace

import numpy as np
import pytest
from films import changed
from PIL import Image
from places import ROOT
from rolled_out_plans import LIMITED, problem_of, rolled_out

import planner
from planner.model.mechanism import Mechanism
from planner.problem.appearance import Appearance, BoundedPanel, GoalMark
from planner.view.plots.plan import draw_plan
from planner.view.plots.style import panels_of
from planner.view.plots.time_series import draw_bounded
from planner.view.render.film import Film
from planner.view.render.scene import Scene
from planner.view.render.video import render_strip

TASKS = sorted((ROOT / "examples" / "tasks").glob("*.toml"))
# One with each kind of goal and panel: a wall, a path, joints, several goals, a constraint, limits.
KINDS = {"around_a_post", "circle", "double_pendulum", "pick_and_place", "reach_upright_cup", "reach_within_limits"}
SIZE = (320, 180)
STAGE = Appearance(title="", azimuth=90.0, elevation=-5.0, distance=2.5, look_at=(0.4, 0.0, 0.3))


@pytest.fixture(scope="module")
def run():
    return planner.replay(rolled_out(problem_of(Mechanism.from_mjcf(LIMITED), 0.01, 60)))


def pictures(run, stage, frames=(0.0, 0.3, 0.6)):
    """The frames, where the goals' labels are in each, and which of them are faint."""
    plan = replace(run.plan, problem=replace(run.plan.problem, appearance=stage))
    with Scene(Film.of(replace(run, plan=plan), np.array(frames)), *SIZE, ghost=False) as scene:
        return [(scene.draw(k), scene.labels(k)) for k in range(len(frames))]


@pytest.mark.render
@pytest.mark.parametrize(
    "path", [pytest.param(p, id=p.stem, marks=() if p.stem in KINDS else pytest.mark.slow) for p in TASKS]
)
def test_pictures_of_each_example_are_drawn(path):
    plan = rolled_out(planner.load_problem(path))
    run = planner.replay(plan)
    with Scene(Film.of(run, np.array([0.4 * plan.t[-1]])), *SIZE) as scene:
        assert scene.draw(0).std() > 10.0  # of 255: there is something
        times = {goal.time for goal in plan.problem.appearance.goals}
        numbers = [number for label in scene.labels(0) for number in label.words.split(", ")]
        assert len(numbers) == (len(times) if len(times) > 1 else 0)
    titles = [axes.get_title(loc="left") for axes in draw_plan(plan, run).axes]
    table = plan.problem.parameters
    plain = not isinstance(table.get("goal"), list) and not {"follow", "constraint", "avoid"} & set(table)
    assert any(title.startswith(("Goals: ", "Constraint: ")) for title in titles) != plain


@pytest.mark.render
def test_a_strip_shows_goals_and_their_numbers(run, tmp_path):
    """In every pose, and the numbers too: more changes than at the goals themselves."""
    goals = tuple(GoalMark("tip", t, (0.3, 0.0, z), number=n) for t, z, n in ((0.2, 0.8, ""), (0.6, 0.5, "")))
    strips = []
    for k, seen in enumerate(((), goals, tuple(replace(one, number="7") for one in goals))):
        problem = replace(run.plan.problem, appearance=replace(STAGE, goals=seen))
        shown = replace(run, plan=replace(run.plan, problem=problem))
        path = render_strip(shown, tmp_path / f"{k}.png", poses=2, width=640, height=200)
        with Image.open(path) as image:
            strips.append(np.asarray(image))
    halves = [(strip[:, :320], strip[:, 320:]) for strip in strips]
    for none, marked, numbered in zip(*halves, strict=True):
        assert 5 < changed(none, marked) < changed(none, numbered)


@pytest.mark.render
def test_a_goal_is_drawn_at_its_place_and_fades_when_passed(run):
    """Its pixels change around its projection and nowhere else; the last goal does not fade."""
    place = (0.4, 0.0, 0.8)  # m, beside the arm
    passed = GoalMark("tip", 0.2, place, number="1")
    plain = pictures(run, STAGE, (0.0, 0.3))
    for mark in (passed, replace(passed, orientation=np.eye(3)), replace(passed, direction=(0.0, 0.0, 1.0))):
        shown = pictures(run, replace(STAGE, goals=(mark,)), (0.0, 0.3))
        strength = []
        for (before, none), (after, labels) in zip(plain, shown, strict=True):
            assert none == []
            ((column, row), words, faint), = labels  # fmt: skip
            assert words == "1"
            away = np.abs(before.astype(int) - after.astype(int)).max(axis=-1)
            rows, columns = np.nonzero(away > 8)
            assert len(rows) > 5
            assert np.hypot(rows - row, columns - column).max() < 27  # pixels, of 87 that 1 m has
            strength.append(away.sum())
            assert faint == (len(strength) > 1)  # it is passed in the second picture
        assert strength[1] < 0.7 * strength[0]
    (_, labels), *_ = pictures(run, replace(STAGE, goals=(replace(passed, time=0.6),)), frames=(0.6,))
    assert not labels[0].faint
    with pytest.raises(planner.PlannerError, match=r"frame is 'toe', expected a site or body of the model: tip\."):
        pictures(run, replace(STAGE, goals=(replace(passed, frame="toe"),)))


@pytest.mark.render
def test_goals_at_one_place_share_a_label(run):
    goals = tuple(GoalMark("tip", 0.1 * k, place, number=str(k)) for k, place in
                  ((1, (0.4, 0.0, 0.8)), (2, (0.9, 0.0, 0.4)), (3, (0.4, 0.0, 0.801))))  # fmt: skip
    (_, labels), *_ = pictures(run, replace(STAGE, goals=goals))
    assert [label.words for label in labels] == ["1, 3", "2"]


@pytest.mark.render
def test_paths_and_frames_are_drawn(run):
    plain = pictures(run, STAGE, (0.3,))
    line = np.array([[0.2, 0.0, 0.3], [0.2, 0.0, 0.8], [0.9, 0.0, 0.8]])
    # The arm hides most of its tip's axes.
    for stage, least in ((replace(STAGE, paths=(line,)), 20), (replace(STAGE, frames=("tip",)), 2)):
        for (before, _), (after, _) in zip(plain, pictures(run, stage, (0.3,)), strict=True):
            assert changed(before, after) >= least


@pytest.mark.render
def test_a_goal_out_of_the_way_is_in_the_picture(run):
    goal = GoalMark("tip", 0.6, (0.0, 0.0, 4.0), number="1")
    far = replace(STAGE, distance=None, goals=(goal,))
    (_, labels), *_ = pictures(run, far)
    column, row = labels[0].at
    assert 0 < column < SIZE[0]
    assert 0 < row < SIZE[1]


@pytest.mark.render
def test_a_ghost_where_the_machine_is_does_not_flicker(run):
    """It is hidden: the picture is that without it, but for the rims of shapes."""

    def draw(ghost):
        plan = replace(run.plan, problem=replace(run.plan.problem, appearance=STAGE))
        film = Film.of(replace(run, plan=plan), np.array([0.3]))
        with Scene(replace(film, ghost_qpos=film.qpos), *SIZE, ghost=ghost) as scene:
            return scene.draw(0)

    with_ghost, alone = draw(True), draw(False)
    assert changed(with_ghost, alone) < 20


def panel(values, lower=-np.inf, upper=np.inf, decades=False, R=1):
    t = np.linspace(0.0, 1.0, len(values))
    sides = [np.broadcast_to(np.asarray(side, float), (len(values), R)) for side in (lower, upper)]
    return BoundedPanel("title", "m", t, tuple("ab"[:R]), (np.reshape(values, (-1, R)),), *sides, decades=decades)


def drawn(one):
    figure, (axes,) = panels_of(1)
    draw_bounded(axes, one, [])
    figure.canvas.draw()
    return axes


def test_bounds_are_lines_with_the_outside_shaded_and_names_are_beside():
    values = np.linspace(0.2, 0.9, 30)
    axes = drawn(panel(values, lower=0.1, upper=0.8))
    assert {round(float(line.get_ydata()[0]), 3) for line in axes.lines} == {0.2, 0.1, 0.8}
    assert len(axes.collections) == 2  # above and below
    assert axes.get_ylim()[0] < 0.1
    assert axes.get_ylim()[1] > 0.9
    own = drawn(panel(np.stack([values, values + 1.0], axis=1), upper=[0.8, 1.8], R=2))
    assert not own.collections
    box, legend = (
        own.get_position(),
        own.get_legend().get_window_extent().transformed(own.figure.transFigure.inverted()),
    )
    assert legend.x0 >= box.x1


def test_a_tolerance_at_one_time_is_a_mark_and_decades_are_logarithmic():
    values = np.geomspace(1.0, 1e-6, 30)
    most = np.full((30, 1), np.inf)
    most[-1] = 5e-3
    axes = drawn(panel(values, upper=most, decades=True))
    assert axes.get_yscale() == "log"
    assert 1e-5 < axes.get_ylim()[0] < 5e-3  # what is far below the tolerance says nothing
    (mark,) = [line for line in axes.lines if line.get_linestyle() == "None"]
    assert (mark.get_xdata()[0], mark.get_ydata()[0]) == (1.0, 5e-3)
    assert "tolerance" in axes.get_ylabel()
    assert drawn(panel(np.linspace(0.5, 1.0, 30), upper=most, decades=True)).get_yscale() == "log"
    assert drawn(panel(np.linspace(0.02, 0.05, 30), upper=most, decades=True)).get_yscale() == "linear"
    met = drawn(panel(np.linspace(0.0, 1.0, 30), lower=most, upper=most))
    assert "ring" in met.get_ylabel()


def test_a_penetration_is_seen_on_a_scale_over_decades():
    """A log scale has no place for -0.002 m, which is just what a clearance is drawn for."""
    values = np.concatenate([np.geomspace(0.9, 0.001, 20), [-0.002], np.geomspace(0.001, 0.9, 9)])
    for deepest in (-0.002, -0.4):
        values[20] = deepest
        axes = drawn(panel(values, lower=0.02, decades=True))
        assert axes.get_yscale() == "symlog"
        assert axes.get_ylim()[0] < deepest
        assert any(line.get_ydata()[20] == deepest for line in axes.lines if len(line.get_ydata()) == 30)
    assert drawn(panel(np.abs(values), lower=0.02, decades=True)).get_yscale() == "log"


def test_long_names_are_broken_into_lines_and_not_cut():
    one = panel(np.stack([np.linspace(0.2, 0.9, 30)] * 2, axis=1), lower=0.1, R=2)
    names = ("geom 'left_finger_pad_collision', table", "post, hand")
    legend = drawn(replace(one, names=names)).get_legend()
    words = [text.get_text() for text in legend.get_texts()]
    assert [" ".join(word.split()).replace("_ ", "_") for word in words] == list(names)
    assert max(len(line) for word in words for line in word.splitlines()) <= 22
    box = legend.get_window_extent()
    assert box.x1 <= legend.figure.bbox.x1  # all of it is in the picture


def test_lines_of_bounds_are_named_below_all_panels(run):
    """The red line that most curves share, and the dotted ones of single curves."""
    kept = planner.Constraint(lambda xs: xs[:, :1], lower=-5.0, upper=5.0)
    figure = draw_plan(replace(run.plan, problem=replace(run.plan.problem, constraints=(kept,))), None)
    words = [text.get_text() for text in figure.legends[0].get_texts()]
    assert "bound" in words
    assert not any("bound" in one.get_text() for one in draw_plan(run.plan, None).legends[0].get_texts())
