"""Several actuators on one joint obey its actuatorfrcrange in sum, as MuJoCo clamps it."""

import numpy as np
import pytest

import planner
from planner.base.gl import load_mujoco
from planner.dynamics import RigidBodyDynamics
from planner.model.mechanism import Mechanism
from planner.problem.constraints.forces import JointForce
from planner.problem.control_bounds import summed_joint_forces
from planner.problem.limits import Limits

# A pendulum with a motor of 3 N m, a servo and a filtered drive, on a joint that takes 2.5 N m in all.
PENDULUM = """
<mujoco>
  <worldbody>
    <body>
      <joint name="hinge" axis="0 1 0" damping="0.1" actuatorfrcrange="-2.5 2"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.03" mass="0.8"/>
    </body>
  </worldbody>
  <actuator>
    <motor name="motor" joint="hinge" gear="1.5" ctrlrange="-2 2"/>
    <position name="servo" joint="hinge" kp="6" kv="0.4" ctrlrange="-2 2"/>
    <general name="slow" joint="hinge" dyntype="filter" dynprm="0.1" gainprm="1.2" ctrlrange="-1 1"/>
  </actuator>
</mujoco>
"""


@pytest.fixture(scope="module")
def problem():
    dynamics = RigidBodyDynamics(Mechanism.from_mjcf(PENDULUM, contacts="off"), 0.02)
    cost = planner.TrackingCost.joints(
        dynamics, [1.2, 0.0, 0.0], 30, effort=0.01, final_position=1e3, final_velocity=1e2
    )
    return planner.Problem(dynamics, cost, np.zeros(3), limits=Limits.of_model())


def test_the_sum_of_the_forces_is_mujoco_s(problem):
    mechanism, rng = problem.dynamics.mechanism, np.random.default_rng(1)
    model = load_mujoco().MjModel.from_xml_string(mechanism.mjcf)
    model.jnt_actfrclimited[:] = 0
    data, xs, us = load_mujoco().MjData(model), rng.normal(size=(5, 3)), rng.uniform(-1.0, 1.0, size=(5, 3))
    force = JointForce("hinge")
    values = force.value(problem.dynamics, xs, us)
    for x, u, value in zip(xs, us, values, strict=True):
        data.qpos[:], data.qvel[:], data.act[:], data.ctrl[:] = x[0], x[1], x[2], u
        load_mujoco().mj_forward(model, data)
        assert value == pytest.approx(data.qfrc_actuator[0], abs=1e-12)
    by_x, by_u = force.jacobian(problem.dynamics, xs, us)
    d = 1e-2  # the force is linear: differences are exact
    for k in range(3):
        by = (force.value(problem.dynamics, xs + d * np.eye(3)[k], us) - values) / d
        np.testing.assert_allclose(by_x[:, 0, k], by, rtol=1e-10)
        by = (force.value(problem.dynamics, xs, us + d * np.eye(3)[k]) - values) / d
        np.testing.assert_allclose(by_u[:, 0, k], by, rtol=1e-10)


def test_a_plan_keeps_the_sum_within_the_joint_s_range(problem):
    assert summed_joint_forces(problem.dynamics.mechanism) == {0: "hinge"}
    plan = planner.solve(problem)
    assert plan.converged
    ends = [JointForce("hinge").value(problem.dynamics, xs, plan.us) for xs in (plan.xs[:-1], plan.xs[1:])]
    assert np.max(ends) <= 2.0 + 1e-6
    assert np.min(ends) >= -2.5 - 1e-6
    free = planner.solve(
        planner.Problem(problem.dynamics, problem.cost, problem.x0, limits=Limits(control={"slow": 1.0}))
    )
    assert np.max(JointForce("hinge").value(problem.dynamics, free.xs[:-1], free.us)) > 2.1  # this motion needs it


def test_joints_that_a_bound_of_the_control_keeps_need_no_constraint():
    alone = PENDULUM[: PENDULUM.index("    <position")] + "  </actuator>\n</mujoco>"
    assert summed_joint_forces(Mechanism.from_mjcf(alone, contacts="off")) == {}
