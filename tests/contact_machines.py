"""Machines with contacts as MJCF, contact laws, and states on both sides of each of their corners."""

import numpy as np
import pytest
from gradients import assert_step_derivatives_near_kinks
from trees import CHAINS, Body, mujoco, relative_error, tree_xml

from planner.dynamics import RigidBodyDynamics, product_of_exponentials
from planner.dynamics.contacts import generalized_forces
from planner.model.contact.laws import ContactLaw
from planner.model.mjcf.contacts import contact_attributes, stop_attributes

# -------------------- A leg with a round foot on sliders: the MuJoCo study's machine for contact (its section 5).

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


# -------------------- Two bodies that meet, as MJCF: what falls freely onto a raft on springs, with shapes to choose.

# The raft's middle moves: MuJoCo's forces are the law's but for 1e-4 A/w (friction: times impratio), with A the inverse
# inertia that a contact feels and w the constant invweight0, which knows of no turning: so the bodies turn heavily.

SPHERE, LONG = 'type="sphere" size=".05"', 'type="capsule" fromto="-.15 -.02 0 .15 .02 .01" size=".05"'
RAFT = 'type="capsule" fromto="-.1 -.2 0 .1 .2 0" size=".04"'
PAIRS = {"spheres": (SPHERE, 'type="sphere" size=".1"'), "sphere on capsule": (SPHERE, RAFT),
         "capsules": (LONG, RAFT)}  # fmt: skip

RAFT_TEXT = """<mujoco>
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
    bare = mujoco.MjModel.from_xml_string(RAFT_TEXT.format(**parts))
    weight = float(np.sum(bare.body_invweight0[[1, 2], 0]))
    pair = contact_attributes(STIFFNESS, DAMPING, SLIP, FRICTION, weight, impratio)
    return RAFT_TEXT.format(**parts | {"pair": attributes(pair | law)})


# -------------------- Contact laws and states on both sides of each of their corners.

# The step study's recommended contact (its section 1), and the unsmoothed one with MuJoCo's projection.
SOFT = ContactLaw(stiffness=5e3, damping=60.0, ramp=5e-3, force_ramp=5.0, slip_damping=150.0, friction=0.6)


SHARP = ContactLaw.exact(5e3, 60.0, 150.0, 0.6, impratio=10.0)


BELT = [Body(-1, ("slide",)), Body(-1, ("free",)), Body(1, ("hinge", "ball"))]


MACHINES = {**CHAINS, "body over a belt": tree_xml(BELT, np.random.default_rng(5))}


each_touch = pytest.mark.parametrize("touch", [SOFT, SHARP], ids=["smooth", "sharp"])


def law_states(touch, rng):
    """Penetrations and velocities on both sides of each end of the ramps, opening, closing, sticking and slipping."""
    a = touch.ramp or 5e-3
    depths = a * np.array([-0.5, -0.01, 0.01, 0.1, 0.5, 0.99, 1.01, 2.0, 10.0])
    openings = [-0.3, 0.0, 0.02, 2.0]
    slides = [(0.0, 0.0), (1e-4, 2e-4), (0.05, -0.02), (3.0, 1.0)]
    e, v = [], []
    for depth in depths:
        for opening in openings:
            for x, y in slides:
                e.append(depth)
                v.append([x, y, opening])
    return np.array(e), np.array(v) + rng.normal(size=(len(v), 3)) * 1e-6


def moved(m, q, direction):
    """q moved along the group by direction (nv,)."""
    x = np.concatenate([q, np.zeros(m.nv + m.na)])
    return m.space.integrate(x[None], np.concatenate([direction, np.zeros(m.nv + m.na)])[None])[0, : m.nq]


def assert_contacts_act(bare, m, x, us):
    """Accelerations of `bare` dynamics with the contacts of m beside NumPy's, and the derivatives of an Euler step."""
    q, qd, rates = x[: m.nq], x[m.nq : m.nq + m.nv], slice(m.nv, 2 * m.nv)
    dynamics, free = RigidBodyDynamics(m, 1.0, "euler", bare.prescribed), np.ones(m.nv, dtype=bool)
    for name in bare.prescribed:
        free[m.joint(name)] = False
    # M_ff dqdd_f = tau_f: what the contacts' forces add to the accelerations
    M, tau, more = product_of_exponentials.mass_matrix(m, q), generalized_forces(m, q, qd), np.zeros(m.nv)
    more[free] = np.linalg.solve(M[np.ix_(free, free)], tau[free])
    acceleration, without = (one.rates(x[None], us)[0, rates] for one in (dynamics, bare))
    assert relative_error(acceleration, without + more) < 1e-9
    assert_step_derivatives_near_kinks(dynamics, x, us)
