"""A pendulum to be refined: shared by the tests of finer problems and of refinement."""

from dataclasses import replace
from types import SimpleNamespace

import planner

PENDULUM = """
<mujoco model="pendulum">
  <option gravity="0 0 -9.81"/>
  <worldbody>
    <body>
      <joint name="pivot" axis="0 -1 0" ARGUMENTS/>
      <inertial pos="0 0 -1" mass="1" diaginertia="1e-6 1e-6 1e-6"/>
    </body>
  </worldbody>
  <actuator><motor joint="pivot"/></actuator>
</mujoco>
"""


def mechanism(arguments=""):
    return planner.Mechanism.from_mjcf(PENDULUM.replace("ARGUMENTS", arguments))


def swing(integrator="semi-implicit-euler", N=20, machine=None, dynamics=None, **weights):
    """A pendulum to the other side in a second, made in Python."""
    machine = machine or mechanism()
    dynamics = dynamics or planner.RigidBodyDynamics(machine, 1.0 / N, integrator)
    weights = {"final_position": 200.0, "final_velocity": 200.0, "effort": 0.1, "position": 0.5} | weights
    cost = planner.TrackingCost.joints(machine, [1.0, 0.0], N, dt=1.0 / N, **weights)
    return planner.Problem(dynamics, cost, x0=[-1.0, 0.0], twin=planner.Twin.of(machine))


def quick(plan):
    return planner.prove(plan, rollouts=0)


def solved(problem):
    plan = planner.solve(problem)
    return plan, quick(plan)


def discrete():
    dynamics = planner.FunctionDynamics(lambda x, u: x + 0.05 * u, 2, 2, 0.05, "discrete")
    cost = planner.TrackingCost.reach([1.0, 1.0], 20, final=1.0, effort=1.0, nu=2)
    return planner.Problem(dynamics, cost, [0.0, 0.0])


def strange(problem):
    """With dynamics of a user's own."""
    names = ("nx", "nu", "dt", "step", "linearize", "space")
    dynamics = SimpleNamespace(**{name: getattr(problem.dynamics, name) for name in names})
    return replace(problem, dynamics=dynamics)
