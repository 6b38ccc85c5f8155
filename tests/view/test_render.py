"""Films, strips and stills: the right size and number, the right things in them, and nothing left after a failure."""

import os
import pickle
import subprocess
import sys
from dataclasses import replace

import imageio_ffmpeg
import numpy as np
import pytest
from films import APPEARANCE, SMALL, changed, decode, make_replay
from PIL import Image
from places import ROOT

from planner.base import gl
from planner.base.errors import FileError, PlannerError, RenderingUnavailable
from planner.problem.appearance import Appearance
from planner.view.render import encoder
from planner.view.render import video as render
from planner.view.render.camera import Window
from planner.view.render.film import Film
from planner.view.render.overlay import decimals, number, speed_words
from planner.view.render.scene import Scene

# What a film is made of, without drawing.


def test_film_interpolates_linearly_and_maps_the_plan():
    replay = make_replay(plan_offset=1.0)
    film = Film.of(replay, np.array([0.0, 0.05025, 0.2]))
    middle = 0.5 * (replay.xs[50] + replay.xs[51])
    np.testing.assert_allclose(replay.t[50:52], [0.05, 0.051])
    np.testing.assert_allclose(film.qpos[1, 0], replay.xs[50, 0] + 0.25 * (replay.xs[51, 0] - replay.xs[50, 0]))
    assert abs(film.qpos[1, 0] - middle[0]) < 0.1
    np.testing.assert_allclose(film.ghost_qpos[:, 0], film.qpos[:, 0] + 1.0)
    np.testing.assert_allclose(film.readings[:, 0, 1] - film.readings[:, 0, 0], 1.0)
    np.testing.assert_array_equal(film.shift, 0.0)  # a camera at rest
    assert film.forces[0, 0, 2] == pytest.approx(400.0)  # the mean over an exposure of a constant
    assert film.forces[1, 0, 2] == 0.0
    assert np.all(np.isnan(film.points[1]))


def test_film_can_be_pickled():
    film = Film.of(make_replay(), np.linspace(0.0, 0.2, 3))
    again = pickle.loads(pickle.dumps(film))
    assert again.mjcf == film.mjcf
    assert again.appearance is not None
    assert again.appearance.readouts == APPEARANCE.readouts
    assert again.appearance.distance == APPEARANCE.distance
    for name in ("t", "qpos", "ghost_qpos", "forces", "points", "readings", "largest", "shift"):
        np.testing.assert_array_equal(getattr(again, name), getattr(film, name))


def test_film_refuses_what_has_nothing_to_draw():
    replay = make_replay()
    replay.qpos[0, 0] = np.nan
    with pytest.raises(PlannerError, match="first state"):
        Film.of(replay, np.array([0.0]))
    replay = make_replay(plan_offset=np.inf)
    with pytest.raises(PlannerError, match="plan_xs"):
        Film.of(replay, np.array([0.0]))


def test_numbers_and_speeds_are_written_short():
    assert number(-0.0001, 2) == "0.00"
    assert number(-1.5, 1) == "\N{MINUS SIGN}1.5"
    assert number(-1234567890.0, 1) == "\N{MINUS SIGN}1e09"
    assert [decimals(value) for value in (0.0, 0.02, 5.0, 20.0, 150.0, 1e6)] == [4, 4, 3, 2, 1, 0]
    assert [speed_words(speed) for speed in (0.25, 1, 0.1, 2.0)] == [
        "1/4 speed", "real time", "1/10 speed", "2\N{MULTIPLICATION SIGN} speed",
    ]  # fmt: skip


# No OpenGL.


def test_missing_library_is_one_sentence_that_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setattr(gl, "_load", lambda names: None)
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    assert gl.backend() is None
    assert not gl.can_render_here()
    with pytest.raises(RenderingUnavailable, match="apt-get install libosmesa6"):
        render.render_video(make_replay(), tmp_path / "film.mp4", **SMALL)
    assert not list(tmp_path.iterdir())


def test_rendering_turned_off_by_the_user(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "disable")
    with pytest.raises(RenderingUnavailable, match="MUJOCO_GL=disable"):
        render.render_frame(make_replay(), 0.0, **SMALL)


@pytest.mark.parametrize("wish", ["osmesa", "nonsense", None])
def test_mujoco_loads_where_nothing_can_draw(wish):
    """With MUJOCO_GL=osmesa and no libOSMesa, `import mujoco` alone would die; everything but drawing must work."""
    code = (
        "import os; from planner.base import gl; gl._load = lambda names: None; before = os.environ.get('MUJOCO_GL');"
        "mujoco = gl.load_mujoco(); mujoco.MjModel.from_xml_string('<mujoco/>');"
        "assert not gl.can_render_here(); assert os.environ.get('MUJOCO_GL') == before"
    )
    hidden = ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY", "PYOPENGL_PLATFORM")
    environment = {key: value for key, value in os.environ.items() if key not in hidden}
    if wish is not None:
        environment["MUJOCO_GL"] = wish
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


# Pictures.


@pytest.mark.render
def test_video_has_size_frames_and_format(tmp_path):
    reports = []
    path = render.render_video(
        make_replay(),
        tmp_path / "film.mp4",
        **SMALL,
        fps=20,
        progress=lambda done, total: reports.append((done, total)),
    )
    assert path == tmp_path / "film.mp4"
    assert os.listdir(tmp_path) == ["film.mp4"]
    # 0.2 s at half speed and 20 fps: 8 intervals, so 9 frames, and the last one held for 1 s.
    assert reports == [(done, 9) for done in range(1, 10)]
    frames, said = decode(path, 320, 180)
    assert len(frames) == 29
    assert "Video: h264" in said
    assert "yuv420p(tv, bt709" in said
    assert "320x180" in said
    assert "20 fps" in said
    assert all(frame.std() > 10 for frame in frames)  # not blank
    assert changed(frames[0], frames[4]) > 200  # the machine moves
    # and then stands still, but for what the compression makes of it
    assert changed(frames[8], frames[28]) < 0.1 * changed(frames[0], frames[4])
    content = path.read_bytes()
    assert 0 <= content.find(b"moov") < content.find(b"mdat")  # faststart


@pytest.mark.render
@pytest.mark.parametrize(("form", "blur"), [("gif", 6.0), ("apng", 3.0)])  # of 255: 256 colours, no dithering; all
def test_a_moving_picture_has_the_frames_of_the_video_and_plays_again(tmp_path, form, blur):
    path = render.render_video(make_replay(), tmp_path / f"film.{form}", **SMALL, fps=20)
    with Image.open(path) as film:
        assert (film.format, film.size, film.info["loop"]) == (form[-3:].upper(), (320, 180), 0)
        assert film.n_frames in (9, 29)  # in the hold nothing changes
        assert film.info["duration"] == 50  # ms
        film.seek(4)
        middle = np.asarray(film.convert("RGB"))
    sharp = render.render_frame(make_replay(), 0.1, width=320, height=180)
    assert np.abs(middle.astype(int) - sharp)[60:].mean() < blur


@pytest.mark.render
def test_what_rests_is_drawn_once_and_looks_as_in_a_whole_picture(monkeypatch):
    """The window has the machine, its ghost, its shadow and the force's arrow in every frame."""
    film = Film.of(make_replay(plan_offset=3.0), np.linspace(0.0, 0.1, 4))
    drawn = []
    for whole in (False, True):
        if whole:
            monkeypatch.setattr(Scene, "_moving_window", lambda self: Window(0, 0, 320, 180))
        with Scene(film, 320, 180, oversize=1.25, quick=True) as scene:
            assert (scene._window.width * scene._window.height < 0.8 * 320 * 180) is not whole
            drawn.append([scene.draw(frame) for frame in range(4)])
    assert changed(drawn[0][0], drawn[0][3]) > 200
    for part, picture in zip(*drawn, strict=True):
        assert changed(part, picture) <= 4  # edges, by rounding


@pytest.mark.render
def test_ghost_is_visible_beside_the_machine():
    film = Film.of(make_replay(), np.array([0.1]))
    with Scene(film, 320, 180) as both:
        picture = both.draw(0)
        column, row = both.project(np.array([26.0, 0.0, 24.0 + film.ghost_qpos[0, 0]]))
    moved = Film.of(make_replay(plan_offset=500.0), np.array([0.1]))
    with Scene(moved, 320, 180) as without:
        empty = without.draw(0)
    assert 160 < column < 320  # right of the machine
    there = (slice(round(row) - 5, round(row) + 5), slice(round(column) - 5, round(column) + 5))
    assert changed(picture[there], empty[there]) > 50
    assert changed(picture[:, :120], empty[:, :120]) == 0
    # translucent: greener than what is behind it, but not the pure colour
    red, green, _ = picture[there].reshape(-1, 3).mean(axis=0)
    assert green > red + 20


@pytest.mark.render
def test_force_arrow_only_in_contact():
    pushing, idle = make_replay(force=400.0), make_replay(force=0.0)

    def pictures(replay):
        film = Film.of(replay, np.array([0.0, 0.1]))
        with Scene(film, 160, 90) as scene:
            return scene.draw(0), scene.draw(1)

    with_force, without = pictures(pushing), pictures(idle)
    arrow = np.abs(with_force[0].astype(int) - without[0].astype(int)).max(axis=-1) > 8
    assert arrow.sum() > 10
    red, green, blue = with_force[0][arrow].mean(axis=0)
    assert red > 2 * max(green, blue)
    assert changed(with_force[1], without[1]) == 0  # in the air


@pytest.mark.render
def test_films_with_other_numbers_of_contacts_are_drawn_beside_each_other():
    """A machine that falls touches the ground with more of its shapes than one that walks."""
    film = Film.of(make_replay(force=400.0), np.array([0.0, 0.1]))
    parts = [(np.repeat(film.forces, n, axis=1), np.repeat(film.points, n, axis=1)) for n in (2, 3)]
    walking, fallen = (replace(film, forces=forces, points=points) for forces, points in parts)
    with Scene(walking, 160, 90) as one, Scene(fallen, 160, 90) as other:
        one.draw(0)
        assert changed(other.draw(0, like=one), other.draw(0)) == 0


@pytest.mark.render
def test_projection_points_at_what_is_drawn():
    """The goal line is dark; around the middle of it there must be dark pixels where project() says."""
    stage = Appearance(
        title="", goal_line=((-16.0, 0.0, 60.0), (42.0, 0.0, 60.0)), look_at=(13.0, 0.0, 50.0), distance=90.0
    )
    with Scene(Film.of(make_replay(stage), np.array([0.0])), 320, 180) as scene:
        picture = scene.draw(0)
        rows = []
        for x in np.linspace(-10.0, 36.0, 40):
            column, row = scene.project(np.array([x, 0.0, 60.0]))
            patch = picture[round(row) - 1 : round(row) + 2, round(column)]
            rows.append(patch.max(axis=-1).min())
        assert scene.project(np.array([13.0, -500.0, 50.0])) is None  # behind the camera
    assert np.mean(np.array(rows) < 160) > 0.3  # dashes: about half of it is line


@pytest.mark.render
def test_a_strip_shows_poses_side_by_side(tmp_path):
    path = render.render_strip(make_replay(), tmp_path / "strip.png", poses=4, width=401, height=150)
    picture = np.asarray(Image.open(path))
    assert picture.shape == (150, 401, 3)
    assert os.listdir(tmp_path) == ["strip.png"]
    tiles = [picture[:, 100 * i + 5 : 100 * i + 95] for i in range(4)]
    assert all(tile.std() > 10 for tile in tiles)
    assert changed(tiles[0], tiles[1]) > 100


@pytest.mark.render
def test_frame_without_a_stage_shows_the_whole_model():
    picture = render.render_frame(make_replay(None), 0.1, width=160, height=120)
    assert picture.shape == (120, 160, 3)
    assert picture.dtype == np.uint8
    assert picture.std() > 10


@pytest.mark.render
def test_no_speckles_on_the_floor():
    """Shadow acne: single dark pixels on a light floor. The shadow itself is large and off this patch."""
    stage = Appearance(title="", look_at=(0.0, -40.0, 0.0), distance=100.0, azimuth=100.0, elevation=-40.0)
    with Scene(Film.of(make_replay(stage, plan_offset=500.0), np.array([0.1])), 320, 180, ghost=False) as scene:
        floor = scene.draw(0)[100:].astype(int).max(axis=-1)
    neighbours = np.stack([floor[1:-1, :-2], floor[1:-1, 2:], floor[:-2, 1:-1], floor[2:, 1:-1]])
    assert np.mean(floor[1:-1, 1:-1] < neighbours.min(axis=0) - 25) < 1e-4


CHILD = """
import sys
import mujoco                                    # first, and with nothing to draw with
sys.path[:0] = [{root!r}, {tests!r}]
from planner.base import gl
from planner.view.render import encoder
from planner.view.render import video as render
from films import make_replay
assert not gl.can_render_here()
reports = []
render.render_video(make_replay(), "film.mp4", width=64, height=36, fps=10, progress=lambda *r: reports.append(r))
assert reports[-1] == (5, 5), reports[-1]
render.render_strip(make_replay(), "strip.png", poses=2, width=64, height=36)
"""


@pytest.mark.render
def test_child_process_draws_when_mujoco_came_first(tmp_path):
    hidden = ("MUJOCO_GL", "PYOPENGL_PLATFORM", "DISPLAY", "WAYLAND_DISPLAY")
    environment = {key: value for key, value in os.environ.items() if key not in hidden}
    code = CHILD.format(root=str(ROOT), tests=str(ROOT / "tests"))
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ["film.mp4", "strip.png"]
    assert imageio_ffmpeg.count_frames_and_secs(str(tmp_path / "film.mp4"))[0] == 15


FORK = """
import os, signal, sys
sys.path[:0] = [{root!r}, {tests!r}]
from planner.view.render import encoder
from planner.view.render import video as render
from films import make_replay
here = render.render_frame(make_replay(), 0.1, width=64, height=36)
child = os.fork()
if not child:
    signal.alarm(60)
    os._exit(0 if (render.render_frame(make_replay(), 0.1, width=64, height=36) == here).all() else 1)
assert os.waitpid(child, 0)[1] == 0
"""


@pytest.mark.render
@pytest.mark.skipif(not hasattr(os, "fork"), reason="there are no forks")
def test_a_fork_of_a_process_that_drew_draws(tmp_path):
    """OpenGL's threads are not there in a fork, where it would wait for them for ever."""
    code = FORK.format(root=str(ROOT), tests=str(ROOT / "tests"))
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.render
def test_errors_of_the_child_are_the_parents(tmp_path, monkeypatch):
    monkeypatch.setattr(gl, "can_render_here", lambda: False)
    replay = make_replay()
    object.__setattr__(replay.twin, "mjcf", "<mujoco><nonsense/></mujoco>")
    with pytest.raises(PlannerError, match="MuJoCo refuses the model"):
        render.render_frame(replay, 0.0, width=64, height=36)


# Failing to write.


@pytest.mark.render
@pytest.mark.parametrize("script", ["exit 1", "head -c 9000 >/dev/null; echo 'No space left on device' >&2; exit 1"])
def test_failed_encoder_leaves_nothing_behind(tmp_path, monkeypatch, script):
    fake = tmp_path / "ffmpeg"
    fake.write_text(f"#!/bin/sh\n{script}\n")
    fake.chmod(0o755)
    monkeypatch.setattr(encoder, "_ffmpeg", lambda shown: str(fake))
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / "film.mp4").write_bytes(b"older")
    with pytest.raises(FileError, match=r"^cannot write '.*film\.mp4': .*\.$"):
        render.render_video(make_replay(), folder / "film.mp4", **SMALL, fps=10)
    assert os.listdir(folder) == ["film.mp4"]
    assert (folder / "film.mp4").read_bytes() == b"older"


@pytest.mark.render
def test_interruption_leaves_nothing_behind(tmp_path):
    def interrupt(done, total):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        render.render_video(make_replay(), tmp_path / "film.mp4", **SMALL, progress=interrupt)
    assert not list(tmp_path.iterdir())


@pytest.mark.render
def test_missing_folder_is_a_file_error(tmp_path):
    with pytest.raises(FileError, match="does not exist"):
        render.render_video(make_replay(), tmp_path / "no" / "film.mp4", **SMALL)
