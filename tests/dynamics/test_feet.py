"""Machines with feet: a ground by what it does, poses at rest on it, what else knows it; others' models stand up."""

import numpy as np
import pytest
from places import PLACES, path

import planner
from planner.base.errors import PlannerError
from planner.cases.problem_file import load
from planner.dynamics.contacts import contact_forces, contact_jacobians
from planner.dynamics.kinematics import center_of_mass
from planner.dynamics.quasi_static import quasi_static_controls
from planner.dynamics.statics import stance_inertia, static_equilibrium
from planner.model.contact.laws import ContactLaw
from planner.model.mechanism import Mechanism
from planner.model.mjcf.ground_law import DAMPING, REST_PENETRATION, SLIP
from planner.problem.default_weights import MAX_CORRECTION_RATE, STANCE_TOLERANCES, default_weights
from planner.problem.goals import MIN_TOLERANCES

others = pytest.mark.skipif(None in PLACES.values(), reason="no models of others")

# A trunk on two slides and a hinge, a driven knee, a foot of two balls.
MONOPED = """
<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1"/>
    <body name="trunk" pos="0 0 1">
      <joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide" axis="0 0 1"/>
      <joint name="tilt" axis="0 1 0"/>
      <inertial pos=".02 0 0" mass="6" diaginertia=".2 .2 .2"/>
      <body name="shank" pos="0 0 -.4">
        <joint name="knee" axis="0 1 0" damping=".1"/>
        <inertial pos="0 0 -.2" mass="1" diaginertia=".02 .02 .02"/>
        <geom name="heel" type="sphere" size=".03" pos="-.1 0 -.4" mass="0"/>
        <geom name="toe" type="sphere" size=".03" pos=".15 0 -.4" mass="0"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="knee" joint="knee" gear="50" ctrlrange="-1 1"/></actuator>
</mujoco>
"""
MASS, G = 7.0, 9.81


def monoped(**law):
    return Mechanism.from_mjcf(MONOPED, contacts=ContactLaw.resting(MASS, **law))


def test_a_ground_by_what_it_does():
    """On one contact the machine sinks in by as much as was asked for, whatever the smoothing."""
    ball = MONOPED.replace('<geom name="toe" type="sphere" size=".03" pos=".15 0 -.4" mass="0"/>', "")
    ball = ball.replace('<joint name="tilt" axis="0 1 0"/>', "").replace('pos="-.1 0 -.4"', 'pos="0 0 -.4"')
    for sink, ramp in ((2e-3, None), (0.02, 1e-3)):
        m = Mechanism.from_mjcf(ball, contacts=ContactLaw.resting(MASS, sink=sink, ramp=ramp))
        at_rest = contact_forces(m, static_equilibrium(m, m.home)[:3], np.zeros(3))
        assert at_rest.depths[0] == pytest.approx(sink, rel=1e-9)
        assert at_rest.forces[0, 2] == pytest.approx(MASS * G, rel=1e-9)
    law = ContactLaw.resting(MASS, sink=0.01, damping_ratio=0.5, friction=0.6, slip=0.3)
    assert law.damping == pytest.approx(np.sqrt(law.stiffness * MASS))  # 2 zeta sqrt(K m)
    assert law.slip_damping * 0.3 == pytest.approx(0.6 * MASS * G)
    with pytest.raises(PlannerError, match="sink is 0, expected"):
        ContactLaw.resting(MASS, sink=0)


@pytest.mark.parametrize("height", [-0.3, 0.0, 0.2])
def test_a_settled_pose_is_at_rest_and_hold_holds_it(height):
    """The ground's forces are those of statics: the weight, at the centre of mass."""
    m = monoped()
    x = static_equilibrium(m, np.array([0.3, height, 0.1, -0.1]))
    assert x[3] == -0.1
    assert x[0] == pytest.approx(0.3, abs=1e-12)  # neither what is driven nor what moves along the ground
    at = contact_forces(m, x[:4], x[4:])
    forces = at.forces[:, 2]
    assert forces.min() > 0.0
    assert forces.sum() == pytest.approx(MASS * G, rel=1e-8)
    assert forces @ at.points[:, 0] / forces.sum() == pytest.approx(center_of_mass(m, x[:4])[0], abs=1e-8)
    u = quasi_static_controls(m, x)
    rates = planner.RigidBodyDynamics(m, dt=1e-3).rates(x[None], u[None])
    np.testing.assert_allclose(rates, 0.0, atol=1e-6)


def test_hold_knows_the_ground_without_the_exact_depth():
    m = monoped()
    x = static_equilibrium(m, np.array([0.0, 0.0, 0.0, 0.1]))
    u = quasi_static_controls(m, x)
    for moved in (-2e-3, 2e-3):
        y = x.copy()
        y[1] += moved
        np.testing.assert_allclose(quasi_static_controls(m, y), u, atol=1e-5)
    x[1] += 1.0  # in the air: as a machine without contacts
    free = Mechanism.from_mjcf(MONOPED, contacts="off")
    np.testing.assert_allclose(quasi_static_controls(m, x), quasi_static_controls(free, x), atol=1e-9)


def test_jacobians_of_contacts_are_those_of_differences():
    m = monoped()
    x = static_equilibrium(m, np.array([0.0, 0.0, 0.0, 0.2]))
    J, h = contact_jacobians(m, x[:4]), 1e-6
    for j in range(4):
        dq = h * np.eye(4)[j]
        depths = [contact_forces(m, x[:4] + side * dq, np.zeros(4)).depths for side in (1.0, -1.0)]
        np.testing.assert_allclose(J[:, 2, j], -(depths[0] - depths[1]) / (2.0 * h), atol=1e-7)


def test_poses_that_cannot_rest():
    with pytest.raises(PlannerError, match="does not stay on the ground"):
        static_equilibrium(monoped(), np.array([0.0, 0.0, 0.0, 1.2]))
    with pytest.raises(PlannerError, match="has no contacts, expected"):
        static_equilibrium(Mechanism.from_mjcf(MONOPED, contacts="off"), np.zeros(4))
    with pytest.raises(PlannerError, match="x has shape"):
        static_equilibrium(monoped(), np.zeros(3))


TOML = """
model = "monoped.xml"
start = {{ knee = 0.1 }}
goal = {{ knee = -0.1 }}
duration = 0.5
dt = 0.005
contacts = {contacts}
{more}
[weights]
effort = 10
final_position = {{ knee = 1000, tilt = 100 }}
final_velocity = 10
"""


def written(tmp_path, contacts, more="settle = true"):
    (tmp_path / "monoped.xml").write_text(MONOPED)
    (tmp_path / "monoped.toml").write_text(TOML.format(contacts=contacts, more=more))
    return tmp_path / "monoped.toml"


@pytest.mark.parametrize(
    ("contacts", "law"),
    [
        ('"ground"', ContactLaw.resting(MASS, sink=REST_PENETRATION, damping_ratio=DAMPING, slip=SLIP)),
        ("{ penetration = 0.01, friction = 0.7 }", ContactLaw.resting(MASS, sink=0.01, friction=0.7)),
        (
            "{ stiffness = 1e4, damping = 100, ramp = 1e-3, slip_damping = 200, friction = 0.5 }",
            ContactLaw(1e4, 100.0, 1e-3, slip_damping=200.0, friction=0.5),
        ),
    ],
)
def test_problem_files_give_a_law(tmp_path, contacts, law):
    problem = load(written(tmp_path, contacts)).problem
    dynamics = problem.dynamics
    assert isinstance(dynamics, planner.RigidBodyDynamics)
    touch = dynamics.mechanism.contacts[0].law
    for name in ("stiffness", "damping", "ramp", "friction"):
        assert getattr(touch, name) == pytest.approx(getattr(law, name), rel=1e-9)
    less = touch.slip_damping / law.slip_damping  # of this light foot, by tests/model/test_ground_law's rule
    assert 0.5 < less < 1.0 if contacts == '"ground"' else less == pytest.approx(1.0, rel=1e-9)
    rates = dynamics.rates(problem.x0[None], problem.first_guess[:1])
    np.testing.assert_allclose(rates, 0.0, atol=1e-5)  # start and guess rest on the ground


@pytest.mark.parametrize(
    ("contacts", "more", "words"),
    [
        ('"soft"', "", "contacts is 'soft', expected one of: auto, avoid, file, ground, model, off"),
        ("{ stifness = 1e4 }", "", "has the key 'stifness', expected some of: penetration, friction"),
        (
            "{ stiffness = 1e4, penetration = 0.01 }",
            "",
            "has the key 'penetration', expected some of: stiffness, damping",
        ),
        ("{ penetration = -1 }", "", "penetration is -1"),
        ('"ground"', "settle = 1", "settle is 1, expected true, false or"),
        ('"off"', "settle = true", "settle of start: the mechanism has no contacts"),
    ],
)
def test_problem_files_name_what_is_wrong(tmp_path, contacts, more, words):
    with pytest.raises(PlannerError) as error:
        load(written(tmp_path, contacts, more))
    assert words in str(error.value)


def test_a_stored_plan_keeps_its_ground(tmp_path):
    plan = planner.solve(load(written(tmp_path, '"ground"')).problem, max_iterations=2)
    plan.save(tmp_path / "plan.npz")
    stored = planner.load_plan(tmp_path / "plan.npz").problem
    assert stored is not None
    assert plan.problem is not None
    np.testing.assert_allclose(stored.x0, plan.problem.x0, atol=1e-10)
    np.testing.assert_allclose(stored.dynamics.step(plan.xs[:-1], plan.us), plan.xs[1:], atol=1e-9)


# Crouched and upright: sums of joint angles that keep the feet flat and the centre of mass above them.
STANDS = {
    "dm hopper": ([0, 0, 0, 0.2, -0.9, 1.2, -0.5], [0, 0, 0, 0.1, -0.4, 0.6, -0.3], 5e-3),
    "dm walker": ([0, 0, 0, 0.5, -1.0, 0.5, 0.5, -1.0, 0.5], [0, 0, 0, 0.2, -0.4, 0.2, 0.2, -0.4, 0.2], 2.5e-3),
}


@others
@pytest.mark.parametrize("name", [pytest.param(one, marks=pytest.mark.slow) for one in ("dm hopper", "dm walker")])
def test_models_of_others_stand_up_and_mujoco_repeats_it(name):
    """Within the ranges of joints and motors; MuJoCo follows with the plan's gains, as one who balances does."""
    crouch, upright, dt = STANDS[name]
    mass = Mechanism.from_mjcf(path(name), contacts="off").mass.sum()
    m = Mechanism.from_mjcf(path(name), contacts=ContactLaw.resting(mass))
    start, goal = static_equilibrium(m, np.array(crouch)), static_equilibrium(m, np.array(upright))
    dynamics, N = planner.RigidBodyDynamics(m, dt), round(1.0 / dt)
    free = {joint: 3.0 for joint in m.joint_names if joint != "rootx"}  # the feet are where they are
    cost = planner.TrackingCost.joints(
        dynamics, goal, N, effort=10.0, final_position=dict.fromkeys(free, 1e3), final_velocity=100.0,
        position=free, velocity=1.0,
    )  # fmt: skip
    problem = planner.Problem(
        dynamics, cost, start, us=np.tile(quasi_static_controls(m, start), (N, 1)), twin=planner.Twin.of(m),
        limits=planner.Limits(control="model"),
        # Its file has MuJoCo's own contact, on which it still rocks: by 0.17 rad/s with gains at every step of the
        # simulator, by 0.33 with those of a controller, which are held for a stage.
        tolerance={"velocity": 0.4},
    )  # fmt: skip
    plan = planner.solve(problem)
    assert plan.success
    moves = [i for i, joint in enumerate(m.joint_names) if joint != "rootx"]
    np.testing.assert_allclose(plan.xs[-1, moves], goal[moves], atol=0.01)
    assert contact_forces(m, plan.xs[:, : m.nq], plan.xs[:, m.nq :]).forces[:, :, 2].sum(axis=1).min() > 0.0
    proof = planner.prove(plan, rollouts=0)
    assert proof.passed, proof
    assert not proof.replay.reached


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
