"""Contact and stops: the law, its twin in NumPy against differences, the kernels against the twin, energy."""

import dataclasses
import math

import numpy as np
import pytest
from contact_machines import MACHINES, SHARP, SOFT, assert_contacts_act, each_touch, law_states
from gradients import assert_step_derivatives
from hypothesis import strategies as st
from trees import CHAINS, actuated, driven, machines, random_state

from planner import dynamics as rigid_body
from planner.base.errors import PlannerError
from planner.dynamics import RigidBodyDynamics, product_of_exponentials
from planner.dynamics.contacts import contact_force, contact_forces, generalized_forces
from planner.model.contact.laws import Contact, ContactLaw, Law, Plane, Stop
from planner.model.mechanism import SCREW, Frame, Mechanism
from planner.proof.engines.motion import normalized

UP = np.array([0.0, 0.0, 1.0])


# ----------------------------------------------------------------------------------------------------------- law


@each_touch
def test_nothing_pulls_and_friction_stays_in_its_cone(touch):
    e, v = law_states(touch, np.random.default_rng(1))
    f = contact_force(touch, UP, e, v)
    assert np.all(f[:, 2] >= 0.0)
    assert np.all(np.linalg.norm(f[:, :2], axis=1) <= touch.friction * f[:, 2] * (1.0 + 1e-12))
    assert np.all(f[e <= 0.0] == 0.0)
    assert np.all(np.sum(f[:, :2] * v[:, :2], axis=1) <= 0.0)
    pulling = touch.stiffness * e - touch.damping * v[:, 2] < -1.0
    assert np.any(pulling & (e > 0.0))  # a spring and damper would pull somewhere


def test_the_smooth_law_and_its_slope_are_continuous():
    """Over every end of a ramp: the jump over an interval falls with its length."""
    v, h = np.array([[0.05, -0.02, 0.01]]), 1e-7
    for end in (0.0, SOFT.ramp):
        far, low, at, high, beyond = (contact_force(SOFT, UP, np.array([end + k * h]), v) for k in (-2, -1, 0, 1, 2))
        assert np.max(np.abs(high - low)) < 3.0 * h * SOFT.stiffness
        assert np.max(np.abs((beyond - at) - (at - far))) < 1e-3 * 2.0 * h * SOFT.stiffness


def test_deep_inside_the_force_is_that_of_a_spring_on_the_real_surface():
    """The lift makes up for both ramps: K (e - a/2) - f/2 at e = depth + lift is K depth."""
    depth = np.array([0.02, 0.03])
    f = contact_force(SOFT, UP, depth + SOFT.surface_offset, np.zeros((2, 3)))
    np.testing.assert_allclose(f[:, 2], SOFT.stiffness * depth, rtol=1e-12)
    assert Law(1e3, ramp=2e-3).force_ramp == pytest.approx(0.2 * 1e3 * 2e-3)


# ---------------------------------------------------------------------------------------------- twin and kernels


def touching(m, x, qd, touch, rng, count=5):
    """A mechanism with contacts whose penetrations at x are what law_states has, on random planes, and with stops."""
    q = x[: m.nq]
    e, _ = law_states(touch, rng)
    carriers = sorted({body.link for body in m.bodies} - {-1})
    slides = [-1, *(i for i in range(m.nv) if m.parent[i] < 0 and m.kind[i] == SCREW and not np.any(m.S[i, :3]))]
    contacts = []
    for k in range(count):
        link, centre, radius = int(rng.choice(carriers)), rng.normal(size=3) * 0.3, float(rng.choice([0.0, 0.05]))
        normal = Plane(rng.normal(size=3)).normal
        slide = int(rng.choice(slides))
        if slide >= 0:  # along itself
            normal = Plane(np.cross(normal, m.T_home[slide, :3, :3] @ m.S[slide, 3:])).normal
        place = product_of_exponentials.world_poses(m, q)[link] @ np.append(centre, 1.0)
        offset = normal @ place[:3] - radius - touch.surface_offset + float(rng.choice(e))
        plane = Plane(normal, offset, rng.normal(size=3), slide)
        contacts.append(Contact(link, centre, radius, plane, touch, f"point {k}"))
    stops = []
    for i in np.flatnonzero(m.kind == SCREW):
        law = Law(1000.0, 10.0, 0.03, 1.0)  # the step study's knee
        side = int(rng.choice([-1, 1]))
        beyond = rng.choice([-0.001, 0.001, 0.029, 0.031, 0.2])
        stops.append(Stop(int(i), q[m.q_address[i]] - side * (beyond - law.surface_offset), side, law))
    return dataclasses.replace(m, contacts=tuple(contacts), stops=tuple(stops))


@machines(12, max_dofs=15, max_bodies=6, sharp=st.booleans())
def test_kernels_are_their_twin(text, seed, sharp):
    """Accelerations, and A of an Euler step, with prescribed joints among them."""
    bare, xs, us, rng = driven(text, seed, K=1, integrator="euler", dt=1.0)
    x = normalized(bare.mechanism, xs[0])
    m = touching(bare.mechanism, x, None, SHARP if sharp else SOFT, rng)
    assert_contacts_act(bare, m, x, us)


@pytest.mark.parametrize("integrator", ["semi-implicit-euler", "rk4"])
@pytest.mark.parametrize("name", MACHINES)
def test_jacobians_of_a_stage_with_contacts(name, integrator):
    rng = np.random.default_rng(3)
    m = Mechanism.from_mjcf(actuated(MACHINES[name], rng))
    x = random_state(m.space, rng, unnormalized=False)
    m = touching(m, x, x[m.nq : m.nq + m.nv], SOFT, rng)
    dynamics = RigidBodyDynamics(m, 1e-3, integrator)
    assert_step_derivatives(dynamics, x, rng.normal(size=dynamics.nu), h=1e-7, within=1e-6)


def test_batches_are_their_states():
    rng = np.random.default_rng(4)
    m = Mechanism.from_mjcf(CHAINS["arm"])
    xs = np.array([random_state(m.space, rng) for _ in range(5)])
    m = touching(m, xs[0], None, SOFT, rng)
    q, qd = xs[:, : m.nq], xs[:, m.nq : m.nq + m.nv]
    many = contact_forces(m, q, qd)
    assert many.points.shape == many.forces.shape == (5, 5, 3)
    for k in range(5):
        for ours, all_of_them in zip(contact_forces(m, q[k], qd[k]), many, strict=True):
            np.testing.assert_allclose(ours, all_of_them[k], atol=1e-12)


def test_functions_of_applied_forces_leave_contacts_out():
    rng = np.random.default_rng(5)
    m = Mechanism.from_mjcf(CHAINS["body in space"])
    x = random_state(m.space, rng, unnormalized=False)
    q, qd, tau = x[: m.nq], x[m.nq : m.nq + m.nv], rng.normal(size=m.nv)
    touched = touching(m, x, qd, SOFT, rng)
    assert np.max(np.abs(generalized_forces(touched, q, qd))) > 1.0
    for function in (rigid_body.forward_dynamics, rigid_body.rnea):
        np.testing.assert_array_equal(function(touched, q, qd, tau), function(m, q, qd, tau))


# --------------------------------------------------------------------------------------------------------- motion

FALLING = """<mujoco><option gravity="0 0 -9.81"/><worldbody><body pos="0 0 0.4"><freejoint/>
  <inertial pos="0 0 0" mass="1" diaginertia="0.02 0.03 0.01"/>
  <body pos="0.1 0 0"><joint name="elbow" axis="0 1 0" springref="0.5" stiffness="3"/>
  <inertial pos="0.1 0 0" mass="0.5" diaginertia="0.001 0.004 0.004"/></body></body></worldbody>
  <actuator><motor joint="elbow"/></actuator></mujoco>"""


def energies(m, q, qd):
    """Kinetic, of gravity and of the spring (K,), J."""
    frames = [Frame(i, np.block([[np.eye(3), m.com[i][:, None]], [np.zeros(3), 1.0]])) for i in range(m.nv)]
    falls = [m.mass[i] * rigid_body.frame_pose(m, q, frames[i])[:, :3, 3] @ m.gravity for i in range(m.nv) if m.mass[i]]
    kinetic = 0.5 * np.einsum("ki,kij,kj->k", qd, rigid_body.mass_matrix(m, q), qd)
    return kinetic - np.sum(falls, axis=0) + 0.5 * (q[:, m.q_address] - m.spring_rest) ** 2 @ m.stiffness


def dropped(touch, steps=1500, dt=5e-4):
    """Energies in flight, and the lowest depths of two linked bodies that fall on a floor on four points."""
    m = Mechanism.from_mjcf(FALLING)
    floor, links = Plane(UP), (5, 6)
    points = [Contact(i, np.array([s * 0.1, 0.0, 0.0]), 0.03, floor, touch) for i in links for s in (-1, 1)]
    m = dataclasses.replace(m, contacts=tuple(points))
    dynamics, xs = RigidBodyDynamics(m, dt, "rk4"), np.tile(m.home, (steps, 1))
    xs[0, m.nq : m.nq + 6] = [0.5, 0.0, 0.0, 1.0, 2.0, 0.5]
    for n in range(1, steps):
        xs[n] = dynamics.step(xs[n - 1 : n], np.zeros((1, 1)))[0]
    q, qd = xs[:, : m.nq], xs[:, m.nq :]
    depths = contact_forces(m, q, qd).depths.max(axis=1)
    return energies(m, q, qd)[depths < -touch.surface_offset], depths


def test_contact_creates_no_energy():
    flying, depths = dropped(SOFT)
    assert np.sum(np.diff((depths > 0.0).astype(int)) == 1) >= 2  # it touches, and again
    assert np.all(np.diff(flying) < 1e-6)
    assert flying[-1] < 0.9 * flying[0]
    assert depths.max() < 0.05


def test_without_damping_and_friction_contact_keeps_energy():
    flying, depths = dropped(ContactLaw(5e3, ramp=5e-3, force_ramp=5.0))
    assert depths.max() > SOFT.ramp
    assert np.ptp(flying) < 1e-4 * np.abs(flying[0])  # RK4's error at half a millisecond


# ---------------------------------------------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda: ContactLaw(0.0), "stiffness is 0.0, expected a finite number greater than 0."),
        (lambda: ContactLaw(1.0, damping=-1.0), "damping is -1.0, expected a finite number of at least 0."),
        (lambda: ContactLaw(1.0, friction=math.nan), "friction is nan"),
        (lambda: ContactLaw(1.0, impratio=0.0), "impratio is 0.0"),
        (lambda: ContactLaw(1.0, lead=-1.0), "lead is -1.0"),
        (lambda: ContactLaw(1.0, lead=0.01, friction=1.0), "impratio is inf, expected a finite number for an elliptic"),
        (lambda: ContactLaw(1.0, cone="round"), "cone is 'round', expected one of: elliptic, pyramidal."),
        (lambda: Law(1.0, ramp="wide"), "ramp is 'wide'"),
        (lambda: Plane(np.zeros(3)), "expected a direction"),
        (lambda: Plane(UP, np.inf), "offset is inf"),
        (lambda: Contact(-1, np.zeros(3), 0.0, Plane(UP), SOFT), "link is -1"),
        (lambda: Contact(0, np.zeros(2), 0.0, Plane(UP), SOFT), "centre has shape"),
        (lambda: Stop(0, 0.0, 0, Law(1.0)), "side is 0, expected 1 or -1."),
    ],
)
def test_bad_numbers_are_one_sentence(make, sentence):
    with pytest.raises(PlannerError) as error:
        make()
    assert sentence in str(error.value)
    assert "\n" not in str(error.value)


def test_a_contact_is_of_a_link_that_exists():
    m = Mechanism.from_mjcf(CHAINS["arm"])
    contact = Contact(m.nv, np.zeros(3), 0.0, Plane(UP), SOFT)
    with pytest.raises(PlannerError, match=r"contacts\[0\] is of link .*, expected one with a body"):
        dataclasses.replace(m, contacts=(contact,))
    carried = Contact(m.nv - 1, np.zeros(3), 0.0, Plane(UP, slide=0), SOFT)
    with pytest.raises(PlannerError, match="carried by dof 0, expected that of a slide on the world along the plane"):
        dataclasses.replace(m, contacts=(carried,))
    balls = Mechanism.from_mjcf(CHAINS["balls"])
    with pytest.raises(PlannerError, match="expected one of a hinge or slide"):
        dataclasses.replace(balls, stops=(Stop(0, 0.0, 1, Law(1.0)),))
