"""A plan replayed in another model: a path brings its own files, a text those of the plan."""

import numpy as np
import pytest
from machines import OBJ

import planner
from planner.__main__ import main
from planner.cases.problem_file import load
from planner.model.mjcf.model_index import compile_model
from planner.model.mjcf.text import edited
from planner.model.twin import Twin
from planner.proof.diagnostics import suggested_fixes
from planner.proof.replays.compiled_twin import with_model

CART = """
<mujoco model="cart">
  <compiler meshdir="shapes"/>
  <option gravity="0 0 -9.81"><flag contact="disable"/></option>
  <asset><mesh name="wedge" file="wedge.obj"/></asset>
  <worldbody><body><joint name="slider" type="slide" axis="1 0 0"/>
    <inertial pos="0 0 0" mass="1" diaginertia="0.1 0.1 0.1"/><geom type="mesh" mesh="wedge"/></body></worldbody>
  <actuator><motor name="push" joint="slider"/></actuator>
</mujoco>
"""
PROBLEM = """
model = "model.xml"
start = [0.0]
goal = [1.0]
duration = 1.0
dt = 0.05
"""


def folder(place, height, shapes="shapes"):
    """A cart with a wedge of some height, in a folder of its own."""
    (place / shapes).mkdir(parents=True)
    (place / shapes / "wedge.obj").write_text(OBJ.format(height))
    (place / "model.xml").write_text(CART.replace('"shapes"', f'"{shapes}"'))
    (place / "problem.toml").write_text(PROBLEM)
    return place


def height(twin):
    """Of the wedge, from the lowest point to the highest; MuJoCo turns a mesh into its own axes."""
    return float(np.ptp(compile_model(twin.mjcf, twin.assets).mesh_vert, axis=0).max())


@pytest.fixture
def plan(tmp_path):
    problem = load(folder(tmp_path / "own", 1) / "problem.toml").problem
    return planner.solve(problem)


def test_another_model_comes_with_its_own_meshes(plan, tmp_path, monkeypatch):
    other = folder(tmp_path / "other", 30, "parts")
    monkeypatch.chdir(tmp_path)
    twin = with_model(plan.twin, "other/model.xml")
    assert twin.assets == {"wedge.obj": (other / "parts" / "wedge.obj").read_bytes()}
    assert height(twin) > 10.0 * height(plan.twin)
    np.testing.assert_array_equal(twin.to_x, plan.twin.to_x)
    assert planner.prove(plan, mjcf=other / "model.xml", rollouts=0).passed

    plan.save("plan.npz")
    assert main(["prove", "plan.npz", "--model", "other/model.xml", "--rollouts", "0"]) == 0
    (other / "parts" / "wedge.obj").unlink()  # the plan's own is no substitute
    with pytest.raises(planner.ModelError, match=r"cannot read 'wedge\.obj' that the model names at other/parts"):
        with_model(plan.twin, "other/model.xml")
    assert main(["prove", "plan.npz", "--model", "other/model.xml", "--rollouts", "0"]) == 2


@pytest.mark.parametrize("before", ["", "\n  ", "\ufeff", "<!-- heavier -->"])
def test_a_text_keeps_the_files_of_the_plan(plan, tmp_path, monkeypatch, before):
    """From wherever it is proved, and whatever stands before the first element."""
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    text = before + edited(plan.twin.mjcf, {".//inertial": {"mass": "2"}})
    twin = with_model(plan.twin, text)
    assert twin.assets == plan.twin.assets
    assert height(twin) == height(plan.twin)
    assert not planner.prove(plan, mjcf=text, rollouts=0).passed  # it is twice as heavy


def test_a_model_whose_actuators_give_less_is_a_cause():
    """The plan keeps the clamps of its own model; the finding that names the others had no cause below it."""
    own = STIFF.replace('<geom name="wall" type="box" size="0.05 0.3 0.2" pos="0.3 0 0.3"/>', "")
    own = own.replace(' frictionloss="0.2"', "")
    weak = own.replace('joint="hinge"/>', 'joint="hinge" ctrlrange="-3 3"/>')
    dynamics = planner.RigidBodyDynamics(planner.Mechanism.from_mjcf(own), 0.02)
    cost = planner.TrackingCost.joints(dynamics, [1.0, 0.0], 50, effort=0.1, final_position=1e4, final_velocity=1e3)
    plan = planner.solve(planner.Problem(dynamics, cost, np.zeros(2), limits=planner.Limits.of_model()))
    assert planner.prove(plan, rollouts=0).passed
    (cause,) = suggested_fixes(plan, planner.prove(plan, mjcf=weak, rollouts=0))
    assert (cause.code, cause.key) == ("clamped_in_file", "limits.control")
    assert "'motor' is asked for more than its ctrlrange" in cause.sentence


def test_no_other_model(plan):
    assert with_model(plan.twin, None) is plan.twin
    for wrong in (3, "", "nowhere.xml"):
        with pytest.raises(planner.ModelError):
            with_model(plan.twin, wrong)
    assert isinstance(plan.twin, Twin)


STIFF = """
<mujoco><option gravity="0 0 -9.81"/><worldbody>
  <geom name="wall" type="box" size="0.05 0.3 0.2" pos="0.3 0 0.3"/>
  <body><joint name="hinge" axis="0 -1 0" damping="0.05" frictionloss="0.2"/>
    <geom name="arm" type="capsule" fromto="0 0 0 0.5 0 0" size="0.02" mass="1"/></body>
</worldbody><actuator><motor name="motor" joint="hinge"/></actuator></mujoco>
"""


@pytest.mark.parametrize("stored", [False, True], ids=["just solved", "from its file"])
def test_what_the_plan_left_out_is_left_out_of_the_other_model(tmp_path, stored):
    """Friction loss and contacts: whether the plan was just solved or read from its file."""
    mechanism = planner.Mechanism.from_mjcf(STIFF, ignore=("frictionloss",), contacts="off")
    dynamics = planner.RigidBodyDynamics(mechanism, 0.02)
    goal = np.array([1.0, 0.0])
    cost = planner.TrackingCost.joints(dynamics, goal, 50, effort=0.1, final_position=100.0, final_velocity=10.0)
    plan = planner.solve(planner.Problem(dynamics, cost, np.zeros(2)))
    if stored:
        plan = planner.load_plan(plan.save(tmp_path / "plan.npz"))
    proof = planner.prove(plan, mjcf=STIFF, rollouts=0)
    for step in ("parity", "same_step", "refined_open_loop"):
        assert proof.sections[step].passed, proof.sections[step].failures
    assert not proof.your_file.passed  # the file has both: the arm does not get through the wall
    words = "FAIL, planned without contacts of 1 pair and friction loss of 1 joint (tested in your file);"
    assert proof.headline.startswith(words)
