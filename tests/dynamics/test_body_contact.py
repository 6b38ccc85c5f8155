"""Contact of two bodies: closest points, the twin in NumPy against differences, the kernels against it, energy."""

import dataclasses

import numpy as np
import pytest
from contact_machines import MACHINES, SHARP, SOFT, assert_contacts_act, each_touch, law_states
from gradients import assert_step_derivatives, assert_step_derivatives_near_kinks
from hypothesis import strategies as st
from trees import actuated, driven, machines, random_state

from planner.base.errors import PlannerError
from planner.dynamics import RigidBodyDynamics
from planner.dynamics import algorithms as rigid_body
from planner.dynamics.contact_kinematics import BodyContactKinematics, closest_points
from planner.dynamics.contacts import body_contact_forces
from planner.dynamics.kinematics import LinkPlaces, angular_momentum, center_of_mass
from planner.model.contact.body_contact import BodyContact, Capsule
from planner.model.contact.laws import ContactLaw
from planner.model.mechanism import Mechanism
from planner.proof.engines.motion import normalized

HINGES = """<mujoco><worldbody>
  <body><joint name="one" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -.3" size=".03"/></body>
  <body pos=".2 0 0"><joint axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -.3" size=".03"/></body></worldbody>
  <actuator><motor joint="one"/></actuator></mujoco>"""

# ------------------------------------------------------------------------------------------------- closest points


def unit_rows(rng, K):
    a = rng.normal(size=(K, 3))
    return a / np.linalg.norm(a, axis=1)[:, None]


def test_closest_points_are_closer_than_all_others():
    """Of segments in all positions: against a grid of points on both, for which no formula is needed."""
    rng, K, half = np.random.default_rng(0), 300, (0.4, 0.7)
    D, a1, a2 = rng.normal(size=(K, 3)), unit_rows(rng, K), unit_rows(rng, K)
    closest = closest_points(D, a1, a2, half, 0.0)
    grids = [np.linspace(-length, length, 61) for length in half]
    u, v = (grid.ravel() for grid in np.meshgrid(*grids))
    apart = np.linalg.norm(D[:, None] + u[:, None] * a1[:, None] - v[:, None] * a2[:, None], axis=2)
    least, found = apart.min(axis=1), np.linalg.norm(closest.D, axis=1)
    assert np.all(found <= least + 1e-12)
    steps = np.hypot(*(grid[1] - grid[0] for grid in grids))
    assert np.all(found >= least - steps)
    assert np.all(np.abs(closest.s) <= np.array(half) + 1e-15)
    ends = np.sum(np.abs(closest.s) == half, axis=1)
    assert {0, 1, 2} <= set(ends)  # every case was there


def test_blunt_points_are_little_farther_apart():
    """The bound of planner.model.contact.body_contact: ramp^2 / 2|D|, at any angle, parallel ones among them."""
    rng, K = np.random.default_rng(1), 400
    contact = BodyContact(Capsule(0, np.zeros(3), [0.3, 0, 0], 0.05), Capsule(1, np.zeros(3), [0, 0.2, 0], 0.0), SOFT)
    half, b = (contact.first.length, contact.second.length), contact.axis_regularization
    assert b == pytest.approx((SOFT.ramp / 0.5) ** 2)
    D, a1 = unit_rows(rng, K) * 0.1, unit_rows(rng, K)
    a2 = a1 + unit_rows(rng, K) * 10.0 ** rng.uniform(-9, 0, size=(K, 1))
    a2 /= np.linalg.norm(a2, axis=1)[:, None]
    a2[:50] = a1[:50]
    blunt, sharp = (np.linalg.norm(closest_points(D, a1, a2, half, x).D, axis=1) for x in (b, 1e-12))
    assert np.all(blunt >= sharp - 1e-9)
    assert np.all(blunt - sharp <= SOFT.ramp**2 / (2.0 * sharp) + 1e-9)
    assert np.max(blunt - sharp) > 1e-5  # and it does something


# ---------------------------------------------------------------------------------------------- twin and kernels


def meeting(m, x, touch, rng, count=4):
    """A mechanism with spheres and capsules of links and of the world that meet at x as deep as law_states has it."""
    carriers, contacts = sorted({body.link for body in m.bodies} - {-1}), []
    for _ in range(count):
        links, long = rng.permutation([-1, *carriers])[:2], rng.integers(3)  # how many are capsules
        first, second = (
            Capsule(int(link), rng.normal(size=3) * 0.3, rng.normal(size=3) * 0.2 * (long > k), 0.05 + 0.1 * k)
            for k, link in enumerate(links)
        )
        above = BodyContactKinematics(
            LinkPlaces(m, x[: m.nq]), BodyContact(first, second, touch), np.zeros((1, m.nv))
        ).e[0]
        radius = second.radius - above + rng.choice(law_states(touch, rng)[0])
        contacts.append(BodyContact(first, dataclasses.replace(second, radius=max(radius, 0.0)), touch))
    return dataclasses.replace(m, body_contacts=tuple(contacts))


@machines(12, max_dofs=15, max_bodies=6, sharp=st.booleans())
def test_kernels_are_their_twin(text, seed, sharp):
    """Accelerations, and A of an Euler step, with prescribed joints among them."""
    bare, xs, us, rng = driven(text, seed, K=1, integrator="euler", dt=1.0)
    x = normalized(bare.mechanism, xs[0])
    assert_contacts_act(bare, meeting(bare.mechanism, x, SHARP if sharp else SOFT, rng), x, us)


@pytest.mark.parametrize("integrator", ["semi-implicit-euler", "rk4"])
@pytest.mark.parametrize("name", MACHINES)
def test_jacobians_of_a_stage(name, integrator):
    rng = np.random.default_rng(3)
    m = Mechanism.from_mjcf(actuated(MACHINES[name], rng))
    x = random_state(m.space, rng, unnormalized=False)
    m = meeting(m, x, SOFT, rng)
    assert np.max(np.abs(body_contact_forces(m, x[: m.nq], x[m.nq : m.nq + m.nv]).forces)) > 1.0
    dynamics = RigidBodyDynamics(m, 1e-3, integrator)
    assert_step_derivatives_near_kinks(dynamics, x, rng.normal(size=dynamics.nu), h=1e-6)


def test_lanes_are_their_states():
    """Four knots that touch at other ends, or not at all, beside each other as one by one; so does the twin."""
    rng = np.random.default_rng(4)
    m = Mechanism.from_mjcf(actuated(MACHINES["body over a belt"], rng))
    xs = np.array([random_state(m.space, rng) for _ in range(6)])
    m = meeting(m, xs[0], SOFT, rng)
    xs[1] = m.space.integrate(xs[:1], 1e-3 * rng.normal(size=(1, m.space.ndx)))[0]
    dynamics, us = RigidBodyDynamics(m, 1e-3), rng.normal(size=(6, m.nu))
    together, alone = dynamics.linearize(xs, us), [dynamics.linearize(xs[[k]], us[[k]]) for k in range(6)]
    for k, parts in enumerate(alone):
        for ours, one in zip(together, parts, strict=True):
            np.testing.assert_array_equal(ours[k], one[0])
    q, qd = xs[:, : m.nq], xs[:, m.nq : m.nq + m.nv]
    many = body_contact_forces(m, q, qd)
    assert many.points.shape == many.forces.shape == (6, 4, 3)
    touching = np.any(many.forces, axis=2)
    assert np.any(touching, axis=0).all()
    assert not np.any(touching.all(axis=0))
    for k in range(6):
        for ours, all_of_them in zip(body_contact_forces(m, q[k], qd[k]), many, strict=True):
            np.testing.assert_allclose(ours, all_of_them[k], atol=1e-12)


# ----------------------------------------------------------------------------------------------- two free bodies

TWO = """<mujoco><option gravity="0 0 0"/><worldbody>
  <body pos="0 0 0.5"><freejoint/><inertial pos="0 0 0" mass="1" diaginertia="0.02 0.03 0.01"/></body>
  <body pos="0.1 0 0"><freejoint/><inertial pos="0 0 0" mass="0.4" diaginertia="0.01 0.02 0.02"/>
  <body pos="0 0 0.1"><joint name="elbow" axis="0 1 0"/><inertial pos="0 0 0" mass=".1"
    diaginertia=".001 .001 .001"/></body></body></worldbody>
  <actuator><motor joint="elbow"/></actuator></mujoco>"""


def rods(touch, turn=(0.0, 0.0, 0.0)):
    """Two free capsules, 0.07 m apart or less, the second along x and the first turned from that; and their state."""
    m = Mechanism.from_mjcf(TWO)
    parts = [Capsule(link, np.zeros(3), [0.1, 0.0, 0.0], 0.04) for link in (5, 11)]
    m = dataclasses.replace(m, body_contacts=(BodyContact(*parts, touch, "rods"),))
    x = m.home
    x[:3], x[7:10] = [0.03, 0.0, 0.57], [0.0, 0.0, 0.5]
    x[3:7] = [1.0, *(0.5 * np.asarray(turn))]
    x[3:7] /= np.linalg.norm(x[3:7])
    return m, x


@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (0.0, 2e-4, 1e-3), (0.1, 0.4, 0.3)])
@each_touch
def test_parallel_capsules_have_forces_and_slopes(touch, turn):
    """Exactly parallel ones too; with a ramp the slopes are those of differences."""
    m, x = rods(touch, turn)
    qd = np.random.default_rng(5).normal(size=m.nv)
    x = np.concatenate([x[: m.nq], qd])
    q, dynamics = x[: m.nq], RigidBodyDynamics(m, 1e-4)
    A, _ = dynamics.linearize(x[None], np.zeros((1, 1)))
    assert np.all(np.isfinite(A))
    force = body_contact_forces(m, q, np.zeros(m.nv)).forces[0]
    assert force[2] > 0.9 * touch.stiffness * 0.0085
    if touch is SOFT:
        assert_step_derivatives(dynamics, x, np.zeros(1), h=1e-8, within=1e-5)


def collided(touch, steps=600, dt=2e-4):
    """Two bodies that fly at each other, turning, and meet askew: states (steps, nx) and how deep they were."""
    m, x = rods(touch, (0.3, -0.2, 0.6))
    x[2] += 0.03
    x[m.nq :] = np.concatenate([[0.1, 0.0, -1.0, 1.0, 0.5, -2.0], [0.0, 0.1, 0.5, 0.0, 2.0, 1.0], [0.5]])
    dynamics, xs = RigidBodyDynamics(m, dt), np.tile(x, (steps, 1))
    for n in range(1, steps):
        xs[n] = dynamics.step(xs[n - 1 : n], np.zeros((1, 1)))[0]
    depths = body_contact_forces(m, xs[:, : m.nq], xs[:, m.nq :]).depths[:, 0]
    assert max(depths[0], depths[-1]) < -touch.surface_offset
    assert depths.max() > 2e-3
    return m, xs


def kinetic(m, x):
    return 0.5 * x[m.nq :] @ rigid_body.mass_matrix(m, x[: m.nq]) @ x[m.nq :]


@each_touch
def test_momentum_is_kept_and_energy_never_made(touch):
    """Linear and angular, to RK4's error; damping and friction only take energy."""
    m, xs = collided(touch)
    q, qd = xs[:, : m.nq], xs[:, m.nq :]
    centre, spin = center_of_mass(m, q), angular_momentum(m, q, qd)
    straight = centre[0] + np.arange(len(xs))[:, None] * (centre[1] - centre[0])
    np.testing.assert_allclose(centre, straight, atol=1e-10)
    np.testing.assert_allclose(spin, np.broadcast_to(spin[0], spin.shape), atol=1e-7)
    assert kinetic(m, xs[-1]) < kinetic(m, xs[0]) - 0.01


@pytest.mark.parametrize(("ramp", "error"), [(0.0, 1e-5), (2e-3, 1e-3)])
def test_a_spring_gives_back_all_energy(ramp, error):
    """Without damping and friction the force has a potential, of the depth alone, however the normal turns.

    That holds for the closest points; a ramp takes others, by a share b = (ramp / 0.2 m)^2 = 1e-4 of their positions.
    """
    m, xs = collided(ContactLaw(stiffness=2e3, ramp=ramp))
    assert kinetic(m, xs[-1]) == pytest.approx(kinetic(m, xs[0]), rel=error)
    assert np.max(np.abs(xs[-1, m.nq :] - xs[0, m.nq :])) > 0.5


# -------------------------------------------------------------------------------------------------------- refusals


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda: Capsule(-2, np.zeros(3), np.zeros(3), 0.1), "link is -2"),
        (lambda: Capsule(0, np.zeros(3), np.zeros(2), 0.1), "half has shape"),
        (lambda: Capsule(0, np.zeros(3), np.zeros(3), -0.1), "radius is -0.1"),
        (lambda: BodyContact(*[Capsule(3, np.zeros(3), np.zeros(3), 0.1)] * 2, SOFT), "both of link 3"),
        (lambda: BodyContact(*(Capsule(k, np.zeros(3), np.zeros(3), 0.0) for k in (0, 1)), SOFT), "radius 0"),
    ],
)
def test_bad_numbers_are_one_sentence(make, sentence):
    with pytest.raises(PlannerError) as error:
        make()
    assert sentence in str(error.value)
    assert "\n" not in str(error.value)


def test_machines_refuse_parts_of_links_that_are_not_there():
    m, _ = rods(SOFT)
    pair = m.body_contacts[0]
    far = dataclasses.replace(pair, second=dataclasses.replace(pair.second, link=m.nv))
    with pytest.raises(PlannerError, match=r"body_contacts\[0\] is of link 13, expected one with a body"):
        dataclasses.replace(m, body_contacts=(far,))
    with pytest.raises(PlannerError, match='hessian="exact"'):
        RigidBodyDynamics(Mechanism.from_mjcf(HINGES, contacts=SOFT), 1e-3).second_order_memory()
