"""Machines with actuators at sites, and random states of them."""

import numpy as np

# A quadrotor of 0.6 kg with arms of 0.12 m: a rotor's torque is 16 mm times its thrust, hover takes 1.47 N each.
QUADROTOR = """
<mujoco model="quadrotor">
  <option timestep="0.005" integrator="RK4"/>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1"/>
    <body name="frame" pos="0 0 0.5">
      <freejoint name="base"/>
      <inertial pos="0 0 0" mass="0.6" diaginertia="3e-3 3e-3 5e-3"/>
      <geom name="hull" type="box" size="0.09 0.09 0.02"/>
      <site name="front" pos="0.085 0.085 0.01"/>
      <site name="left" pos="-0.085 0.085 0.01"/>
      <site name="back" pos="-0.085 -0.085 0.01"/>
      <site name="right" pos="0.085 -0.085 0.01"/>
    </body>
  </worldbody>
  <actuator>
    <motor name="front" site="front" gear="0 0 1 0 0 0.016" ctrlrange="0 4"/>
    <motor name="left" site="left" gear="0 0 1 0 0 -0.016" ctrlrange="0 4"/>
    <motor name="back" site="back" gear="0 0 1 0 0 0.016" ctrlrange="0 4"/>
    <motor name="right" site="right" gear="0 0 1 0 0 -0.016" ctrlrange="0 4"/>
  </actuator>
</mujoco>
"""

# Every way to act at a site: on a body with one joint, with several, with a ball and on a floating one; from the
# world, from another tree and from a body of the same tree, before and behind it; in the axes of what carries a ball or
# free joint; by the control and by activations.
EVERY_WAY = """
<mujoco model="every way">
  <compiler angle="radian"/>
  <option gravity="0.4 -0.3 -9.81"/>
  <worldbody>
    <site name="anchor" pos="0.3 -0.2 0.9" euler="0.3 -0.5 0.7"/>
    <body name="upper" pos="0.1 0.2 1">
      <joint name="shoulder" axis="0 1 0.2" pos="0.01 0 0.02"/>
      <joint name="rail" type="slide" axis="1 0.3 0"/>
      <inertial pos="0.02 0.1 -0.1" mass="1.3" diaginertia="0.02 0.03 0.04"/>
      <site name="elbow" pos="0.1 0.02 -0.2" euler="0.2 0.4 -0.3"/>
      <body name="lower" pos="0 0.1 -0.3">
        <joint name="wrist" type="ball" pos="0 0.01 0.02" damping="0.1"/>
        <inertial pos="0.03 0 -0.1" mass="0.7" diaginertia="0.01 0.008 0.006"/>
        <site name="tip" pos="0.05 -0.04 -0.25" euler="-0.6 0.1 0.5"/>
        <body name="tool" pos="0 0 -0.3" euler="0.1 0 0">
          <joint name="twist" axis="0 0 1"/>
          <inertial pos="0 0 -0.05" mass="0.3" diaginertia="0.003 0.004 0.002"/>
          <site name="end" pos="0.02 0 -0.1"/>
        </body>
      </body>
      <body name="side" pos="0.2 0 0">
        <joint name="swivel" axis="1 0 0"/>
        <inertial pos="0.05 0 0" mass="0.4" diaginertia="0.004 0.004 0.004"/>
        <site name="beside" pos="0.1 0.03 0" euler="0 0.7 0"/>
      </body>
    </body>
    <body name="drone" pos="0 0.5 0.4">
      <freejoint name="base"/>
      <inertial pos="0.01 0 0.02" mass="0.9" diaginertia="0.01 0.012 0.015"/>
      <site name="rotor" pos="0.1 0.1 0.03" euler="0.2 -0.1 0.4"/>
      <body name="arm" pos="0 0 -0.1">
        <joint name="hip" axis="0 1 0"/>
        <inertial pos="0 0 -0.1" mass="0.2" diaginertia="0.002 0.002 0.001"/>
        <site name="foot" pos="0 0.02 -0.2"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor site="elbow" gear="1 2 -1 0.3 0.1 0.2"/>
    <motor site="tip" gear="0.5 -1 2 0.1 0.4 -0.2"/>
    <motor site="rotor" gear="0 0 1 0 0 0.05"/>
    <motor site="foot" gear="1 0.2 0.1 0 0.1 0"/>
    <motor site="tip" refsite="anchor" gear="1 -0.5 0.3 0.2 0.1 -0.3"/>
    <motor site="anchor" refsite="foot" gear="0.3 1 0.2 0.1 -0.2 0.3"/>
    <motor site="end" refsite="elbow" gear="1 0.4 -0.6 0.2 0.3 0.1"/>
    <motor site="elbow" refsite="end" gear="-0.3 0.4 0.6 0.1 0.3 0.2"/>
    <motor site="beside" refsite="tip" gear="0.7 0.1 -0.2 0.3 0.2 -0.1"/>
    <motor site="foot" refsite="tip" gear="0.2 0.5 0.4 -0.1 0.2 0.3"/>
    <motor joint="hip" gear="3"/>
    <motor jointinparent="wrist" gear="0.3 0.5 -0.2"/>
    <motor jointinparent="base" gear="0.3 0.1 0.4 0.2 -0.1 0.3"/>
    <motor joint="wrist" gear="0.1 0.2 0.3"/>
    <general site="end" dyntype="filter" dynprm="0.08" gainprm="2" gear="0.5 1 0 0 0.2 0.1"/>
    <general site="rotor" dyntype="integrator" gainprm="1.5" biastype="affine" biasprm="0.7 0 0"
             gear="0.1 0.2 1 0.02 0 0"/>
  </actuator>
</mujoco>
"""


def random_states(mechanism, rng, count):
    """States (count, nx) with joints within about 1 rad, and controls (count, nu)."""
    dx = rng.normal(scale=0.6, size=(count, mechanism.space.ndx))
    xs = np.array([mechanism.space.integrate(mechanism.home, one) for one in dx])
    return xs, rng.normal(scale=2.0, size=(count, mechanism.nu))
