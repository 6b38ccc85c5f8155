"""Poses at rest that a small push tips: point feet and two wheels; and machines with thrusters, which are off there."""

import numpy as np
import pytest
from thrusters import EVERY_WAY, QUADROTOR

from planner.base.errors import PlannerError
from planner.dynamics.algorithms import bias
from planner.dynamics.contacts import contact_forces, generalized_forces
from planner.dynamics.kinematics import center_of_mass
from planner.dynamics.quasi_static import carried_by_thrusters
from planner.dynamics.resting_poses import MAX_LEAN, saddle_of_energy
from planner.dynamics.statics import KEPT, clearance, lowered_to_ground, static_equilibrium, stays_in_air
from planner.model.capabilities import Capabilities, thrusters, unactuated_basis
from planner.model.contact.laws import ContactLaw
from planner.model.mechanism import Mechanism

# A trunk on two slides and a hinge, and a driven hip, which bears a leg on one ball.
POINT_FOOT = """<mujoco><worldbody><geom name="floor" type="plane" size="0 0 1"/><body name="trunk" pos="0 0 .7">
  <joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide" axis="0 0 1"/>
  <joint name="tilt" axis="0 1 0"/><inertial pos="0 0 .1" mass="6" diaginertia=".2 .2 .2"/>
  <body name="leg"><joint name="hip" axis="0 1 0"/><inertial pos="0 0 -.3" mass="1" diaginertia=".02 .02 .02"/>
    <geom size=".03" pos="0 0 -.6" mass="0"/></body></body></worldbody>
  <actuator><motor joint="hip"/></actuator></mujoco>"""
HIP, TILT, MASS, G = 3, 2, 7.0, 9.81


def point_foot(text=POINT_FOOT):
    return Mechanism.from_mjcf(text, contacts=ContactLaw.resting(MASS))


def missing(m, x, ways):
    """The force (n,) that is missing in the directions of ways (nv, n) at rest."""
    q, still = x[: m.nq], np.zeros(m.nv)
    return (bias(m, q, still) - generalized_forces(m, q, still)) @ ways


@pytest.mark.parametrize("hip", [0.05, -0.15, 0.25])
def test_a_machine_on_a_point_foot_is_put_where_it_balances(hip):
    """The one foot bears the weight below the centre of mass; a fall from there goes either way."""
    m = point_foot()
    x = static_equilibrium(m, np.array([0.3, 0.2, 0.0, hip]))
    assert x[HIP] == hip
    assert x[0] == pytest.approx(0.3, abs=1e-12)
    assert 0.01 < abs(x[TILT]) < MAX_LEAN
    ground = contact_forces(m, x[: m.nq], np.zeros(m.nv))
    assert ground.forces[0, 2] == pytest.approx(MASS * G, rel=1e-8)
    assert ground.points[0, 0] == pytest.approx(center_of_mass(m, x[: m.nq])[0], abs=1e-9)
    tips = [missing(m, x + push * np.eye(m.space.nx)[TILT], np.eye(m.nv)[:, TILT]) for push in (1e-3, -1e-3)]
    assert tips[0] < 0.0 < tips[1]


def test_not_where_that_is_another_pose_or_not_what_was_asked():
    m = point_foot()
    with pytest.raises(PlannerError, match="does not stay on the ground"):
        static_equilibrium(m, np.array([0.0, 0.0, 0.0, 1.2]))  # would lean by more than MAX_LEAN
    asked = np.array([0.0, 0.0, 0.0, 0.25])
    leans = static_equilibrium(m, asked)
    tilt = np.arange(m.nv) == TILT
    with pytest.raises(PlannerError, match="does not stay on the ground"):
        static_equilibrium(m, asked, tilt)
    near = asked + np.eye(4)[TILT] * (leans[TILT] + 0.5 * KEPT)
    np.testing.assert_allclose(static_equilibrium(m, near, tilt)[1:4], leans[1:4], atol=1e-9)


def test_not_on_the_edge_of_a_foot_that_carries_an_area():
    """Beyond its toe a machine on a flat foot falls; that it could balance on the toe is no pose that was asked for."""
    toe, heel = (f'<geom size=".03" pos="{x} 0 -.6" mass="0"/>' for x in (0.05, -0.05))
    flat = POINT_FOOT.replace('<geom size=".03" pos="0 0 -.6" mass="0"/>', toe + heel)
    m = point_foot(flat.replace('pos="0 0 .1"', 'pos=".1 0 .1"'))
    x = lowered_to_ground(m, m.home)
    assert contact_forces(m, x[: m.nq], np.zeros(m.nv)).forces[:, 2].min() > 60.0
    assert 0.06 < center_of_mass(m, x[: m.nq])[0] < 0.1
    assert not saddle_of_energy(m, x, unactuated_basis(m))[1]
    with pytest.raises(PlannerError, match="does not stay on the ground"):
        static_equilibrium(m, x)
    for hip in (-0.3, -0.2, -0.1, 0.1):  # the foot is tilted from the beginning, and one end of it bears all
        with pytest.raises(PlannerError, match="does not stay on the ground"):
            static_equilibrium(m, [0.0, 0.2, 0.0, hip])


def test_the_upper_end_of_a_leg_is_no_part_of_its_sole():
    """A leg drawn as a capsule has a contact at either end, and stands on the lower one."""
    foot = '<geom size=".03" pos="0 0 -.6" mass="0"/>'
    leg = '<geom type="capsule" size=".03" fromto="0 0 -.6 0 0 -.1" mass="0"/>'
    m, x = point_foot(POINT_FOOT.replace(foot, leg)), np.array([0.0, 0.2, 0.0, 0.1])
    assert len(m.contacts) == 2
    np.testing.assert_allclose(
        static_equilibrium(m, x)[1:4], static_equilibrium(point_foot(POINT_FOOT), x)[1:4], atol=1e-3
    )


def test_a_machine_on_two_wheels_is_put_where_it_balances():
    """A bent trunk leans until its centre of mass is above the wheels, which are driven and roll with it."""
    m = Mechanism.from_mjcf(
        """<mujoco><worldbody><geom name="floor" type="plane" size="0 0 1"/><body pos="0 0 .2"><freejoint name="base"/>
          <inertial pos="0 0 .3" mass="8" diaginertia=".2 .2 .1"/>
          <body pos="0 0 .5"><joint name="waist" axis="0 1 0"/><inertial pos="0 0 .2" mass="4" diaginertia=".1 .1 .1"/>
          </body><body pos="0 .2 0"><joint name="left" axis="0 1 0"/><geom size=".1" mass="1"/></body>
          <body pos="0 -.2 0"><joint name="right" axis="0 1 0"/><geom size=".1" mass="1"/></body></body></worldbody>
          <actuator><motor joint="waist"/><motor joint="left"/><motor joint="right"/></actuator></mujoco>""",
        contacts=ContactLaw.resting(14.0),
    )
    x = m.home.copy()
    x[7] = 0.4
    there = static_equilibrium(m, x)
    ground = contact_forces(m, there[: m.nq], np.zeros(m.nv))
    assert ground.forces[:, 2].min() > 60.0  # both carry
    np.testing.assert_allclose(ground.points[:, 0], center_of_mass(m, there[: m.nq])[0], atol=1e-8)
    assert 0.02 < abs(m.space.difference(there, x)[4]) < MAX_LEAN


SLED = """<mujoco><worldbody><geom name="floor" type="plane" size="0 0 1"/><body name="sled" pos="0 0 .5">
  <freejoint name="sled"/><geom type="box" size=".4 .25 .04" mass="4" contype="0" conaffinity="0"/>
  <geom size=".05" pos=".3 .2 -.05" mass=".1"/><geom size=".05" pos="-.3 .2 -.05" mass=".1"/>
  <geom size=".05" pos=".3 -.2 -.05" mass=".1"/><geom size=".05" pos="-.3 -.2 -.05" mass=".1"/>
  <site name="a" pos="-.4 .2 0"/><site name="b" pos="-.4 -.2 0"/></body></worldbody>
  <actuator><motor site="a" gear="1 0 0 0 0 0"/><motor site="b" gear="1 0 0 0 0 0"/></actuator></mujoco>"""


def test_a_machine_with_thrusters_rests_on_the_ground():
    """They are off: the ground carries the weight. Its degrees of freedom are still ones that they act on."""
    m = Mechanism.from_mjcf(SLED, contacts=ContactLaw.resting(4.4))
    x = static_equilibrium(m, m.home)
    assert contact_forces(m, x[:7], np.zeros(6)).forces[:, 2].sum() == pytest.approx(4.4 * G, rel=1e-8)
    assert unactuated_basis(m).shape == (6, 6)
    assert Capabilities.of_mechanism(m).actuated.all()
    assert not carried_by_thrusters(m)  # fans that push along the ground
    assert clearance(m, m.home) > 0.3
    assert not stays_in_air(m, m.home)


def test_a_drone_stays_in_the_air_and_rests_on_the_ground():
    m = Mechanism.from_mjcf(QUADROTOR, contacts=ContactLaw.resting(0.6))
    assert carried_by_thrusters(m)
    assert stays_in_air(m, m.home)
    x = static_equilibrium(m, m.home)
    assert not stays_in_air(m, x)
    assert contact_forces(m, x[:7], np.zeros(6)).forces[:, 2].sum() == pytest.approx(0.6 * G, rel=1e-8)


def test_what_is_a_thruster():
    """What pushes on a machine from outside along its own axes; not a motor of a ball, nor between two of its links."""
    m = Mechanism.from_mjcf(EVERY_WAY, contacts="off")
    np.testing.assert_array_equal(np.flatnonzero(thrusters(m)), [0, 1, 2, 3, 5, 14, 15])
