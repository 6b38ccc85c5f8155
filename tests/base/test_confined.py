"""Inputs are confined to a folder: links are followed, and no message has a word of a file that another file names."""

import os

import pytest

from planner.__main__ import main
from planner.base.errors import FileError
from planner.base.files import CONFINE, also_reading, confined, read_input

ARM = """<mujoco><worldbody><body><joint name="hinge" axis="0 1 0"/><geom name="link" size="0.1" pos="0 0 -1"/>
<site name="hand"/></body></worldbody><actuator><motor joint="hinge"/></actuator></mujoco>"""
PROBLEM = """model = "{model}"
start = [0.0]
duration = 1.0
{more}
"""
SECRET = "root:x:0:0:secret"


@pytest.fixture
def places(tmp_path):
    """A folder to stay in, and a file outside of it."""
    inside = tmp_path / "inside"
    inside.mkdir()
    (tmp_path / "outside.txt").write_text(SECRET)
    (tmp_path / "arm.xml").write_text(ARM)
    (tmp_path / "wall.obj").write_text(SECRET)
    (inside / "arm.xml").write_text(ARM)
    return inside, tmp_path / "outside.txt"


def test_what_lies_outside_is_refused_and_links_are_followed(places):
    inside, outside = places
    os.symlink(outside, inside / "link.txt")
    with confined(inside):
        assert read_input(inside / "arm.xml", "the model")
        for path in (outside, inside / "link.txt", inside / ".." / "outside.txt"):
            with pytest.raises(FileError, match="is outside of"):
                read_input(path, "the model")
    assert CONFINE not in os.environ
    assert read_input(outside, "the model")


@pytest.mark.parametrize(
    ("model", "more"),
    [
        ("../arm.xml", "goal = [1.0]"),
        ("arm.xml", '[follow]\nframe = "hand"\nfile = "../outside.txt"'),
        ("arm.xml", 'goal = [1.0]\n[attach]\nframe = "hand"\nmodel = "../arm.xml"'),
        ("arm.xml", 'goal = [1.0]\n[[obstacle]]\nshape = "mesh"\nfile = "../wall.obj"'),
        ("meshes.xml", "goal = [1.0]"),
        ("includes.xml", "goal = [1.0]"),
    ],
)
def test_nothing_that_a_strangers_file_names_is_read_outside(places, model, more, capsys):
    inside, outside = places
    (inside / "meshes.xml").write_text(
        f'<mujoco><asset><mesh name="m" file="{outside}"/></asset><worldbody><body><joint/><geom type="mesh" mesh="m"/>'
        "</body></worldbody></mujoco>"
    )
    (inside / "includes.xml").write_text('<mujoco><include file="../arm.xml"/></mujoco>')
    (inside / "reach.toml").write_text(PROBLEM.format(model=model, more=more))
    assert main(["solve", str(inside / "reach.toml"), "--confine", str(inside), "--out", str(inside / "x.npz")]) == 2
    message = capsys.readouterr().err
    assert "expected a file in it (--confine)" in message
    assert SECRET not in message


def test_a_message_has_no_word_of_a_file_that_another_names(places, capsys):
    inside, _ = places
    for text in (SECRET, f"0,1,2,3\n{SECRET},1,2,3", f"{SECRET},b,c,d\n0,1,2,3\n1,1,2,3"):
        (inside / "path.csv").write_text(text)
        (inside / "reach.toml").write_text(
            PROBLEM.format(model="arm.xml", more='[follow]\nframe = "hand"\nfile = "path.csv"')
        )
        assert main(["solve", str(inside / "reach.toml"), "--out", str(inside / "x.npz")]) == 2
        assert "secret" not in capsys.readouterr().err


def test_a_folder_that_is_not_there_is_refused(capsys):
    assert main(["list", "--confine", "nowhere"]) == 2
    assert "--confine is nowhere, expected an existing folder" in capsys.readouterr().err


def test_a_run_reads_what_it_wrote_outside(places, capsys, monkeypatch):
    """Its folder is named by who runs it, not by the stranger's file."""
    inside, outside = places
    (inside / "reach.toml").write_text(PROBLEM.format(model="arm.xml", more="goal = [1.0]"))
    monkeypatch.chdir(inside.parent)
    words = ["run", "inside/reach.toml", "--confine", "inside", "--no-video", "--rollouts", "0"]
    assert main(words) == 0, capsys.readouterr().err
    assert (inside.parent / "renders" / "reach" / "report.html").is_file()
    plan = inside.parent / "renders" / "reach" / "plan.npz"
    with confined(inside), also_reading([plan]):
        assert read_input(plan, "the plan")
        for other in (outside, plan.with_name("proof.json")):
            with pytest.raises(FileError, match="inside, expected"):
                read_input(other, "the model")
    with confined(inside), pytest.raises(FileError, match="inside, expected"):
        read_input(plan, "the plan")
