"""A camera by its name or its angles: the direction is the model's, the motion stays in the picture."""

from types import SimpleNamespace

import numpy as np
import pytest
from films import make_replay
from PIL import Image

import planner
from planner.base.errors import PlannerError
from planner.cli.console import Console
from planner.cli.results import BackgroundRender
from planner.model.mjcf.model_index import compile_model
from planner.view.render.camera import angles_of_camera, directions
from planner.view.render.scene import matted

MODEL = """<mujoco><worldbody>
<camera name="front" pos="0 -2 1" xyaxes="1 0 0 0 0 1"/><camera name="down" pos="3 0 3" xyaxes="0 1 0 -0.6 0 0.8"/>
<body><joint/><geom size="0.1"/></body></worldbody></mujoco>"""


@pytest.mark.parametrize(("name", "ahead"), [("front", [0, 1, 0]), ("down", [-0.8, 0, -0.6])])
def test_angles_of_a_camera_are_its_direction(name, ahead):
    """A camera looks along its -z, z being x cross y of its axes."""
    angles = angles_of_camera(compile_model(MODEL), name)
    assert np.allclose(directions(*angles)[0], ahead, atol=1e-12)


def test_an_unknown_camera_is_refused():
    with pytest.raises(PlannerError, match=r"no camera 'side', expected one of: front, down, or azimuth"):
        angles_of_camera(compile_model(MODEL), "side")
    with pytest.raises(PlannerError, match="camera"):
        planner.render_frame(make_replay(), 0.0, camera=(1.0, 2.0, 3.0))


@pytest.mark.render
def test_a_frame_is_seen_from_the_direction_asked_for():
    replay, size = make_replay(), {"width": 160, "height": 96}
    usual = planner.render_frame(replay, 0.1, **size)
    above = planner.render_frame(replay, 0.1, camera=(90.0, -80.0), **size)
    assert above.shape == usual.shape
    assert np.abs(above.astype(float) - usual).mean() > 1.0  # of 255: another picture
    assert above.std() > 10  # and not an empty one


def test_opacity_is_found_from_a_picture_on_black_and_one_on_white():
    """Alpha a, colour c on a background b is a c + (1 - a) b: solid red, half a green, and nothing."""
    on_black = np.array([[[255, 0, 0], [0, 128, 0], [0, 0, 0]]], np.uint8)
    on_white = np.array([[[255, 0, 0], [127, 255, 127], [255, 255, 255]]], np.uint8)
    assert matted(on_black, on_white).tolist() == [[[255, 0, 0, 255], [0, 255, 0, 128], [0, 0, 0, 0]]]


@pytest.mark.render
def test_a_transparent_picture_has_the_machine_and_neither_sky_nor_floor(tmp_path):
    replay, size = make_replay(), {"width": 160, "height": 96}
    usual = planner.render_frame(replay, 0.1, **size)
    picture = planner.render_frame(replay, 0.1, transparent=True, **size)
    alpha = picture[..., 3]
    assert picture.shape == (96, 160, 4)
    assert (alpha[:10] == 0).all()  # sky
    assert (alpha[-10:] == 0).all()  # floor
    assert 50 < (alpha == 255).sum() < 0.3 * alpha.size
    assert ((alpha > 20) & (alpha < 200)).sum() > 20  # the ghost, and edges
    solid = alpha == 255  # there it has the usual picture's colours, but for marks and words on that
    assert np.median(np.abs(picture[solid][:, :3].astype(int) - usual[solid]).max(axis=-1)) <= 8
    path = planner.render_strip(replay, tmp_path / "strip.png", poses=3, width=240, height=80, transparent=True)
    with Image.open(path) as strip:
        assert strip.mode == "RGBA"
        assert strip.getpixel((0, 0))[3] == 0


def test_the_strip_of_a_run_is_transparent_where_asked_and_its_film_has_a_ground(monkeypatch, tmp_path):
    drawn = {}
    for name in ("render_strip", "render_video"):
        call = lambda shown, path, name=name, **looks: drawn.update({name: looks})  # noqa: E731
        monkeypatch.setattr(f"planner.view.render.video.{name}", call)
    replay = make_replay()
    films = BackgroundRender(SimpleNamespace(replay=replay), tmp_path, (), Console(), {"camera": (90, 0)}, True)
    with films:
        assert films.finish()
    assert drawn["render_strip"] == {"camera": (90, 0), "transparent": True}
    assert drawn["render_video"].keys() == {"camera", "progress"}
