"""A planar arm of two links in the x-z plane, hanging, with motors and ranges; and problem files about its hand."""

from __future__ import annotations

import numpy as np
import pytest

import planner
from planner.cases.problem_file import load

ARM = """
<mujoco model="arm">
  <option><flag contact="disable"/></option>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" axis="0 1 0" damping="1" range="-170 170"/>
      <inertial pos="0 0 -0.2" mass="1" diaginertia="0.02 0.02 0.002"/>
      <body name="lower" pos="0 0 -0.4">
        <joint name="elbow" axis="0 1 0" damping="1" range="-150 150"/>
        <inertial pos="0 0 -0.15" mass="0.5" diaginertia="0.01 0.01 0.001"/>
        <site name="hand" pos="0 0 -0.3"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="shoulder" joint="shoulder" ctrlrange="-30 30"/>
    <motor name="elbow" joint="elbow" ctrlrange="-30 30"/>
  </actuator>
  <keyframe><key name="bent" qpos="0.5 -1"/></keyframe>
</mujoco>
"""
START = {"shoulder": 0.5, "elbow": -1.0}


def mechanism(**options):
    return planner.Mechanism.from_mjcf(ARM, **options)


def hand(shoulder, elbow):
    """Where the hand is, by trigonometry: (x, z)."""
    both = shoulder + elbow
    return -0.4 * np.array([np.sin(shoulder), np.cos(shoulder)]) - 0.3 * np.array([np.sin(both), np.cos(both)])


def write(folder, goals, duration=1.0, **keys):
    """A problem file with the TOML of its goals at its end."""
    (folder / "arm.xml").write_text(ARM, encoding="utf-8")
    own = {"model": '"arm.xml"', "start": '"bent"', "duration": str(duration), "dt": "0.02"} | keys
    path = folder / "task.toml"
    path.write_text("\n".join([*(f"{key} = {value}" for key, value in own.items()), goals]), encoding="utf-8")
    return path


def refuse(path, *fragments):
    with pytest.raises(planner.PlannerError) as caught:
        load(path)
    message = str(caught.value)
    assert "\n" not in message
    for fragment in fragments:
        assert fragment in message, message
