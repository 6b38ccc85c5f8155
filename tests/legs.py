"""A leg with a round foot on sliders, as MJCF: the MuJoCo study's machine for contact (its section 5)."""

import numpy as np
from trees import mujoco

from planner.model.mjcf.contacts import contact_attributes, stop_attributes

STIFFNESS, DAMPING, SLIP, FRICTION, RADIUS = 2e4, 100.0, 1000.0, 0.7, 0.03

LEG = """<mujoco><compiler angle="radian"/>
  <option timestep="1e-4" integrator="RK4" cone="elliptic" impratio="{impratio}" tolerance="1e-15" iterations="200">
    <flag refsafe="disable"/></option>
  <custom>{ramps}</custom>
  <worldbody><geom name="floor" type="plane" size="0 0 1" euler="{tilt}"/>
    <body name="trunk" pos="0 0 0.75"><joint name="x" type="slide" axis="1 0 0"/>
      <joint name="z" type="slide" axis="0 0 1"/>
      <geom type="box" size=".1 .08 .1" mass="8" contype="0" conaffinity="0"/>
      <body name="thigh"><joint name="hip" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 -.35" size=".03" mass="1.2" contype="0" conaffinity="0"/>
        <body name="shank" pos="0 0 -.35"><joint name="knee" axis="0 1 0" {stop}/>
          <geom type="capsule" fromto="0 0 0 0 0 -.35" size=".02" mass=".5" contype="0" conaffinity="0"/>
          <geom name="foot" type="sphere" pos="0 0 -.35" size="0.03" mass=".1"/></body></body></body></worldbody>
  <contact><pair geom1="floor" geom2="foot" {pair}/></contact>
  <actuator><motor name="hip" joint="hip"/><motor name="knee" joint="knee"/></actuator></mujoco>"""


def attributes(values):
    """Of an element."""
    return " ".join(f'{name}="{value}"' for name, value in values.items())


def leg(impratio=10.0, ramp=None, tilt=0.0, stop=None, **law):
    """The text of a leg whose foot touches by STIFFNESS and so on.

    Args:
        impratio: The model's.
        ramp: m, of the contact's smoothing.
        tilt: rad, of the floor, upwards along x.
        stop: (stiffness, damping, ramp) of the knee's, at -2 and -1.1.
        law: Other attributes of the pair.
    """
    parts = {"impratio": impratio, "tilt": f"0 {-tilt} 0", "ramps": "", "stop": "", "pair": ""}
    if ramp is not None:
        parts["ramps"] = f'<numeric name="contact_ramp" data="{ramp}"/>'
    bare = mujoco.MjModel.from_xml_string(LEG.format(**parts))
    weight = bare.body_invweight0[bare.body("shank").id, 0]
    pair = contact_attributes(STIFFNESS, DAMPING, SLIP, FRICTION, weight, impratio)
    parts["pair"] = attributes(pair | law)
    if stop is not None:
        joint = stop_attributes(stop[0], stop[1], bare.dof_invweight0[bare.joint("knee").dofadr[0]])
        parts["stop"] = attributes({"range": "-2 -1.1", **joint})
        parts["ramps"] += f'<numeric name="stop_ramp" data="{stop[2]}"/>'
    return LEG.format(**parts)


def standing(m, height=0.01, speed=0.5):
    """The state with a bent knee, the foot `height` above the floor, moving along x."""
    x = m.home
    x[2:4] = 0.5, -1.0
    x[1] = RADIUS + height - 0.75 + 0.35 * (np.cos(0.5) + np.cos(0.5 - 1.0))
    x[m.nq] = speed
    return x


def torques(x):
    """Of hip and knee (2,): a spring and damper towards the bent knee."""
    return np.array([-60.0 * (x[2] - 0.5) - 3.0 * x[6], -60.0 * (x[3] + 1.0) - 3.0 * x[7]])
