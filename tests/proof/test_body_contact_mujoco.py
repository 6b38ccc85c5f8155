"""Contacts of two bodies in MuJoCo: the same motion and the same forces, what is read, what is not, and a plan proved.

Bounds are those of contacts with planes (test_contact_mujoco.py).
"""

import numpy as np
import pytest
from contact_machines import DAMPING, FRICTION, PAIRS, SLIP, STIFFNESS, meeting
from trees import mujoco

import planner
from planner.base.errors import ModelError
from planner.dynamics import RigidBodyDynamics
from planner.dynamics.contact_kinematics import BodyContactKinematics
from planner.dynamics.contacts import body_contact_forces, contact_forces
from planner.dynamics.kinematics import LinkPlaces
from planner.model.contact.laws import ContactLaw
from planner.model.mechanism import Mechanism
from planner.model.mjcf.contacts import contact_attributes

# From where the bodies touch almost at once, so that they press, roll and slip for most of the time.
HEIGHTS = {"spheres": 0.65, "sphere on capsule": 0.595, "capsules": 0.593}
each_pair = pytest.mark.parametrize("name", PAIRS)


@each_pair
def test_mujoco_moves_by_the_same_law(name):
    """What falls on a raft, bounces, rolls and slips on it."""
    text, dt, N = meeting(name, height=HEIGHTS[name]), 1e-4, 4000
    m, model = Mechanism.from_mjcf(text), mujoco.MjModel.from_xml_string(text)
    data, dynamics, x = mujoco.MjData(model), RigidBodyDynamics(m, dt), m.home
    x[m.nq + 3 :] = [0.2, 0.3, 0.1, 0.1, 0.1, 0.0, 0.5, 1.0, 2.0]
    data.qpos, data.qvel = x[: m.nq], x[m.nq :]
    ours, theirs = np.tile(x, (N + 1, 1)), np.tile(x, (N + 1, 1))
    for n in range(N):
        ours[n + 1] = dynamics.step(ours[n : n + 1], np.zeros((1, 1)))[0]
        mujoco.mj_step(model, data)
        theirs[n + 1] = *data.qpos, *data.qvel
    assert np.max(np.abs(ours[:, : m.nq] - theirs[:, : m.nq])) < 1e-5
    found = body_contact_forces(m, ours[:, : m.nq], ours[:, m.nq :])
    assert np.mean(found.depths > 0.0) > 0.5
    assert np.max(np.abs(ours[-1, : m.nq] - ours[0, : m.nq])) > 0.3  # of a quaternion: 35 degrees


@each_pair
def test_mujocos_forces_are_the_laws(name):
    """At random states in contact, at ends and sides of capsules; relative to the force or to 5 N."""
    text = meeting(name)
    m, model, rng = Mechanism.from_mjcf(text), mujoco.MjModel.from_xml_string(text), np.random.default_rng(1)
    (contact,), data, errors = m.body_contacts, mujoco.MjData(model), []
    assert contact.name == "geom 'raft' and geom 'log'"
    qs, qds = rng.normal(size=(100, m.nq)), rng.normal(size=(100, m.nv)) * 0.3
    qs[:, :3] *= 0.01  # of the raft's springs
    qs[:, 7:10] = np.array([0.0, 0.0, 0.5]) + 0.2 * qs[:, 7:10]
    for address, _ in m.quaternions:
        qs[:, address : address + 4] /= np.linalg.norm(qs[:, address : address + 4], axis=1)[:, None]
    place, depths = BodyContactKinematics(LinkPlaces(m, qs), contact, qds), 10 ** rng.uniform(-4, -2.3, size=100)
    qs[:, 7:10] -= (place.e - depths)[:, None] * place.n  # the first is the raft: now they touch that deep
    ours = body_contact_forces(m, qs, qds)
    np.testing.assert_allclose(ours.depths[:, 0], depths, atol=1e-8)
    for k, (q, qd) in enumerate(zip(qs, qds, strict=True)):
        data.qpos, data.qvel = q, qd
        mujoco.mj_forward(model, data)
        force = np.empty(6)
        mujoco.mj_contactForce(model, data, 0, force)
        towards = 1.0 if data.contact[0].geom[1] == model.geom("raft").id else -1.0  # MuJoCo's is on the second
        theirs = towards * data.contact[0].frame.reshape(3, 3).T @ force[:3]
        np.testing.assert_allclose(ours.points[k, 0], data.contact[0].pos, atol=1e-6)
        assert ours.depths[k, 0] == pytest.approx(-data.contact[0].dist, abs=1e-9)
        errors.append(np.linalg.norm(ours.forces[k, 0] - theirs) / max(np.linalg.norm(theirs), 5.0))
    assert np.quantile(errors, 0.95) < 5e-3
    assert np.median(errors) < 1e-3


def test_attributes_are_read_back():
    touch = Mechanism.from_mjcf(meeting("capsules", impratio=1000.0, ramp=2e-3)).body_contacts[0].law
    read = [touch.stiffness, touch.damping, touch.slip_damping, touch.friction, touch.ramp]
    np.testing.assert_allclose(read, [STIFFNESS, DAMPING, SLIP, FRICTION, 2e-3], rtol=1e-12)
    with pytest.raises(ModelError, match="solref is a time constant"):
        Mechanism.from_mjcf(meeting("capsules", solref="0.02 1"), contacts="model")


SCENE = """<mujoco><worldbody>
  <geom name="post" type="capsule" fromto="0 0 0 0 0 1" size=".05"/>
  <geom name="knob" type="sphere" pos=".5 0 0" size=".1"/>
  <body pos=".1 0 .5"><joint name="slide" type="slide" axis="1 0 0"/>
    <geom name="{shape}" type="{shape}" size=".04 .04 .04"/>
    <body pos=".2 0 0"><joint name="hinge" axis="0 1 0"/>
      <geom name="rod" type="capsule" fromto="0 0 0 .3 0 0" size=".02"/>
      <body pos=".3 0 0"><joint axis="0 0 1"/><geom name="tip" type="capsule" fromto="0 0 0 0 0 .3" size=".02"/></body>
    </body></body></worldbody>
  <actuator><motor joint="slide"/></actuator></mujoco>"""
GIVEN = ContactLaw(stiffness=2e4, damping=200.0, ramp=5e-3, slip_damping=500.0, friction=0.8)


def test_a_law_for_pairs_of_bodies_and_of_the_world():
    """What hangs on each other by a joint is left alone, as in MuJoCo; what is fixed has no link."""
    m = Mechanism.from_mjcf(SCENE.format(shape="sphere"), contacts=GIVEN)
    names = {tuple(contact.name.replace("geom ", "").replace("'", "").split(" and ")) for contact in m.body_contacts}
    assert names == {(a, b) for a in ("post", "knob") for b in ("sphere", "rod", "tip")} | {("sphere", "tip")}
    assert m.contacts == m.ignored == ()
    for contact in m.body_contacts:
        assert (contact.first.link < 0) == (contact.name.split("'")[1] in ("post", "knob"))
        assert contact.law.stiffness == pytest.approx(GIVEN.stiffness)
        assert contact.law.ramp == GIVEN.ramp
    post = next(contact.first for contact in m.body_contacts if "post" in contact.name)
    np.testing.assert_allclose([post.middle, np.abs(post.half)], [[0, 0, 0.5], [0, 0, 0.5]], atol=1e-12)
    again = Mechanism.from_mjcf(m.mjcf)  # as a stored plan is read
    assert [contact.name for contact in again.body_contacts] == [contact.name for contact in m.body_contacts]


@pytest.mark.parametrize("shape", ["cylinder", "ellipsoid", "box"])
def test_other_shapes_are_named(shape):
    m = Mechanism.from_mjcf(SCENE.format(shape=shape), contacts=GIVEN)
    assert len(m.body_contacts) == 4
    more = 1 if shape == "box" else 2  # post, knob and tip; to the tip a box that slides along its top is a belt
    assert m.ignored == (f"contacts of geom 'post' and geom '{shape}' and {more} more pairs",)
    with pytest.raises(ModelError, match=f"capsule and {shape}, expected .* or two spheres or capsules"):
        Mechanism.from_mjcf(SCENE.format(shape=shape), contacts="model")


BRICK = """<mujoco><option cone="elliptic" impratio="10"><flag refsafe="disable"/></option><worldbody>
  {floor}<body name="brick" pos="0 0 .2"><freejoint/><geom name="brick" type="box" size=".1 .06 .05" mass="2"
    friction=".5" solref="{solref}" solimp="{solimp}"/></body></worldbody></mujoco>"""


@pytest.mark.parametrize("kind", ['type="plane" size="5 5 1"', 'type="box" size="5 5 .1" pos="0 0 -.1"'])
def test_a_box_meets_a_plane_with_its_corners(kind):
    """MuJoCo's own contacts of a brick askew: as many, as deep, and the same force."""
    law = contact_attributes(1e4, 50.0, 500.0, 0.5, 1.0 / 2.0, 10.0)  # of a free body of 2 kg
    floor = f'<geom name="floor" {kind} friction=".3" solref="{law["solref"]}" solimp="{law["solimp"]}"/>'
    text = BRICK.format(floor=floor, solref=law["solref"], solimp=law["solimp"])
    m, model, rng = Mechanism.from_mjcf(text), mujoco.MjModel.from_xml_string(text), np.random.default_rng(2)
    assert [contact.name for contact in m.contacts] == [f"geom 'brick' corner {k + 1}" for k in range(8)]
    data, counts = mujoco.MjData(model), set()
    for tilt in (0.0, 3e-3, 0.3):
        q, qd = m.home[:7], 0.1 * rng.normal(size=6)
        q[3:] = 1.0, *(0.5 * tilt * rng.normal(size=3))
        q[3:] /= np.linalg.norm(q[3:])
        q[2] += contact_forces(m, q, qd).depths.max() - 2e-3
        ours = contact_forces(m, q, qd)
        data.qpos, data.qvel = q, qd
        mujoco.mj_forward(model, data)
        touching = ours.depths > 0.0
        counts.add(data.ncon)
        assert data.ncon == np.sum(touching)
        order = [np.argmin(np.linalg.norm(ours.points - contact.pos, axis=1)) for contact in data.contact]
        np.testing.assert_allclose(ours.points[order], data.contact.pos, atol=1e-9)
        np.testing.assert_allclose(ours.depths[order], -data.contact.dist, atol=1e-9)
        np.testing.assert_allclose(ours.forces.sum(axis=0), data.qfrc_constraint[:3], rtol=5e-3, atol=0.05)
    assert {1, 4} <= counts


PUSH = """<mujoco><option timestep="1e-3"/><worldbody>
  <body name="pusher" pos="0 0 .1"><joint name="push_x" type="slide" axis="1 0 0" damping="5"/>
    <joint name="push_y" type="slide" axis="0 1 0" damping="5"/>
    <geom name="pusher" type="capsule" fromto="0 0 -.05 0 0 .1" size=".03" mass="1"/></body>
  <body name="ball" pos=".1 0 .1"><joint name="x" type="slide" axis="1 0 0" damping="10"/>
    <joint name="y" type="slide" axis="0 1 0" damping="10"/><joint name="spin" axis="0 0 1" damping=".002"/>
    <geom name="ball" type="sphere" size=".05" mass=".5"/></body></worldbody>
  <actuator><motor joint="push_x"/><motor joint="push_y"/></actuator></mujoco>"""


def test_a_pusher_pushes_a_ball_and_mujoco_repeats_it(tmp_path):
    """A dragged ball is to be 20 cm ahead and 10 cm aside: the pusher finds its way around it."""
    m = Mechanism.from_mjcf(PUSH, contacts=ContactLaw(1e3, 20.0, 5e-3, slip_damping=50.0, friction=0.3))
    dynamics, N, goal = planner.RigidBodyDynamics(m, dt=5e-3), 240, np.zeros(10)
    goal[2:4] = 0.3, 0.1  # from its place in the file
    ball, pusher = dict.fromkeys("xy", 1.0), {"push_x": 0.0, "push_y": 0.0, "spin": 0.0}
    cost = planner.TrackingCost.joints(
        dynamics, goal, horizon=N, effort=0.01, position=ball | pusher, velocity=0.0,
        final_position=dict.fromkeys("xy", 1e4) | pusher,
        final_velocity={"push_x": 10.0, "push_y": 10.0, "x": 100.0, "y": 100.0, "spin": 0.0},
    )  # fmt: skip
    us = np.tile([6.0, 0.0], (N, 1))  # straight ahead
    plan = planner.solve(planner.Problem(dynamics, cost, x0=m.home, us=us, twin=planner.Twin.of(m)))
    assert plan.success
    np.testing.assert_allclose(plan.xs[-1, 2:4], goal[2:4], atol=1e-3)
    found = body_contact_forces(m, plan.xs[:, :5], plan.xs[:, 5:])
    assert np.mean(found.depths > 0.0) > 0.5
    proof = planner.prove(plan, rollouts=0)
    assert proof.passed, proof
    assert proof.same_step.not_applicable
    plan.save(tmp_path / "plan.npz")
    read = planner.load_plan(tmp_path / "plan.npz")
    assert read.problem is not None
    np.testing.assert_allclose(read.problem.dynamics.step(plan.xs[:-1], plan.us), plan.xs[1:], atol=1e-9)
