"""Plans of trees for the tests of proof and pictures: rolled out, or of the acrobot."""

from dataclasses import replace

import numpy as np

import planner
from planner.dynamics.rigid_body import RigidBodyDynamics
from planner.model.mechanism import Mechanism
from planner.model.mjcf.text import model_path
from planner.problem.plan import Plan, Status
from planner.problem.problem import Problem
from planner.proof.replays.compiled_twin import CompiledTwin
from planner.proof.robustness.rollouts import MODES

LIMITED = """
<mujoco model="limited">
  <compiler angle="radian" autolimits="true"/>
  <option timestep="0.001"><flag contact="disable"/></option>
  <worldbody>
    <body>
      <joint name="hinge" axis="0 -1 0" damping="0.1" range="-1 1"/>
      <inertial pos="1 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>
      <geom type="capsule" fromto="0 0 0 1 0 0" size="0.05" contype="0" conaffinity="0"/>
      <site name="tip" pos="1 0 0"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge"/></actuator>
</mujoco>
"""


def acrobot():
    return Mechanism.from_mjcf(model_path("acrobot") / "scene.xml")


def problem_of(mechanism, dt, N, *, integrator="rk4", x0=None, us=None, **rest):
    dynamics = RigidBodyDynamics(mechanism, dt, integrator)
    cost = planner.TrackingCost.reach(
        mechanism.home, N, final=1.0, effort=np.ones(mechanism.nu), dt=dt, nu=mechanism.nu, space=mechanism.space
    )
    start = mechanism.home if x0 is None else x0
    return Problem(dynamics, cost, start, us=us, horizon=N, twin=planner.Twin.of(mechanism), **rest)


def rolled_out(problem):
    """A plan that nobody optimized: the rollout of the problem's first controls, without gains."""
    xs = np.empty((problem.N + 1, problem.dynamics.nx))
    xs[0] = problem.x0
    for n, u in enumerate(problem.first_guess):
        xs[n + 1] = problem.dynamics.step(xs[n : n + 1], u[None])[0]
    us, dynamics = problem.first_guess, problem.dynamics
    K = np.zeros((problem.N, us.shape[1], dynamics.ndx))
    t = dynamics.dt * np.arange(problem.N + 1)
    return Plan(
        t=t, xs=xs, us=us, K=K, cost=problem.cost.value(xs, us), gradient_norm=0.0, status=Status.CONVERGED, history=(),
        problem=problem, twin=problem.twin,
    )  # fmt: skip


def tree_plan(integrator, dt=0.005, N=80):
    """The tree of the parity test thrown through the air, all joints moving."""
    tree = Mechanism.from_mjcf(TREE)
    rng = np.random.default_rng(3)
    x0 = tree.space.integrate(tree.home, rng.normal(scale=0.5, size=tree.space.ndx))
    return rolled_out(problem_of(tree, dt, N, integrator=integrator, x0=x0, us=rng.normal(size=(N, tree.nu))))


def swing_up(integrator, dt):
    mechanism = acrobot()
    N = round(4.0 / dt)
    dynamics = RigidBodyDynamics(mechanism, dt, integrator)
    cost = planner.TrackingCost.reach(mechanism.keyframe("goal"), N, final=1000.0, effort=1.0, dt=dt)
    twin, start = planner.Twin.of(mechanism), mechanism.keyframe("start")
    return planner.solve(Problem(dynamics, cost, start, horizon=N, twin=twin))


TREE = """
<mujoco>
  <compiler angle="radian"/>
  <option gravity="0 0 -9.81"><flag contact="disable"/></option>
  <worldbody>
    <body name="trunk">
      <freejoint name="root"/>
      <inertial pos="0.1 0 0.2" mass="12" diaginertia="0.3 0.4 0.2"/>
      <body name="thigh" pos="0 0.1 -0.2">
        <joint name="hip" axis="0 1 0" damping="0.3" stiffness="2" springref="0.1" armature="0.01"/>
        <inertial pos="0 0 -0.2" mass="3" diaginertia="0.05 0.05 0.01"/>
        <body name="shank" pos="0 0 -0.4">
          <joint name="knee" axis="0 1 0"/>
          <inertial pos="0.01 0 -0.2" mass="2" diaginertia="0.03 0.03 0.005"/>
        </body>
      </body>
      <body name="boom" pos="0.2 0 0.3">
        <joint name="boom" type="slide" axis="1 0 0" damping="0.2"/>
        <inertial pos="0.1 0 0" mass="1" diaginertia="0.01 0.02 0.02"/>
        <body name="hand" pos="0.3 0 0">
          <joint name="wrist" type="ball" damping="0.05" stiffness="0.4"/>
          <inertial pos="0 0.02 0.1" mass="0.5" diaginertia="0.004 0.003 0.002"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="hip" joint="hip" gear="3"/>
    <position name="boom" joint="boom" kp="40" kv="2"/>
    <general name="knee" joint="knee" dyntype="filter" dynprm="0.05" gainprm="2"/>
    <general name="spring" joint="boom" dyntype="integrator" gainprm="5" biasprm="0 -5 0" biastype="affine"/>
  </actuator>
</mujoco>
"""


FAST = 'timestep="0.0005"', 'timestep="0.005"'


def coarse(plan):
    """The same plan with a simulator as coarse as its control steps: quick."""
    return CompiledTwin(replace(plan.twin, mjcf=plan.twin.mjcf.replace(*FAST)))


def ends(result):
    return np.array([result.end_error[mode] for mode in MODES])
