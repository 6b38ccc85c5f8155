"""FrameCost: MuJoCo says where the frame is, differences check the model, and a machine goes where it is told."""

import numpy as np
import pytest
from gradients import assert_gradients, hessian, spd
from hypothesis import given, settings
from hypothesis import strategies as st
from machines import HAND_ARM, HAND_MACHINE, random_states
from scipy.spatial.transform import Rotation

import planner
from planner import Mechanism, PlannerError, Problem, RigidBodyDynamics, TrackingCost
from planner.base.gl import load_mujoco
from planner.model.space import exp_quaternion, product
from planner.problem.costs.frame import FrameCost
from planner.problem.costs.residual_functions import quaternion_of

mujoco = load_mujoco()
seeds = st.integers(0, 2**32 - 1)

NQ, NV = 12, 10


@pytest.fixture(scope="module")
def machine():
    return Mechanism.from_mjcf(HAND_MACHINE)


def pose(x, name="hand"):
    """Where MuJoCo has a site: position, quaternion."""
    model = mujoco.MjModel.from_xml_string(HAND_MACHINE)
    data = mujoco.MjData(model)
    data.qpos = x[:NQ]
    mujoco.mj_kinematics(model, data)
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, data.site(name).xmat)
    return data.site(name).xpos.copy(), quaternion


@settings(max_examples=15, deadline=None)
@given(seed=seeds)
def test_the_value_is_what_mujoco_measures(seed):
    machine, rng, N = Mechanism.from_mjcf(HAND_MACHINE), np.random.default_rng(seed), 3
    xs, us = random_states(machine, rng, N + 1), np.zeros((N, 2))
    position, orientation = rng.normal(size=(N + 1, 3)), rng.normal(size=(N + 1, 4))
    weight, final = rng.uniform(size=3), rng.uniform(size=3)
    cost = FrameCost(
        machine, "hand", position=position, orientation=orientation, position_weight=weight,
        final_position_weight=final, orientation_weight=0.7, dt=0.1,
    )  # fmt: skip
    assert cost.N == N
    total = 0.0
    for n in range(N + 1):
        p, quaternion = pose(xs[n])
        turn, unit = np.empty(3), orientation[n] / np.linalg.norm(orientation[n])
        mujoco.mju_subQuat(turn, quaternion, unit)
        total += 0.5 * np.sum((final if n == N else 0.1 * weight) * (p - position[n]) ** 2)
        total += 0.5 * 0.1 * 0.7 * turn @ turn  # the final weight of the orientation is that of the way
    assert cost.value(xs, us) == pytest.approx(total, rel=1e-10)


CASES = {
    "position": {"position": [0.3, 0.2, 0.4], "position_weight": [1.0, 2.0, 0.0], "final_position_weight": 3.0},
    "orientation": {"orientation": [1.0, 0.2, 0.1, -0.3], "orientation_weight": [1.0, 0.5, 2.0]},
    "both, at the end": {"position": [0.3, 0.2, 0.4], "final_position_weight": 5.0, "orientation": [1, 0, 0, 0],
                         "final_orientation_weight": 2.0},
    "per stage": {"position": np.arange(9.0).reshape(3, 3) / 9, "position_weight": np.arange(9.0).reshape(3, 3)},
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_gradients_are_differences_of_the_value(machine, name):
    rng = np.random.default_rng(0)
    xs, us = random_states(machine, rng, 3), rng.normal(size=(2, 3))
    cost = FrameCost(machine, "hand", dt=0.5, **CASES[name])
    model = assert_gradients(cost, machine.space, xs, us)
    assert np.abs(model.q).max() > 0.01
    assert not model.R.any()
    for H in model.Q:
        assert np.linalg.eigvalsh(H).min() > -1e-12


def test_at_the_target_gauss_newton_is_exact(machine):
    x = random_states(machine, np.random.default_rng(1), 1)
    position, orientation = pose(x[0])
    cost = FrameCost(
        machine, "hand", position=position, orientation=orientation, position_weight=2.0, orientation_weight=0.3, dt=1.0
    )
    xs, us = np.repeat(x, 2, axis=0), np.zeros((1, 1))
    model = cost.quadratize(xs, us)
    assert cost.value(xs, us) < 1e-25
    np.testing.assert_allclose(model.q, 0.0, atol=1e-12)
    np.testing.assert_allclose(model.Q[0], hessian(cost, machine.space, xs, us, 0), atol=1e-6)


def test_frames_of_the_world_are_where_they_are(machine):
    cost = FrameCost(machine, "fixed", position=[1.0, 2.0, 5.0], final_position_weight=3.0, dt=1.0)
    xs = random_states(machine, np.random.default_rng(2), 4)
    assert cost.value(xs, np.zeros((3, 1))) == pytest.approx(0.5 * 3.0 * 2.0**2)
    assert not cost.quadratize(xs, np.zeros((3, 1))).Q.any()


def test_a_candidate_that_ran_away_costs_infinitely(machine):
    cost = FrameCost(machine, "hand", position=[0.0, 0.0, 0.0], final_position_weight=1.0, dt=1.0)
    xs = random_states(machine, np.random.default_rng(2), 4)
    xs[3, 0] = np.nan
    assert cost.value(xs, np.zeros((3, 1))) == np.inf


@given(seed=seeds)
def test_quaternions_of_matrices(seed):
    rng = np.random.default_rng(seed)
    quaternion = rng.normal(size=4) * rng.integers(0, 2, 4)  # among them half turns
    quaternion = np.eye(4)[0] if not quaternion.any() else quaternion / np.linalg.norm(quaternion)
    matrix = Rotation.from_quat(np.roll(quaternion, -1)).as_matrix()
    back = quaternion_of(matrix[None, None])[0, 0]
    np.testing.assert_allclose(back * np.sign(back @ quaternion), quaternion, rtol=0, atol=1e-12)


def test_an_arm_reaches_for_a_point_or_turns_its_hand():
    dynamics = RigidBodyDynamics(Mechanism.from_mjcf(HAND_ARM), 0.05)
    turned = exp_quaternion(np.array([0.0, -1.2, 0.0]))
    effort = TrackingCost.joints(dynamics, np.zeros(4), 20, effort=0.01, final_velocity=10.0)
    tip = FrameCost(
        dynamics, "tip", position=[1.2, 0.0, -1.1], final_position_weight=1e4,
        orientation=turned, final_orientation_weight=0.1,
    )  # fmt: skip
    problem = Problem(dynamics, effort + tip, np.zeros(4))
    plan = planner.solve(problem)
    assert plan.success
    end = planner.dynamics.frame_pose(dynamics.mechanism, plan.xs[-1, :2], "tip")
    np.testing.assert_allclose(end[:3, 3], [1.2, 0.0, -1.1], atol=2e-3)
    # Asked for another orientation, and with more weight, it ends elsewhere.
    other = FrameCost(
        dynamics, "tip", position=[1.2, 0.0, -1.1], final_position_weight=1e4,
        orientation=product(turned, exp_quaternion(np.array([0.0, 1.0, 0.0]))), final_orientation_weight=1e3,
    )  # fmt: skip
    bend = planner.solve(Problem(dynamics, effort + other, np.zeros(4)))
    assert bend.success
    assert np.linalg.norm(bend.xs[-1, :2] - plan.xs[-1, :2]) > 0.1


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"frame": "hnad"}, "frame is 'hnad', expected one of: fixed, hand, world, trunk, arm, palm."),
        ({"position": None}, "position and orientation are None, expected a target for the frame."),
        ({"position": [1.0, 2.0]}, "position has shape (2,), expected (3,)."),
        ({"position": np.ones((4, 2))}, "position has shape (4, 2), expected (N+1, 3)."),
        ({"orientation": np.zeros(4), "orientation_weight": 1.0}, "orientation has length zero, expected a quaternion"),
        ({"orientation": [1.0, 0.0, 0.0, 0.0]}, "orientation has no weight, expected orientation_weight or final_"),
        ({"orientation_weight": 1.0}, "orientation_weight has no target, expected orientation=."),
        ({"position_weight": 0.0}, "position has no weight, expected position_weight or final_position_weight above 0"),
        ({"position_weight": -1.0}, "position_weight is -1.0, expected finite weights of at least 0."),
        ({"final_position_weight": [1.0, -1.0, 0.0]}, "final_position_weight is [1.0, -1.0, 0.0], expected finite"),
        ({"position_weight": [1.0, 2.0]}, "position_weight has shape (2,), expected (3,)."),
        ({"position_weight": "much"}, "position_weight is 'much', expected numbers."),
        ({"position_weight": np.nan}, "position_weight is nan, expected finite weights of at least 0."),
        ({"position": np.ones((4, 3)), "position_weight": np.ones((5, 3))},
         "position_weight has 5 rows, expected N+1 = 4 as the others."),
        ({"dt": None}, "dt is None, expected the length of a stage in s, since a Mechanism has none."),
        ({"machine": 3}, "the machine is 3, expected RigidBodyDynamics or a Mechanism."),
    ],
)  # fmt: skip
def test_wrong_targets_are_refused_in_one_sentence(machine, changes, expected):
    arguments = {
        "machine": machine, "frame": "hand", "position": [0.0, 0.0, 1.0], "position_weight": 1.0, "dt": 0.1, **changes
    }  # fmt: skip
    with pytest.raises(PlannerError) as error:
        FrameCost(arguments.pop("machine"), arguments.pop("frame"), **arguments)
    assert str(error.value).startswith(expected)
    assert "\n" not in str(error.value)


def test_horizons_must_agree(machine):
    frame = FrameCost(machine, "hand", position=np.ones((4, 3)), position_weight=1.0, dt=0.1)
    tracking = TrackingCost(
        [np.eye(20)] * 6, [spd(np.random.default_rng(0), 2)] * 5, machine.home, 0.0, space=machine.space
    )
    with pytest.raises(PlannerError, match="made for N = 5 and 3: expected one"):
        tracking + frame
