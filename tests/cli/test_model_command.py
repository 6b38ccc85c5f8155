"""planner model FILE: tables, JSON, a problem file that runs, and one sentence for what cannot be described."""

import json

import numpy as np
import pytest
from commands import refused, run
from urdfs import inertial, joint, link, robot, shape

import planner
from planner.base.gl import backend
from planner.cases.problem_file import load
from planner.model.urdf.meshes import stl

TEXT = """<mujoco model="lift"><worldbody>
  <body name="car"><joint name="rise" type="slide" axis="0 0 1" range="0 2" limited="true" damping="1"/>
    <geom name="car" type="box" size=".2 .2 .2" mass="3"/></body></worldbody>
  <actuator><motor name="winch" joint="rise" ctrlrange="-60 60"/></actuator>
  <keyframe><key name="down" qpos=".1"/><key name="up" qpos="1.9"/></keyframe></mujoco>"""


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "lift.xml").write_text(TEXT)
    return tmp_path


def test_the_tables_say_what_the_machine_is(folder):
    done = run("model", "lift.xml", "--no-picture", cwd=folder)
    assert done.returncode == 0, done.stderr
    for words in ("1 degree of freedom", "rise", "slide", "0 to 2 m", "winch", "motor", "-60 to 60", "keyframes", "up"):
        assert words in done.stdout
    assert "armature" not in done.stdout  # a column in which there is nothing
    assert [path.name for path in folder.iterdir()] == ["lift.xml"]


def test_json_has_the_same(folder):
    done = run("model", "lift.xml", "--no-picture", "--json", cwd=folder)
    document = json.loads(done.stdout)
    assert document["joints"][0]["range"] == [0.0, 2.0]
    assert document["keyframes"] == ["down", "up"]
    assert (document["problems"], document["picture"], document["exit_code"]) == ([], None, 0)


def test_the_written_problem_runs_and_is_not_overwritten(folder):
    done = run("model", "lift.xml", "--no-picture", "--write", "first.toml", cwd=folder)
    assert done.returncode == 0, done.stderr
    text = (folder / "first.toml").read_text()
    assert 'start = "down"' in text
    assert "or a keyframe: down, up" in text  # what else the goal may be
    ran = run("solve", "first.toml", cwd=folder)
    assert ran.returncode in (0, 1), ran.stderr  # converged or not, the file is understood
    assert (folder / "plan.npz").is_file()
    again = run("model", "lift.xml", "--no-picture", "--write", "first.toml", cwd=folder)
    refused(again, "first.toml is there already")
    assert (folder / "first.toml").read_text() == text


GRIPPER = """<mujoco model="gripper"><compiler angle="radian"/><worldbody>
  <body><joint name="left" type="slide" axis="1 0 0" range="0 {most}" limited="true" damping="1"/>
    <geom size=".02" mass=".1"/></body>
  <body pos=".3 0 0"><joint name="right" type="slide" axis="-1 0 0" range="{least} .04" limited="true" damping="1"/>
    <geom size=".02" mass=".1"/></body></worldbody>
  <actuator><motor name="squeeze" joint="left" ctrlrange="-9 9"/></actuator>
  <equality><joint joint1="right" joint2="left"/></equality></mujoco>"""


LIGHT = """<mujoco><worldbody><body><joint name="a" axis="0 0 1" damping="2" range="-120 120"/>
  <geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass=".2"/></body></worldbody>
  <actuator><motor joint="a" ctrlrange="-20 20"/></actuator></mujoco>"""


def test_the_default_and_the_objective_that_is_written_as_a_comment_start_gently(tmp_path):
    """A light arm in strong dampers, of which least effort alone takes half of its speed in three stages."""
    (tmp_path / "light.xml").write_text(LIGHT)
    run("model", "light.xml", "--no-picture", "--write", "first.toml", cwd=tmp_path)
    text = (tmp_path / "first.toml").read_text()
    assert text.count('# objective = "jerk"') == 1
    (tmp_path / "jerk.toml").write_text(text.replace("# objective", "objective"))
    (tmp_path / "effort.toml").write_text(text.replace('# objective = "jerk"', 'objective = "effort"'))
    shares = []
    for name, objective in (("first", None), ("jerk", "jerk"), ("effort", "effort")):
        asked = load(tmp_path / f"{name}.toml")
        assert (asked.objective is None) == (objective is None)
        plan = planner.solve(asked.problem) if objective is None else planner.solve_for(asked.problem, objective)
        speed = np.abs(plan.xs[:, 1])
        shares.append(speed[3] / speed.max())
    assert max(shares[:2]) < 0.1
    assert shares[2] > 0.2


def test_what_is_written_is_accepted(folder):
    """A finger that follows is not asked for, a stiff one gets its own step; what would be refused is not written."""
    (folder / "gripper.xml").write_text(GRIPPER.format(least=0, most=0.04))
    (folder / "stiff.xml").write_text(GRIPPER.format(least=0, most=0.04).replace('damping="1"', 'damping="1e4"'))
    for name in ("gripper", "stiff"):
        done = run("model", f"{name}.xml", "--no-picture", "--write", f"{name}.toml", cwd=folder)
        assert done.returncode == 0, done.stderr
        assert "goal = { left = 0.006 }" in (folder / f"{name}.toml").read_text()
        load(folder / f"{name}.toml")
    (folder / "apart.xml").write_text(GRIPPER.format(least=0.03, most=0.02))
    refused(run("model", "apart.xml", "--write", "apart.toml", cwd=folder), "`planner run` would refuse it")
    assert not (folder / "apart.toml").exists()


def test_what_cannot_be_described_is_one_sentence(folder):
    (folder / "bad.xml").write_text("<mujoco><worldbody><body/></mujoco>")
    (folder / "empty.xml").write_text("<mujoco><worldbody/></mujoco>")
    refused(run("model", "bad.xml", cwd=folder), "bad.xml")
    refused(run("model", "empty.xml", cwd=folder), "no joints")
    refused(run("model", "nowhere.xml", cwd=folder), "nowhere.xml")
    refused(run("model", "lift.xml", "--out", "", cwd=folder), "--out is empty")
    refused(run("model", "lift.xml", "--write", "first.txt", cwd=folder), ".toml")
    refused(run("model", "lift.xml", "--write", "none/first.toml", cwd=folder), "make none first")
    refused(run("model", cwd=folder), "FILE")


@pytest.mark.render
@pytest.mark.skipif(backend() is None, reason="no OpenGL")
def test_its_keyframes_are_drawn_into_the_folder(folder):
    done = run("model", "lift.xml", "--out", "pictures", cwd=folder)
    assert done.returncode == 0, done.stderr
    assert (folder / "pictures" / "poses.png").stat().st_size > 1000


def test_a_urdf_is_said_to_be_fixed_and_how_it_walks(tmp_path):
    parts = link("base", inertial()), link("upper", inertial()), joint("hip", "base", "upper")
    (tmp_path / "arm.urdf").write_text(f'<robot name="arm">{"".join(parts)}</robot>')
    done = run("model", "arm.urdf", "--no-picture", cwd=tmp_path)
    assert 'a machine that walks wants base = "free" and floor = true' in " ".join(done.stdout.split())


def test_an_arm_beside_what_floats_is_said_to_be_fixed(tmp_path):
    parts = link("world"), *(link(name, inertial()) for name in ("ball", "upper"))
    joints = joint("loose", "world", "ball", kind="floating"), joint("hip", "world", "upper", axis="0 0 1")
    (tmp_path / "arm.urdf").write_text(robot(*parts, *joints))
    done = run("model", "arm.urdf", "--no-picture", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "fixed to the world" in done.stdout


@pytest.mark.parametrize(("kind", "fixed"), [("floating", False), ("planar", False), ("revolute", True)])
def test_a_urdf_whose_top_joint_is_free_is_not_said_to_be_fixed(kind, fixed, tmp_path):
    parts = link("world"), link("base", inertial()), link("upper", inertial())
    joints = joint("root", "world", "base", kind=kind, axis="0 0 1"), joint("hip", "base", "upper")
    (tmp_path / "arm.urdf").write_text(robot(*parts, *joints))
    done = run("model", "arm.urdf", "--no-picture", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert ("fixed to the world" in done.stdout) == fixed


def test_the_folder_of_a_urdfs_packages_is_taken_and_written(tmp_path):
    """As seen from the file that is written, which runs as it is."""
    mesh = shape("collision", '<mesh filename="package://parts/ball.stl"/>')
    upper = link("upper", inertial(), mesh)
    text = robot(link("base", inertial()), upper, joint("hip", "base", "upper"))
    (tmp_path / "arm.urdf").write_text(text, encoding="utf-8")
    (tmp_path / "far" / "parts").mkdir(parents=True)
    corners = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]])
    (tmp_path / "far" / "parts" / "ball.stl").write_bytes(stl(corners[[[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]]))
    assert "there is no such file" in run("model", "arm.urdf", "--no-picture", cwd=tmp_path).stdout
    (tmp_path / "tasks").mkdir()
    words = ("--package-path", "far", "--write", "tasks/first.toml", "--no-picture")
    done = run("model", "arm.urdf", *words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "there is no such file" not in done.stdout
    assert 'package_path = "../far"' in (tmp_path / "tasks" / "first.toml").read_text(encoding="utf-8")
    (tmp_path / "lift.xml").write_text(TEXT, encoding="utf-8")
    refused(run("model", "lift.xml", "--package-path", "far", cwd=tmp_path), "expected it for a URDF alone")
