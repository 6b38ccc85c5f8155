"""Wrong input is refused: exit code 2, one sentence, nothing on stdout and nothing left on disk."""

import json

import numpy as np
import pytest
from commands import launch, refused, run
from places import ROOT

import planner

EXAMPLES = ROOT / "examples"


def test_a_wrong_problem_file_is_refused_in_one_sentence(tmp_path):
    text = (EXAMPLES / "crane.toml").read_text().replace("crane.xml", str(EXAMPLES / "crane.xml"))
    for old, new, fragments in (
        ("trolley = 2.0", "troley = 2.0", ("troley", "Did you mean 'trolley'?")),
        ('contacts = "off"', 'contacts = "model"', ("crane.xml", "contacts", 'contacts = "avoid"')),
        ("dt = 0.02", "dt = -0.02", ("dt is -0.02",)),
        ("duration", "durration", ("durration", "Did you mean 'duration'?")),
    ):
        (tmp_path / "p.toml").write_text(text.replace(old, new))
        refused(run("run", "p.toml", cwd=tmp_path), *fragments)
        assert [p.name for p in tmp_path.iterdir()] == ["p.toml"]


def test_prove_refuses_the_model_of_another_machine(finished, tmp_path):
    folder, _ = finished
    other = planner.cases.hopper().twin
    assert other is not None
    (tmp_path / "other.xml").write_text(other.mjcf)
    refused(run("prove", folder / "out" / "plan.npz", "--model", "other.xml", cwd=tmp_path), "the plan was made for")
    assert [p.name for p in tmp_path.iterdir()] == ["other.xml"]


@pytest.mark.parametrize(
    ("words", "fragments"),
    [
        (("run", "hopper", "--height", "-3"), ("height is -3.0", "greater than 0")),
        (("run", "hopper", "--height", "nan"), ("height is nan", "finite")),
        (("run", "hopper", "--height", "inf"), ("height is inf",)),
        (("run", "hopper", "--height", "tall"), ("--height", "'tall' is not a number")),
        (("run", "hopper", "--smoothing", "0"), ("smoothing is 0.0",)),
        (("run", "hopper", "--horizon", "0"), ("horizon is 0", "at least 1")),
        (("run", "hopper", "--horizon", "2.5"), ("'2.5' is not a whole number",)),
        (("run", "hopper", "--duration", "-1"), ("duration is -1.0",)),
        (("run", "hopper", "--horizon", "1000000000"), ("horizon is 1000000000", "at most")),
        (("run", "hopper", "--duration", "1e300"), ("duration is 1e+300", "at most")),
        (("run", "hopper", "--flow-weight", "0"), ("flow_weight is 0.0",)),
        (("run", "hopper", "--integrator", "rk5"), ("rk5", "semi-implicit-euler")),
        (("run", "hopper", "--line-search", "golden"), ("golden", "goldstein")),
        (("run", "hopper", "--max-iterations", "0"), ("--max-iterations: '0'", "at least 1")),
        (("run", "hopper", "--hieght", "3"), ("--hieght", "Did you mean --height?")),
        (("run", "hoper"), ("hoper", "hopper")),
        (("run",), ("CASE",)),
        (("run", "acrobot", "--start", "up"), ("--start", "'up'", "hanging")),
        (("run", "acrobot", "--gues", "zero"), ("--gues", "Did you mean --guess?")),
        (("run", "two-link", "--mass1", "0"), ("mass1 is 0.0",)),
        (("run", "two-link", "--starts", "0"), ("--starts: '0'", "at least 1")),
        (("run", "two-link", "--starts", "2", "--seed", "-1"), ("--seed: '-1'", "at least 0")),
        (("run", "nowhere.toml"), ("nowhere.toml", "No such file")),
        (("solve", "nowhere.toml", "--height", "3"), ("--height",)),
        (("run", "crane.xml"), ("crane.xml", "planner model crane.xml --write crane.toml")),
        (("fly",), ("fly", "run")),
        (("run", "hopper", "extra"), ("'extra'",)),
        (("prove", "nowhere.npz"), ("nowhere.npz", "does not exist")),
        # a folder, since a plan that is not there is told before what the flags say
        (("render", ".", "--out", "x.webm"), ("x.webm", ".mp4")),
        (("render", ".", "--transparent"), ("--transparent", "video.mp4", ".png")),
        (("render", "nowhere.npz", "--size", "big"), ("'big' is not a size",)),
        (("prove", ".", "--plot", "x.gif"), ("x.gif", ".svg")),
        (("paper", "gripper"), ("gripper", "hopper")),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else None,
)
def test_wrong_words_are_refused_in_one_sentence(tmp_path, words, fragments):
    refused(run(*words, cwd=tmp_path), *fragments)
    assert list(tmp_path.iterdir()) == []  # nothing half-written


def test_a_refusal_exits_2_with_one_sentence_and_no_traceback(tmp_path):
    refused(launch("run", "hopper", "--height", "-3", cwd=tmp_path), "height is -3.0")
    done = run("run", "hopper", "--height", "-3", "--json", cwd=tmp_path)
    assert done.returncode == 2
    assert json.loads(done.stdout)["error"].startswith("height is -3.0")


def test_prove_refuses_files_that_are_no_plans(tmp_path):
    (tmp_path / "x.npz").write_bytes(b"PK\x03\x04nonsense")
    refused(run("prove", "x.npz", cwd=tmp_path), "x.npz is not a plan")
    np.savez(tmp_path / "y.npz", a=np.zeros(3))
    refused(run("prove", "y.npz", cwd=tmp_path), "y.npz is not a plan")


def test_folders_that_cannot_be_written_are_refused(tmp_path):
    (tmp_path / "file").write_text("mine")
    refused(run("run", "hopper", "--no-video", "--out", "file/sub", cwd=tmp_path), "file")
    refused(run("run", "hopper", "--no-video", "--out", "file", cwd=tmp_path), "file")
    refused(run("solve", "hopper", "--out", "file/plan.npz", cwd=tmp_path), "file")
    refused(run("run", "hopper", "--no-video", "--out", "/proc/planner", cwd=tmp_path), "/proc/planner")
    refused(run("solve", "hopper", "--out", "p.txt", cwd=tmp_path), ".npz")
    assert [p.name for p in tmp_path.iterdir()] == ["file"]
    assert (tmp_path / "file").read_text() == "mine"


def test_prove_does_not_overwrite_a_plan(finished, tmp_path):
    folder, _ = finished
    plan = tmp_path / "p.npz"
    plan.write_bytes((folder / "out" / "plan.npz").read_bytes())
    before = plan.read_bytes()
    refused(run("prove", "p.npz", "--out", "p.npz", cwd=tmp_path), ".json")
    refused(run("prove", "p.npz", "--out", "nowhere/p.json", cwd=tmp_path), "nowhere")
    assert plan.read_bytes() == before
