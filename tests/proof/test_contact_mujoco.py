"""Contacts of an MJCF: what is read, what is refused, and that MuJoCo moves as the plan's law does.

Bounds are the MuJoCo study's (section 5): it measured 2.6e-6 of path and 2e-3 of force.
"""

import re

import numpy as np
import pytest
from contact_machines import DAMPING, FRICTION, RADIUS, SLIP, STIFFNESS, leg, standing, torques
from trees import mujoco

from planner.base.errors import ModelError, PlannerError
from planner.dynamics import RigidBodyDynamics
from planner.dynamics.contacts import contact_forces
from planner.model.mechanism import Mechanism
from planner.model.mjcf.contacts import contact_attributes, stop_attributes


def together(text, duration=0.6, dt=1e-4, substeps=1, speed=0.5):
    """The leg dropped and sliding, by the plan's law and by MuJoCo under the same torques: states (N+1, 8) of both."""
    m = Mechanism.from_mjcf(text)
    model = mujoco.MjModel.from_xml_string(text)
    model.opt.timestep = dt / substeps
    data, dynamics, N = mujoco.MjData(model), RigidBodyDynamics(m, dt), round(duration / dt)
    ours, theirs = np.empty((N + 1, 8)), np.empty((N + 1, 8))
    ours[0] = theirs[0] = standing(m, speed=speed)
    data.qpos, data.qvel = ours[0, :4], ours[0, 4:]
    for n in range(N):
        data.ctrl = u = torques(ours[n])
        ours[n + 1] = dynamics.step(ours[n : n + 1], u[None])[0]
        for _ in range(substeps):
            mujoco.mj_step(model, data)
        theirs[n + 1] = *data.qpos, *data.qvel
    return m, ours, theirs


@pytest.mark.parametrize(("speed", "bound"), [(0.5, 1e-5), (3.0, 5e-4)])
def test_mujoco_moves_by_the_same_law(speed, bound):
    """The study's drop, in which the foot slips little; and a metre of slipping, where its 2e-3 of force add up."""
    m, ours, theirs = together(leg(impratio=10.0), speed=speed)
    assert np.max(np.abs(ours[:, :4] - theirs[:, :4])) < bound
    forces = contact_forces(m, ours[:, :4], ours[:, 4:]).forces[:, 0]
    pressed = forces[:, 2] > 0.0
    assert np.mean(pressed) > 0.8
    slipping = np.abs(forces[pressed, 0]) > 0.999 * FRICTION * forces[pressed, 2]
    assert (np.mean(slipping) > 0.5) == (speed > 1.0)


def mujoco_force(model, q, qd):
    """(3,) N of the first contact, in the world, on the machine."""
    data = mujoco.MjData(model)
    data.qpos, data.qvel = q, qd
    mujoco.mj_forward(model, data)
    if not data.ncon:
        return np.zeros(3)
    force = np.empty(6)
    mujoco.mj_contactForce(model, data, 0, force)
    return data.contact[0].frame.reshape(3, 3).T @ force[:3]


@pytest.mark.parametrize(("tilt", "margin"), [(0.0, "0"), (0.3, "0"), (0.3, "0.02")])
def test_mujocos_forces_are_the_laws(tilt, margin):
    """At random states in contact, as the study draws them; relative to the force or to 5 N."""
    text = leg(impratio=10.0, tilt=tilt, margin=margin)
    m, model, rng = Mechanism.from_mjcf(text), mujoco.MjModel.from_xml_string(text), np.random.default_rng(1)
    errors, along = [], np.array([-np.sin(tilt), 0.0, np.cos(tilt)])
    for _ in range(300):
        q = np.array([rng.normal(), 0.0, rng.uniform(-0.8, 0.8), rng.uniform(-1.2, -0.1)])
        qd = rng.normal(size=4) * 0.3
        depth = 10 ** rng.uniform(-4, -2.3)
        above = -contact_forces(m, q, qd).depths[0]
        q[1] -= (above + depth) / along[2]
        ours = contact_forces(m, q, qd)
        assert ours.depths[0] == pytest.approx(depth, abs=1e-12)
        theirs = mujoco_force(model, q, qd)
        errors.append(np.linalg.norm(ours.forces[0] - theirs) / max(np.linalg.norm(theirs), 5.0))
    assert np.quantile(errors, 0.95) < 5e-3
    assert np.median(errors) < 1e-3


def test_less_smoothing_is_nearer_to_mujoco():
    """The planning law (impratio 1000): from 5 to 0.5 mm the error falls at least 1.5 times (the step study: 2.2).

    Measured: 9 times.
    """
    errors = []
    for ramp in (5e-3, 5e-4):
        _, ours, theirs = together(leg(impratio=1000.0, ramp=ramp), dt=2e-4, substeps=2)
        errors.append(np.sqrt(np.mean((ours[:, :4] - theirs[:, :4]) ** 2)))
    assert errors[0] > 1.5 * errors[1]
    assert errors[0] < 0.05


def test_a_knee_stop_is_mujocos():
    """Without smoothing, the knee driven into its stop at -1.1."""
    m, ours, theirs = together(leg(stop=(200.0, 2.0, 0.0)), duration=0.3)
    assert len(m.stops) == 2
    assert np.max(ours[:, 3]) > -1.1 + 0.01
    assert np.max(np.abs(ours[:, :4] - theirs[:, :4])) < 1e-5


def test_attributes_are_read_back():
    """What contact_attributes wrote, with the surface of the plane and the smoothing of the file."""
    m = Mechanism.from_mjcf(leg(impratio=1000.0, ramp=2e-3))
    (contact,) = m.contacts
    touch = contact.law
    read = [touch.stiffness, touch.damping, touch.slip_damping, touch.friction, touch.ramp, contact.radius]
    np.testing.assert_allclose(read, [STIFFNESS, DAMPING, SLIP, FRICTION, 2e-3, RADIUS], rtol=1e-12)
    assert touch.force_ramp == pytest.approx(0.2 * STIFFNESS * 2e-3)
    assert touch.bend == 0.5
    assert Mechanism.from_mjcf(leg(impratio=1000.0, ramp="0.002 1 0.25")).contacts[0].law.bend == 0.25
    assert touch.impratio == np.inf
    assert m.body_names[[body.link for body in m.bodies].index(contact.link)] == "shank"
    assert "foot" in contact.name
    exact = Mechanism.from_mjcf(leg(impratio=10.0)).contacts[0].law
    assert exact.bend == 0.0
    assert exact.impratio == 10.0
    assert exact.ramp == exact.force_ramp == 0.0


def test_geoms_that_meet_without_a_pair_and_capsules_on_boxes():
    """Two capsule ends on the top of a turned box, by the geoms' own parameters, as MuJoCo mixes them."""
    weight = 1.0 / 2.0  # a free body's invweight0 is that of its mass
    law = contact_attributes(1e4, 50.0, 500.0, 0.5, weight, 10.0)
    solref, solimp = law["solref"], law["solimp"]
    text = f"""<mujoco><option cone="elliptic" impratio="10"><flag refsafe="disable"/></option><worldbody>
      <body pos="0 0 1" euler="90 0 0"><geom name="step" type="box" size=".5 .2 .4" friction=".3" solref="{solref}"
        solimp="{solimp}"/></body>
      <body name="log" pos="0 0 1.3"><freejoint/><inertial pos="0 0 0" mass="2" diaginertia=".1 .1 .1"/>
        <geom name="log" type="capsule" fromto="-.2 0 0 .2 0 0" size=".05" friction=".5" solref="{solref}"
        solimp="{solimp}"/></body></worldbody></mujoco>"""
    m, model = Mechanism.from_mjcf(text), mujoco.MjModel.from_xml_string(text)
    assert [contact.name for contact in m.contacts] == ["geom 'log' end 1", "geom 'log' end 2"]
    touch = m.contacts[0].law
    assert (touch.stiffness, touch.damping, touch.friction) == pytest.approx((1e4, 50.0, 0.5), rel=1e-9)
    assert touch.slip_damping == pytest.approx(10.0 * 50.0, rel=1e-9)  # impratio times the normal damping
    x = m.home
    x[2] = 1.2 + 0.05 - 0.002  # the box's half width is upwards
    x[7:10] = 0.1, 0.05, -0.1
    ours, data = contact_forces(m, x[:7], x[7:]), mujoco.MjData(model)
    data.qpos, data.qvel = x[:7], x[7:]
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(ours.depths, 0.002, atol=1e-12)
    assert data.ncon == 2
    total = data.qfrc_constraint[:3]
    np.testing.assert_allclose(ours.forces.sum(axis=0), total, rtol=5e-3)


BELT = """<body name="belt" pos="0 0 -0.1"><joint name="belt" type="slide" axis="{axis}"/>
  <inertial pos="0 0 0" mass="30" diaginertia="1 1 1"/><geom name="floor" type="box" size="5 1 .1"/></body>"""


def on_a_belt(axis="1 0 0"):
    """The leg on a box that slides, with the coefficients that this gives."""
    text = leg(impratio=10.0).replace("<worldbody>", "<worldbody>" + BELT.format(axis=axis))
    return re.sub(r'<geom name="floor" type="plane"[^>]*>', "", text)


def test_a_belt_and_what_stands_on_it_move_as_in_mujoco():
    """The belt slides freely: friction brakes it and drives the leg."""
    text = on_a_belt()
    m, model = Mechanism.from_mjcf(text), mujoco.MjModel.from_xml_string(text)
    (contact,) = m.contacts
    assert contact.plane.slide == 0
    data, dynamics = mujoco.MjData(model), RigidBodyDynamics(m, 1e-4)
    x = np.concatenate([[0.0], standing(Mechanism.from_mjcf(leg()), height=0.001, speed=0.0)])
    x = np.insert(x, 5, -1.0)  # m/s of the belt
    data.qpos, data.qvel = x[:5], x[5:]
    for _ in range(2000):
        data.ctrl = u = torques(np.delete(x, [0, 5]))
        x = dynamics.step(x[None], u[None])[0]
        mujoco.mj_step(model, data)
    assert x[5] > -0.99
    assert x[6] < -0.02  # the trunk, carried along
    assert np.max(np.abs(x[:5] - data.qpos)) < 1e-4


def test_a_box_that_moves_otherwise_is_refused():
    with pytest.raises(ModelError, match="box and sphere that both move, expected a plane or box at rest"):
        Mechanism.from_mjcf(on_a_belt(axis="0 0 1"), contacts="model")


@pytest.mark.parametrize(
    ("change", "phrase"),
    [
        ({"solref": "0.02 1"}, "solref is a time constant"),
        ({"solimp": "0.9 0.95 0.001 0.5 2"}, "solimp 0.9 0.95"),
        ({"condim": "4"}, "condim 4, expected 1 or 3"),
        ({"friction": "0.7 0.3 0.005 0.0001 0.0001"}, "other friction along than across"),
        ({"solreffriction": "0.02 1"}, "solreffriction is a time constant"),
    ],
)
def test_other_contacts_are_refused_by_name(change, phrase):
    with pytest.raises(ModelError) as error:
        Mechanism.from_mjcf(leg(**change), contacts="model")
    sentence = str(error.value)
    assert phrase in sentence
    assert "contacts of geom 'floor' and geom 'foot'" in sentence
    of_file = "solimp" in phrase or "condim" in phrase  # MuJoCo's own law has these
    assert sentence.endswith(f'contacts = "{"file" if of_file else "ground"}" loads it without.')
    assert Mechanism.from_mjcf(leg(**change), contacts="off").contacts == ()


def test_other_options_are_refused_by_name():
    for old, new, phrase in (
        ('cone="elliptic"', 'cone="pyramidal"', "expected cone='elliptic'"),
        ('type="plane"', 'type="cylinder"', "cylinder and sphere, expected a plane or box"),
    ):
        with pytest.raises(ModelError, match=phrase):
            Mechanism.from_mjcf(leg().replace(old, new).replace('size="0 0 1"', 'size="1 1 1"'), contacts="model")
    with pytest.raises(ModelError, match="impratio 10, expected at least 100 for smoothed friction"):
        Mechanism.from_mjcf(leg(impratio=10.0, ramp=1e-3), contacts="model")
    for ramp in ("-1", "1e-3 -1", "1e-3 1 1.5", "1e-3 1 0.5 0"):
        with pytest.raises(ModelError, match=r"numeric 'contact_ramp' is .* and a bend within 0 to 1\."):
            Mechanism.from_mjcf(leg(impratio=1000.0, ramp=ramp), contacts="model")


def test_limits_in_other_formats_stop_nothing():
    """As ever: a replay says whether a plan reached them."""
    m = Mechanism.from_mjcf(leg().replace('axis="0 1 0" />', 'axis="0 1 0" range="-2 -1" limited="true"/>'))
    assert m.stops == ()
    assert m.joint_range[3, 0] == -2.0


def test_bad_coefficients_are_one_sentence():
    for wrong in ({"stiffness": 0.0}, {"damping": -1.0}, {"invweight": 0.0}, {"friction": "much"}, {"impratio": 0}):
        good = {"stiffness": 1e4, "damping": 1.0, "slip_damping": 1.0, "friction": 0.5, "invweight": 1.0}
        with pytest.raises(PlannerError, match=next(iter(wrong))):
            contact_attributes(**(good | wrong))
    with pytest.raises(PlannerError, match="invweight is nan"):
        stop_attributes(1.0, 1.0, np.nan)
    assert contact_attributes(1e4, 1.0, 0.0, 0.5, 1.0)["condim"] == "1"
