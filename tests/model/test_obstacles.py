"""Obstacles beside a model of any format: geoms of the world that plan, replay and stored plan all have."""

import numpy as np
import pytest
from arms import ARM

import planner
from planner.base.gl import load_mujoco
from planner.cases.problem_file import load
from planner.model.mjcf.obstacles import SIZES
from planner.model.twin import read_again
from planner.proof.diagnostics import suggested_fixes
from planner.proof.original_model import as_given

mujoco = load_mujoco()
# Defaults that would make a geom invisible to contacts, and other than MuJoCo has it, if they held for obstacles too.
HIDDEN = '<default><geom contype="0" conaffinity="0" condim="1" margin="0.1" rgba="0 0 0 0" group="4"/></default>'
FIST = '<geom name="fist" size="0.02" pos="0 0 -0.3" conaffinity="6" mass="0"/><site name="hand"'
TOUCHING = ARM.replace('<option><flag contact="disable"/></option>', HIDDEN).replace('<site name="hand"', FIST)
LINK = """<inertial><mass value="1"/><origin xyz="0.15 0 0"/>
  <inertia ixx="0.005" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>
  <collision><origin xyz="0.15 0 0" rpy="0 1.5708 0"/>
  <geometry><capsule radius="0.03" length="0.2"/></geometry></collision>"""
URDF = f"""<robot name="arm"><link name="base"/><link name="upper">{LINK}</link><link name="lower">{LINK}</link>
  <joint name="yaw" type="revolute"><origin xyz="0 0 0.2"/><parent link="base"/><child link="upper"/>
    <axis xyz="0 0 1"/>
    <limit lower="-3" upper="3" effort="40" velocity="5"/></joint>
  <joint name="elbow" type="revolute"><origin xyz="0.3 0 0"/><parent link="upper"/><child link="lower"/>
    <axis xyz="0 1 0"/>
    <limit lower="-2.5" upper="2.5" effort="20" velocity="5"/></joint></robot>"""
AT = [0.3, 0.3, 0.3]
POST = {"shape": "box", "size": [0.1, 0.1, 0.6], "position": [0.3, 0.3, 0.3], "name": "post"}
CUBE = """solid s
facet normal 0 0 1
outer loop
vertex 0 0 0
vertex 1 0 0
vertex 0 1 0
endloop
endfacet
facet normal 0 0 1
outer loop
vertex 0 0 0
vertex 1 0 0
vertex 0 0 1
endloop
endfacet
endsolid s
"""


def of_mujoco(machine):
    return mujoco.MjModel.from_xml_string(machine.original or machine.mjcf, machine.assets)


@pytest.mark.parametrize(
    ("shape", "size", "mujocos"),
    [
        ("box", [0.2, 0.4, 0.6], [0.1, 0.2, 0.3]), ("sphere", 0.2, [0.2, 0, 0]),
        ("capsule", [0.1, 0.6], [0.1, 0.3, 0]), ("cylinder", [0.1, 0.6], [0.1, 0.3, 0]), ("plane", None, [0, 0, 0.05]),
    ],
)  # fmt: skip
def test_a_shape_is_where_it_was_asked_for_and_touches_whatever_the_files_defaults_are(shape, size, mujocos):
    asked = {"shape": shape, "size": size, "position": [0.4, 0, 1.0], "orientation": {"yaw": 90}}
    machine = planner.Mechanism.from_mjcf(TOUCHING, contacts="avoid", obstacles=asked)
    geom = of_mujoco(machine).geom("obstacle")
    assert geom.type == int(getattr(mujoco.mjtGeom, f"mjGEOM_{shape.upper()}"))
    assert geom.bodyid == 0
    np.testing.assert_allclose(geom.size, mujocos, atol=1e-15)
    np.testing.assert_allclose(geom.pos, [0.4, 0, 1.0])
    np.testing.assert_allclose(geom.quat, np.sqrt(0.5) * np.array([1, 0, 0, 1]), atol=1e-15)
    assert geom.contype == 6
    assert geom.conaffinity == 0
    assert geom.condim == 3
    assert geom.margin == 0
    assert geom.rgba[3] == 1
    at_hand = planner.Mechanism.from_mjcf(TOUCHING, contacts="avoid", obstacles=asked | {"position": [0, 0, -0.7]})
    model = of_mujoco(at_hand)
    data = mujoco.MjData(model)
    mujoco.mj_fwdPosition(model, data)
    assert data.ncon > 0


def test_a_mesh_is_scaled_and_stored_and_the_plans_text_needs_no_file(tmp_path):
    (tmp_path / "tip.stl").write_text(CUBE, encoding="utf-8")
    asked = {"shape": "mesh", "file": tmp_path / "tip.stl", "scale": [0.5, 0.5, 0.25], "position": [0, 0, 2]}
    machine = planner.Mechanism.from_mjcf(TOUCHING, contacts="avoid", obstacles=[asked])
    (tmp_path / "tip.stl").unlink()
    model = of_mujoco(machine)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    geom = model.geom("obstacle").id
    vertices = model.mesh_vert @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
    np.testing.assert_allclose(vertices.max(axis=0), [0.5, 0.5, 2.25], atol=1e-6)  # float32 of an STL
    np.testing.assert_allclose(vertices.min(axis=0), [0, 0, 2.0], atol=1e-6)


@pytest.mark.parametrize(
    ("name", "words"), [("crate", "without an ending is not read, expected .stl, .obj"), ("c.stl", "triangles")]
)
def test_a_mesh_that_is_none_is_named(name, words, tmp_path):
    (tmp_path / name).write_text("solid\nendsolid\n", encoding="utf-8")
    with pytest.raises(planner.ModelError, match=rf"the mesh .*{name} of 'obstacle' cannot be used: .*{words}"):
        planner.Mechanism.from_mjcf(
            TOUCHING, contacts="avoid", obstacles=[{"shape": "mesh", "file": str(tmp_path / name)}]
        )


def problem_file(folder, more="[avoid]\nself = false\nclearance = 0.02\n"):
    (folder / "arm.urdf").write_text(URDF, encoding="utf-8")
    rows = "".join(f"{key} = {value!r}\n" for key, value in POST.items())
    (folder / "reach.toml").write_text(
        f'model = "arm.urdf"\nstart = {{}}\ngoal = {{ yaw = 1.6 }}\nduration = 2.0\n[[obstacle]]\n{rows}{more}',
        encoding="utf-8",
    )
    return folder / "reach.toml"


def distance_to_post(plan, xs):
    model = mujoco.MjModel.from_xml_string(plan.twin.given, plan.twin.assets)
    data, post, least = mujoco.MjData(model), model.geom("post").id, np.inf
    for q in xs[:, : model.nq]:
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        others = [geom for geom in range(model.ngeom) if geom != post]
        least = min(least, *(mujoco.mj_geomDistance(model, data, post, geom, 1.0, None) for geom in others))
    return least


@pytest.mark.slow
def test_a_plan_goes_around_what_stands_beside_a_urdf_and_so_does_the_stored_plan(tmp_path):
    problem = load(problem_file(tmp_path)).problem
    plan = planner.solve(problem)
    assert plan.converged
    assert distance_to_post(plan, plan.xs) > 0.02 - 4e-4  # the clearance less its tolerance of 2 %
    proof = planner.prove(plan, rollouts=0)
    assert proof.passed, proof.reason
    assert as_given(problem, plan.twin).model.geom("post").bodyid == 0
    plan.save(tmp_path / "plan.npz")
    stored = planner.load_plan(tmp_path / "plan.npz")
    assert stored.twin.given == plan.twin.given
    np.testing.assert_array_equal(stored.problem.first_guess, problem.first_guess)
    text, files = read_again(plan.twin.origin)  # what `planner check` compares the plan's model with
    assert text == plan.twin.given
    assert files == plan.twin.assets


def test_a_plan_that_was_stored_without_the_position_of_a_box_is_compared_with_its_file(tmp_path):
    """Until a position had to be written, a box without one stood at the origin."""
    origin = load(problem_file(tmp_path)).problem.twin.origin
    at_origin = dict(POST, position=[0.0, 0.0, 0.0])
    stored = {key: value for key, value in POST.items() if key != "position"}
    texts = [read_again(origin | {"obstacles": [one]})[0] for one in (stored, at_origin)]
    assert texts[0] == texts[1]


def test_without_avoid_the_plan_fails_at_the_obstacle_and_the_proof_says_what_to_write(tmp_path):
    plan = planner.solve(load(problem_file(tmp_path, "")).problem)
    assert distance_to_post(plan, plan.xs) < 0.0
    proof = planner.prove(plan, rollouts=0)
    assert not proof.passed
    assert "'post'" in proof.reason
    assert "avoid" in [fix.key for fix in suggested_fixes(plan, proof)]


def test_self_means_the_robot_and_world_the_obstacles():
    machine = planner.Mechanism.from_urdf(URDF, contacts="avoid", obstacles=POST)
    pairs = planner.constraints.Avoid(self=False).constraint(machine, machine.home).constraint.of.pairs
    assert {pair.names for pair in pairs} == {"geom 'upper' and geom 'post'", "geom 'lower' and geom 'post'"}


def test_an_obstacle_may_carry_a_machine():
    ball = '<mujoco><worldbody><body pos="0 0 0.1"><freejoint/><geom size="0.1" mass="1"/></body></worldbody></mujoco>'
    floor = {"shape": "plane", "name": "floor"}
    machine = planner.Mechanism.from_mjcf(ball, contacts="ground", obstacles=floor)
    assert machine.contacts_mode == "ground"
    assert len(machine.contacts) == 1


@pytest.mark.parametrize(
    ("asked", "fragments"),
    [
        ({"size": 1.0}, ("no key 'shape'", *SIZES)),
        ({"shape": "bxo", "size": 1.0}, ("shape of an obstacle is 'bxo'", "Did you mean 'box'?")),
        ({"shape": "box", "size": [1.0, 2.0]}, ("size of obstacle 'box' is [1.0, 2.0]", "edges, m: [0.1, 0.2, 0.3].")),
        ({"shape": "sphere"}, ("size of obstacle 'sphere' is None", "radius")),
        ({"shape": "sphere", "size": -1.0}, ("is -1.0", "above 0")),
        ({"shape": "box", "size": [1.0, 1.0, 1.0]}, ("obstacle 'box' has no key 'position'", "position = [")),
        ({"shape": "plane", "size": 1.0}, ("expected none",)),
        ({"shape": "sphere", "size": 0.1, "at": [0, 0, 0]}, ("a key of obstacle is 'at'", "position")),
        ({"shape": "sphere", "size": 0.1, "position": [0, 0]}, ("an obstacle is [0, 0], expected 3 numbers",)),
        ({"shape": "sphere", "size": 0.1, "orientation": [0, 0, 0, 0]}, ("length zero",)),
        ({"shape": "sphere", "size": 0.1, "position": AT, "name": "fist"}, ("'fist', which the model has",)),
        ({"shape": "mesh"}, ("expected the path of a mesh",)),
        ({"shape": "mesh", "file": "none.stl"}, ("the mesh", "none.stl")),
        ({"shape": "sphere", "size": 0.1, "file": "x.stl"}, ("none elsewhere",)),
        ([{"shape": "sphere", "size": 0.1, "position": AT, "name": "a"}] * 2, ("'a' twice",)),
        (3.0, ("obstacle is 3.0", "a table")),
    ],
    ids=str,
)  # fmt: skip
def test_wrong_obstacles_are_refused(asked, fragments):
    with pytest.raises(planner.PlannerError) as caught:
        planner.Mechanism.from_mjcf(TOUCHING, obstacles=asked)
    message = str(caught.value)
    assert "\n" not in message
    assert all(fragment in message for fragment in fragments), message


def test_a_model_of_which_nothing_collides_is_refused():
    with pytest.raises(planner.ModelError, match=r"nothing of the model can touch an obstacle.*<collision>"):
        planner.Mechanism.from_mjcf(TOUCHING.replace('conaffinity="6"', ""), obstacles=POST)
