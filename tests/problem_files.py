"""Problem files of an arm of two joints and of a pole on a slider, solved, proved and changed by suggested fixes."""

from dataclasses import replace

import numpy as np

import planner
from planner.cases.problem_file import load, of_table
from planner.cases.problem_file.keys import RESOLVED

ARM = """
<mujoco>
  <compiler angle="radian"/>
  <option gravity="0 0 {gravity}"/>
  <worldbody>
    {world}
    <body>
      <joint name="shoulder" axis="0 1 0" damping="0.1" {shoulder}/>
      <geom name="upper" type="capsule" size="0.03" fromto="0 0 0 0.4 0 0" mass="2" {collides}/>
      <body pos="0.4 0 0">
        <joint name="elbow" axis="0 1 0" damping="0.1" {elbow}/>
        <geom name="lower" type="capsule" size="0.03" fromto="0 0 0 0.3 0 0" mass="1" {collides}/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="at shoulder" joint="shoulder" {motor}/><motor name="at elbow" joint="elbow" {motor}/>
  </actuator>
</mujoco>
"""
USUAL = {
    "gravity": -9.81, "world": "", "shoulder": "", "elbow": "", "motor": "", "collides": 'contype="0" conaffinity="0"',
}  # fmt: skip
POLE = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body>
      <joint name="slider" type="slide" axis="1 0 0" damping="0.1" {slider}/>
      <inertial pos="0 0 0" mass="1" diaginertia="0.1 0.1 0.1"/>
      <body>
        <joint name="pole" axis="0 1 0"/>
        <inertial pos="0 0 0.5" mass="0.2" diaginertia="0.01 0.01 0.01"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="slider"/></actuator>
</mujoco>
"""
WEIGHTS = {"effort": 1.0, "final_position": 1000.0, "final_velocity": 1000.0, "position": 0.0, "velocity": 0.0}


def file(folder, model, keys, weights=None, limits=None):
    """A problem file of a model's text, with TOML by key."""
    (folder / "machine.xml").write_text(model, encoding="utf-8")
    keys = {"model": '"machine.xml"', "start": "[0.0, 0.0]", "duration": "1.0", "dt": "0.01"} | keys
    lines = [f"{key} = {value}" for key, value in keys.items()]
    for name, table in (("weights", WEIGHTS | (weights or {})), ("limits", limits)):
        lines += [f"[{name}]", *(f"{key} = {value}" for key, value in table.items())] if table else []
    (folder / "problem.toml").write_text("\n".join(lines), encoding="utf-8")
    return load(folder / "problem.toml").problem


def arm(folder, *, weights=None, limits=None, goal="[-0.5, 0.8]", model=None, **keys):
    return file(folder, ARM.format(**USUAL | (model or {})), {"goal": goal} | keys, weights, limits)


def without_limits(problem):
    """A problem that does not know the limits of its file."""
    return replace(problem, limits=None)


def tried(problem, **options):
    plan = planner.solve(problem, **options)
    proof = planner.prove(plan, rollouts=0) if np.isfinite(plan.xs).all() else None
    return plan, proof


def cured(problem, cure):
    """The problem with a cure written into the table of its file; what was chosen by itself is chosen again."""
    table = {name: value for name, value in problem.parameters.items() if name != RESOLVED}
    return of_table(cure.applied(table), problem.twin)
