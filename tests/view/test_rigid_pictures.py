"""Pictures of trees: stages nobody wrote, cameras, trails, ghosts."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from films import changed
from rolled_out_plans import LIMITED, TREE, acrobot, problem_of, rolled_out

import planner
from planner.model.mechanism import Mechanism
from planner.model.mjcf.text import edited
from planner.model.space import exp_quaternion
from planner.problem.appearance import Appearance
from planner.problem.default_appearance import default_appearance
from planner.view.render.camera import between_words, directions, standing_back
from planner.view.render.film import Film
from planner.view.render.overlay import Overlay, Words
from planner.view.render.scene import Scene


def test_a_stage_nobody_wrote_names_joints_and_looks_across_the_plane():
    stage = default_appearance(acrobot())
    assert (stage.title, stage.azimuth) == ("acrobot scene", 90.0)
    assert [panel.title for panel in stage.plots] == ["Joint angles", "Angular velocities", "Controls: torques"]
    assert stage.plots[0].states == ((0, "shoulder"), (1, "elbow"))
    assert stage.plots[1].states == ((2, "shoulder"), (3, "elbow"))
    tree = Mechanism.from_mjcf(TREE)
    stage = default_appearance(tree)
    assert stage.azimuth not in (0.0, 90.0, 180.0)
    assert stage.plots[1].states[:3] == ((0, "root x"), (1, "root y"), (2, "root z"))
    many = TREE.replace('<joint name="knee" axis="0 1 0"/>', '<joint name="knee" axis="0 1 0"/><joint axis="1 0 0"/>')
    stage = default_appearance(Mechanism.from_mjcf(many))
    turning = [panel for panel in stage.plots if panel.title.startswith("Angular velocities")]
    # 3 of the root, 3 of the wrist, hip, knee and one more: too many for one panel, and none is left out
    assert [panel.title for panel in turning] == ["Angular velocities, 1 to 4 of 9", "Angular velocities, 5 to 9 of 9"]
    assert len({index for panel in turning for index, _ in panel.states}) == 9


@pytest.mark.parametrize(
    ("axis", "view"),
    [
        ("0 -1 0", (90.0, 0.0)), ("0 1 0", (90.0, 0.0)), ("1 0 0", (180.0, 0.0)), ("0 0 1", (90.0, -90.0)),
        ("1 1 0", (45.0, 0.0)), ("1 -1 0", (135.0, 0.0)), ("0 1 1", (-90.0, -45.0)),
    ],
)  # fmt: skip
def test_a_planar_machine_is_seen_along_the_normal_of_its_plane(axis, view):
    """A camera that looks down on a vertical plane shows its angles tilted."""
    stage = default_appearance(Mechanism.from_mjcf(LIMITED.replace("0 -1 0", axis)))
    assert (stage.azimuth, stage.elevation) == pytest.approx(view)
    along = np.cross([float(part) for part in axis.split()], directions(stage.azimuth, stage.elevation)[0])
    np.testing.assert_allclose(along, 0.0, atol=1e-12)


def test_slides_have_a_plane_too():
    slides = """<mujoco><worldbody><body><joint type="slide" axis="{}"/><geom size=".1" mass="1"/><body>
      <joint type="slide" axis="{}"/><geom size=".1" mass="1"/></body></body></worldbody></mujoco>"""
    found = [default_appearance(Mechanism.from_mjcf(slides.format(*axes))) for axes in (
        ("1 0 0", "0 0 1"), ("0 1 0", "0 0 1"), ("1 0 0", "0 1 0"), ("1 1 0", "0 0 1"))]  # fmt: skip
    views = [(stage.azimuth, stage.elevation) for stage in found]
    np.testing.assert_allclose(views, [(90.0, 0.0), (180.0, 0.0), (90.0, -90.0), (135.0, 0.0)], atol=1e-9)


@pytest.mark.render
@pytest.mark.parametrize("axis", ["1 0 0", "0 -1 0", "0 0 1"])
def test_a_model_without_light_or_floor_is_seen_whole(axis):
    """The camera finds it, whatever the plane of motion: the arm covers a good part and touches no edge."""
    text = LIMITED.replace("0 -1 0", axis).replace('range="-1 1"', "")
    text = text.replace('fromto="0 0 0 1 0 0"', 'fromto="0 0 0 0 1 0"') if axis == "1 0 0" else text
    text = text.replace('pos="1 0 0"', 'pos="0 1 0"') if axis == "1 0 0" else text
    plan = rolled_out(problem_of(Mechanism.from_mjcf(text), 0.01, 100, us=np.full((100, 1), 2.0)))
    film = Film.of(planner.replay(plan), np.array([0.0, 0.5, 1.0]))
    empty_model = edited(text, {".//geom": {"rgba": "0 0 0 0"}})
    with (
        Scene(film, 160, 90, ghost=False) as scene,
        Scene(replace(film, mjcf=empty_model), 160, 90, ghost=False) as none,
    ):
        for frame in range(3):
            picture, background = scene.draw(frame), none.draw(frame)
            blue = picture[..., 2] > picture[..., 0] + 15.0  # not the grey of its shadow, which may touch an edge
            arm = blue & (np.abs(picture.astype(int) - background.astype(int)).max(axis=-1) > 8)
            assert arm.sum() > 60
            assert not arm[[0, -1]].any()
            assert not arm[:, [0, -1]].any()
            assert background.mean() > 100  # no black nothing


@pytest.mark.render
def test_a_trail_follows_the_site():
    stage = Appearance(title="", azimuth=90.0, elevation=-5.0)
    problem = problem_of(Mechanism.from_mjcf(LIMITED), 0.01, 60)

    def pictures(stage):
        plan = rolled_out(replace(problem, appearance=stage))
        with Scene(Film.of(planner.replay(plan), np.array([0.0, 0.3, 0.6])), 320, 180, ghost=False) as scene:
            return [scene.draw(frame) for frame in range(3)]

    plain, trailed = pictures(stage), pictures(replace(stage, trail="tip"))
    drawn = [changed(a, b) for a, b in zip(plain, trailed, strict=True)]
    assert drawn[0] < 10
    assert 40 < drawn[1] < drawn[2]
    with pytest.raises(planner.PlannerError, match=r"trail is 'toe', expected a site or body of the model: tip\."):
        pictures(replace(stage, trail="toe"))


@pytest.mark.render
def test_the_ghost_of_a_tree_stands_where_its_quaternions_say():
    """The ghost of a turned plan covers the pixels that the machine itself would cover if it were turned so."""
    box = '<geom type="box" size="0.3 0.1 0.15" contype="0" conaffinity="0" rgba="0.8 0.2 0.2 1"/><body name="thigh"'
    lamp = '<light dir="0 0 -1" castshadow="false"/>'  # the machine alone, not its shadow, is compared
    tree = TREE.replace('<body name="thigh"', box).replace("<worldbody>", f"<worldbody>{lamp}")
    stage = Appearance(title="", distance=2.5, azimuth=90.0, elevation=-10.0)
    mechanism = Mechanism.from_mjcf(tree)
    x0 = mechanism.home.copy()
    x0[0] = 0.8
    run = planner.replay(
        rolled_out(problem_of(mechanism, 0.005, 2, x0=x0, us=np.zeros((2, mechanism.nu)), appearance=stage))
    )
    turned = run.plan_xs.copy()
    turned[:, 0], turned[:, 3:7] = -0.5, exp_quaternion(np.array([0.0, np.pi / 2, 0.0]))

    away = turned[:, : mechanism.nq].copy()
    away[:, 1] = 50.0

    def drawn(ghost, qpos):
        film = Film.of(replace(run, plan_xs=turned, qpos=qpos), np.array([0.0]))
        with Scene(film, 160, 90, ghost=ghost) as scene:
            return scene.draw(0).astype(int)

    def where(a, b):
        return np.abs(a - b).max(axis=-1) > 8

    ghost = where(drawn(True, run.qpos), drawn(False, run.qpos))
    machine = where(drawn(False, turned[:, : mechanism.nq]), drawn(False, away))
    assert ghost.sum() > 100
    assert (ghost & machine).sum() > 0.85 * (ghost | machine).sum()


@pytest.mark.parametrize(("half", "lowered"), [((2.0, 0.1, 0.3), 0.15), ((0.3, 0.1, 2.0), None)], ids=["wide", "tall"])
def test_a_motion_stands_below_the_numbers_where_there_is_room_and_above_the_caption_always(half, lowered):
    caption = Overlay(Appearance(title=""), 1280, 720, Words(np.zeros(0), numbers=False, difference=True))._panels[-1]
    corners = np.array(list(itertools.product((-1.0, 1.0), repeat=3))) * half
    angles = 90.0, 0.0, 45.0
    distance = standing_back(corners, *angles, 16 / 9, 0.9)
    aside = between_words(corners, *angles, distance)
    ahead, _, up = directions(*angles[:2])
    depth, tangent = distance + corners @ ahead, np.tan(np.radians(22.5))
    rows = 360.0 * (1.0 - (corners - aside) @ up / (depth * tangent))
    assert rows.max() < caption[1][1]
    assert rows.min() > 0.1 * 360.0
    if lowered is not None:
        np.testing.assert_allclose(aside, [0.0, 0.0, lowered * distance * tangent])
