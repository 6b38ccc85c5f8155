"""Machines of other people's making given a law of contact, and one of them planned to stand up, with proof."""

import re

import numpy as np
import pytest
from contact_machines import LEG, leg
from places import PLACES, path
from trees import mujoco

import planner
from planner import dynamics as rigid_body
from planner.base.errors import ModelError, PlannerError
from planner.dynamics.contacts import contact_forces
from planner.model.contact.laws import ContactLaw
from planner.model.mechanism import Frame, Mechanism

# A person's weight sinks in by some millimetres, and friction is steep enough for its feet not to creep.
GROUND = ContactLaw(stiffness=2e4, damping=200.0, ramp=5e-3, slip_damping=500.0, friction=0.8)

others = pytest.mark.skipif(None in PLACES.values(), reason="no models of others")


@others
@pytest.mark.parametrize(
    ("name", "spheres", "bodies"),
    [("gym hopper", 8, 3), ("dm hopper", 12, 9), ("dm walker", 14, 0), ("gym ant", 25, 0)],
)
def test_a_law_for_the_contacts_of_others(name, spheres, bodies):
    """Each capsule ends twice, and bodies touch each other."""
    m = Mechanism.from_mjcf(path(name), contacts=GROUND)
    assert len(m.contacts) == spheres
    assert len(m.body_contacts) == bodies
    for contact in (*m.contacts, *m.body_contacts):
        touch = contact.law
        read = [touch.stiffness, touch.damping, touch.ramp, touch.force_ramp, touch.slip_damping, touch.friction]
        expected = [
            getattr(GROUND, key) for key in ("stiffness", "damping", "ramp", "force_ramp", "slip_damping", "friction")
        ]
        np.testing.assert_allclose(read, expected, rtol=1e-12)
    assert m.ignored == ()
    model = mujoco.MjModel.from_xml_string(m.mjcf, m.assets)
    assert model.npair == len({(contact.name.split(" end")[0]) for contact in m.contacts}) + bodies
    again = Mechanism.from_mjcf(m.mjcf)  # as a stored plan is read
    assert [contact.name for contact in again.contacts] == [contact.name for contact in m.contacts]
    assert again.ignored == ()


def test_a_law_replaces_that_of_the_file():
    m = Mechanism.from_mjcf(leg(impratio=10.0, ramp=1e-3), contacts=GROUND)
    assert len(m.contacts) == 1
    assert m.contacts[0].law.stiffness == pytest.approx(GROUND.stiffness)
    assert m.contacts[0].law.ramp == GROUND.ramp
    unnamed = LEG.format(impratio=1.0, tilt="0 0 0", ramps="", stop="", pair="").replace('name="foot"', "")
    unnamed = re.sub(r"<contact>.*</contact>", "", unnamed).replace('name="shank"', "")
    m = Mechanism.from_mjcf(unnamed, contacts=GROUND)
    assert [contact.name for contact in m.contacts] == ["geom 'geom number 4'"]


def test_laws_that_cannot_be_given():
    with pytest.raises(PlannerError, match="contacts is 3, expected one of: auto, avoid, file, ground"):
        Mechanism.from_mjcf(leg(), contacts=3)
    replicated = leg().replace('<geom name="foot"', '<replicate count="2"><geom name="foot"')
    replicated = replicated.replace('mass=".1"/>', 'mass=".1"/></replicate>')
    replicated = re.sub(r"<contact>.*</contact>", "", replicated)
    with pytest.raises(ModelError, match="the file has not all geoms of the model"):
        Mechanism.from_mjcf(replicated, contacts=GROUND)


def standing_forces(m, q):
    """Controls (nu,) that hold a pose at rest on its feet: least squares, the ground's forces among the unknowns."""
    rows = []
    for contact in m.contacts:
        if "foot" in contact.name:
            T = np.eye(4)
            T[:3, 3] = contact.centre
            rows.append(rigid_body.jacobian(m, q, Frame(contact.link, T))[[0, 2]])
    # a newton of the ground's is as good as 1/200 of a control, which is 200 N m
    known = np.hstack([m.actuators.moment.T * m.actuators.gain, 0.005 * np.concatenate(rows).T])
    return np.linalg.lstsq(known, rigid_body.bias(m, q, np.zeros(m.nv)), rcond=None)[0][: m.nu]


def on_the_floor(m, q):
    """A pose lowered until two points of its feet carry it."""
    at_rest = contact_forces(m, q, np.zeros(m.nv))
    depth = float(m.mass.sum()) * 9.81 / 2.0 / GROUND.stiffness
    q[1] += at_rest.depths.max() - depth
    return q, at_rest.points[np.argmax(at_rest.depths), 0]


@pytest.mark.slow
@others
def test_gymnasiums_hopper_stands_up_and_mujoco_repeats_it(tmp_path):
    """From a crouch, the foot where it is; inside the ranges of joints and motors."""
    m = Mechanism.from_mjcf(path("gym hopper"), contacts=GROUND)
    crouch, heel = on_the_floor(m, np.array([0.0, 1.25, -0.5, -0.1, -0.9, 0.5]))
    upright, other = on_the_floor(m, np.array([0.0, 1.25, -0.05, -0.05, -0.1, 0.1]))
    upright[0] += heel - other
    dynamics, N = planner.RigidBodyDynamics(m, dt=5e-3), 160
    cost = planner.TrackingCost.joints(
        dynamics, np.concatenate([upright, np.zeros(6)]), horizon=N, effort=10.0, final_position=1e4,
        final_velocity=1e3, position=dict.fromkeys(m.joint_names[1:], 10.0), velocity=0.3,
    )  # fmt: skip
    us = np.repeat(standing_forces(m, crouch)[None], N, axis=0)
    x0 = np.concatenate([crouch, np.zeros(6)])
    problem = planner.Problem(dynamics, cost, x0=x0, us=us, twin=planner.Twin.of(m), tolerance={"velocity": 0.2})
    plan = planner.solve(problem)  # its file has MuJoCo's own contact, on which it still rocks by 0.12 rad/s
    assert plan.success
    assert np.max(np.abs(plan.xs[-1, :6] - upright)) < 1e-3
    vertical = contact_forces(m, plan.xs[:, :6], plan.xs[:, 6:]).forces[:, :, 2].sum(axis=1)
    assert vertical.min() > 0.0  # it never leaves the floor
    assert np.abs(plan.us).max() < 1.0  # of its motors' ranges
    proof = planner.prove(plan, rollouts=0)
    assert proof.passed, proof
    assert proof.same_step.not_applicable
    plan.save(tmp_path / "plan.npz")
    read = planner.load_plan(tmp_path / "plan.npz")
    assert read.problem is not None
    np.testing.assert_allclose(read.problem.dynamics.step(plan.xs[:-1], plan.us), plan.xs[1:], atol=1e-9)
