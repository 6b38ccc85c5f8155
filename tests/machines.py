"""Machines as MJCF that several tests share, and random states of them."""

import numpy as np
from scipy.spatial.transform import Rotation

from planner.base.gl import load_mujoco
from planner.model.mechanism import SCREW
from planner.model.space import log_quaternion

# -------------------- All kinds of joints, random states, and passive forces: reading MJCF.

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


# -------------------- Friction loss, gravity compensation and fixed tendons.

FRICTION_ARM = """
<mujoco>
  <option timestep="0.002"/>
  <default><joint armature="0.05" damping="0.2"/><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body pos="0 0 1"><joint name="turn" axis="0 0 1" frictionloss="0.6"/>
      <geom type="capsule" size="0.05" fromto="0 0 0 0 0 0.3" mass="2"/>
      <body pos="0 0 0.3"><joint name="lift" axis="0 1 0" frictionloss="0.4" solreffriction="-3 -60"/>
        <geom type="capsule" size="0.05" fromto="0 0 0 0.4 0 0" mass="2"/>
        <body pos="0.4 0 0"><joint name="bend" axis="0 1 0" frictionloss="0.2" solimpfriction="0.8 0.9 0.1"/>
          <geom type="capsule" size="0.04" fromto="0 0 0 0.3 0 0" mass="1"/></body></body></body>
  </worldbody>
  <actuator><motor joint="turn"/><motor joint="lift"/><motor joint="bend"/></actuator>
</mujoco>
"""

LIFTED = ('<body name="arm"', '<body name="tip"', '<body name="wrist"', '<body name="kite"')
"""Bodies of MACHINE, of which gravity compensation carries a share."""

TENDONS = """
<tendon>
  <fixed name="slack" stiffness="5" springlength="0.1 0.4" damping="0.7" limited="true" range="-1 1">
    <joint joint="lift" coef="1.3"/><joint joint="swing" coef="-0.6"/><joint joint="turn" coef="0.4"/></fixed>
  <fixed name="taut" stiffness="2"><joint joint="slip" coef="1"/><joint joint="turn" coef="2"/></fixed>
</tendon>
<actuator><motor name="push" joint="slip"/></actuator>
"""


def lifted(text: str) -> str:
    """MACHINE with gravity compensation of several shares and with fixed tendons."""
    for share, body in zip((1.0, 0.6, -0.5, 1.2), LIFTED, strict=True):
        text = text.replace(body, f'{body} gravcomp="{share}"')
    return text.replace("</worldbody>", f"</worldbody>{TENDONS}")


# -------------------- Machines with a hand: costs of its position.

HAND_MACHINE = """
<mujoco>
  <option gravity="0 0 -9.81"><flag contact="disable"/></option>
  <worldbody>
    <site name="fixed" pos="1 2 3"/>
    <body name="trunk">
      <freejoint name="root"/>
      <inertial pos="0 0 0" mass="3" diaginertia="0.1 0.2 0.3"/>
      <body name="arm" pos="0.1 0.2 0" euler="0 30 10">
        <joint name="shoulder" axis="0 1 0"/>
        <inertial pos="0.2 0 0" mass="1" diaginertia="0.01 0.02 0.03"/>
        <body name="palm" pos="0.4 0 0">
          <joint name="wrist" type="ball"/>
          <inertial pos="0.05 0 0" mass="0.2" diaginertia="0.001 0.002 0.003"/>
          <site name="hand" pos="0.1 0.02 0" euler="10 20 30"/>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


def random_states(machine, rng, count):
    return machine.space.integrate(machine.home, rng.uniform(-0.6, 0.6, (count, machine.space.ndx)))


HAND_ARM = """
<mujoco>
  <option><flag contact="disable"/></option>
  <worldbody>
    <body>
      <joint name="a" axis="0 1 0" damping="0.1"/>
      <inertial pos="0 0 -0.5" mass="1" diaginertia="0.1 0.1 0.1"/>
      <body pos="0 0 -1">
        <joint name="b" axis="0 1 0" damping="0.1"/>
        <inertial pos="0 0 -0.5" mass="1" diaginertia="0.1 0.1 0.1"/>
        <site name="tip" pos="0 0 -1"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="a" joint="a"/><motor name="b" joint="b"/></actuator>
</mujoco>
"""


# -------------------- An arm with a light, damped finger: too fast for one step of RK4 in a usual stage.

FAST_FINGER = """
<mujoco><worldbody><body name="arm"><joint name="arm" axis="0 1 0"/>
  <inertial mass="1" pos="0 0 -0.5" diaginertia="0.1 0.1 0.1"/>
  <body name="finger" pos="0 0 -1"><joint name="finger" axis="0 1 0" damping="0.02" stiffness="0.5"/>
    <inertial mass="0.02" pos="0 0 -0.05" diaginertia="1e-5 1e-5 1e-5"/></body></body></worldbody>
  <actuator><motor joint="arm"/><position joint="finger" kp="1" kv="0.01"/></actuator></mujoco>
"""


# -------------------- A tool on two slides beside a wall, which blocks the straight path.

GANTRY = """<mujoco model="gantry">
  <option gravity="0 0 0"/>
  <worldbody>
    <body name="tool">
      <joint name="x" type="slide" axis="1 0 0" range="-2 2" damping="1"/>
      <joint name="z" type="slide" axis="0 0 1" range="-1 2" damping="1"/>
      <geom name="tool" {tool} mass="1"/>
    </body>
    <geom name="wall" {wall}/>
    {others}
  </worldbody>
  <actuator><motor name="x" joint="x" ctrlrange="-60 60"/><motor name="z" joint="z" ctrlrange="-60 60"/></actuator>
  <keyframe><key name="left" qpos="-0.5 0.1"/><key name="right" qpos="0.5 0.1"/></keyframe>
</mujoco>"""


def gantry(tool='type="sphere" size="0.05"', wall='type="box" size="0.05 0.5 0.3"', others=""):
    return GANTRY.format(tool=tool, wall=wall, others=others)


# -------------------- A dog of 10 kg in a plane: two legs of two joints each, balls for feet, default contacts.

DOG = """<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1"/>
    <body name="trunk" pos="0 0 .45">
      <joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide" axis="0 0 1"/>
      <joint name="pitch" axis="0 1 0"/>
      <geom type="capsule" fromto="-.3 0 0 .3 0 0" size=".06" mass="7"/>
      {legs}
    </body>
  </worldbody>
  <actuator>{motors}</actuator>
</mujoco>"""
DOG_LEG = """<body name="{name} thigh" pos="{x} 0 0">
  <joint name="{name} hip" axis="0 1 0" range="-60 60" damping="1"/>
  <geom type="capsule" fromto="0 0 0 -.1 0 -.17" size=".03" mass="1"/>
  <body name="{name} shank" pos="-.1 0 -.17">
    <joint name="{name} knee" axis="0 1 0" range="-80 40" damping="1"/>
    <geom type="capsule" fromto="0 0 0 .1 0 -.17" size=".02" mass=".4"/>
    <geom name="{name} foot" size=".035" pos=".1 0 -.17" mass=".1"/>
  </body>
</body>"""
DOG_MOTOR = '<motor joint="{}" ctrllimited="true" ctrlrange="-40 40"/>'


def dog() -> str:
    """The MJCF."""
    legs = "".join(DOG_LEG.format(name=name, x=x) for name, x in (("fore", 0.3), ("hind", -0.3)))
    names = [f"{name} {joint}" for name in ("fore", "hind") for joint in ("hip", "knee")]
    return DOG.format(legs=legs, motors="".join(DOG_MOTOR.format(name) for name in names))
