"""Machines some of whose joints are given their acceleration, and problems about them."""

from contact_machines import attributes
from trees import mujoco

from planner import Mechanism, Problem, RigidBodyDynamics, TrackingCost
from planner.dynamics.contacts import contact_forces
from planner.model.mjcf.contacts import contact_attributes, stop_attributes

# A double pendulum hangs on a cart that is moved; its second joint has a motor. What acts on the cart does nothing.
CART = """
<mujoco model="moved cart">
  <compiler autolimits="true"/>
  <option gravity="0 0 -9.81"><flag contact="disable"/></option>
  <default><motor ctrlrange="-50 50" gear="3"/><joint damping="0.02"/></default>
  <worldbody><body name="cart">
    <joint name="cart" type="slide" axis="1 0 0" range="-0.1 0.1" stiffness="40" frictionloss="0" armature="0.3"/>
    <inertial pos="0 0 0" mass="1" diaginertia="0.1 0.1 0.1"/>
    <body name="upper"><joint name="hip" axis="0 1 0"/>
      <inertial pos="0 0 -0.2" mass="0.6" diaginertia="0.01 0.01 0.001"/>
      <body name="lower" pos="0 0 -0.4"><joint name="knee" axis="0 1 0" stiffness="0.3"/>
        <inertial pos="0 0 -0.2" mass="0.4" diaginertia="0.008 0.008 0.001"/></body></body></body></worldbody>
  <actuator><position name="servo" joint="cart" kp="500" ctrlrange="-1 1"/><motor name="motor" joint="knee"/></actuator>
  <keyframe><key name="hanging" qpos="0 0 0" ctrl="0.1 0.2"/></keyframe>
</mujoco>
"""


def moved_cart(N=120, dt=0.01, integrator="rk4"):
    """The cart goes 0.5 m and what hangs on it comes to rest."""
    dynamics = RigidBodyDynamics(Mechanism.from_mjcf(CART), dt, integrator, prescribed=("cart",))
    goal = [0.5, 0.0, 0.0, 0.0, 0.0, 0.0]
    cost = TrackingCost.joints(dynamics, goal, N, effort=0.01, final_position=200.0, final_velocity=50.0)
    return Problem(dynamics, cost, dynamics.mechanism.home)


# A leg of three joints under a pelvis that moves in six ways, with a knee stop, over a belt.
PELVIS = ("pelvis_x", "pelvis_y", "pelvis_z", "pelvis_tilt", "pelvis_list", "pelvis_rotation")
STIFFNESS, DAMPING, SLIP, FRICTION, STOP = 5e3, 60.0, 150.0, 0.6, (1000.0, 10.0)
LEG = """
<mujoco model="hanging leg"><compiler angle="radian"/>
  <option timestep="5e-4" integrator="RK4" cone="elliptic" impratio="{impratio}"><flag refsafe="disable"/></option>
  <custom><numeric name="contact_ramp" data="0.005 5"/><numeric name="stop_ramp" data="0.003 0.1"/></custom>
  <worldbody>
    <body name="belt"><inertial pos="0 0 0" mass="1e5" diaginertia="1e5 1e5 1e5"/>
      <joint name="belt" type="slide" axis="1 0 0"/>
      <geom name="belt" type="box" size="60 1 .1" pos="0 0 -.1" contype="0" conaffinity="0"/></body>
    <body name="pelvis" pos="0 0 0.9"><inertial pos="0 0 .15" mass="45" diaginertia="1.5 1.5 .6"/>
      <joint name="pelvis_x" type="slide" axis="1 0 0"/><joint name="pelvis_y" type="slide" axis="0 1 0"/>
      <joint name="pelvis_z" type="slide" axis="0 0 1"/><joint name="pelvis_tilt" axis="0 -1 0"/>
      <joint name="pelvis_list" axis="1 0 0"/><joint name="pelvis_rotation" axis="0 0 1"/>
      <body name="thigh" pos="0 -0.1 0"><inertial pos="0 0 -.18" mass="7" diaginertia=".12 .12 .03"/>
        <joint name="hip" axis="0 -1 0" stiffness="10" damping="1"/>
        <body name="shank" pos="0 0 -.42"><inertial pos="0 0 -.18" mass="3.3" diaginertia=".05 .05 .006"/>
          <joint name="knee" axis="0 -1 0" damping="1" {stop}/>
          <body name="foot" pos="0 0 -.42"><inertial pos=".06 0 -.04" mass="1" diaginertia=".001 .004 .004"/>
            <joint name="ankle" axis="0 -1 0" stiffness="30" damping="0.5"/>
            <geom name="heel" type="sphere" pos="-.05 0 -.05" size=".005" contype="0" conaffinity="0"/>
            <geom name="toe" type="sphere" pos=".15 0 -.05" size=".005" contype="0" conaffinity="0"/>
          </body></body></body></body></worldbody>
  <contact><pair geom1="belt" geom2="heel" {pair}/><pair geom1="belt" geom2="toe" {pair}/></contact>
</mujoco>
"""


def hanging_leg(impratio=1000.0):
    """The text of the leg, whose contacts and stop have the coefficients above."""
    bare = mujoco.MjModel.from_xml_string(LEG.format(stop="", pair="", impratio=impratio))
    weight = bare.body_invweight0[[bare.body("foot").id, bare.body("belt").id], 0].sum()
    knee = stop_attributes(*STOP, bare.dof_invweight0[bare.joint("knee").dofadr[0]])
    pair = contact_attributes(STIFFNESS, DAMPING, SLIP, FRICTION, weight, impratio)
    return LEG.format(stop=attributes({"range": "-2 0.05", **knee}), pair=attributes(pair), impratio=impratio)


def standing_leg(depth=0.004):
    """The leg's mechanism and a state in which its sole presses on the belt."""
    m = Mechanism.from_mjcf(hanging_leg())
    x = m.home
    x[[7, 8, 9]] = 0.2, -0.3, 0.1  # the sole is level
    x[3] += contact_forces(m, x[: m.nq], x[m.nq :]).depths[0] - depth
    return m, x


def walking_leg(N=80, dt=0.005, speed=0.8):
    """The belt carries the foot backwards, and the pelvis lifts the leg and swings it forward."""
    m, x0 = standing_leg()
    dynamics = RigidBodyDynamics(m, dt, prescribed=PELVIS)
    x0[m.nq] = -speed
    goal = x0.copy()
    goal[[7, 8, 9]], goal[m.nq + 1 :] = [0.3, -0.1, 0.0], 0.0
    weight = {"hip": 500.0, "knee": 500.0, **dict.fromkeys(PELVIS, 100.0)}
    cost = TrackingCost.joints(
        dynamics, goal, N, effort=0.02, final_position=weight, position=dict.fromkeys(PELVIS, 20.0)
    )
    return Problem(dynamics, cost, x0)
