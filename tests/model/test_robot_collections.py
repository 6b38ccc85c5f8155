"""Models by their names in the package robot_descriptions, of which a stand-in is put on the path."""

import sys

import pytest
from arms import ARM, START

import planner
from planner.cases.problem_file import load
from planner.model.robot_collections import model_location

NAME = "robot_descriptions:tiny_mj_description"


@pytest.fixture
def package(tmp_path, monkeypatch):
    folder = tmp_path / "site" / "robot_descriptions"
    folder.mkdir(parents=True)
    (folder / "__init__.py").write_text("")
    (tmp_path / "arm.xml").write_text(ARM)
    modules = {
        "tiny_mj": f"print('Cloning')\nMJCF_PATH = {str(tmp_path / 'arm.xml')!r}",
        "far_mj": "raise OSError('no network')",
        "odd": "XACRO_PATH = 'x'",
    }  # fmt: skip
    for name, text in modules.items():
        (folder / f"{name}_description.py").write_text(text)
    monkeypatch.syspath_prepend(folder.parent)
    yield folder
    for name in [one for one in sys.modules if one.startswith("robot_descriptions")]:
        del sys.modules[name]


def test_a_model_is_found_by_its_name_in_a_file_in_python_and_by_the_command(package, tmp_path, capsys):
    problem = tmp_path / "reach.toml"
    goal = "".join(f"{key} = {value}, " for key, value in START.items())
    problem.write_text(f'model = "{NAME}"\nstart = {{}}\ngoal = {{ {goal.removesuffix(", ")} }}\nduration = 1.0\n')
    mechanism = load(problem).problem.dynamics.mechanism
    assert mechanism.joint_names == ("shoulder", "elbow")
    assert mechanism.origin["path"] == str(tmp_path / "arm.xml")  # what `planner check` reads again
    assert planner.Mechanism.from_mjcf(NAME).joint_names == ("shoulder", "elbow")
    assert "Cloning" not in capsys.readouterr().out  # the output of a command is its own


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("tiny_description", r"the robot description is 'tiny_description', .* Did you mean 'tiny_mj_description'"),
        ("far_mj_description", r"not in its cache and cannot download them \(OSError\): run python -c .* once with"),
        ("odd_description", "neither an MJCF nor a URDF"),
    ],
)
def test_what_cannot_be_found_is_one_sentence(package, name, message):
    with pytest.raises(planner.PlannerError, match=message):
        model_location(f"robot_descriptions:{name}")


def test_without_the_package_the_message_says_to_install_it(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(planner.ModelError, match="pip install robot_descriptions"):
        model_location(NAME)
