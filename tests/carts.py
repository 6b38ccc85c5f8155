"""A cart with a pole, and problem files about it."""

from dataclasses import replace

import pytest

import planner
from planner import Limits, Mechanism, Problem, RigidBodyDynamics, TrackingCost, cases
from planner.cases.problem_file import load
from planner.paper.studies.objective import CART as RAIL

CART = """
<mujoco model="cart">
  <option gravity="0 0 -9.81"/>
  <worldbody>
    <body>
      <joint name="slider" type="slide" axis="1 0 0" damping="0.1"/>
      <inertial pos="0 0 0" mass="1" diaginertia="0.1 0.1 0.1"/>
      <body>
        <joint name="pole" axis="0 1 0"/>
        <inertial pos="0 0 -0.5" mass="0.2" diaginertia="0.01 0.01 0.01"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="slider"/></actuator>
  <keyframe>
    <key name="left" qpos="-1 0.1"/>
    <key name="right" qpos="1 0.2" qvel="0.3 0.4"/>
  </keyframe>
</mujoco>
"""
BASE = {"model": '"cart.xml"', "start": '"left"', "goal": "[1.0, 0.0]", "duration": "1.0", "dt": "0.05"}


def write(folder, weights="", **keys):
    (folder / "cart.xml").write_text(CART, encoding="utf-8")
    lines = [f"{key} = {value}" for key, value in (BASE | keys).items() if value is not None]
    path = folder / "problem.toml"
    path.write_text("\n".join(lines) + "\n" + weights, encoding="utf-8")
    return path


def refuse(path, *fragments):
    with pytest.raises(planner.PlannerError) as caught:
        load(path)
    message = str(caught.value)
    assert "\n" not in message
    for fragment in fragments:
        assert fragment in message


def cart(N=50, duration=4.0, **limits):
    """1 kg on a rail, a metre from rest to rest: the double integrator."""
    dynamics = RigidBodyDynamics(Mechanism.from_mjcf(RAIL), duration / N)
    cost = TrackingCost.joints(dynamics, [1.0, 0.0], N, effort=1.0, final_position=1e3, final_velocity=1e3)
    return Problem(dynamics, cost, [0.0, 0.0], limits=Limits(final="exact", **limits))


def arm(N=50, **limits):
    return replace(cases.two_link(horizon=N), limits=Limits(final="exact", **limits))
