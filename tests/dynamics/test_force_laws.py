"""Actuators with a gain that depends on the state: MuJoCo's forces, derivatives against differences, a plan's proof."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from gradients import assert_gradients, assert_step_derivatives

import planner
from planner.base.errors import PlannerError
from planner.base.gl import load_mujoco
from planner.constraints import Power
from planner.dynamics import RigidBodyDynamics
from planner.dynamics.joint_forces import actuator_forces, actuator_lengths, force_slopes
from planner.kernels.force_laws import LAW_SIZE, LAWS
from planner.model.actuators import ForceLaw
from planner.model.mechanism import Mechanism
from planner.problem.constraints.forces import ActuatorForce, JointForce
from planner.problem.control_bounds import unbounded
from planner.problem.costs.motors import EnergyCost
from planner.proof.compare.differences import differences

mujoco = load_mujoco()

# A brake at the elbow, a gain of length and speed along a tendon, one behind a filter, and a motor.
ARM = """
<mujoco model="braked arm">
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="RK4"/>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" axis="0 -1 0"/>
      <inertial pos="0.25 0 0" mass="1" diaginertia="0.02 0.02 0.02"/>
      <body name="lower" pos="0.5 0 0">
        <joint name="elbow" axis="0 -1 0.2"/>
        <inertial pos="0.2 0 0" mass="0.5" diaginertia="0.01 0.01 0.01"/>
        <body name="hand" pos="0.4 0 0">
          <joint name="slide" type="slide" axis="1 0 0"/>
          <inertial pos="0.05 0 0" mass="0.2" diaginertia="1e-3 1e-3 1e-3"/>
        </body>
      </body>
    </body>
  </worldbody>
  <tendon><fixed name="cord"><joint joint="shoulder" coef="0.3"/><joint joint="slide" coef="1"/></fixed></tendon>
  <actuator>
    <motor name="motor" joint="shoulder"/>
    <damper name="brake" joint="elbow" kv="2" gear="1.5" ctrlrange="0 5"/>
    <general name="cord" tendon="cord" gear="2" gaintype="affine" gainprm="3 0.7 -0.4" biastype="affine"
             biasprm="0.1 -2 -0.3" forcerange="-8 8"/>
    <general name="late" joint="slide" gaintype="affine" gainprm="1 2 0.5" dyntype="filter" dynprm="0.1"/>
  </actuator>
</mujoco>
"""


@pytest.fixture(scope="module")
def arm():
    return Mechanism.from_mjcf(ARM)


def random_states(arm, n=6):
    rng = np.random.default_rng(7)
    return rng.normal(size=(n, arm.space.nx)), np.abs(rng.normal(size=(n, arm.nu)))


def test_forces_and_accelerations_are_mujoco_s(arm):
    xs, us = random_states(arm)
    model = mujoco.MjModel.from_xml_string(arm.mjcf)
    model.actuator_forcelimited[:] = 0
    rates = RigidBodyDynamics(arm, 0.01).rates(xs, us)
    for x, u, rate in zip(xs, us, rates, strict=True):
        data, (q, v, act) = mujoco.MjData(model), np.split(x, [arm.nq, arm.nq + arm.nv])
        data.qpos, data.qvel, data.act, data.ctrl = q, v, act, u
        mujoco.mj_forward(model, data)
        given = np.append(u[:3], act)
        force = actuator_forces(arm.actuators, given, actuator_lengths(arm, q), arm.actuators.moment @ v)
        np.testing.assert_allclose(force, data.actuator_force, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(rate[arm.nv : 2 * arm.nv], data.qacc, rtol=1e-10, atol=1e-10 * abs(data.qacc).max())


@pytest.mark.parametrize("integrator", ["rk4", "euler", "semi-implicit-euler", "rosenbrock"])
@pytest.mark.parametrize("prescribed", [(), ("elbow",)])
def test_derivatives_of_a_step_are_exact(arm, integrator, prescribed):
    dynamics = RigidBodyDynamics(arm, 0.01, integrator, prescribed)
    for x, u in zip(*random_states(arm, 3), strict=True):
        assert_step_derivatives(dynamics, x, np.append(u, 0.3 * np.ones(len(prescribed))))


@pytest.mark.parametrize("kind", LAWS)
def test_a_law_has_the_derivatives_that_it_states_and_is_affine_in_what_it_is_given(kind):
    p, at = tuple(np.random.default_rng(1).normal(size=LAW_SIZE)), (0.7, -0.4, 1.3)
    law: Any = LAWS[kind]
    terms = law(*at, p)
    for i in range(3):  # a complex step: exact to rounding, as laws are arithmetic alone
        moved = [x + 1e-30j * (j == i) for j, x in enumerate(at)]
        assert law(*moved, p)[0].imag / 1e-30 == pytest.approx(terms[1 + i], rel=1e-14)
    none, twice = law(0.0, *at[1:], p)[0], law(2.0 * at[0], *at[1:], p)[0]
    assert twice - none == pytest.approx(2.0 * (terms[0] - none), rel=1e-13)


def test_power_joint_force_and_energy_have_exact_derivatives(arm):
    xs, us = random_states(arm)
    dynamics, h = RigidBodyDynamics(arm, 0.01), 1e-6
    for residual in (Power("brake"), Power("late"), JointForce("slide"), ActuatorForce("cord")):
        function = residual.residual_function(dynamics, len(us))
        n = np.arange(len(us))
        by_x, by_u = function.derivatives(xs, us, n)
        for i in range(dynamics.nx):
            d = h * np.eye(dynamics.nx)[i]
            slope = (function.values(xs + d, us, n) - function.values(xs - d, us, n)) / (2 * h)
            np.testing.assert_allclose(by_x[:, 0, i], slope[:, 0], atol=1e-7 * max(1.0, np.abs(by_x).max()))
        for i in range(dynamics.nu):
            d = h * np.eye(dynamics.nu)[i]
            slope = (function.values(xs, us + d, n) - function.values(xs, us - d, n)) / (2 * h)
            np.testing.assert_allclose(by_u[:, 0, i], slope[:, 0], atol=1e-7 * max(1.0, np.abs(by_u).max()))
    assert_gradients(EnergyCost(dynamics, smoothing=1.0), arm.space, np.concatenate([xs, xs[:1]]), us)


def test_what_the_plan_does_not_bound_or_integrate_is_said(arm):
    nameless = replace(arm, actuators=replace(arm.actuators, names=("", "", "", "")))
    assert [one for one in unbounded(nameless) if "forcerange" in one and "not linear" in one]
    assert unbounded(arm) == ()  # the cord's is a constraint, see below
    with pytest.raises(PlannerError, match="'brake', with a damping that depends on the state"):
        RigidBodyDynamics(arm, 0.01, "implicitfast")
    by_length = ForceLaw(0, "affine gain", (3.0, 0.0))
    with pytest.raises(PlannerError, match="together"):  # the brake is no reason, a tendon's damping is
        RigidBodyDynamics(replace(arm, actuators=replace(arm.actuators, laws=(by_length,))), 0.01, "implicitfast")
    with pytest.raises(PlannerError, match="force laws"):
        RigidBodyDynamics(arm, 0.01).second_order_memory()


def test_another_law_is_named(arm):
    other = Mechanism.from_mjcf(ARM.replace("3 0.7 -0.4", "3 0.7 -0.5"))
    assert "force laws" in differences(arm, other)
    assert differences(arm, arm) == ""


def test_a_brake_holds_nothing_at_rest(arm):
    slopes = force_slopes(arm.actuators, np.zeros(arm.nu), np.zeros(arm.nu))
    np.testing.assert_array_equal(slopes.gain[1:3], [0.0, 3.0])
    assert arm.actuators.pushes.all()


# A slide whose motor has a gain that grows with position.
SLIDE = """
<mujoco model="slide">
  <option timestep="0.002" integrator="RK4" gravity="0 0 0"/>
  <worldbody>
    <body><joint name="x" type="slide" axis="1 0 0"/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body>
  </worldbody>
  <actuator><general name="a" joint="x" gaintype="affine" gainprm="2 1" forcerange="-%s %s"/></actuator>
</mujoco>
"""


def test_a_forcerange_is_kept_where_the_gain_depends_on_the_state():
    """From rest to rest over 1 m in 1 s no force of less than 4 N moves 1 kg, by bang-bang."""

    def largest(limit):
        arm = Mechanism.from_mjcf(SLIDE % (limit, limit))
        plan = planner.solve(planner.task(arm, start={}, goals=planner.Goal(joints={"x": 1.0}), duration=1.0))
        assert plan.converged
        return plan, np.abs((2.0 + plan.xs[:-1, 0]) * plan.us[:, 0]).max()

    assert largest(100)[1] > 5.0
    plan, force = largest(5)
    assert 4.0 < force <= 5.0
    assert planner.prove(plan, rollouts=0).passed


def test_a_falling_arm_is_braked_and_the_plan_passes():
    """Without the brake the elbow, which nothing else moves, would swing through."""
    text = ARM.replace('<joint joint="slide" coef="1"/>', "")
    text = text[: text.index('    <general name="cord"')] + "  </actuator>\n</mujoco>"
    hand, after = text.index('        <body name="hand"'), text.index("      </body>\n    </body>\n  </worldbody>")
    text = text[:hand] + text[after:]
    arm = Mechanism.from_mjcf(text.replace('axis="0 -1 0.2"', 'axis="0 -1 0"'))
    start = arm.home.copy()
    start[:2] = -1.2, -0.4
    goal = planner.Goal(joints={"shoulder": -np.pi / 2, "elbow": 0.0})
    problem = planner.task(arm, start=start, goals=goal, duration=1.5)
    plan = planner.solve(problem)
    assert plan.converged
    assert planner.prove(plan, rollouts=0).passed
    assert plan.us[:, 1].max() > 0.0  # it brakes
    free = replace(arm, actuators=replace(arm.actuators, laws=()))
    assert np.abs(RigidBodyDynamics(free, problem.dynamics.dt).step(plan.xs[:-1], plan.us) - plan.xs[1:]).max() > 1e-4
