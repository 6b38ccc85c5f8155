"""Payloads and tools at a frame: masses by the formulas of balls and boxes, and the file that MuJoCo gets has them."""

import re

import numpy as np
import pytest
from arms import ARM, START, mechanism, write

import planner
from planner.base.gl import load_mujoco
from planner.cases.problem_file import load
from planner.dynamics import bias, frame_pose, mass_matrix
from planner.model.mjcf.attached import ALUMINIUM, Attachment

mujoco = load_mujoco()
Q = np.array([0.4, -0.9])
IN_A_FRAME = '<frame pos="0 0 -0.1"><site name="hand" pos="0 0 -0.2" euler="0 90 0"/></frame>'
TURNED = ARM.replace('<site name="hand" pos="0 0 -0.3"/>', IN_A_FRAME)
GRIPPER = """<mujoco><worldbody><body name="palm"><inertial pos="0 0 0.05" mass="0.7" diaginertia="1e-3 1e-3 1e-3"/>
  <site name="grip" pos="0 0 0.1"/></body></worldbody></mujoco>"""


def of_mujoco(text, assets=None):
    """Mass matrix and bias at Q, as MuJoCo has them."""
    model = mujoco.MjModel.from_xml_string(text, assets or {})
    data = mujoco.MjData(model)
    data.qpos[:] = Q
    mujoco.mj_forward(model, data)
    data.qacc[:] = 0.0
    M = np.array([column(model, data, e) for e in np.eye(2)]).T
    return M, data.qfrc_bias.copy()


def column(model, data, e):
    """M e."""
    force = np.zeros(model.nv)
    mujoco.mj_mulM(model, data, force, e)
    return force


def test_a_point_mass_adds_what_a_point_mass_adds():
    """M gains m J'J and the bias -m J'g, J the Jacobian of the point."""
    bare, loaded = mechanism(), mechanism(attach={"frame": "hand", "mass": 2.0, "size": 1e-4, "com": [0.1, 0.0, 0.05]})
    J = planner.dynamics.jacobian(loaded, Q, "payload")[:3]
    T = frame_pose(bare, Q, "hand")
    J = J + np.cross(planner.dynamics.jacobian(loaded, Q, "payload")[3:].T, T[:3, :3] @ [0.1, 0.0, 0.05]).T
    np.testing.assert_allclose(mass_matrix(loaded, Q) - mass_matrix(bare, Q), 2.0 * J.T @ J, atol=1e-7)  # 2/5 m r^2
    gained = bias(loaded, Q, np.zeros(2)) - bias(bare, Q, np.zeros(2))
    np.testing.assert_allclose(gained, J.T @ [0.0, 0.0, 2.0 * 9.81], atol=1e-9)


@pytest.mark.parametrize(
    ("size", "moments"),
    [
        ([0.1], 0.4 * 3.0 * 0.01 * np.ones(3)),
        ([0.1, 0.2, 0.3], 3.0 / 12.0 * np.array([0.04 + 0.09, 0.01 + 0.09, 0.01 + 0.04])),
        (None, 0.4 * 3.0 * (3.0 * 3.0 / (4.0 * np.pi * ALUMINIUM)) ** (2.0 / 3.0) * np.ones(3)),
    ],
)
def test_shapes_have_the_inertia_of_their_formulas(size, moments):
    given = {} if size is None else {"size": size}
    np.testing.assert_allclose(Attachment("hand", 3.0, **given).moments, [*moments, 0.0, 0.0, 0.0], rtol=1e-14)
    own = {"frame": "hand", "mass": 3.0, **given}
    model = mujoco.MjModel.from_xml_string(mechanism(attach=own).mjcf)
    np.testing.assert_allclose(np.sort(model.body("payload").inertia), np.sort(moments), rtol=1e-9)


def test_a_given_inertia_and_a_turned_frame_are_mujocos():
    attach = {"frame": "hand", "mass": 1.5, "com": [0, 0, 0.1], "inertia": [0.02, 0.03, 0.04, 0.001, 0.002, -0.003]}
    loaded = planner.Mechanism.from_mjcf(TURNED, attach=attach)
    M, h = of_mujoco(loaded.mjcf)
    np.testing.assert_allclose(mass_matrix(loaded, Q), M, atol=1e-12)
    np.testing.assert_allclose(bias(loaded, Q, np.zeros(2)), h, atol=1e-12)
    np.testing.assert_allclose(frame_pose(loaded, Q, "payload"), frame_pose(loaded, Q, "hand"), atol=1e-12)


def test_several_and_a_body_and_its_name():
    attach = [{"frame": "upper", "mass": 0.1, "name": "cable"}, {"frame": "hand", "mass": 0.2}]
    loaded = mechanism(attach=attach)
    assert loaded.mass.sum() == pytest.approx(1.8)
    np.testing.assert_allclose(frame_pose(loaded, Q, "cable"), frame_pose(loaded, Q, "upper"))


def test_a_tool_of_another_file_is_carried(tmp_path):
    (tmp_path / "gripper.xml").write_text(GRIPPER, encoding="utf-8")
    loaded = mechanism(attach={"frame": "hand", "model": tmp_path / "gripper.xml", "name": "tool"})
    assert loaded.mass.sum() == pytest.approx(2.2)
    at = frame_pose(loaded, Q, "tool-grip")
    np.testing.assert_allclose(at[:3, 3], (frame_pose(loaded, Q, "hand") @ [0, 0, 0.1, 1])[:3], atol=1e-12)
    M, _ = of_mujoco(loaded.mjcf, loaded.assets)
    np.testing.assert_allclose(mass_matrix(loaded, Q), M, atol=1e-12)


def test_a_urdf_carries_one_too():
    urdf = """<robot name="r"><link name="base"/><link name="arm">
      <inertial><mass value="1"/><origin xyz="0.2 0 0"/>
      <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
      <joint name="j" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>
      <limit lower="-3" upper="3" effort="20" velocity="5"/></joint></robot>"""
    loaded = planner.Mechanism.from_urdf(urdf, attach={"frame": "arm", "mass": 2.0, "size": 0.01, "com": [0.5, 0, 0]})
    assert mass_matrix(loaded, [0.0])[0, 0] == pytest.approx(0.01 + 0.04 + 2.0 * 0.25 + 0.4 * 2.0 * 1e-4)


def test_the_plan_of_a_file_its_replay_and_your_file_carry_it_and_so_does_a_stored_plan(tmp_path):
    text = '[[goal]]\nframe = "payload"\nposition = [0.4, 0, 0.2]\n'
    loss = ARM.replace('<joint name="elbow"', '<joint name="elbow" frictionloss="0"')
    attach = "{ frame = 'hand', mass = 1.5, com = [0, 0, -0.05] }"
    path = write(tmp_path, text, attach=attach)
    (tmp_path / "arm.xml").write_text(loss, encoding="utf-8")
    plan = planner.solve(load(path).problem)
    proof = planner.prove(plan, rollouts=0)
    assert proof.passed, proof.reason
    for xml in filter(None, (plan.twin.mjcf, plan.twin.original)):
        assert mujoco.MjModel.from_xml_string(xml).body("payload").mass[0] == 1.5
    plan.save(tmp_path / "plan.npz")
    stored = planner.load_plan(tmp_path / "plan.npz")
    assert stored.problem.dynamics.mechanism.mass.sum() == pytest.approx(3.0)  # once
    np.testing.assert_array_equal(stored.problem.first_guess, plan.problem.first_guess)
    assert re.search(r'<geom name="payload"', plan.twin.mjcf)  # pictures draw the twin


def test_an_arm_that_does_not_know_of_its_payload_misses():
    """The plan of the bare arm in the model with the payload: what the proof of an unmodelled load says."""
    goal = planner.Goal(frame="hand", position=(0.4, 0.0, 0.2))
    plan = planner.solve(planner.task(mechanism(), START, goal, duration=1.0, dt=0.02))
    loaded = mechanism(attach={"frame": "hand", "mass": 1.5}).mjcf
    assert not planner.prove(plan, mjcf=loaded, rollouts=0).passed


@pytest.mark.parametrize(
    ("attach", "fragments"),
    [
        ({"frame": "hnad", "mass": 1.0}, ("frame of attach is 'hnad'", "Did you mean 'hand'?")),
        ({"mass": 1.0}, ("no key 'frame'",)),
        ({"frame": "hand"}, ("neither mass nor model",)),
        ({"frame": "hand", "mass": 1.0, "model": "x.xml"}, ("or both",)),
        ({"frame": "hand", "mass": -1.0}, ("mass of attach is -1.0",)),
        ({"frame": "hand", "mass": 1.0, "size": [0.1, 0.2]}, ("size of attach is [0.1, 0.2]", "three edges")),
        ({"frame": "hand", "mass": 1.0, "com": [0.1]}, ("com of attach is [0.1], expected 3 numbers",)),
        ({"frame": "hand", "mass": 1.0, "inertia": [1.0, 1.0, 3.0]}, ("which no body has",)),
        ({"frame": "hand", "mass": 1.0, "inertia": [1.0]}, ("three or six numbers",)),
        ({"frame": "hand", "mass": 1.0, "name": "upper"}, ("name of attach is 'upper', which the model has",)),
        ({"frame": "hand", "masss": 1.0}, ("a key of attach is 'masss'", "Did you mean 'mass'?")),
        ({"frame": "hand", "model": "nowhere.xml"}, ("nowhere.xml",)),
        ({"frame": "hand", "model": GRIPPER, "body": "plam"}, ("body of attach is 'plam'", "palm")),
        (3.0, ("attach is 3.0",)),
    ],
    ids=str,
)
def test_wrong_attachments_are_refused(attach, fragments):
    with pytest.raises(planner.PlannerError) as caught:
        mechanism(attach=attach)
    for fragment in fragments:
        assert fragment in str(caught.value)
    assert "\n" not in str(caught.value)
