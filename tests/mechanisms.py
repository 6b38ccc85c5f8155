"""Machines as MJCF, random states of them, and their passive forces, for the tests of reading MJCF."""

import numpy as np
from scipy.spatial.transform import Rotation

from planner.base.gl import load_mujoco
from planner.model.mechanism import SCREW
from planner.model.space import log_quaternion

mujoco = load_mujoco()

# Every kind of joint, several to a body, branches, bodies welded to links and to the world, ref, frames of any pose.
MACHINE = """
<mujoco>
  <compiler angle="degree"/>
  <option gravity="0.3 -0.2 -9.81"><flag contact="disable"/></option>
  <worldbody>
    <body name="pedestal" pos="0.1 0.2 0.3" euler="10 20 30">
      <geom type="box" size="0.1 0.2 0.3"/>
      <body name="arm" pos="0.4 0 0.1" euler="0 40 15">
        <joint name="lift" type="slide" axis="1 2 3" pos="0.1 0 0" ref="0.2" damping="0.3" armature="0.05"
               stiffness="7" springref="0.5"/>
        <joint name="swing" axis="0 1 1" pos="0.05 0.1 -0.2" ref="25" stiffness="2" springref="-15" damping="0.1"/>
        <joint name="roll" type="ball" pos="-0.1 0.2 0.3" stiffness="3" damping="0.2" armature="0.02"/>
        <joint name="slip" type="slide" axis="0 0 1"/>
        <geom type="capsule" size="0.05 0.2" pos="0.1 0 0" euler="0 30 0"/>
        <body name="plate" pos="0.2 0.1 0" euler="50 0 0">
          <geom type="ellipsoid" size="0.1 0.2 0.05" pos="0 0.1 0"/>
          <site name="edge" pos="0.1 0 0.2" euler="0 0 70"/>
          <body name="tip" pos="0 0.3 0" euler="0 0 20"><inertial pos="0.1 0 0" mass="0.7" diaginertia="0.1 0.1 0.1"/>
            <body name="wrist" pos="0 0 0.2"><joint name="turn" axis="1 0 0"/><geom size="0.1" pos="0.1 0.1 0"/></body>
          </body>
        </body>
        <body name="branch" pos="0 0 -0.4"><joint axis="0 1 0"/><geom type="box" size="0.1 0.05 0.02"/></body>
      </body>
    </body>
    <body name="kite" pos="1 2 3" euler="0 0 90">
      <joint name="fly" type="free" stiffness="4" damping="0.6" armature="0.1"/>
      <geom type="box" size="0.1 0.2 0.05" pos="0.2 0 0" euler="5 6 7"/>
      <body name="tail" pos="-0.3 0 0"><joint name="wag" type="ball"/><geom size="0.1" pos="-0.2 0 0.1"/></body>
    </body>
    <site name="mark" pos="5 6 7"/>
  </worldbody>
  <keyframe>
    <key name="there" qpos="1 2 0.6 0 0.8 0 5 6 7 8 9 10 0 1 0 0 1 0 0 0"
         qvel="1 2 3 4 5 6 7 8 9 10 11 12 13 14 15 16 17"/>
  </keyframe>
</mujoco>
"""

PLAIN = """
<mujoco>
  <option>%(option)s</option>
  %(default)s
  <worldbody>
    <body name="one" %(body)s><joint name="h" axis="0 1 0" %(joint)s/><geom size="0.1" mass="1"/>
      <site name="p" pos="0.2 0 0"/>
      <body name="two" pos="1 0 0"><joint name="s" type="slide"/><geom size="0.1"/><site name="q"/></body></body>
    %(world)s
  </worldbody>
  <tendon>%(tendon)s</tendon>
  <equality>%(equality)s</equality>
  <actuator><motor name="kept" joint="s"/>%(actuator)s<motor name="last" joint="h"/></actuator>
  <sensor>%(sensor)s</sensor>
  <keyframe>%(key)s</keyframe>
</mujoco>
"""

# A tetrahedron of some height, as a mesh file.
OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 {}\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def state(model, seed):
    """A random state of a compiled model, and its data there."""
    rng = np.random.default_rng(seed)
    data = mujoco.MjData(model)
    mujoco.mj_integratePos(model, data.qpos, rng.normal(size=model.nv), 1.0)
    data.qvel[:] = rng.normal(size=model.nv)
    data.act[:] = rng.normal(size=model.na)
    data.ctrl[:] = rng.normal(size=model.nu)
    mujoco.mj_forward(model, data)
    return data


def passive(m, data):
    """Springs and dampers, as the mechanism has them."""
    force = -m.damping * data.qvel
    screws = np.flatnonzero(m.kind == SCREW)
    force[screws] -= m.stiffness[screws] * (data.qpos[m.q_address[screws]] - m.spring_rest[screws])
    for k, (address, dof) in enumerate(m.quaternions):
        rest, now = m.ball_rest[k], data.qpos[address : address + 4]
        turn = Rotation.from_quat(np.roll(rest, -1)).inv() * Rotation.from_quat(np.roll(now, -1))
        force[dof : dof + 3] -= m.ball_stiffness[k] * log_quaternion(np.roll(turn.as_quat(), 1))
    return force


def plain(**parts):
    names = ("option", "default", "body", "joint", "world", "tendon", "equality", "actuator", "sensor", "key")
    return PLAIN % {name: parts.get(name, "") for name in names}
