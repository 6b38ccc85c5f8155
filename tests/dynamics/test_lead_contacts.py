"""Contact laws with a lead: MuJoCo's accelerations of files with usual contacts, derivatives against differences."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from contact_machines import moved
from lead_contacts import accelerations
from trees import mujoco

from planner.dynamics import RigidBodyDynamics
from planner.dynamics.contacts import contact_force, contact_forces, contact_wrench
from planner.model.contact.laws import ContactLaw
from planner.model.mechanism import Mechanism

HEAD = """<mujoco><compiler angle="radian"/>
  <option cone="{cone}" impratio="{impratio}" tolerance="1e-15" iterations="200" ls_iterations="100"
    ls_tolerance="1e-10"/>
  <custom><text name="contact_law" data="file"/></custom>
  <default><geom condim="{condim}" friction=".6 .02 .01" solref="{solref}" solimp="{solimp}"/></default><worldbody>"""

BOX = (
    HEAD
    + """<geom name="floor" type="plane" size="0 0 1" euler="0.3 0.2 0"/>
  <body><freejoint/><geom type="box" size=".1 .08 .05" mass="2"/></body></worldbody></mujoco>"""
)

LEGS = (
    HEAD
    + """<geom name="floor" type="plane" size="0 0 1"/>
  <body name="trunk" pos="0 0 .55"><freejoint/><geom type="box" size=".1 .15 .1" mass="6" contype="0" conaffinity="0"/>
    <body pos="0 .1 -.1"><joint name="hip" axis="0 1 0" ref=".5" damping=".2"/><joint axis="1 0 0"/>
      <geom type="capsule" fromto="0 0 -.05 0 0 -.2" size=".03" mass="1" contype="0" conaffinity="0"/>
      <body pos="0 0 -.2"><joint axis="0 1 0" armature=".01"/><geom name="foot" pos="0 0 -.22" size=".03" mass=".2"/>
        </body></body>
    <body pos="0 -.1 -.1"><joint axis="0 1 0"/><joint axis="1 0 0"/>
      <geom type="capsule" fromto="0 0 -.05 0 0 -.2" size=".03" mass="1" contype="0" conaffinity="0"/>
      <body pos="0 0 -.2"><joint axis="0 1 0"/><geom pos="0 0 -.22" size=".03" mass=".2"/></body></body></body>
  </worldbody></mujoco>"""
)

DRIVEN = LEGS.format(cone="pyramidal", impratio=1, condim=3, solref=".02 1", solimp=".9 .9 .001").replace(
    "</mujoco>", '<actuator><motor joint="hip"/></actuator></mujoco>'
)

RAFT = (
    HEAD
    + """<body name="raft" pos="0 0 .5"><joint type="slide" axis="0 0 1"/><joint type="ball"/>
      <geom type="capsule" fromto="-.1 -.2 0 .1 .2 0" size=".04" mass="4"/></body>
    <body pos=".01 .02 .58"><freejoint/><geom type="{shape}" size=".05 .1" mass="2" euler="0 1.3 0"/></body></worldbody>
  </mujoco>"""
)

# Newton's method of MuJoCo ends in elliptic cones when rounding of its cost hides further progress: 7e-10 at most here.
# Ten edges of which small friction makes nearly one leave 4e-11.
BOUNDS = {"pyramidal": 1e-10, "elliptic": 5e-9}

FLAT, USUAL, RUBBER = ".9 .9 .001", ".9 .95 .001", ".015 1 .01 .4 2"  # solimp: constant, the default, and rising far

STATES = 8  # of each machine, in which every number of its contacts is seen

law_of_a_file = ("cone", "impratio", "condim", "solref", "solimp")
LAWS_WITH_A_WIDTH = [
    *itertools.product(BOUNDS, (10,), (3,), (".02 1",), (USUAL, RUBBER)),
    *itertools.product(BOUNDS, (1,), (4, 6), (".02 1",), (USUAL,)),
]
EVERY_LAW = [
    *LAWS_WITH_A_WIDTH,
    *itertools.product(BOUNDS, (1, 10, 100), (3,), (".02 1", "-4000 -60"), (FLAT,)),
    *itertools.product(BOUNDS, (10,), (4, 6), (".02 1",), (RUBBER,)),
    ("pyramidal", 1, 1, ".02 1", USUAL),
    ("elliptic", 1, 1, ".003 .7", FLAT),  # below twice the step: refsafe
]


def beside_mujoco(text, states):
    """The largest difference of our accelerations and MuJoCo's, relative to the largest one, and the contacts seen."""
    m, model = Mechanism.from_mjcf(text, contacts="model"), mujoco.MjModel.from_xml_string(text)
    data, worst, seen = mujoco.MjData(model), 0.0, []
    for q, v, tau in states(m):
        data.qpos[:], data.qvel[:], data.qfrc_applied[:], data.qacc_warmstart[:] = q, v, tau, 0.0
        mujoco.mj_forward(model, data)
        difference = np.abs(accelerations(m, q, v, tau) - data.qacc).max()
        worst = max(worst, difference / max(1.0, np.abs(data.qacc).max()))
        seen.append(data.ncon)
    return worst, seen


def lying(m):
    """States of a box whose lower corners are in a tilted floor at several depths, moving and pushed."""
    rng, floor = np.random.default_rng(0), m.contacts[0].plane
    for _ in range(STATES):
        q, turn = m.home[: m.nq], np.empty(4)
        mujoco.mju_quatZ2Vec(turn, floor.normal)
        mujoco.mju_mulQuat(q[3:7], turn, np.append(1.0, rng.normal(size=3) * 0.03))
        q[3:7] /= np.linalg.norm(q[3:7])
        q[:3] = floor.normal * (0.05 + rng.uniform(-0.003, 0.006))
        yield q, rng.normal(size=6) * rng.choice([0.01, 0.3, 2.0]), rng.normal(size=6) * 5.0


def moving(dof, low, high):
    """States around home, with a degree of freedom raised by low to high, m; slow ones stick and fast ones slide."""

    def states(m):
        rng = np.random.default_rng(0)
        for _ in range(STATES):
            direction = rng.normal(size=m.nv) * 0.01
            direction[dof] = rng.uniform(low, high)
            q = moved(m, m.home[: m.nq], direction)
            yield q, rng.normal(size=m.nv) * rng.choice([0.003, 0.3, 3.0]), rng.normal(size=m.nv) * 5.0

    return states


@pytest.mark.parametrize(law_of_a_file, EVERY_LAW)
def test_a_box_has_mujocos_accelerations(cone, impratio, condim, solref, solimp):
    text = BOX.format(cone=cone, impratio=impratio, condim=condim, solref=solref, solimp=solimp)
    worst, seen = beside_mujoco(text, lying)
    assert max(seen) >= 3
    assert worst < BOUNDS[cone]


@pytest.mark.parametrize(law_of_a_file, LAWS_WITH_A_WIDTH)
def test_two_legs_have_mujocos_accelerations(cone, impratio, condim, solref, solimp):
    text = LEGS.format(cone=cone, impratio=impratio, condim=condim, solref=solref, solimp=solimp)
    worst, seen = beside_mujoco(text, moving(2, -0.004, 0.003))
    assert set(seen) == {0, 1, 2}
    assert worst < BOUNDS[cone]


@pytest.mark.parametrize("shape", ["sphere", "capsule"])
@pytest.mark.parametrize("cone", BOUNDS)
def test_two_bodies_have_mujocos_accelerations(cone, shape):
    text = RAFT.format(cone=cone, impratio=10, condim=3, solref=".02 1", solimp=USUAL, shape=shape)
    worst, seen = beside_mujoco(text, moving(-4, -0.002, 0.015))
    assert set(seen) == {0, 1}
    assert worst < BOUNDS["elliptic"]  # closest points of capsules are those of axis_regularization, to 1e-9


@pytest.mark.parametrize(("text", "states", "count"), [(BOX, lying, 3), (LEGS, moving(2, -0.004, 0.005), 2)])
def test_margins_press_before_surfaces_touch(text, states, count):
    """Of the floor and of what stands on it; a gap is what contact is seen in without a force."""
    text = text.format(cone="elliptic", impratio=10, condim=3, solref=".02 1", solimp=RUBBER)
    text = text.replace("<geom condim", '<geom margin=".002" condim').replace('size="0 0 1"', 'size="0 0 1" gap=".001"')
    worst, seen = beside_mujoco(text, states)
    assert max(seen) >= count
    assert worst < BOUNDS["elliptic"]
    m = Mechanism.from_mjcf(text, contacts="model")
    assert all(0.0 < contact.law.margin <= 0.004 for contact in m.contacts)


SLED = (
    HEAD
    + """<geom type="plane" size="0 0 1"/><body pos="0 0 .1"><joint type="slide" axis="1 0 0"/>
    <joint type="slide" axis="0 1 0"/><joint type="slide" axis="0 0 1"/><geom size=".1" mass="2"/></body></worldbody>
  </mujoco>"""
)


@pytest.mark.parametrize("condim", [4, 6])
def test_edges_for_spinning_and_rolling_press(condim):
    """What does not turn has all of MuJoCo's force: edges that resist spinning and rolling press as the others do."""
    text = SLED.format(cone="pyramidal", impratio=2, condim=condim, solref=".02 1", solimp=USUAL)
    worst, seen = beside_mujoco(text, moving(2, -0.004, 0.003))
    assert set(seen) == {0, 1}
    assert worst < BOUNDS["pyramidal"]


LAWS = {
    "pyramid": ContactLaw(5e3, 60.0, 5e-3, 5.0, friction=0.6, lead=0.02, cone="pyramidal"),
    "sharp pyramid": ContactLaw(5e3, 60.0, force_ramp=0.0, friction=0.6, lead=0.02, cone="pyramidal"),
    "condim 6": ContactLaw(
        5e3, 60.0, 5e-3, 5.0, friction=0.6, lead=0.02, cone="pyramidal", spinning=0.02, rolling=0.05
    ),
    "condim 4 round": ContactLaw(5e3, 60.0, 5e-3, friction=0.6, impratio=3.0, lead=0.02, spinning=0.04),
    "condim 6 round": ContactLaw(5e3, 60.0, 5e-3, friction=0.6, impratio=3.0, lead=0.02, spinning=0.1, rolling=0.05),
    "cone": ContactLaw(5e3, 60.0, 5e-3, friction=0.6, impratio=10.0, lead=0.02),
    "sharp cone": ContactLaw(5e3, 60.0, force_ramp=0.0, friction=0.6, impratio=10.0, bend=0.0, lead=0.02),
    "no friction": ContactLaw(5e3, 60.0, 5e-3, 5.0, lead=0.02),
    "rising": ContactLaw(
        5e3, 60.0, 5e-3, 0.0, friction=0.6, impratio=2.0, lead=0.02, impedance=(0.1, 0.8, 0.01, 0.3), margin=2e-3
    ),
}


def states_of_a_law(law):
    """Normals (K, 3), penetrations (K,) and velocities (K, 6) in which a contact sticks, slides, or is open."""
    rng = np.random.default_rng(3)
    n = rng.normal(size=(400, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    return (
        n,
        rng.uniform(-0.2, 3.0, size=400) * (law.ramp or 5e-3),
        rng.normal(size=(400, 6)) * [0.3, 0.3, 0.3, 3.0, 3.0, 3.0],
    )


def wrench(law, n, e, x):
    """contact_wrench of velocities x (K, 6)."""
    return contact_wrench(law, n, e, x[:, :3], x[:, 3:])


@pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)
def test_derivatives_of_a_law_with_a_lead(law):
    n, e, x = states_of_a_law(law)
    f, by_x = wrench(law, n, e, x)
    assert np.max(np.abs(f)) > 10.0
    h = 1e-7
    for axis in range(6):
        d = h * np.eye(6)[axis]
        slope = (wrench(law, n, e, x + d)[0] - wrench(law, n, e, x - d)[0]) / (2 * h)
        assert np.mean(np.abs(slope - by_x[:, :, axis]).max(axis=1) < 1e-5 * law.damping) > 0.99  # but over a kink


@pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)
def test_the_force_is_minus_the_gradient_of_a_convex_function_and_stays_in_its_cone(law):
    n, e, x = states_of_a_law(law)
    f, by_x = wrench(law, n, e, x)
    np.testing.assert_allclose(by_x, np.swapaxes(by_x, 1, 2), atol=1e-10 * law.damping)
    assert np.linalg.eigvalsh(by_x).max() <= 1e-10 * law.damping
    normal, spin = np.einsum("ka,ka->k", f[:, :3], n), np.einsum("ka,ka->k", f[:, 3:], n)
    along = np.linalg.norm(f[:, :3] - normal[:, None] * n, axis=1)
    rolling = np.linalg.norm(f[:, 3:] - spin[:, None] * n, axis=1)
    assert np.all(normal >= 0.0)
    for part, most in ((along, law.friction), (np.abs(spin), law.spinning), (rolling, law.rolling)):
        assert np.all(part <= most * normal + 1e-9)
        assert most == 0.0 or part.max() > 0.01 * most * normal.max()  # it is in use
    assert np.any(normal == 0.0)


@pytest.mark.parametrize("name", ["pyramid", "condim 6"])
def test_deep_inside_a_smoothed_law_presses_as_the_sharp_one(name):
    """surface_offset makes up for the ramps of the depth and of each edge: K (e - a/2) - 4 f/2 is K depth."""
    law, depth = LAWS[name], 0.03
    f = contact_force(law, np.array([[0.0, 0.0, 1.0]]), np.array([depth + law.surface_offset]), np.zeros((1, 3)))
    assert f[0, 2] == pytest.approx(law.stiffness * depth, rel=1e-12)


@pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)
def test_kernels_have_the_accelerations_of_the_reference(law):
    m = Mechanism.from_mjcf(DRIVEN, contacts="model")
    m = replace(m, contacts=tuple(replace(contact, law=law) for contact in m.contacts), body_contacts=())
    dynamics, hip = RigidBodyDynamics(m, 0.01), m.joint_links[m.joint_names.index("hip")].start
    pressed = 0
    for q, v, _ in moving(2, -0.006, 0.003)(m):
        tau = np.zeros(m.nv)
        tau[hip] = 3.0
        ours = dynamics.rates(np.concatenate([q, v])[None], np.array([[3.0]]))[0, m.nv :]
        expected = accelerations(m, q, v, tau)
        np.testing.assert_allclose(ours, expected, atol=1e-8 * np.abs(expected).max())
        pressed += np.count_nonzero(contact_forces(m, q, v).depths > 0.0)
    assert pressed > STATES // 2


@pytest.mark.parametrize("cone", BOUNDS)
def test_a_state_does_not_depend_on_those_beside_it(cone):
    """One in the air, one that touches, friction in the joints: alone and together the same bits, in all substeps."""
    text = LEGS.format(cone=cone, impratio=1, condim=3, solref=".02 1", solimp=USUAL)
    text = text.replace('axis="0 1 0" ref', 'axis="0 1 0" frictionloss=".3" ref')
    m = Mechanism.from_mjcf(text.replace("</mujoco>", '<actuator><motor joint="hip"/></actuator></mujoco>'))
    m = replace(m, body_contacts=())
    dynamics, states = RigidBodyDynamics(m, 0.01, substeps=5), [
        np.concatenate([q, v]) for start in (moving(2, -0.004, -0.001), moving(2, 0.001, 0.02)) for q, v, _ in start(m)
    ]  # fmt: skip
    xs, us = np.array(states)[np.random.default_rng(4).permutation(len(states))], np.ones((len(states), 1))
    alone = np.concatenate([dynamics.step(x[None], u[None]) for x, u in zip(xs, us, strict=True)])
    np.testing.assert_array_equal(dynamics.step(xs, us), alone)
