"""A user's own dynamics with an MJCF twin goes through the same proof by the general rules."""

from dataclasses import replace

import numpy as np
import pytest

import planner

MJCF = """
<mujoco>
  <option timestep="0.002" integrator="RK4"><flag contact="disable"/></option>
  <worldbody>
    <body>
      <joint name="hinge" type="hinge" axis="0 -1 0" damping="{damping}"/>
      <inertial pos="0 0 -1" mass="1" diaginertia="1e-6 1e-6 1e-6"/>
    </body>
  </worldbody>
  <actuator><motor joint="hinge"/></actuator>
</mujoco>
"""


def pendulum(x, u):
    return np.stack([x[..., 1], (u[..., 0] - 9.81 * np.sin(x[..., 0])) / (1.0 + 1e-6)], axis=-1)


def problem(integrator, dt, damping=0.0):
    horizon = round(2.0 / dt)
    dynamics = planner.FunctionDynamics(pendulum, 2, 1, dt, integrator)
    cost = planner.TrackingCost.reach([np.pi, 0.0], horizon, final=1000.0, effort=1.0, dt=dt)
    twin = planner.Twin(MJCF.format(damping=damping), np.eye(2), np.zeros(2), np.eye(2)[None], np.zeros((1, 2)))
    return planner.Problem(dynamics, cost, [0.0, 0.0], twin=twin)


def test_a_right_plan_passes():
    plan = planner.solve(problem("rk4", 0.02))
    proof = planner.prove(plan, rollouts=0)
    assert plan.success
    assert proof.passed, proof.reason
    assert proof.refined_open_loop.measured[0].name == "end_state_error"
    assert proof.same_step.measured[0].value <= 1e-10  # the same RK4 at the same step: rounding


def test_states_that_are_not_the_rollout_fail():
    plan = planner.solve(problem("rk4", 0.02))
    xs = plan.xs.copy()
    xs[1:-1] = 1e3
    proof = planner.prove(replace(plan, xs=xs), rollouts=0)
    assert proof.verdict == "FAIL"
    assert "stage_error" in [figure.name for figure in proof.plan.failures]


def test_a_plan_of_coarse_euler_steps_fails():
    proof = planner.prove(planner.solve(problem("euler", 0.05)), rollouts=0)
    assert proof.verdict == "FAIL"
    assert proof.mode is None


def test_a_model_with_damping_fails_open_loop():
    proof = planner.prove(planner.solve(problem("rk4", 0.02, damping=0.3)), rollouts=0)
    assert not proof.refined_open_loop.passed


def test_a_twin_of_another_size_is_refused():
    good = problem("rk4", 0.02)
    twin = planner.Twin(good.twin.mjcf, np.eye(3, 2), np.zeros(3), np.zeros((1, 2, 3)), np.zeros((1, 2)))
    with pytest.raises(planner.PlannerError, match="maps to 3 states"):
        planner.Problem(good.dynamics, good.cost, [0.0, 0.0], twin=twin)
    with pytest.raises(planner.PlannerError, match="to_x_offset has shape"):
        planner.Twin(good.twin.mjcf, np.eye(2), np.zeros(3), np.eye(2)[None], np.zeros((1, 2)))


def test_without_a_twin_there_is_nothing_to_replay():
    p = problem("rk4", 0.02)
    plan = planner.solve(planner.Problem(p.dynamics, p.cost, [0.0, 0.0]))
    with pytest.raises(planner.PlannerError, match="no MuJoCo model"):
        planner.prove(plan, rollouts=0)
