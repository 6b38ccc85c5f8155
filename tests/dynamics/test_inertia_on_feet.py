"""The inertia that a joint moves while the feet stay on the ground."""

import numpy as np
import pytest

import planner
from planner.dynamics.statics import stance_inertia
from planner.model.mechanism import Mechanism
from planner.problem.default_weights import MAX_CORRECTION_RATE, STANCE_TOLERANCES, default_weights
from planner.problem.goals import MIN_TOLERANCES

BODY, FOOT, HEIGHT = 10.0, 0.5, 0.8  # kg, kg, m from the ankle to the centre of the body
SIZE = 0.02  # m, radius of the body: its own inertia is that of a ball
ROD = (
    '<mujoco><worldbody><geom name="floor" type="plane" size="0 0 1"/><body pos="0 0 .9"><joint name="x" type="slide" '
    'axis="1 0 0"/><joint name="z" type="slide" axis="0 0 1"/><joint name="tilt" axis="0 1 0"/>'
    f'<geom size="{SIZE}" mass="{BODY}"/><body pos="0 0 -{HEIGHT}"><joint name="ankle" axis="0 1 0"/>'
    f'<geom name="foot" type="box" size=".1 .1 .05" pos="0 0 -.05" mass="{FOOT}"/></body></body></worldbody>'
    '<actuator><motor joint="ankle" ctrlrange="-200 200"/></actuator></mujoco>'
)


def standing():
    m = Mechanism.from_mjcf(ROD, contacts=planner.contact.ContactLaw.resting(10.5))
    return m, planner.dynamics.static_equilibrium(m, m.home)


def test_an_ankle_moves_what_stands_on_it():
    """A foot that is held: the body turns about the ankle, m h^2 + 2/5 m r^2."""
    m, x = standing()
    ankle = m.joint("ankle").start
    about = BODY * HEIGHT**2 + 0.4 * BODY * SIZE**2
    assert stance_inertia(m, x[: m.nq])[ankle] == pytest.approx(about, rel=1e-9)


def test_by_a_small_push():
    """The same as 1 / acceleration of the constrained machine under a unit torque, solved with multipliers."""
    m, x = standing()
    q, still = x[: m.nq], np.zeros(m.nv)
    carry = np.flatnonzero(planner.dynamics.contact_forces(m, q, still).forces.any(axis=1))
    J = np.vstack([planner.dynamics.contacts.contact_jacobians(m, q, carry)]).reshape(-1, m.nv)
    M = planner.dynamics.mass_matrix(m, q)
    saddle = np.block([[M, J.T], [J, np.zeros((len(J), len(J)))]])
    for i in np.flatnonzero(stance_inertia(m, q)):
        push = np.concatenate([np.eye(m.nv)[i], np.zeros(len(J))])
        moved = np.linalg.lstsq(saddle, push, rcond=1e-10)[0][i]
        assert stance_inertia(m, q)[i] == pytest.approx(1.0 / moved, rel=1e-6)


def test_in_the_air_nothing_is_carried():
    m, x = standing()
    x[1] += 0.5
    np.testing.assert_array_equal(stance_inertia(m, x[: m.nq]), np.zeros(m.nv))


def test_an_ankle_may_push_as_what_it_carries_asks():
    """Its effort is weighed by the body above it, not by the foot below: or hips alone would balance a machine."""
    m, x = standing()
    dynamics = planner.RigidBodyDynamics(m, dt=0.01)
    goal = x.copy()
    goal[m.joint("ankle").start] += 0.4
    goal[m.joint("tilt").start] -= 0.4
    goal[1] -= HEIGHT * (1.0 - np.cos(0.4))  # the foot stays flat on the ground
    weights = default_weights(dynamics, x, goal, 1.0)
    carried = (
        stance_inertia(m, goal[: m.nq])[m.joint("ankle").start]
        * MAX_CORRECTION_RATE**2
        * STANCE_TOLERANCES
        * MIN_TOLERANCES["rad"]
    )
    alone = (
        planner.dynamics.mass_matrix(m, goal[: m.nq])[-1, -1]
        * MAX_CORRECTION_RATE**2
        * STANCE_TOLERANCES
        * MIN_TOLERANCES["rad"]
    )
    limit = 1.0 / np.sqrt(weights.weights["effort"][0])
    assert alone < limit <= carried * (1.0 + 1e-9)
