"""Kernels of contacts with a lead: they solve the law's equation, have exact derivatives, and keep lanes apart."""

from dataclasses import replace

import numpy as np
import pytest
from closed_chains import four_bar
from gradients import step_derivatives
from lead_contacts import turning
from machines import FRICTION_ARM
from trees import driven, machines, random_state

from planner import Mechanism
from planner.base.errors import PlannerError
from planner.dynamics import RigidBodyDynamics, mass_matrix
from planner.dynamics.assembly import feasible_directions
from planner.dynamics.contact_kinematics import contact_kinematics
from planner.dynamics.contacts import contact_wrench
from planner.dynamics.joint_forces import friction_forces
from planner.dynamics.kinematics import LinkPlaces, frame_pose
from planner.model.contact.body_contact import BodyContact, Capsule
from planner.model.contact.laws import Contact, ContactLaw, Plane
from planner.model.mechanism import Frame

RISING = {"ramp": 4e-3, "force_ramp": 0.0, "impedance": (0.5, 0.9, 5e-3, 0.4)}
LAWS = {
    "pyramidal": ContactLaw(2e3, 80.0, friction=0.7, lead=0.02, cone="pyramidal", **RISING),
    "elliptic": ContactLaw(2e3, 80.0, friction=0.7, impratio=10.0, lead=0.02, bend=0.5, **RISING),
    "sharp": ContactLaw(2e3, 80.0, force_ramp=0.0, friction=0.7, impratio=1.0, lead=0.02, bend=0.0),
    "pyramidal, rolling": ContactLaw(
        2e3, 80.0, friction=0.7, lead=0.02, cone="pyramidal", spinning=0.05, rolling=0.02, **RISING
    ),
    "elliptic, rolling": ContactLaw(
        2e3, 80.0, friction=0.7, impratio=10.0, lead=0.02, bend=0.5, spinning=0.05, rolling=0.02, **RISING
    ),
    "elliptic, spinning": ContactLaw(2e3, 80.0, friction=0.7, impratio=2.0, lead=0.02, spinning=0.05, **RISING),
    "no friction": ContactLaw(2e3, 80.0, lead=0.02, **RISING),
}
BELT = """<mujoco><worldbody><body><joint name="belt" type="slide" axis="1 0 0"/><geom size=".1"/></body>
  <body pos="0 0 1"><joint type="slide" axis="0 0 1"/><geom size=".1"/></body></worldbody>
  <actuator><motor joint="belt"/></actuator></mujoco>"""
every_law = pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)


def touching(m, x, law, rng, count=3):
    """The machine with soft contacts of random spheres whose planes run through them at a state x (nx,)."""
    contacts, carriers = [], sorted({body.link for body in m.bodies} - {-1})
    for _ in range(count):
        link, n = int(rng.choice(carriers)), rng.normal(size=3)
        n /= np.linalg.norm(n)
        T = np.eye(4)
        T[:3, 3] = 0.3 * rng.normal(size=3)
        centre = frame_pose(m, x[None, : m.nq], Frame(link, T))[0, :3, 3]
        plane = Plane(n, n @ centre - 0.05 + rng.uniform(-1e-3, 8e-3), 0.3 * rng.normal(size=3))
        contacts.append(Contact(link, T[:3, 3], 0.05, plane, law))
    return replace(m, contacts=tuple(contacts))


def residual(m, x, u, a):
    """What is left of the equation of motion (n,) along the feasible directions at accelerations a (nv,), N and N m."""
    q, v = x[: m.nq], x[m.nq : m.nq + m.nv]
    free = replace(m, contacts=(), friction_loss=np.zeros(m.nv))
    M, without = mass_matrix(m, q), RigidBodyDynamics(free, 0.01).rates(x[None], u[None])[0, m.nv : 2 * m.nv]
    r, size = M @ (a - without), np.abs(M).max() * np.abs(a).max()
    r -= friction_forces(m, v, a)[0]
    for contact in m.contacts:
        place = contact_kinematics(LinkPlaces(m, q), contact, v[None])
        J, lead = np.vstack([place.J[0], turning(place)]), contact.law.lead
        ahead = np.append(place.v[0], J[3:] @ v) + lead * (J @ a)
        f = contact_wrench(contact.law, place.n, place.e, ahead[None, :3], ahead[None, 3:])[0][0]
        r, size = r - J.T @ f, max(size, np.abs(f).max())
    return feasible_directions(m, q)[0].T @ r / size


@every_law
@machines(examples=15, max_dofs=14, max_bodies=6)
def test_accelerations_solve_the_laws_equation(law, text, seed):
    dynamics, xs, us, rng = driven(text, seed, K=1, prescribe=False)
    m = touching(dynamics.mechanism, xs[0], law, rng)
    a = RigidBodyDynamics(m, 0.01).rates(xs, us)[0, m.nv : 2 * m.nv]
    # A law is met to 1e-10 of its spring and damper before the cone cuts them off: of what may be a hundred times more.
    assert np.abs(residual(m, xs[0], us[0], a)).max() < 1e-8


@every_law
@pytest.mark.parametrize("make", [lambda: Mechanism.from_mjcf(FRICTION_ARM), four_bar], ids=["friction", "loop"])
def test_beside_friction_loss_and_closed_chains(make, law):
    m, worst, rng = make(), 0.0, np.random.default_rng(0)
    for _ in range(10):
        x = m.home
        Z = feasible_directions(m, x[: m.nq])[0]
        x[m.nq : m.nq + m.nv] = Z @ rng.normal(size=Z.shape[1])
        held = touching(m, x, law, rng)
        u = rng.normal(size=m.nu)
        a = RigidBodyDynamics(held, 0.01).rates(x[None], u[None])[0, m.nv : 2 * m.nv]
        worst = max(worst, float(np.abs(residual(held, x, u, a)).max()))
    assert worst < 1e-9


@pytest.mark.parametrize("integrator", ["semi-implicit-euler", "rk4", "rosenbrock"])
@pytest.mark.parametrize("name", ["pyramidal", "elliptic", "pyramidal, rolling", "elliptic, rolling", "no friction"])
def test_derivatives_of_a_stage(name, integrator):
    rng, errors = np.random.default_rng(1), []
    text = """<mujoco><worldbody><body><freejoint/><geom size=".1" mass="3"/><body pos=".1 0 0"><joint type="ball"/>
      <geom type="capsule" fromto="0 0 0 .2 0 -.1" size=".03" mass="1"/><body pos=".2 0 -.1">
      <joint name="hinge" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 .1 .1 -.2" size=".02" mass=".5"/></body></body></body></worldbody>
      <actuator><motor joint="hinge"/></actuator></mujoco>"""
    m = Mechanism.from_mjcf(text, contacts="off")
    for _ in range(12):
        x = m.space.integrate(m.home, 0.5 * rng.normal(size=m.space.ndx))
        dynamics = RigidBodyDynamics(touching(m, x, LAWS[name], rng), 1e-3, integrator)
        A, _ = dynamics.linearize(np.stack([x, x]), np.zeros((1, 1)))
        by_x, _ = step_derivatives(dynamics, x[None], np.zeros((1, 1)), 1e-7)
        errors.append(np.abs(by_x - A).max() / max(1.0, np.abs(A).max()))
    # The forces have kinks where an edge of the cone lets go: differences over one are off by the jump of the slope.
    assert np.median(errors) < 1e-8
    assert np.mean(np.array(errors) < 1e-6) > 0.8


@every_law
def test_lanes_do_not_feel_each_other(law):
    rng = np.random.default_rng(2)
    m = Mechanism.from_mjcf(FRICTION_ARM)
    x = random_state(m.space, rng, unnormalized=False)
    held = touching(m, x, law, rng)
    dynamics = RigidBodyDynamics(held, 0.01)
    near = [m.space.integrate(x, 0.01 * rng.normal(size=m.space.ndx)) for _ in range(2)]
    xs = np.array([x, *near, np.full(m.space.nx, np.nan)])
    us = rng.normal(size=(4, m.nu))
    together = dynamics.rates(xs, us)
    for k in range(3):
        np.testing.assert_array_equal(together[k], dynamics.rates(xs[k : k + 1], us[k : k + 1])[0])


def test_a_lead_is_for_planes_at_rest():
    m, law = Mechanism.from_mjcf(BELT), LAWS["elliptic"]
    on_slide = Contact(1, np.zeros(3), 0.1, Plane(np.array([0.0, 0.0, 1.0]), slide=0), law)
    of_bodies = BodyContact(*(Capsule(link, np.zeros(3), np.zeros(3), 0.1) for link in (0, 1)), law)
    for machine in (replace(m, contacts=(on_slide,)), replace(m, body_contacts=(of_bodies,))):
        with pytest.raises(PlannerError, match="lead, expected a sphere and a plane at rest"):
            RigidBodyDynamics(machine, 0.01)
