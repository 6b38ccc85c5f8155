"""Wrong arguments of films, strips and stills are refused in one sentence that says what to pass, before any work."""

import pytest
from films import SMALL, make_replay

from planner.base.errors import PlannerError
from planner.view.render import video as render


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"width": 321}, "width"),
        ({"height": 0}, "height"),
        ({"width": 100_000}, "width"),
        ({"width": 320.0}, "width"),
        ({"fps": 0}, "fps"),
        ({"fps": float("nan")}, "fps"),
        ({"speed": -1.0}, "speed"),
        ({"speed": 1e-9}, "frames"),
        ({"speed": 1e-4}, r"0\.2 s at speed 0\.0001 play for 2000 s, .* a speed of 0\.0004 or more"),
        ({"fps": 1e9}, "fps of 250000 or less"),
        ({"camera": (0, 200)}, r"camera is 0,200, expected .* e\.g\. 90,-15"),
        ({"camera": "-15"}, r"no camera '-15', expected one of: .*azimuth and elevation, degrees, e\.g\. 90,-15"),
    ],
)
def test_video_refuses_wrong_arguments(tmp_path, arguments, words):
    with pytest.raises(PlannerError, match=words):
        render.render_video(make_replay(), tmp_path / "film.mp4", **{**SMALL, **arguments})
    assert not list(tmp_path.iterdir())


def test_other_verbs_refuse_wrong_arguments(tmp_path):
    replay = make_replay()
    with pytest.raises(PlannerError, match=r"\.mp4"):
        render.render_video(replay, tmp_path / "film.avi", **SMALL)
    with pytest.raises(PlannerError, match=r"\.png"):
        render.render_strip(replay, tmp_path / "strip.jpg")
    with pytest.raises(PlannerError, match="poses"):
        render.render_strip(replay, tmp_path / "strip.png", poses=0)
    with pytest.raises(PlannerError, match=r"t is 0\.3"):
        render.render_frame(replay, 0.3, **SMALL)
    for wrong in (replay.plan, "plan.npz", None):
        with pytest.raises(PlannerError, match=r"shown is .*, expected a Proof or a Replay, e\.g\. render_v.*prove"):
            render.render_video(wrong, tmp_path / "film.mp4")
        with pytest.raises(PlannerError, match=r"replay is .*, expected a Replay, e\.g\. render_strip\(proof\.replay"):
            render.render_strip(wrong, tmp_path / "strip.png")
        with pytest.raises(PlannerError, match=r"replay is .*, expected a Replay, e\.g\. render_frame\(proof\.replay"):
            render.render_frame(wrong, 0.0)
        with pytest.raises(PlannerError, match=r"mechanism is .*, expected a Mechanism"):
            render.render_poses(wrong, {}, tmp_path / "strip.png")
    with pytest.raises(PlannerError, match=r"path is 5, expected a name ending in \.mp4"):
        render.render_video(replay, 5)
    with pytest.raises(PlannerError, match=r"t is 'end'"):
        render.render_frame(replay, "end")
    assert not list(tmp_path.iterdir())
