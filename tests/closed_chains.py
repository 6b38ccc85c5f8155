"""Closed chains for tests: a four-bar, a parallelogram in closed form, and random trees with loops and cams."""

from dataclasses import replace

import numpy as np

from planner import Mechanism
from planner.model.couplings import LoopClosure, PolynomialCoupling
from planner.model.mechanism import SCREW
from planner.model.space import exp_quaternion
from tests.trees import actuated

FOUR_BAR = """
<mujoco><worldbody>
  <body name="crank"><joint name="crank" axis="0 1 0" damping="{damping}"/>
    <geom type="capsule" fromto="0 0 0 0 0 .3" size=".02" mass="1"/>
    <body name="coupler" pos="0 0 .3"><joint name="coupler" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 .5 0 .1" size=".02" mass=".7"/></body></body>
  <body name="rocker" pos=".6 0 0"><joint name="rocker" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 -.1 0 .4" size=".02" mass=".5"/></body>
</worldbody>
<contact><exclude body1="crank" body2="rocker"/><exclude body1="coupler" body2="rocker"/></contact>
<equality><connect name="pin" body1="coupler" body2="rocker" anchor=".5 0 .1"/></equality>
<actuator><motor name="motor" joint="crank"/></actuator></mujoco>
"""

# Two cranks of 0.4 m and 1 kg, their masses at their middles, carry a coupler of 2 kg that cannot turn.
PARALLELOGRAM = """
<mujoco><worldbody>
  <body name="left"><joint name="left" axis="0 1 0"/><inertial pos="0 0 .2" mass="1" diaginertia=".01 .01 .01"/>
    <body name="coupler" pos="0 0 .4"><joint name="coupler" axis="0 1 0"/>
      <inertial pos=".3 0 0" mass="2" diaginertia=".05 .05 .05"/></body></body>
  <body name="right" pos=".6 0 0"><joint name="right" axis="0 1 0"/>
    <inertial pos="0 0 .2" mass="1" diaginertia=".01 .01 .01"/></body>
</worldbody>
<equality><connect name="pin" body1="coupler" body2="right" anchor=".6 0 0"/></equality>
<actuator><motor name="motor" joint="left"/></actuator></mujoco>
"""


def parallelogram_acceleration(q, torque, gravity=9.81):
    """Of the cranks at the angle q from upright: inertia 2 (.01 + .2^2) + 2 .4^2, all masses rise with cos q."""
    inertia = 2.0 * (0.01 + 1.0 * 0.2**2) + 2.0 * 0.4**2
    lever = 2.0 * 1.0 * 0.2 + 2.0 * 0.4
    return (torque + lever * gravity * np.sin(q)) / inertia


def four_bar(damping=0.1):
    return Mechanism.from_mjcf(FOUR_BAR.format(damping=damping))


def random_chain(text, rng, loops=2, polynomial_couplings=1):
    """A random tree with actuators whose links, or links and the world, are held together at random."""
    m = Mechanism.from_mjcf(actuated(text, rng))
    carriers = sorted({body.link for body in m.bodies})
    closed = []
    for k in range(loops if len(carriers) > 1 else 0):
        first, second = rng.permutation(carriers)[:2]
        frames = np.tile(np.eye(4), (2, 1, 1))
        frames[:, :3, 3] = 0.3 * rng.normal(size=(2, 3))
        frames[:, :3, :3] = [rotation(rng) for _ in range(2)]
        closed.append(LoopClosure(f"equality {k}", (int(first), int(second)), frames, bool(rng.random() < 0.4)))
    screws = np.array([i for i in np.flatnonzero(m.kind == SCREW) if not _of_free(m, i)])
    following = []
    if len(screws) > 1:
        for k in range(polynomial_couplings):
            follower, leader = map(int, rng.permutation(screws)[:2])
            numbers = tuple(0.3 * rng.normal(size=5))
            following.append(PolynomialCoupling(f"cam {k}", follower, leader, tuple(0.3 * rng.normal(size=2)), numbers))
    return replace(m, loops=tuple(closed), polynomial_couplings=tuple(following))


def _of_free(m, i):
    return any(links.stop - links.start == 6 and links.start <= i < links.stop for links in m.joint_links)


def rotation(rng):
    """A random rotation (3, 3)."""
    from planner.dynamics.product_of_exponentials import rotation as of_quaternion

    return of_quaternion(exp_quaternion(rng.normal(size=3)))
