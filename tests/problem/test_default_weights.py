"""Default weights: dimensionless, from the model's limits; no goal needs tuning."""

import numpy as np
import pytest

import planner
from planner.costs import default_cost
from planner.problem.default_weights import default_weights, fully_actuated
from planner.problem.objective import VELOCITY_SHARE

ARM = """
<mujoco>
  <option gravity="0 0 -9.81"/>
  <worldbody>
    <body>
      <joint name="shoulder" axis="0 1 0" damping="{damping}"/>
      <geom type="capsule" fromto="0 0 0 {length} 0 0" size="{width}" mass="{mass}"/>
      <body pos="{length} 0 0">
        <joint name="elbow" axis="0 1 0" damping="{damping}"/>
        <geom type="capsule" fromto="0 0 0 {length} 0 0" size="{width}" mass="{mass}"/>
      </body>
    </body>
  </worldbody>
  <actuator>{actuators}</actuator>
</mujoco>
"""
MOTORS = """<motor name="one" joint="shoulder" ctrllimited="{limited}" ctrlrange="-{one} {one}" gear="{gear}"/>
<motor name="two" joint="elbow" ctrllimited="{limited}" ctrlrange="-{two} {two}"/>"""


def arm(length=0.5, mass=1.0, one=40.0, two=20.0, limited="true", gear=1.0, actuators=MOTORS):
    actuators = actuators.format(one=one, two=two, limited=limited, gear=gear)
    damping = 0.1 * mass * length**2
    text = ARM.format(length=length, damping=damping, width=length / 20, mass=mass, actuators=actuators)
    return planner.RigidBodyDynamics(planner.Mechanism.from_mjcf(text, contacts="off"), 0.01)


def chosen(dynamics, way, duration=1.0, **more):
    goal = dynamics.mechanism.home.copy()
    goal[: len(way)] = way
    return default_weights(dynamics, dynamics.mechanism.home, goal, duration, **more)


def test_effort_is_one_over_the_square_of_the_limit():
    weights = chosen(arm(), [1.0, 0.0]).weights
    np.testing.assert_allclose(weights["effort"], [1 / 40**2, 1 / 20**2])
    np.testing.assert_array_equal(weights["control"], 0.0)


def test_without_limits_the_effort_does_not_depend_on_the_unit_of_the_control():
    plain, geared = (chosen(arm(limited="false", gear=gear), [1.0, 0.0]) for gear in (1.0, 50.0))
    np.testing.assert_allclose(geared.weights["effort"] / plain.weights["effort"], [50.0**2, 1.0])
    assert "no limit" in plain.reasons["effort"]
    # What holds two rods of 1 kg and 0.5 m at the shoulder, 9.81 (0.25 + 0.75), is a part of the limit.
    assert plain.weights["effort"][0] < 1 / 9.81**2


def test_speed_is_twice_the_mean_one():
    weights = chosen(arm(), [1.5, 0.1], duration=2.0).weights
    np.testing.assert_allclose(weights["velocity"], [1 / 1.5**2, 1 / 0.5**2])  # the elbow at the least speed


def test_a_machine_with_a_free_joint_keeps_its_swing():
    one_motor = arm(actuators='<motor name="two" joint="elbow"/>')
    home = one_motor.mechanism.home[None]
    assert not fully_actuated(one_motor, home)
    found = chosen(one_motor, [1.0, 0.0])
    assert not np.any(found.weights["velocity"])
    assert "swing" in found.reasons["velocity"]
    assert fully_actuated(planner.RigidBodyDynamics(one_motor.mechanism, 0.01, prescribed=["shoulder"]), home)


def test_an_objective_keeps_a_small_weight_of_velocities():
    usual, found = chosen(arm(), [1.0, 0.0]), chosen(arm(), [1.0, 0.0], named=True)
    np.testing.assert_allclose(found.weights["velocity"], VELOCITY_SHARE * usual.weights["velocity"])
    assert f"{VELOCITY_SHARE:g}, beside the objective" in found.reasons["velocity"]


def test_goals_are_as_tight_as_they_are_judged():
    usual = chosen(arm(), [1.0, 0.0]).weights
    np.testing.assert_allclose(usual["final_position"], 4 / 0.02**2)
    np.testing.assert_allclose(usual["final_velocity"], 10 / 0.1**2)
    fine = chosen(arm(), [1.0, 0.0], tolerance={"elbow": 1e-3, "velocity": 1.0}).weights
    np.testing.assert_allclose(fine["final_position"], [4 / 0.02**2, 4 / 1e-3**2])
    np.testing.assert_allclose(fine["final_velocity"], usual["final_velocity"])  # never softer than by default


def test_a_servo_is_counted_from_a_minimum_jerk_motion():
    servos = """<position name="one" joint="shoulder" kp="200" kv="20" ctrlrange="-3 3" forcerange="-50 50"/>
                <position name="two" joint="elbow" kp="100" kv="10"/>"""
    dynamics = arm(actuators=servos)
    weights = chosen(dynamics, [1.0, 0.5]).weights
    assert "control" not in weights
    assert weights["effort"][0] == pytest.approx((200 / 50) ** 2)  # its force is the nearer limit
    N, goal = 100, np.array([1.0, 0.5, 0.0, 0.0])
    cost = default_cost(dynamics, dynamics.mechanism.home, goal, N)
    s = (np.arange(N) + 0.5) / N
    q = (10 * s**3 - 15 * s**4 + 6 * s**5)[:, None] * goal[:2]
    v = (30 * s**2 - 60 * s**3 + 30 * s**4)[:, None] * goal[:2] / (N * dynamics.dt)
    held = np.array([planner.dynamics.bias(dynamics.mechanism, one, [0.0, 0.0]) for one in q])
    # u is q where the servo holds its weight, kp (u - q) = held + kv v. Twice the step moves a mean by h^2 s'' / 8.
    np.testing.assert_allclose(cost.u_ref, q + held / [200, 100] + v * 0.1, atol=3e-4)
    np.testing.assert_allclose(cost.x_ref[N // 2, 2:], 1.875 * goal[:2] / (N * dynamics.dt), rtol=1e-12)


@pytest.mark.parametrize("kp", [100.0, 1e4])
def test_servos_do_not_rush(kp):
    """The peak speed is at most about that of a minimum-jerk motion, for soft and for stiff servos."""
    servos = "".join(
        f'<position name="{joint}" joint="{joint}" kp="{kp}" kv="{0.1 * kp}" ctrlrange="-3 3" forcerange="-90 90"/>'
        for joint in ("shoulder", "elbow")
    )
    text = ARM.format(length=0.5, damping=0.1, width=0.025, mass=1.0, actuators=servos)
    text = text.replace("<joint", '<joint armature="1"')  # as geared motors have
    dynamics, N = planner.RigidBodyDynamics(planner.Mechanism.from_mjcf(text, contacts="off"), 0.01, substeps=16), 100
    goal = np.array([0.8, -0.6, 0.0, 0.0])
    cost = default_cost(dynamics, dynamics.mechanism.home, goal, N)
    plan = planner.solve(planner.Problem(dynamics, cost, dynamics.mechanism.home, limits=planner.Limits("model")))
    assert plan.success
    share = np.abs(plan.xs[:, 2:]).max(axis=0) / (1.875 * np.abs(goal[:2]) / (N * dynamics.dt))
    assert np.all((share > 1 / 1.875) & (share < 1.2))  # a constant speed is the slowest
    assert len(plan.history) <= 15


@pytest.mark.parametrize("size", [0.02, 0.5, 3.0])
def test_arms_of_any_size_arrive_in_a_few_iterations(size):
    mass = 1000.0 * size**3
    dynamics = arm(length=size, mass=mass, limited="false")
    goal = np.array([0.8, -0.6, 0.0, 0.0])
    cost = default_cost(dynamics, dynamics.mechanism.home, goal, 100)
    plan = planner.solve(planner.Problem(dynamics, cost, dynamics.mechanism.home, expected_reduction_tolerance=1e-7))
    assert plan.success
    assert plan.nit <= 20  # issue: 3 to 15 on nine arms of others
    assert planner.prove(plan, rollouts=0).passed


# A rocket that steers by its nozzle, which nothing asks to move: neither a force limit nor a reference says how far.
ROCKET = """<mujoco><worldbody><body name="rocket"><freejoint/><geom type="cylinder" size=".1 .8" mass="10"/>
  <body name="nozzle" pos="0 0 -.8"><joint name="gimbal" axis="0 1 0" {range} damping=".1" armature=".01"/>
    <geom type="cylinder" size=".06 .1" pos="0 0 -.1" mass=".5"/><site name="thrust"/></body></body></worldbody>
  <actuator><motor site="thrust" gear="0 0 1 0 0 0" ctrlrange="20 250"/><position joint="gimbal" kp="20" kv="2"/>
  </actuator></mujoco>"""


@pytest.mark.parametrize(
    ("limited", "limit"), [('range="-12 12"', np.radians(12.0)), pytest.param("", 0.25, marks=pytest.mark.slow)]
)
def test_a_servo_of_a_machine_that_swings_may_move_its_joint(limited, limit):
    """By half of its range, or the least displacement of a joint: 1e4 times what accelerates the nozzle alone."""
    mechanism = planner.Mechanism.from_mjcf(ROCKET.format(range=limited), contacts="off")
    dynamics = planner.RigidBodyDynamics(mechanism, 0.01)
    weights = chosen(dynamics, [1.0], duration=3.0).weights
    assert weights["effort"][1] == pytest.approx(1.0 / limit**2)
    goals = planner.Goal("rocket", position=(1.0, 0.0, -1.0), orientation=(1.0, 0.0, 0.0, 0.0))
    plan = planner.solve(planner.task(mechanism, mechanism.home, goals, duration=3.0))
    assert plan.success, plan.message
