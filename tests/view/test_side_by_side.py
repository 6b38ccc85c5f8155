"""Films of both replays of a proof, and of replays that ran away."""

import pickle

import numpy as np
import pytest
from films import APPEARANCE, changed, decode, make_proof, make_replay
from PIL import Image

from planner.base import gl
from planner.view.render import overlay
from planner.view.render.camera import kept_near
from planner.view.render.drawing import Job, carry_out
from planner.view.render.film import Caption, Film
from planner.view.render.overlay import Overlay, Words
from planner.view.render.scene import Scene
from planner.view.render.video import _captioned, render_strip, render_video


def run_away(replay, after=100, last=None):
    """The replay with nothing known after some samples; `last` is where it was then."""
    replay.qpos[after:] = replay.xs[after:] = np.nan
    if last is not None:
        replay.qpos[after - 1, 0] = replay.xs[after - 1, 0] = last
    return replay


# What is written


def test_captions_say_mode_and_verdict():
    off = make_replay(plan_offset=-0.25)
    captions = list(_captioned(make_proof(off, make_replay(), refined_open_loop=True)).values())
    assert captions == [Caption("open loop", "FAIL"), Caption("with gains", "PASS")]
    away = list(_captioned(make_proof(run_away(make_replay()), make_replay(), None)).values())
    assert away == [Caption("open loop", "FAIL"), Caption("with gains", "FAIL")]
    # with gains it would pass too, but that is not what the verdict is about
    other = make_replay()
    other.qpos[5:9] += 0.5
    both = list(_captioned(make_proof(make_replay(), other, "open-loop")).values())
    assert [caption.verdict for caption in both] == ["PASS", ""]


def test_two_that_look_the_same_are_one_picture():
    words = "open loop, and with gains the same"
    for offset, mode, verdict in ((0.0, "open-loop", "PASS"), (-0.25, None, "FAIL")):
        (caption,) = _captioned(make_proof(*(make_replay(plan_offset=offset) for _ in range(2)), mode)).values()
        assert caption == Caption(words, verdict)
    (caption,) = _captioned(make_proof(make_replay(), make_replay(), "open-loop", passed=False)).values()
    assert caption == Caption(words, "FAIL", "not optimal")


@pytest.mark.parametrize(
    ("failing", "why"), [({"order": True}, "step convergence"), ({"refined_open_loop": True}, ""), ({}, "goal")]
)
def test_two_that_look_the_same_of_which_one_fails_are_told_apart_and_say_why(failing, why):
    """What fails the plan's controls alone may not be seen: the error of a step, a bound of a thousandth of a goal."""
    captions = list(_captioned(make_proof(make_replay(), make_replay(), "feedback", **failing)).values())
    assert captions == [Caption("open loop", "FAIL", why), Caption("with gains", "PASS")]
    lost = list(_captioned(make_proof(make_replay(), make_replay(), "open-loop", lost_with_gains=("end",))).values())
    assert lost == [Caption("open loop", "PASS"), Caption("with gains", "FAIL")]


@pytest.mark.parametrize(("apart", "pictures"), [(0.2, 1), (0.6, 2)])  # in: 2.6 and 8 pixels of 500 for 38 in
def test_how_far_apart_two_may_be_to_look_the_same_follows_from_the_picture(apart, pictures):
    other = make_replay()
    other.qpos[5:9, 0] += apart
    assert len(_captioned(make_proof(make_replay(), other, "open-loop"))) == pictures


# A replay that ran away


def test_a_replay_that_ran_away_stays_in_its_last_pose():
    replay = run_away(make_replay())
    film = Film.of(replay, np.array([0.05, 0.0995, 0.15, 0.2]))
    assert film.unstable == pytest.approx(0.1)
    assert np.isfinite(film.qpos).all()
    assert np.isfinite(film.path_qpos).all()
    np.testing.assert_array_equal(film.qpos[1:], np.tile(replay.qpos[99], (3, 1)))
    assert film.readings[3, 0, 0] == replay.xs[99, 0]
    assert film.readings[3, 0, 1] == replay.plan_xs[-1, 0]  # the plan goes on
    assert Film.of(make_replay(), np.array([0.0])).unstable == np.inf


def test_its_film_can_be_pickled():
    caption = Caption("open loop", "FAIL")
    for replay in (run_away(make_replay()), make_replay()):
        film = Film.of(replay, np.array([0.0]), caption)
        again = pickle.loads(pickle.dumps(film))
        assert (again.unstable, again.caption) == (film.unstable, caption)


def test_the_camera_follows_what_strays_only_so_far():
    plan, strays = np.array([[0.0] * 3, [1.0] * 3]), np.array([[-0.2, 0.0, -9.0], [1.0, 50.0, 0.5]])
    np.testing.assert_array_equal(kept_near(plan, strays), [[-0.2, 0.0, -0.5], [1.0, 1.5, 0.5]])


def test_the_warning_appears_when_it_happens():
    words = Overlay(APPEARANCE, 640, 360, Words(np.array([10.0]), unstable=0.1))
    grey = np.full((360, 640, 3), 128, np.uint8)
    readings = np.array([[1.0, 1.0]])

    def red(t):
        picture = words.write(grey, t, readings, []).astype(int)
        return int(np.sum((picture[..., 0] > 150) & (picture[..., 1] < 90)))

    legend = red(0.05)  # the force's own red
    assert red(0.09) == legend
    assert red(0.1) > legend + 50


@pytest.mark.render
@pytest.mark.parametrize("last", [None, 9e9])
def test_a_replay_that_ran_away_can_be_filmed(tmp_path, last):
    replay = run_away(make_replay(), last=last)
    size = {"width": 160, "height": 90}
    render_video(make_proof(replay, make_replay()), tmp_path / "both.mp4", **size, fps=10)
    render_strip(replay, tmp_path / "strip.png", poses=3, width=300, height=100)
    frames, _ = decode(tmp_path / "both.mp4", 160, 90)
    assert len(frames) == 15
    assert all(frame.std() > 10 for frame in frames)


# Side by side


@pytest.mark.render
def test_open_loop_is_left_and_gains_are_right_each_with_the_ghost(tmp_path):
    """What differs between the replays differs in its own half; the ghost is in both."""
    still = make_replay()

    def frames(open_loop, gains):
        path = render_video(make_proof(open_loop, gains), tmp_path / "film.mp4", width=320, height=180, fps=10, speed=1)
        return decode(path, 320, 180)[0]

    def asleep():  # it stays where it begins, which the camera sees anyhow
        replay = make_replay()
        replay.qpos[:] = replay.qpos[0]
        return replay

    plain = frames(still, make_replay())
    assert plain.shape == (13, 180, 320, 3)
    upper = slice(60, 140)  # without the words
    left, right = (slice(None), upper, slice(0, 160)), (slice(None), upper, slice(160, 320))
    other = frames(asleep(), make_replay())
    assert changed(plain[left], other[left]) > 5 * changed(plain[right], other[right])
    assert np.median(np.abs(plain[left].astype(int) - plain[right].astype(int))) <= 3  # the same machine, camera, ghost


@pytest.mark.render
def test_both_are_seen_by_one_camera():
    replays = [make_replay(), make_replay()]
    replays[1].qpos[:, 0] += 5.0
    films = [Film.of(replay, np.array([0.1])) for replay in replays]
    with Scene(films[0], 160, 180, beside=films[1:]) as one, Scene(films[1], 160, 180, beside=films[:1]) as other:
        one.draw(0)
        other.draw(0)
        for point in ((0.0, 0.0, 0.0), (13.0, 0.0, 40.0)):
            assert one.project(np.array(point)) == pytest.approx(other.project(np.array(point)))


@pytest.mark.render
def test_the_machine_stays_clear_of_the_words_above_and_below():
    films = [Film.of(make_replay(), np.array([0.0, 0.1])) for _ in range(2)]
    with Scene(films[0], 320, 360, beside=films[1:], ghost=False) as scene:
        for frame in range(2):
            scene.draw(frame)
            top, foot = scene.project(np.array([0.0, 0.0, 44.0])), scene.project(np.zeros(3))
            assert top is not None
            assert foot is not None
            assert 0.1 * 360 < top[1] < foot[1] < 0.9 * 360


@pytest.mark.render
def test_an_odd_width_is_shared(tmp_path):
    films = [Film.of(make_replay(), np.array([0.1])) for _ in range(2)]
    assert carry_out(films, Job("frame", 201, 90)).shape == (90, 201, 3)


@pytest.mark.render
def test_a_child_process_draws_both_alike(monkeypatch):
    films = [Film.of(run_away(make_replay()), np.array([0.15]), Caption("open loop", "FAIL")) for _ in range(2)]
    here = carry_out(films, Job("frame", 128, 72))
    monkeypatch.setattr(gl, "can_render_here", lambda: False)
    np.testing.assert_array_equal(carry_out(films, Job("frame", 128, 72)), here)


# Strips


def test_the_time_of_a_pose_hides_nothing_of_it():
    picture = np.random.default_rng(0).integers(0, 255, (40, 60, 3), np.uint8)
    with_time = overlay.write_below(picture, "1.50 s", 20, 0.5)
    assert with_time.shape == (60, 60, 3)
    np.testing.assert_array_equal(with_time[:40], picture)
    assert with_time[40:].min() < 100  # ink


@pytest.mark.render
def test_a_strip_of_one_that_ran_away_says_so(tmp_path):
    def red(replay):
        render_strip(replay, tmp_path / "strip.png", poses=4, width=800, height=200)
        band = np.asarray(Image.open(tmp_path / "strip.png")).astype(int)[-20:]
        ink = (band[..., 0] > band[..., 1] + 60).any(axis=0)
        return [bool(ink[200 * tile : 200 * (tile + 1)].any()) for tile in range(4)]

    assert red(make_replay()) == [False] * 4
    assert red(run_away(make_replay())) == [False, False, True, True]
