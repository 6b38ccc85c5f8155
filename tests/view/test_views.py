"""Several cameras, a given ghost, scenery, and a force for each contact."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from contact_machines import leg
from films import changed, decode, make_proof
from PIL import Image
from treadmills import APPEARANCE, BELT_SPEED, FRICTION, TREADMILL, WEIGHT, standing

from planner.base import gl
from planner.base.errors import PlannerError
from planner.model.mechanism import Mechanism
from planner.model.mjcf.model_index import compile_model
from planner.problem.appearance import Ghost, View
from planner.problem.default_appearance import default_appearance
from planner.proof.replays import contact_history
from planner.proof.replays.contact_history import ContactRecorder
from planner.view.render.drawing import Job, carry_out
from planner.view.render.film import Film
from planner.view.render.scene import Scene
from planner.view.render.shapes import SceneGeoms
from planner.view.render.video import render_frame, render_strip, render_video

AT = np.array([0.0, 0.39])


@pytest.fixture(scope="module")
def replay():
    return standing()


def lifted(replay, by):
    """The ghost of one who stands higher."""
    states = replay.xs[::40].copy()
    states[:, 2] += by
    return Ghost(states, "lifted", colour=(0.9, 0.1, 0.9), opacity=0.8)


def staged(replay, **changes):
    """The replay with another appearance."""
    plan = replay.plan
    problem = type(plan.problem)(**{**vars(plan.problem), "appearance": replace(APPEARANCE, **changes)})
    return replace(replay, plan=replace(plan, problem=problem))


# The force of each contact


def test_each_contact_has_its_force_and_their_normals_sum_to_the_total(replay):
    seen = replay.contacts
    assert seen.names == ("left_foot on belt", "right_foot on belt")
    np.testing.assert_array_equal(seen.t, replay.t)
    # the belt is level, so that normal forces are the vertical ones
    np.testing.assert_allclose(seen.forces[..., 2].sum(axis=1), replay.contact_force, atol=1e-9)
    mean = seen.forces[200:].mean(axis=0)
    assert mean[:, 2].sum() == pytest.approx(WEIGHT, rel=0.02)  # at rest they carry him
    # friction acts on the feet, along the belt's motion, and is no larger than mu times the load
    slipping = seen.forces[20:60].mean(axis=0)
    np.testing.assert_allclose(slipping[:, 0], -FRICTION * slipping[:, 2], rtol=0.1)
    both = np.nanmean(seen.points[200:], axis=0)
    np.testing.assert_allclose(both[:, 1], [0.1, -0.1], atol=1e-6)
    np.testing.assert_allclose(both[:, 2], 0.0, atol=0.01)


def test_forces_are_those_on_the_feet_whichever_shape_mujoco_names_first():
    """It sorts shapes by their kind: a sphere comes before a box, and after a plane."""
    box = TREADMILL.replace('<joint name="belt" type="slide" axis="1 0 0"/>', "")
    plane = box.replace('type="box" size="60 .5 .1" pos="0 0 -.1"', 'type="plane" size="60 .5 .1"')
    for text in (box, plane):
        seen = standing(text=text).contacts
        assert seen.names == ("left_foot on belt", "right_foot on belt")
        assert seen.forces[-1, :, 2].sum() == pytest.approx(WEIGHT, rel=0.02)


def test_a_long_simulation_keeps_means(monkeypatch, replay):
    monkeypatch.setattr(contact_history, "MAX_SAMPLES", 101)
    few, many = standing().contacts, replay.contacts
    assert len(few.t) == 101  # of 401 steps: four each, the last alone
    np.testing.assert_allclose(few.forces[:100], many.forces[:400].reshape(100, 4, 2, 3).mean(axis=1), atol=1e-9)
    np.testing.assert_allclose(few.t[:2], [1.5e-3, 5.5e-3])
    film = Film.of(replace(replay, contacts=few), np.array([0.0, 0.4]))
    assert np.isfinite(film.forces).all()


def test_not_more_pairs_than_can_be_kept(monkeypatch):
    monkeypatch.setattr(contact_history, "MAX_PAIRS", 1)
    one = standing()
    assert one.contacts.names == ("left_foot on belt",)
    assert one.contact_force[300:].mean() == pytest.approx(WEIGHT, rel=0.02)  # the sum has all


def test_a_machine_that_cannot_touch_is_not_looked_at():
    text = "<mujoco><worldbody><body><joint/><geom size='1'/></body></worldbody></mujoco>"
    model = compile_model(text)
    recorder = ContactRecorder(model, 3)
    recorder.look(0, None)  # costs nothing: not even the state is read
    assert recorder.history(np.arange(4.0)).names == ()
    assert recorder.sentence(1.0) == ""


# Data


def test_an_appearance_is_seen_from_each_of_its_views():
    side, front = (APPEARANCE.seen_from(view) for view in APPEARANCE.views)
    assert (side.azimuth, front.azimuth, front.elevation) == (90.0, 180.0, -8.0)
    assert (front.distance, front.look_at) == (APPEARANCE.distance, APPEARANCE.look_at)  # the appearance's own
    near = APPEARANCE.seen_from(View(0.0, 0.0, distance=1.0, look_at=(0.0, 0.0, 9.0)))
    assert (near.distance, near.look_at) == (1.0, (0.0, 0.0, 9.0))


def test_a_pickled_film_keeps_views_and_ghost(replay):
    film = Film.of(staged(replay, ghost=lifted(replay, 0.5)), AT)
    again = pickle.loads(pickle.dumps(film))
    assert again.appearance.views == APPEARANCE.views
    assert again.appearance.scenery == APPEARANCE.scenery
    assert (again.appearance.ghost.label, again.appearance.ghost.opacity) == ("lifted", 0.8)
    assert tuple(again.appearance.ghost.colour) == (0.9, 0.1, 0.9)
    for name in ("forces", "points", "ghost_qpos", "path_ghost_qpos"):
        np.testing.assert_array_equal(getattr(again, name), getattr(film, name))
    assert [seen.appearance.azimuth for seen in again.views] == [90.0, 180.0]
    assert Film.of(staged(replay, views=()), AT).views[0].appearance.azimuth == APPEARANCE.azimuth


def test_a_given_ghost_is_spread_over_the_motion(replay):
    film = Film.of(staged(replay, ghost=lifted(replay, 0.5)), np.array([0.0, 0.12, 0.4]))  # at knots of the ghost
    np.testing.assert_allclose(film.ghost_qpos[:, 2], film.qpos[:, 2] + 0.5, atol=1e-12)
    # of another number of knots: the same motion
    coarse = Film.of(staged(replay, ghost=Ghost(replay.xs[::200], "coarse")), np.array([0.0, 0.2, 0.4]))
    np.testing.assert_allclose(coarse.ghost_qpos, coarse.qpos, atol=1e-12)


@pytest.mark.parametrize(
    ("states", "words"),
    [
        (np.zeros((5, 3)), r"shape \(5, 3\), expected \(K, 6\)"),
        (np.zeros((1, 6)), "1 states, expected two or more"),
        (np.full((2, 6), np.nan), "expected finite"),
    ],
)
def test_a_ghost_that_is_no_motion_of_the_machine(replay, states, words):
    with pytest.raises(PlannerError, match=words):
        Film.of(staged(replay, ghost=Ghost(states, "wrong")), AT)


def test_an_appearance_nobody_wrote_takes_a_belt_for_scenery():
    assert default_appearance(Mechanism.from_mjcf(leg())).scenery == ()
    sliding = '<body name="belt"><joint name="run" type="slide"/>'
    text = leg().replace('<geom name="floor" type="plane" size="0 0 1" euler="0 -0.0 0"/>', "")
    text = text.replace(
        '<body name="trunk"',
        f'{sliding.replace("slide", "slide" + chr(34) + " axis=" + chr(34) + "1 0 0")}<geom name="floor" type="box" '
        'size="9 1 .1" pos="0 0 -.1" mass="100"/></body><body name="trunk"',
    )
    mechanism = Mechanism.from_mjcf(text)
    assert mechanism.contacts[0].plane.slide == 0
    assert default_appearance(mechanism).scenery == ("belt",)


# Pictures


def halves(picture):
    width = picture.shape[1] // 2
    return picture[:, :width], picture[:, width:]


@pytest.mark.render
def test_cameras_stand_side_by_side_with_one_set_of_words(replay):
    """Each half is what the camera alone draws, but for words; title and numbers are in the left one only."""
    film = Film.of(replay, AT[1:])
    both = carry_out([film], Job("frame", 640, 360))
    assert both.shape == (360, 640, 3)
    left, right = halves(both)
    for half, seen in zip((left, right), film.views, strict=True):
        with Scene(seen, 320, 360, narrow=True, quick=False) as scene:  # as a frame is drawn
            alone = scene.draw(0)
        middle = slice(100, 320)  # below the labels, above the legend
        assert changed(half[middle, 4:-4], alone[middle, 4:-4]) == 0
    assert changed(*halves(both)) > 2000  # two cameras
    with Scene(film.views[1], 320, 360, narrow=True, quick=False) as scene:
        words = np.abs(right.astype(int) - scene.draw(0).astype(int)).max(axis=-1) > 8
    assert not words[30:-30, 4:160].any()  # the right one has a label and no numbers
    assert words[:30, 220:].any()


@pytest.mark.render
def test_two_films_have_a_column_each(replay, tmp_path):
    path = render_video(make_proof(replay, replay), tmp_path / "film.mp4", width=320, height=240, fps=5, speed=1)
    frames, _ = decode(path, 320, 240)
    assert frames.shape[1:] == (240, 320, 3)
    frame = frames[-1].astype(int)
    upper, lower = frame[:120], frame[120:]
    middle = slice(50, 90)  # without words
    assert np.median(np.abs(upper[middle, :158] - upper[middle, 162:])) <= 3  # the same camera
    assert changed(upper[middle].astype(np.uint8), lower[middle].astype(np.uint8)) > 400


@pytest.mark.render
def test_a_strip_has_a_row_for_each_camera(tmp_path, replay):
    render_strip(replay, tmp_path / "strip.png", poses=3, width=300, height=201)
    strip = np.asarray(Image.open(tmp_path / "strip.png"))
    assert strip.shape == (201, 300, 3)
    assert changed(strip[:80], strip[100:180]) > 500
    render_strip(staged(replay, views=APPEARANCE.views[:1]), tmp_path / "one.png", poses=3, width=300, height=100)
    one = np.asarray(Image.open(tmp_path / "one.png"))
    assert changed(strip[:100], one) == 0  # the first camera's row is what it would draw alone


@pytest.mark.render
def test_the_ghost_is_the_given_motion_in_its_colour(replay):
    film, other = (Film.of(staged(replay, ghost=lifted(replay, by)), AT[1:]).views[0] for by in (0.5, 50.0))
    with Scene(film, 320, 240) as scene, Scene(other, 320, 240) as away:
        there, without = scene.draw(0), away.draw(0)
        # the middle of the ghost's trunk is above the machine's
        column, row = scene.project(np.array([film.ghost_qpos[0, 1], -0.15, 0.8 + film.ghost_qpos[0, 2]]))
    spot = (slice(round(row) - 3, round(row) + 3), slice(round(column) - 3, round(column) + 3))
    assert changed(there[spot], without[spot]) == 36
    red, green, blue = there[spot].reshape(-1, 3).mean(axis=0)
    assert min(red, blue) > green + 60  # magenta


@pytest.mark.render
def test_scenery_has_no_ghost(replay):
    """A ghost aside would bring its belt and strut; with them as scenery, nothing of it is seen below its feet."""
    lift = lifted(replay, 0.5)
    aside = {"ghost": lift, "ghost_offset": (0.0, -1.0, 0.6)}
    bare, full = (
        Film.of(staged(replay, **aside, scenery=names), AT[1:]).views[0] for names in (APPEARANCE.scenery, ())
    )
    none = Film.of(staged(replay, ghost=lifted(replay, 90.0)), AT[1:]).views[0]
    with Scene(bare, 320, 240) as one, Scene(full, 320, 240) as two, Scene(none, 320, 240) as three:
        without, ghostly, clean = one.draw(0), two.draw(0), three.draw(0)
    corner = (slice(100, 240), slice(0, 60))  # the belt crosses the whole picture, he does not
    assert changed(without[corner], clean[corner]) == 0
    assert changed(ghostly[corner], clean[corner]) > 500


@pytest.mark.render
def test_no_camera_tries_to_see_a_whole_belt(replay):
    """120 m of it would make him a speck; without a distance of its own, the camera looks at him."""
    film = Film.of(staged(replay, distance=None, ghost=None), AT[1:]).views[0]
    with Scene(film, 320, 240) as scene:
        scene.draw(0)
        top, foot = scene.project(np.array([0.0, 0.0, 1.0])), scene.project(np.array([0.0, 0.0, 0.0]))
    assert 0.4 * 240 < foot[1] - top[1] < 240


@pytest.mark.render
def test_the_belts_pattern_moves_with_it(replay):
    film = Film.of(staged(replay, force_scale=0.0, ghost=lifted(replay, 90.0)), np.array([0.39, 0.40])).views[0]
    half_a_period = 0.5  # m: MuJoCo repeats a uniform texture texrepeat times in two units of length
    still = replace(film, qpos=film.qpos[[0, 0, 0]], t=film.t[[0, 0, 0]], **{
        name: getattr(film, name)[[0, 0, 0]] for name in ("ghost_qpos", "forces", "points", "readings", "shift")
    })  # fmt: skip
    still.qpos[1, 0] += half_a_period
    still.qpos[2, 0] += 2 * half_a_period
    with Scene(still, 320, 240) as scene:
        before, after, again = (scene.draw(frame) for frame in range(3))
    assert changed(before, after) > 2000  # dark squares where light ones were
    assert changed(before, again) < 0.05 * changed(before, after)
    assert film.qpos[1, 0] - film.qpos[0, 0] == pytest.approx(-BELT_SPEED * 0.01, rel=1e-3)


@pytest.mark.render
def test_every_loaded_foot_has_an_arrow_along_its_force(replay):
    """From ahead the feet stand apart: an arrow over each, as long as its force, and tilted by the belt's pull."""
    stage = {"force_scale": 0.01, "ghost": lifted(replay, 90.0), "force_offset": (0.6, 0.0, 0.0)}
    film = Film.of(staged(replay, **stage), np.array([0.05]))
    for view, foot in ((film.views[1], 0), (film.views[1], 1), (film.views[0], 1)):
        with Scene(view, 640, 480) as scene:
            picture = scene.draw(0).astype(int)
            tip = film.points[0, foot] + [0.6, 0.0, 0.0] + 0.0095 * film.forces[0, foot]
            column, row = scene.project(tip)
        red = (picture[..., 0] > 150) & (picture[..., 1] < 90)
        assert red[round(row) - 3 : round(row) + 4, round(column) - 3 : round(column) + 4].any()
    assert film.forces[0, 1, 0] < -10.0  # the side view's arrow leans, or the test of it would show nothing


@pytest.mark.render
def test_an_unknown_name_in_the_scenery_is_a_sentence(replay):
    with pytest.raises(PlannerError, match="scenery is 'carpet', expected a body or tendon of the model: belt, trunk"):
        render_frame(staged(replay, scenery=("carpet",)), 0.1, width=64, height=48)


def test_short_arrows_are_slim_and_none_is_a_speck():
    """A shaft is never thicker than a part of its length, so that the head does not swallow it."""
    mujoco = gl.load_mujoco()
    model = compile_model("<mujoco/>")
    scene = mujoco.MjvScene(model, 10)
    shapes = SceneGeoms(scene, eye=np.array([0.0, -1.0, 0.0]), distance=1.0, pixel=1e-3)
    foot, up, paint = np.zeros(3), np.array([0.0, 0.0, 1.0]), (1.0, 0.0, 0.0, 1.0)
    for length, drawn in ((0.001, 0), (np.nan, 0), (0.05, 1), (1.0, 2)):
        shapes.arrow(foot, length * up, paint)
        assert scene.ngeom == drawn
    shapes.arrow(np.full(3, np.nan), up, paint)
    assert scene.ngeom == 2
    assert scene.geoms[0].size[0] < 0.05 * 0.1 < scene.geoms[1].size[0]
