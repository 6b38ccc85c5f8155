"""The viewer: what keys do, what is drawn, and MuJoCo's own window on a display without a screen."""

import os
import shutil
import subprocess
import sys
import time

import numpy as np
import pytest
from films import APPEARANCE, make_replay
from places import ROOT

from planner.__main__ import main
from planner.base.gl import load_mujoco
from planner.view.render.film import Film
from planner.view.viewer import DOWN, END, HOME, LEFT, RIGHT, SPACE, UP, Player, ViewerScene

XVFB = shutil.which("Xvfb")


def test_time_goes_on_at_the_speed_and_begins_again():
    player = Player(end=2.0, speed=0.5)
    player.advance(1.0)
    assert player.t == 0.5
    player.advance(3.5)
    assert player.t == 2.0
    player.advance(0.5)
    assert player.t == 2.0  # the end stays for a second
    player.advance(0.6)
    assert player.t == 0.0


def test_keys_pause_and_scrub():
    player = Player(end=2.0, speed=1.0)
    player.press(RIGHT)
    assert (player.t, player.playing) == (0.02, False)
    player.advance(5.0)
    assert player.t == 0.02
    player.press(LEFT)
    player.press(LEFT)
    assert player.t == 0.0
    player.press(END)
    player.press(RIGHT)
    assert player.t == 2.0
    player.press(HOME)
    player.press(SPACE)
    player.press(UP)
    player.press(UP)
    assert (player.t, player.playing, player.speed) == (0.0, True, pytest.approx(2.0))
    player.press(DOWN)
    player.press(ord("A"))  # MuJoCo's own
    assert player.speed == pytest.approx(2.0**0.5)


def test_digits_switch_what_is_shown():
    player = Player(end=2.0, speed=1.0)
    for key in "678":
        player.press(ord(key))
    assert (player.ghost, player.rollouts, player.gains) == (False, True, False)
    assert "open loop" in player.words()[1]


def test_ghost_rollouts_and_pose_are_drawn_at_the_players_time():
    """On a scene of MuJoCo's without a window."""
    mujoco = load_mujoco()
    film = Film.of(make_replay(APPEARANCE, plan_offset=3.0), np.linspace(0.0, 0.2, 101))
    other = film.qpos + 9.0
    shown = ViewerScene([film, film], iter([other, other]))
    scene, camera = mujoco.MjvScene(shown.model, 2000), mujoco.MjvCamera()
    shown.place(camera)
    player = Player(end=0.2, speed=1.0, t=0.1, ghost=False)

    def drawn():
        shown.draw(scene, camera, player)
        return scene.ngeom

    bare = drawn()
    np.testing.assert_allclose(shown.data.qpos, film.qpos[50], atol=1e-9)
    player.ghost = True
    with_ghost = drawn()
    assert with_ghost > bare
    player.rollouts = True
    each = with_ghost - bare
    assert [drawn() - with_ghost for _ in range(3)] == [each, 2 * each, 2 * each]  # a simulation more each time
    other[:] = np.nan
    assert drawn() == with_ghost  # one that exploded is not drawn
    player.t = 0.15
    drawn()
    np.testing.assert_allclose(shown.data.qpos, film.qpos[75], atol=1e-9)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="other systems have a display")
def test_without_a_display_it_is_one_sentence_with_what_to_do(monkeypatch, capsys, tmp_path):
    (tmp_path / "plan.npz").touch()  # it is not read before a window can be opened
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    assert main(["view", str(tmp_path / "plan.npz")]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "DISPLAY is not set" in said
    assert "planner render PLAN" in said


PROGRAM = """
import sys
from planner import cases, solve
from planner.view.viewer import view
pictures, seen = 0, []

def each(player):
    global pictures
    pictures += 1
    if pictures == 5:
        player.press(ord("7")), player.press(ord("6"))
    if pictures in (4, 10):
        seen.append((player.t, player.ghost, player.rollouts))
    return pictures >= 12

view(solve(cases.build("two-link", horizon=50)), rollouts=2, each=each)
(t0, *first), (t1, *last) = seen
assert t1 > t0, "time goes on"
assert (first, last) == ([True, False], [False, True])
print("closed")
"""


@pytest.fixture
def display(tmp_path):
    """A display without a screen; its number."""
    if XVFB is None:
        pytest.skip("no Xvfb: apt-get install xvfb libgl1-mesa-dri")
    read, write = os.pipe()
    server = subprocess.Popen(
        [XVFB, "-displayfd", str(write), "-screen", "0", "800x600x24"], pass_fds=[write], stderr=subprocess.DEVNULL
    )
    os.close(write)
    with os.fdopen(read) as answer:
        number = answer.readline().strip()
    yield f":{number}"
    server.terminate()
    server.wait()


def test_mujocos_window_opens_plays_and_closes(display, tmp_path):
    environment = {**os.environ, "DISPLAY": display, "PYTHONPATH": str(ROOT), "LIBGL_ALWAYS_SOFTWARE": "1"}
    began = time.monotonic()
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True, timeout=180, cwd=tmp_path,
        check=False,
    )  # fmt: skip
    assert done.returncode == 0, (done.stderr, time.monotonic() - began)
    assert done.stdout.strip().endswith("closed")


def test_a_display_that_is_not_there_is_one_sentence(tmp_path):
    environment = {**os.environ, "DISPLAY": ":4999", "PYTHONPATH": str(ROOT)}
    environment.pop("WAYLAND_DISPLAY", None)
    (tmp_path / "plan.npz").touch()
    done = subprocess.run(
        [sys.executable, "-m", "planner", "view", "plan.npz"], env=environment, capture_output=True, text=True,
        timeout=60, cwd=tmp_path, check=False,
    )  # fmt: skip
    assert done.returncode == 2
    assert "cannot open a window on the display :4999" in done.stderr
    assert done.stderr.count("\n") == 1
