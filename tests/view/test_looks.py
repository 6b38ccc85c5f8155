"""Other people's machines are drawn so that they can be seen: the right shapes, sticks, a floor, all joints."""

from dataclasses import replace

import numpy as np
import pytest

from planner.base.gl import load_mujoco
from planner.model.mechanism import Mechanism
from planner.model.mjcf.model_index import compile_model
from planner.problem.appearance import Appearance, GoalMark
from planner.problem.default_appearance import MAX_CURVES, small_multiples
from planner.view.render.camera import directions, swept_box, whole_motion
from planner.view.render.environment import visible_model
from planner.view.render.film import Film
from planner.view.render.scene import Scene, best_rows
from planner.view.render.shapes import LinkCapsules, drawn
from planner.view.render.video import render_poses

ARM = """<mujoco><worldbody>{world}<body name="upper" pos="0 0 {height}"><joint name="a" axis="0 1 0"/>{upper}
  <body name="fore" pos="0 0 .4"><joint name="b" axis="0 1 0"/>{fore}</body></body></worldbody></mujoco>"""
BOX = '<geom name="{}" type="box" size="{size} {size} .2" pos="0 0 .2" mass="1" group="{}" {}/>'
MASS = '<inertial pos="0 0 .2" mass="1" diaginertia=".01 .01 .01"/>'
SEEN, SOLID = 'contype="0" conaffinity="0" rgba=".9 .9 .9 1"', 'rgba="0 .5 0 1"'


def box(name, group, options, size=0.05):
    return BOX.format(name, group, options, size=size)


def film(poses=((0.0, 0.0),), scenery=(), **parts):
    text = ARM.format(**{"world": "", "upper": MASS, "fore": MASS, "height": 0.5} | parts)
    mechanism = Mechanism.from_mjcf(text, contacts="off")
    made = Film.of_poses(mechanism, {str(k): np.array(pose) for k, pose in enumerate(poses)})
    made = replace(made, mjcf=text, appearance=Appearance(title="", scenery=scenery))
    return made, visible_model([made])


def shown(model):
    return {model.geom(i).name for i in np.flatnonzero(drawn(model))} - {"planner floor"}


def floor_of(model):
    """Where our floor is, None where it is hidden."""
    mujoco, floor = load_mujoco(), model.geom("planner floor").id
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return float(data.geom_xpos[floor, 2]) if drawn(model)[floor] else None


@pytest.mark.parametrize(("seen", "solid"), [(1, 0), (0, 3), (0, 0), (2, 4)])
def test_shapes_that_collide_are_hidden_where_others_are_to_be_seen_whatever_their_groups(seen, solid):
    both = box("mesh", seen, SEEN) + box("proxy", solid, SOLID)
    assert shown(film(upper=both, fore=box("tip", 0, SOLID))[1]) == {"mesh", "tip"}


def test_an_ornament_hides_nothing():
    """Eyes do not collide either, but they are not the head."""
    assert shown(film(upper=box("eye", 0, SEEN, size=0.01).replace(".2", ".01") + box("head", 0, SOLID))[1]) == {
        "eye", "head",
    }  # fmt: skip


def test_where_colliding_shapes_have_a_group_of_their_own_no_link_shows_one_beside_others():
    upper = box("mesh", 1, SEEN) + box("proxy", 0, SOLID)
    fore = box("screw", 1, SEEN, size=0.01).replace(".2", ".01") + box("hull", 0, SOLID)
    assert shown(film(upper=upper, fore=fore)[1]) == {"mesh", "screw"}


def test_a_link_whose_shapes_are_all_in_hidden_groups_is_seen():
    assert shown(film(upper=box("hull", 3, SOLID), fore=box("tip", 0, SOLID))[1]) == {"hull", "tip"}


def test_what_nobody_painted_gets_two_colours_and_what_somebody_did_stays():
    plain = film(upper=box("one", 0, ""), fore=box("two", 0, ""))[1]
    one, two = (plain.geom(name).rgba for name in ("one", "two"))
    assert np.abs(one - two).max() > 0.2
    painted = film(upper=box("one", 0, ""), fore=box("two", 0, 'rgba="1 0 0 1"'))[1]
    np.testing.assert_allclose(painted.geom("one").rgba, [0.5, 0.5, 0.5, 1.0])


def test_links_without_shapes_are_sticks_from_joint_to_joint():
    """The last one is as long as a rod with its centre of mass: twice 0.2 m."""
    _, model = film()
    mujoco = load_mujoco()
    data = mujoco.MjData(model)
    data.qpos[:] = [0.0, np.pi / 2]
    mujoco.mj_kinematics(model, data)
    ends = LinkCapsules(model).ends(data).reshape(-1, 2, 3)
    np.testing.assert_allclose(ends[0], [[0, 0, 0.5], [0, 0, 0.9]], atol=1e-12)
    np.testing.assert_allclose(ends[1], [[0, 0, 0.9], [0.4, 0, 0.9]], atol=1e-12)
    assert len(LinkCapsules(film(upper=box("a", 0, SEEN), fore=box("b", 0, SEEN))[1]).ends(data)) == 0


@pytest.mark.parametrize("joint", ["hinge", "slide", "ball", "free"])
def test_a_machine_that_is_a_point_is_a_rod_of_its_inertia_and_has_a_place_for_the_camera(joint):
    """A rod of the mass 3 kg and the length 2 m has the moment of inertia 1 kg m^2 about its middle."""
    text = f"""<mujoco><worldbody><body><joint type="{joint}" axis="0 1 0"/>
      <inertial pos="0 0 0" mass="3" diaginertia="1 1 1"/></body></worldbody></mujoco>"""
    mechanism = Mechanism.from_mjcf(text)
    still = Film.of_poses(mechanism, dict.fromkeys(["one", "the same"], compile_model(text, {}).qpos0))
    model = visible_model([still])
    data = load_mujoco().MjData(model)
    load_mujoco().mj_kinematics(model, data)
    start, end = LinkCapsules(model).ends(data)
    np.testing.assert_allclose(np.linalg.norm(end - start), 2.0)
    assert abs((end - start)[1]) < 1e-9 or joint in ("ball", "free")
    assert LinkCapsules(model).radius > 0.0
    assert best_rows(still, model, 320, 90) in (1, 2)


def test_nothing_that_moves_has_a_place_for_the_camera_too():
    text = "<mujoco><worldbody><site/></worldbody></mujoco>"
    still = replace(film()[0], mjcf=text, path_qpos=np.zeros((2, 0)), path_ghost_qpos=np.zeros((2, 0)))
    model = compile_model(text, {})
    assert whole_motion([still], model, still.appearance, 1.5, ghost=True)[1] > 0.0


def test_the_floor_is_below_the_lowest_pose_or_at_zero_and_only_where_there_is_none():
    """The machine is 0.8 m long and hangs or stands at a joint at 0.5 m."""
    made = {"upper": box("a", 0, SEEN), "fore": box("b", 0, SEEN)}
    hanging = floor_of(film(poses=((0.0, 0.0), (np.pi, 0.0)), **made)[1])
    assert hanging is not None
    assert -0.3 - 0.2 < hanging < -0.3 - 0.1  # a visible gap below the lowest point
    standing = floor_of(film(**made)[1])
    assert standing is not None
    assert -0.01 < standing < 0.0
    high = floor_of(film(**made, height=5.5)[1])
    assert high is not None
    assert 5.3 < high < 5.5  # the height 0 would be out of the picture
    plane = '<geom type="plane" size="{}" rgba=".2 .2 .2 {}"/>'
    assert floor_of(film(world=plane.format("0 0 1", 1), **made)[1]) is None
    assert floor_of(film(world=plane.format("0 0 1", 0), **made)[1]) is not None  # one that cannot be seen
    assert floor_of(film(world=plane.format(".1 .1 1", 1), **made)[1]) is not None  # a tile
    wall = plane.format("0 0 1", 1).replace("<geom", '<geom zaxis="1 0 0"')
    assert floor_of(film(world=wall, **made)[1]) is not None


LAMP, FLOOR = '<light pos="0 0 3"/>', '<geom name="own" type="plane" size="3 3 .1" {}/>'


def test_a_floor_that_nobody_painted_is_no_black_square_under_a_weak_light():
    model = film(world=LAMP + FLOOR.format(""))[1]
    assert floor_of(model) is None  # it is the machine's own
    assert model.geom("own").matid == model.material("planner paving").id
    np.testing.assert_array_equal(model.geom("own").size[:2], 0.0)  # to the horizon
    assert model.vis.headlight.ambient.min() >= 0.3
    for own in ('rgba=".1 .2 .3 1"', 'euler="0 80 0"'):  # painted; a wall
        stays = film(world=LAMP + FLOOR.format(own))[1].geom("own")
        assert stays.matid == -1
        assert stays.size[0] == 3.0


def test_light_that_the_file_gives_stays():
    text = ARM.format(world=LAMP, upper=MASS, fore=MASS, height=0.5)
    dark = text.replace("<mujoco>", '<mujoco><visual><headlight ambient=".02 .02 .02"/></visual>')
    np.testing.assert_allclose(visible_model([replace(film()[0], mjcf=dark)]).vis.headlight.ambient, 0.02)


def test_no_film_of_a_plan_goes_through_the_floor_and_none_is_laid_under_one_that_fell_away():
    made, _ = film(upper=box("a", 0, SEEN), fore=box("b", 0, SEEN))
    missed = replace(made, path_qpos=np.array([[0.0, 0.0], [np.pi, 0.0], [0.0, 0.0]]))
    floor = floor_of(visible_model([made, missed]))
    assert floor is not None
    assert floor < -0.3  # the replay that missed hangs 0.8 m below the joint, and nothing else does
    mark = GoalMark("fore", 0.0, position=(0.0, 0.0, -2.0))
    marked = floor_of(visible_model([replace(made, appearance=replace(made.appearance, goals=(mark,)))]))
    assert marked is not None
    assert marked < -2.0
    text = made.mjcf.replace('<joint name="a" axis="0 1 0"/>', '<joint name="a" type="slide" axis="0 0 1"/>')
    fallen = replace(made, mjcf=text, path_qpos=np.array([[0.0, 0.0], [-1e4, 0.0]]))
    assert floor_of(visible_model([replace(made, mjcf=text), fallen])) is None


def test_a_wall_far_away_does_not_move_the_camera_nor_make_marks_larger():
    """It carries nothing that moves; a base that does belongs to the machine."""
    made, model = film(upper=box("a", 0, SEEN), fore=box("b", 0, SEEN))
    wall = '<body name="wall" pos="9 0 0"><geom type="box" size=".1 1 1"/></body>'
    walled = film(world=wall, upper=box("a", 0, SEEN), fore=box("b", 0, SEEN))[1]
    none = np.zeros(model.nbody, bool), np.zeros(walled.nbody, bool)
    poses = made.path_qpos
    near, far = (swept_box(one, poses, hidden) for one, hidden in zip((model, walled), none, strict=True))
    np.testing.assert_allclose(far.high - far.low, near.high - near.low)


def test_a_strip_has_no_words_and_its_motion_fills_it():
    made, model = film(poses=((0.0, 0.0), (1.0, 0.5)), upper=box("a", 0, SEEN), fore=box("b", 0, SEEN))
    (_, near), (_, far) = (
        whole_motion([made], model, made.appearance, 1.5, False, words=words) for words in (False, True)
    )
    assert near < 0.95 * far


@pytest.mark.render
def test_a_goals_ball_can_be_seen_however_small_the_machine_is_in_the_picture():
    """0.8 m of machine in a picture of 17 m: in its own size the ball would be a seventh of a pixel wide."""
    made, _ = film(upper=box("a", 0, SEEN), fore=box("b", 0, SEEN))
    stage = Appearance(title="", distance=20.0, azimuth=90.0, elevation=0.0)
    mark = GoalMark("fore", 0.0, position=(3.0, 0.0, 3.0))
    pictures = []
    for seen in (stage, replace(stage, goals=(mark,))):
        with Scene(replace(made, appearance=seen), 160, 90, ghost=False) as scene:
            pictures.append(scene.draw(0).astype(int))
    assert np.sum(np.abs(pictures[0] - pictures[1]).max(axis=-1) > 8) > 25


@pytest.mark.render
def test_keyframes_are_drawn_side_by_side_with_their_names(tmp_path):
    from PIL import Image

    mechanism = Mechanism.from_mjcf(ARM.format(height=0.5, world="", upper=box("a", 0, SEEN), fore=box("b", 0, SEEN)))
    poses = {"up": np.zeros(2), "bent": np.array([0.5, 1.0])}
    picture = np.asarray(Image.open(render_poses(mechanism, poses, tmp_path / "p.png", width=320, height=120)))
    assert picture.shape == (120, 320, 3)
    halves = picture[:90, :158].astype(int), picture[:90, 162:].astype(int)
    assert np.sum(np.abs(halves[0] - halves[1]).max(axis=-1) > 40) > 100  # another pose, seen by the same camera


def test_panels_hold_every_curve_and_none_too_many():
    for number in (0, 1, 8, 9, 23, 64):
        panels = small_multiples("Angles", [(i, f"joint {i}") for i in range(number)])
        assert [index for _, curves in panels for index, _ in curves] == list(range(number))
        assert all(0 < len(curves) <= MAX_CURVES for _, curves in panels)
    assert [title for title, _ in small_multiples("Angles", [(0, "a"), (1, "b")])] == ["Angles"]


@pytest.mark.parametrize("tilt", [-0.8, 0.8])
def test_a_camera_sees_all_corners_of_what_moves_towards_it(tilt):
    """The near end of an arm is far from both corners of its box along the axes that lie on a diagonal."""
    made, model = film(poses=((tilt, 0.0),), upper=box("a", 0, SEEN), fore=box("b", 0, SEEN))
    seen = replace(made.appearance, azimuth=0.0, elevation=0.0)
    look_at, distance = whole_motion([made], model, seen, 2.0, False, words=False)
    ahead, right, up = directions(seen.azimuth, seen.elevation)
    mujoco = load_mujoco()
    data, half = mujoco.MjData(model), np.tan(0.5 * np.radians(model.vis.global_.fovy))
    for qpos in made.path_qpos:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        for geom in np.flatnonzero(model.geom_bodyid > 0):
            for corner in np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, -1).T * model.geom_aabb[geom, 3:]:
                local = model.geom_aabb[geom, :3] + corner
                point = data.geom_xpos[geom] + data.geom_xmat[geom].reshape(3, 3) @ local - look_at
                depth = distance + point @ ahead
                assert abs(point @ up) <= half * depth
                assert abs(point @ right) <= 2.0 * half * depth
