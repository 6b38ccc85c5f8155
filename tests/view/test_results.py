"""The files of a run: each is finished or not there, what is finished is not drawn again."""

import os

import pytest
from fake_plans import make_plan, make_proof
from PIL import Image

from planner.base.errors import FileError, RenderingUnavailable
from planner.cli import results
from planner.cli.console import Console
from planner.cli.results import INTERRUPTED, OUTPUTS, draw_results, write_proof
from planner.view.plots.case_pictures import CASE_PICTURES
from planner.view.plots.style import blank

QUIET = Console(quiet=True)


@pytest.fixture
def plan():
    return make_plan()


@pytest.fixture
def proof(plan):
    return make_proof(plan)


def names(folder):
    return sorted(os.listdir(folder))


def draw(plan, proof, folder, **options):
    return draw_results(plan, proof, folder, [], options.pop("video", False), QUIET, **options)


@pytest.fixture(autouse=True)
def sketched(monkeypatch):
    """Plots are blank here: what is in them is tested where they are drawn."""
    for name in ("draw_plan", "draw_proof"):
        monkeypatch.setattr(results, name, lambda *_: blank(1.0, 1.0))


@pytest.fixture
def film(monkeypatch):
    """Stands for OpenGL: says what was filmed."""
    from planner.view.render import video as render

    calls = []

    def record(shown, path, **options):
        calls.append((shown, path.name))
        path.write_bytes(b"drawn")

    monkeypatch.setattr(render, "render_strip", record)
    monkeypatch.setattr(render, "render_video", record)
    return calls


def test_all_pictures_are_drawn(plan, proof, tmp_path, film):
    assert draw(plan, proof, tmp_path, video=True) == ""
    assert names(tmp_path) == ["plots.png", "proof.png", "report.html", "strip.png", "video.mp4"]
    assert set(names(tmp_path)) | {"plan.npz", "proof.json"} == set(OUTPUTS) - set(CASE_PICTURES.values())
    # the strip is of the replay that was judged, the film of both
    assert film == [(proof.replay, "strip.png"), (proof, "video.mp4")]


def test_without_video_or_without_a_proof_the_page_says_why(plan, proof, tmp_path):
    assert "--no-video" in draw(plan, proof, tmp_path)
    assert names(tmp_path) == ["plots.png", "proof.png", "report.html"]
    assert "--no-video" in (tmp_path / "report.html").read_text()
    assert "not replayed" in draw(plan, None, tmp_path, video=True)
    assert names(tmp_path) == ["plots.png", "report.html"]  # the proof.png was another plan's


def test_files_to_keep_are_not_drawn_again(plan, proof, tmp_path, film):
    (tmp_path / "video.mp4").write_bytes(b"finished")
    (tmp_path / "proof.png").write_bytes(b"finished")
    (tmp_path / "report.html").write_bytes(b"finished")
    draw(plan, proof, tmp_path, video=True, keep={"video.mp4", "proof.png", "report.html"})
    assert [name for _, name in film] == ["strip.png"]
    assert (tmp_path / "video.mp4").read_bytes() == (tmp_path / "proof.png").read_bytes() == b"finished"
    assert (tmp_path / "report.html").read_bytes() != b"finished"  # there is more to show than it had


def test_nothing_is_done_where_all_is_kept(plan, proof, tmp_path, film):
    for name in OUTPUTS:
        (tmp_path / name).write_bytes(b"finished")
    assert draw(plan, proof, tmp_path, video=True, keep=set(OUTPUTS)) == ""
    assert {(tmp_path / name).read_bytes() for name in OUTPUTS} == {b"finished"}


def test_pictures_of_an_older_plan_do_not_stay(plan, proof, tmp_path):
    for name in ("strip.png", "video.mp4", "mine.txt"):
        (tmp_path / name).write_bytes(b"older")
    draw(plan, proof, tmp_path)
    assert names(tmp_path) == ["mine.txt", "plots.png", "proof.png", "report.html"]


@pytest.mark.parametrize("after", [1, 2, 3])
def test_an_interruption_keeps_what_was_finished_and_resumes(plan, proof, tmp_path, film, monkeypatch, after):
    """Ctrl-C while the picture number `after` is drawn: those before are whole, none is half, the page is there."""
    order = ["plots.png", "proof.png", "strip.png", "video.mp4"]
    from planner.view.render import video as render

    modules = {
        "proof.png": (results, "draw_proof"),
        "strip.png": (render, "render_strip"),
        "video.mp4": (render, "render_video"),
    }

    def interrupt(*arguments, **options):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(*modules[order[after]], interrupt)
        assert draw(plan, proof, tmp_path, video=True) == INTERRUPTED
    assert names(tmp_path) == sorted([*order[:after], "report.html"])
    assert INTERRUPTED in (tmp_path / "report.html").read_text()
    before = {name: (tmp_path / name).stat().st_mtime_ns for name in order[:after]}
    assert draw(plan, proof, tmp_path, video=True, keep={*order[:after], "report.html"}) == ""
    assert names(tmp_path) == sorted([*order, "report.html"])
    assert {name: (tmp_path / name).stat().st_mtime_ns for name in order[:after]} == before
    assert INTERRUPTED not in (tmp_path / "report.html").read_text()


def test_where_nothing_can_draw_the_plots_are_there(plan, proof, tmp_path, monkeypatch):
    from planner.view.render import video as render

    def refuse(*arguments, **options):
        raise RenderingUnavailable("Rendering needs a library.")

    monkeypatch.setattr(render, "render_strip", refuse)
    assert draw(plan, proof, tmp_path, video=True) == "Rendering needs a library."
    assert names(tmp_path) == ["plots.png", "proof.png", "report.html"]


def test_a_folder_in_the_place_of_a_picture_is_one_sentence(plan, proof, tmp_path):
    (tmp_path / "plots.png").mkdir()
    with pytest.raises(FileError, match=r"plots\.png"):
        draw(plan, proof, tmp_path)


def test_a_plan_without_a_proof_has_a_proof_json_that_fails(plan, tmp_path):
    write_proof(plan, None, tmp_path, "digest", [])
    assert '"verdict": "FAIL"' in (tmp_path / "proof.json").read_text()


def test_the_pictures_are_pictures(plan, proof, tmp_path):
    draw(plan, proof, tmp_path)
    for name in ("plots.png", "proof.png"):
        with Image.open(tmp_path / name) as image:
            assert image.format == "PNG"
