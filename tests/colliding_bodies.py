"""Two bodies that meet, as MJCF: what falls freely onto a raft on springs, with shapes to choose.

The raft's middle moves: MuJoCo's forces are the law's but for 1e-4 A/w (friction: times impratio), with A the inverse
inertia that a contact feels and w the constant invweight0, which knows of no turning: so the bodies turn heavily.
"""

import numpy as np
from legs import attributes
from trees import mujoco

from planner.model.mjcf.contacts import contact_attributes

STIFFNESS, DAMPING, SLIP, FRICTION = 2e4, 100.0, 1000.0, 0.7

SPHERE, LONG = 'type="sphere" size=".05"', 'type="capsule" fromto="-.15 -.02 0 .15 .02 .01" size=".05"'
RAFT = 'type="capsule" fromto="-.1 -.2 0 .1 .2 0" size=".04"'
PAIRS = {"spheres": (SPHERE, 'type="sphere" size=".1"'), "sphere on capsule": (SPHERE, RAFT),
         "capsules": (LONG, RAFT)}  # fmt: skip

TEXT = """<mujoco>
  <option timestep="1e-4" integrator="RK4" cone="elliptic" impratio="{impratio}" tolerance="1e-15" iterations="200">
    <flag refsafe="disable"/></option>
  <custom>{ramp}</custom>
  <worldbody><body name="raft" pos="0 0 .5">
      <joint type="slide" axis="1 0 0" stiffness="500" damping="5"/>
      <joint type="slide" axis="0 1 0" stiffness="500" damping="5"/>
      <joint type="slide" axis="0 0 1" stiffness="2000" damping="5"/>
      <joint name="tilt" type="ball" stiffness="40" damping=".2"/>
      <inertial pos="0 0 0" mass="4" diaginertia=".08 .09 .1"/><geom name="raft" {second}/></body>
    <body name="log" pos="0.01 .02 {height}"><freejoint/>
      <inertial pos="0 0 0" mass="2" diaginertia=".04 .05 .06"/><geom name="log" {first}/></body></worldbody>
  <contact><pair geom1="log" geom2="raft" {pair}/></contact>
  <actuator><motor joint="tilt" gear="1 0 0"/></actuator></mujoco>"""


def meeting(name, impratio=10.0, ramp=None, height=0.65, **law):
    """The text of what falls on a raft: spheres, a sphere on a capsule, or capsules."""
    first, second = PAIRS[name]
    numeric = "" if ramp is None else f'<numeric name="contact_ramp" data="{ramp}"/>'
    parts = {"impratio": impratio, "ramp": numeric, "first": first, "second": second, "height": height, "pair": ""}
    bare = mujoco.MjModel.from_xml_string(TEXT.format(**parts))
    weight = float(np.sum(bare.body_invweight0[[1, 2], 0]))
    pair = contact_attributes(STIFFNESS, DAMPING, SLIP, FRICTION, weight, impratio)
    return TEXT.format(**parts | {"pair": attributes(pair | law)})
