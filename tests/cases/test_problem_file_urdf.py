"""problem.toml with a URDF: its keys, and a plan that keeps the MJCF."""

import numpy as np
import pytest
from urdfs import ARM, BALL, UNCLEAR, inertial, joint, link, robot, shape

from planner import PlannerError, load_plan, solve
from planner.cases.problem_file import load
from planner.cli.parser import parse
from planner.model.twin import read_again
from planner.model.urdf.meshes import stl
from planner.model.urdf.read import opened_model
from planner.problem.description import describe

GOAL = "start = { elbow = 0.2 }\ngoal = { elbow = 0.5 }\nduration = 0.4\ndt = 0.02\n"


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "arm.urdf").write_text(ARM)
    return tmp_path


def write(folder, keys="", model="arm.urdf"):
    (folder / "lift.toml").write_text(f'model = "{model}"\n{GOAL}{keys}')
    return folder / "lift.toml"


def test_a_plan_is_loaded_without_the_urdf(folder):
    problem = load(write(folder)).problem
    plan = solve(problem, max_iterations=3)
    plan.save(folder / "plan.npz")
    (folder / "arm.urdf").unlink()
    again = load_plan(folder / "plan.npz").problem.dynamics.mechanism
    np.testing.assert_array_equal(again.velocity_limit, [3.0, np.inf, 0.5])
    assert again.ignored == problem.dynamics.mechanism.ignored == UNCLEAR
    assert again.mjcf == problem.dynamics.mechanism.mjcf


def test_base_floor_and_inertia_are_keys(folder):
    path = write(folder, 'base = "free"\nfloor = true\ncontacts = "off"')
    m = load(path).problem.dynamics.mechanism
    assert m.nv == 9
    assert 'name="floor"' in m.mjcf
    bad = (0.01, 0.02, 0.06, 0, 0, 0)
    (folder / "arm.urdf").write_text(robot(link("a"), link("b", inertial(1.0, bad)), joint("elbow", "a", "b")))
    with pytest.raises(PlannerError, match='or write inertia = "nearest"'):
        load(write(folder))
    assert load(write(folder, 'inertia = "nearest"')).problem.dynamics.mechanism.nv == 1


@pytest.mark.parametrize(
    ("keys", "sentence"),
    [
        ('base = "loose"', "base is 'loose', expected one of: fixed, free"),
        ("floor = 1", "floor is 1, expected true or false"),
        ("package_path = 3", "package_path is 3, expected a folder"),
        ('package_path = "nowhere"', "expected a folder of packages"),
        ('inertia = "mine"', "inertia is 'mine', expected one of: given, nearest"),
    ],
)
def test_wrong_keys_are_refused(keys, sentence, folder):
    with pytest.raises(PlannerError, match=sentence):
        load(write(folder, keys))


def test_packages_are_found_from_the_problem_file_and_the_command_line(folder):
    (folder / "ros" / "arm").mkdir(parents=True)
    (folder / "ros" / "arm" / "m.stl").write_bytes(stl(np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0]],
                                                                [[0, 0, 0], [0, 0, 1], [1, 0, 0]]])))  # fmt: skip
    seen = shape("visual", '<mesh filename="package://arm/m.stl"/>')
    (folder / "arm.urdf").write_text(robot(link("a"), link("b", inertial(), seen), joint("elbow", "a", "b")))
    assert load(write(folder)).problem.dynamics.mechanism.assets == {}
    assert set(load(write(folder, 'package_path = "ros"')).problem.dynamics.mechanism.assets) == {"m.coarse.stl"}
    arguments = parse(["run", str(write(folder)), "--package-path", str(folder / "ros")])
    assert arguments.package_path == str(folder / "ros")
    file = load(write(folder), package_path=arguments.package_path)
    assert set(file.problem.dynamics.mechanism.assets) == {"m.coarse.stl"}


def test_a_urdf_in_place_of_a_problem_file_is_told_so():
    with pytest.raises(PlannerError, match=r"arm\.urdf is a model, expected a problem file"):
        parse(["run", "arm.urdf"])


def test_a_run_says_what_planner_model_says_is_left_out(folder):
    notes = load(write(folder)).notes
    assert f"The model is read without {', '.join(UNCLEAR)}." in notes
    assert describe(*opened_model(folder / "arm.urdf")).left_out == list(UNCLEAR)


def test_a_urdf_without_inertias_runs_with_those_of_its_shapes(tmp_path):
    bare = robot(link("base"), link("arm", shape("visual", BALL, "0 0 0.2")), joint("elbow", "base", "arm"))
    (tmp_path / "bare.urdf").write_text(bare)
    with pytest.raises(PlannerError, match=r"joint 'elbow' .* moves link 'arm', .* or inertia = \"from shapes\""):
        load(write(tmp_path, model="bare.urdf"))
    assert opened_model(tmp_path / "bare.urdf")[1] == {"inertia": "from shapes"}
    keys = "inertia = { density = 2700 }"
    mechanism = load(write(tmp_path, keys, model="bare.urdf")).problem.dynamics.mechanism
    assert mechanism.mass.sum() == pytest.approx(2700 * 4 / 3 * np.pi * 0.05**3)
    assert read_again(mechanism.origin)[0] == (mechanism.original or mechanism.mjcf)


def test_a_refusal_names_joints_that_the_model_is_read_without(folder):
    """A link without <inertial>: its joint does not move, and neither does the hand on it."""
    parts = link("base"), link("upper", inertial(1.0)), link("lower", shape("collision", BALL)), link("hand")
    arm = (
        joint("shoulder", "base", "upper"),
        joint("elbow", "upper", "lower"),
        joint("grip", "lower", "hand", "fixed", more=""),
    )
    (folder / "arm.urdf").write_text(robot(*parts, *arm))
    with pytest.raises(PlannerError, match=r"joint in start is 'elbow'.*without the motion of joint 'elbow' \(no mass"):
        load(write(folder))


MJCF_ARM = """<mujoco><worldbody><body name="l1"><joint name="elbow"/><geom size=".1"/></body></worldbody>
  <actuator><motor joint="elbow"/></actuator></mujoco>"""


@pytest.mark.parametrize(
    ("name", "text", "advice"),
    [
        (
            "arm.xml",
            MJCF_ARM,
            'expected one on the ground: a <geom type="plane" size="0 0 1"/> in worldbody, or no gait',
        ),
        ("arm.urdf", ARM, "expected one on the ground: `floor = true`, or no gait"),
    ],
)
def test_who_has_no_floor_is_told_how_the_format_adds_one(tmp_path, name, text, advice):
    (tmp_path / name).write_text(text)
    with pytest.raises(PlannerError, match="the model has no plane") as refused:
        load(write(tmp_path, 'gait = "trot"\n', name))
    assert advice in str(refused.value)
