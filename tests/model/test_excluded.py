"""Bodies that `exclude` names do not touch, in a model of any format; the verdict names them."""

import pytest

import planner
from planner.base.gl import load_mujoco
from planner.cases.problem_file import load
from planner.model.twin import read_again
from planner.proof.diagnostics import suggested_fixes

mujoco = load_mujoco()
# The palm's ball overlaps the tip's by 1 mm at the start, and more where the finger is bent: a fault of the file.
HAND = """<mujoco><option timestep="0.002" gravity="0 0 0"/><worldbody>
  <body name="palm"><joint name="wrist" axis="0 0 1" damping="0.1"/>
    <inertial mass="0.5" pos="0 0 0" diaginertia="1e-3 1e-3 1e-3"/>
    <geom name="pad" size="0.03" pos="0.1 0 0.03"/>
    <body name="base"><joint name="knuckle" axis="0 1 0" damping="0.1" armature="0.001"/>
      <geom name="bone" type="capsule" fromto="0 0 0 0.06 0 0" size="0.005"/>
      <body name="tip" pos="0.1 0 0"><joint name="joint" axis="0 1 0" damping="0.05" armature="0.001" range="-90 90"/>
        <geom name="ball" size="0.01" pos="0 0 -0.009"/></body></body></body></worldbody>
  <actuator><motor joint="wrist" ctrlrange="-2 2"/><motor joint="knuckle" ctrlrange="-2 2"/>
    <motor joint="joint" ctrlrange="-1 1"/></actuator></mujoco>"""
LINK = """<inertial><mass value="1"/><inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>
  <collision><geometry><sphere radius="0.1003"/></geometry></collision>"""
URDF = f"""<robot name="arm"><link name="base"/><link name="upper">{LINK}</link><link name="lower">{LINK}</link>
  <link name="end">{LINK}</link>""" + "".join(
    f"""<joint name="{child}" type="continuous"><origin xyz="0.1 0 0"/><parent link="{parent}"/><child link="{child}"/>
    <axis xyz="0 0 1"/><limit effort="40" velocity="5"/></joint>"""
    for parent, child in (("base", "upper"), ("upper", "lower"), ("lower", "end"))
) + "</robot>"  # fmt: skip


def touching(machine):
    """The pairs of bodies in contact at the start of the user's model."""
    model = mujoco.MjModel.from_xml_string(machine.original or machine.mjcf, machine.assets)
    data = mujoco.MjData(model)
    mujoco.mj_fwdPosition(model, data)
    return {frozenset(model.body(model.geom_bodyid[geom]).name for geom in one.geom) for one in data.contact}


def problem(folder, more="", hand=HAND):
    (folder / "hand.xml").write_text(hand, encoding="utf-8")
    lines = f'model = "hand.xml"\nstart = [0, 0, 0]\ngoal = [0.1, -0.15, 0.2]\nduration = 1.0\n{more}\n'
    (folder / "hand.toml").write_text(lines, encoding="utf-8")
    return load(folder / "hand.toml").problem


@pytest.mark.parametrize("names", [("palm", "tip"), ("pad", "ball"), ("tip", "pad")], ids="-".join)
def test_bodies_or_shapes_of_them_do_not_touch(names):
    pair = frozenset(("palm", "tip"))
    assert pair in touching(planner.Mechanism.from_mjcf(HAND, contacts="avoid"))
    assert pair not in touching(planner.Mechanism.from_mjcf(HAND, contacts="avoid", exclude=[names]))


def test_also_of_a_urdf(tmp_path):
    """Its links overlap by 0.6 mm: by more than 1 mm they would not touch without being asked for."""
    file = tmp_path / "arm.urdf"
    file.write_text(URDF, encoding="utf-8")
    pair = frozenset(("upper", "end"))
    assert pair in touching(planner.Mechanism.from_urdf(file))
    machine = planner.Mechanism.from_urdf(file, exclude=[["upper", "end"]])
    assert pair not in touching(machine)
    text, files = read_again(machine.origin)  # as a stored plan compares it with the disk
    assert (text, files) == (machine.original or machine.mjcf, machine.assets)


def test_a_motion_that_presses_an_overlap_names_the_line_that_excludes_it_and_passes_with_it(tmp_path):
    plan = planner.solve(problem(tmp_path))
    proof = planner.prove(plan, rollouts=0)
    assert {one.name for one in proof.your_file.failures} >= {"unknown_contacts"}
    (fix,) = suggested_fixes(plan, proof)
    assert (fix.key, fix.code, fix.values["bodies"]) == ("exclude", "overlap_deepens", '[["palm", "tip"]]')
    plan = planner.solve(problem(tmp_path, f"exclude = {fix.values['bodies']}"))
    proof = planner.prove(plan, rollouts=0)
    assert proof.passed, proof.reason
    assert any("palm and tip" in phrase for phrase in proof.not_checked)
    stored = planner.load_plan(plan.save(tmp_path / "plan.npz"))
    assert planner.prove(stored, rollouts=0).not_checked == proof.not_checked


# A column that turns lies flush on the floor, as the cube does beside it.
COLUMN = """<mujoco><worldbody><geom name="floor" type="plane" size="2 2 0.1"/>
  <body name="column" pos="0 0 0.2"><joint name="yaw" axis="0 0 1" damping="1"/>
    <geom type="cylinder" size="0.08 0.2"/><body pos="0.1 0 0.1"><joint name="elbow" axis="0 1 0" damping="1"/>
      <geom type="capsule" size="0.02" fromto="0 0 0 0.3 0 0" mass="1"/></body></body>
  <body name="cube" pos="0.4 0.4 0.03"><freejoint/><geom type="box" size="0.03 0.03 0.03" mass="0.1"/></body>
  </worldbody><actuator><motor joint="yaw"/><motor joint="elbow"/></actuator></mujoco>"""


def test_an_object_that_rests_on_the_floor_is_not_named(tmp_path):
    (tmp_path / "column.xml").write_text(COLUMN, encoding="utf-8")
    lines = 'model = "column.xml"\nstart = "home"\ngoal = { yaw = 0.5, elbow = -0.5 }\nduration = 0.5'
    (tmp_path / "column.toml").write_text(lines, encoding="utf-8")
    plan = planner.solve(load(tmp_path / "column.toml").problem)
    (fix,) = suggested_fixes(plan, planner.prove(plan, rollouts=0))
    assert fix.values["bodies"] == '[["world", "column"]]'


@pytest.mark.parametrize("wrong", ["palm", [["palm"]], [["palm", 3]], [["palm", "palm"]], {"palm": "tip"}])
def test_what_is_no_list_of_pairs_is_refused(wrong):
    with pytest.raises(planner.PlannerError, match=r"^exclude is "):
        planner.Mechanism.from_mjcf(HAND, exclude=wrong)


def test_names_that_the_model_lacks_and_shapes_of_one_body_are_refused():
    with pytest.raises(planner.ModelError, match="Did you mean 'palm'"):
        planner.Mechanism.from_mjcf(HAND, exclude=[("plam", "tip")])
    with pytest.raises(planner.ModelError, match="one body"):
        planner.Mechanism.from_mjcf(HAND, exclude=[("palm", "pad")])
    with pytest.raises(planner.ModelError, match="without a name"):
        planner.Mechanism.from_mjcf(HAND.replace('<body name="tip"', "<body"), exclude=[("palm", "ball")])


def test_bodies_without_names_are_to_get_some(tmp_path):
    plan = planner.solve(problem(tmp_path, hand=HAND.replace('body name="tip"', "body")))
    (fix,) = suggested_fixes(plan, planner.prove(plan, rollouts=0))
    assert (fix.key, fix.code) == ("exclude", "overlap_deepens_unnamed")
