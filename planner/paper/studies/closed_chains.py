"""Closed chains (section 1.2): the tree's equations with algebraic constraints, against a closed form.

Two equal cranks carry a coupler that therefore does not turn: a parallelogram, whose one coordinate, the angle q of its
cranks from upright, has

    (2 (I + m c^2) + M l^2) qdd = tau + (2 m c + M l) g sin q

with the cranks' mass m, inertia I, length l and distance c of their centres of mass, and the coupler's mass M. The
paper names the constraints and gives no example.
"""

from __future__ import annotations

import numpy as np

from planner.dynamics import RigidBodyDynamics
from planner.dynamics.loops import misses
from planner.model.mechanism import Mechanism

CRANK, INERTIA, COUPLER, LENGTH, CENTRE = 1.0, 0.01, 2.0, 0.4, 0.2  # kg, kg m^2, kg, m, m
SECONDS = 10.0  # how long a chain swings
STATES = 50

_CRANK = f'<inertial pos="0 0 {CENTRE}" mass="{CRANK}" diaginertia="{INERTIA} {INERTIA} {INERTIA}"/>'
PARALLELOGRAM = f"""
<mujoco><worldbody>
  <body name="left"><joint name="left" axis="0 1 0"/>{_CRANK}
    <body name="coupler" pos="0 0 {LENGTH}"><joint name="coupler" axis="0 1 0"/>
      <inertial pos=".3 0 0" mass="{COUPLER}" diaginertia=".05 .05 .05"/></body></body>
  <body name="right" pos=".6 0 0"><joint name="right" axis="0 1 0"/>{_CRANK}</body>
</worldbody><equality><connect body1="coupler" body2="right" anchor=".6 0 0"/></equality>
<actuator><motor joint="left"/></actuator></mujoco>
"""


def closed_form_error() -> float:
    """The largest relative difference of accelerations from the closed form, at random states."""
    m, rng = Mechanism.from_mjcf(PARALLELOGRAM), np.random.default_rng(0)
    q, qd, tau = rng.uniform(-1.4, 1.4, STATES), rng.normal(size=STATES), rng.normal(size=STATES)
    signs = np.array([1.0, -1.0, 1.0])
    xs = np.hstack([q[:, None] * signs, qd[:, None] * signs])
    found = RigidBodyDynamics(m, 0.01).rates(xs, tau[:, None])[:, 3:6]
    inertia = 2.0 * (INERTIA + CRANK * CENTRE**2) + COUPLER * LENGTH**2
    qdd = (tau + (2.0 * CRANK * CENTRE + COUPLER * LENGTH) * 9.81 * np.sin(q)) / inertia
    return float(np.abs(found - qdd[:, None] * signs).max() / np.abs(qdd).max())


def drift() -> float:
    """How far the pin opens, m, while the parallelogram swings for SECONDS, by RK4 at 2 ms."""
    m = Mechanism.from_mjcf(PARALLELOGRAM)
    dynamics, x, most = RigidBodyDynamics(m, 0.002), np.array([2.2, -2.2, 2.2, 0.0, 0.0, 0.0]), 0.0
    for _ in range(round(SECONDS / dynamics.dt)):
        x = dynamics.step(x[None], np.zeros((1, 1)))[0]
        most = max(most, float(np.abs(misses(m, x[:3])).max()))
    return most
