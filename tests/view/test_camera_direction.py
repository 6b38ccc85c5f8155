"""A camera by its name or its angles: the direction is the model's, the motion stays in the picture."""

import numpy as np
import pytest
from films import make_replay

import planner
from planner.base.errors import PlannerError
from planner.model.mjcf.model_index import compile_model
from planner.view.render.camera import angles_of_camera, directions

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
