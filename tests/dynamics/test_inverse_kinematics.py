"""Inverse kinematics: MuJoCo finds the frames where they were asked to be, and differences check the Jacobian."""

import numpy as np
import pytest
from arms import ARM, hand, mechanism
from machines import HAND_MACHINE
from scipy.spatial.transform import Rotation

import planner
from planner.base.gl import load_mujoco
from planner.dynamics.inverse_kinematics import Target, integrate_base, inverse_kinematics, residuals
from planner.dynamics.kinematics import frame_pose

mujoco = load_mujoco()
DOWN = (np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, -1.0]))


def quaternion(R):
    return Rotation.from_matrix(R).as_quat()[[3, 0, 1, 2]]


def test_an_arm_of_two_links_has_the_elbow_of_the_law_of_cosines():
    at = hand(0.3, 1.1)
    target = Target("hand", np.array([at[0], 0.0, at[1]]))
    found = inverse_kinematics(mechanism(), [target], [0.2, 0.9])
    assert found.residual < 1e-3
    np.testing.assert_allclose(found.q, [0.3, 1.1], atol=1e-4)  # what LEAN moves: some 1e-4 of 5 mm
    other = inverse_kinematics(mechanism(), [target], [0.2, -0.9])
    assert np.cos(other.q[1]) == pytest.approx(np.cos(1.1), abs=1e-4)
    assert other.q[1] < 0.0  # from the other side the other elbow


@pytest.mark.parametrize("seed", range(4))
def test_mujoco_has_the_frame_where_it_was_asked_to_be(seed):
    machine, rng = planner.Mechanism.from_mjcf(HAND_MACHINE), np.random.default_rng(seed)
    q = machine.space.integrate(machine.home, rng.uniform(-0.8, 0.8, machine.space.ndx))[: machine.nq]
    T = frame_pose(machine, q, "hand")
    target = Target("hand", T[:3, 3], quaternion(T[:3, :3]))
    found = inverse_kinematics(machine, [target], machine.home[: machine.nq], seed=seed)
    assert found.residual < 0.01
    model = mujoco.MjModel.from_xml_string(HAND_MACHINE)
    data = mujoco.MjData(model)
    data.qpos[:] = found.q
    mujoco.mj_kinematics(model, data)
    np.testing.assert_allclose(data.site("hand").xpos, T[:3, 3], atol=5e-5)  # 0.01 of 5 mm
    np.testing.assert_allclose(data.site("hand").xmat.reshape(3, 3), T[:3, :3], atol=4e-4)


@pytest.mark.parametrize("part", ["position", "orientation", "pointing"])
def test_the_jacobian_is_the_difference_of_the_residuals(part):
    machine, rng = planner.Mechanism.from_mjcf(HAND_MACHINE), np.random.default_rng(1)
    q = machine.space.integrate(machine.home, rng.uniform(-0.5, 0.5, machine.space.ndx))[: machine.nq]
    parts = {"position": np.array([0.3, 0.2, 0.1]), "orientation": np.array([0.8, 0.6, 0.0, 0.0]), "pointing": DOWN}
    target = Target("hand", **{part: parts[part]})
    _, J, _ = residuals(machine, q, target)
    for i, e in enumerate(1e-6 * np.eye(machine.nv)):
        ahead, behind = (residuals(machine, integrate_base(machine, q, s * e), target)[0] for s in (1.0, -1.0))
        np.testing.assert_allclose((ahead - behind) / 2e-6, J[:, i], atol=1e-8)  # 1e-16 / 1e-6, and the square of 1e-6


def test_ranges_are_kept_and_frozen_joints_stay():
    machine = mechanism()
    target = Target("hand", np.array([0.0, 0.0, -0.3]))  # the elbow turns by 2.24 rad to get there
    ranges = np.array([[-3.0, 3.0], [-1.0, 1.0]])
    found = inverse_kinematics(machine, [target], [0.5, -0.9], ranges=ranges)
    assert found.residual > 10.0
    assert np.all((found.q >= ranges[:, 0]) & (found.q <= ranges[:, 1]))
    frozen = inverse_kinematics(machine, [target], [0.5, -0.9], free=np.array([True, False]))
    assert frozen.q[1] == -0.9


def test_the_same_seed_finds_the_same():
    target = Target("hand", np.array([0.1, 0.0, 0.3]))
    ranges = np.array([[-0.5, 3.1], [-2.6, 0.1]])
    first, again = (inverse_kinematics(mechanism(), [target], [0.0, 0.0], ranges=ranges, seed=3) for _ in range(2))
    np.testing.assert_array_equal(first.q, again.q)


def test_couplings_are_kept():
    mimic = ARM.replace(
        "<actuator>", '<equality><joint joint1="elbow" joint2="shoulder" polycoef="0 0.5"/></equality><actuator>'
    ).replace('<keyframe><key name="bent" qpos="0.5 -1"/></keyframe>', "")
    machine = planner.Mechanism.from_mjcf(mimic)
    at = hand(0.8, 0.4)
    found = inverse_kinematics(machine, [Target("hand", np.array([at[0], 0.0, at[1]]))], [0.2, 0.1])
    np.testing.assert_allclose(found.q, [0.8, 0.4], atol=1e-4)


THREE_LINKS = """<mujoco><worldbody><body><joint name="a" axis="0 -1 0" range="-180 180"/>
  <geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.02"/><body pos="0.4 0 0"><joint name="b" axis="0 -1 0" range="-180 180"/>
  <geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.02"/><body pos="0.4 0 0"><joint name="c" axis="0 -1 0" range="-180 180"/>
  <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02"/><site name="tip" pos="0.3 0 0"/></body></body></body></worldbody>
  <actuator><motor joint="a"/></actuator></mujoco>"""  # noqa: E501 - the model as it is


def test_a_criterion_that_poses_near_the_start_fail_is_met_by_others():
    """A hand in a plane leaves one of three joints open; the 0.1 rad of it that pass are far from where the arm is."""
    arm = planner.Mechanism.from_mjcf(THREE_LINKS)
    wanted = np.array([-1.0, 1.8, -0.6])
    target = Target("tip", frame_pose(arm, wanted, "tip")[:3, 3])
    found = inverse_kinematics(
        arm, [target], [0.9, 0.3, 0.2], short=lambda q: max(0.0, abs(q[0] - wanted[0]) - 0.05)
    )  # fmt: skip
    assert found.residual < 0.1
    assert found.short == 0.0
    assert abs(found.q[0] - wanted[0]) <= 0.05
