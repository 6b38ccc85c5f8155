"""Coupled machines against a KKT solution, a machine in reduced coordinates, energy, differences and complex steps."""

import re
from dataclasses import replace

import numpy as np
import pytest

from planner import Mechanism, PlannerError, RigidBodyDynamics
from planner.dynamics import algorithms as rb
from planner.dynamics import product_of_exponentials
from planner.dynamics.contacts import contact_forces
from planner.dynamics.kinematics import center_of_mass
from planner.dynamics.quasi_static import quasi_static_controls
from planner.dynamics.statics import static_equilibrium
from planner.model.contact.laws import ContactLaw
from planner.model.couplings import Coupling, closed_state
from planner.model.mechanism import SCREW
from planner.problem.initial_guess import inverse_dynamics_controls, quintic
from tests.trees import actuated, machines, random_state, relative_error, stepped


def coupled_dynamics(mechanism, q, qd, tau):
    """Accelerations qdd (nv,) = G (G' M G)^-1 G' (tau - h) under tau (nv,) of a mechanism with couplings."""
    G = mechanism.reduction.G
    M = G.T @ product_of_exponentials.mass_matrix(mechanism, q) @ G
    return G @ np.linalg.solve(M, G.T @ (tau - product_of_exponentials.bias(mechanism, q, qd)))


def coupled(text, rng, prescribe=False):
    """A random tree with actuators and, if it has the joints for it, couplings; with joints that are prescribed."""
    m = Mechanism.from_mjcf(actuated(text, rng))
    screws = rng.permutation(np.flatnonzero(m.kind == SCREW))
    free = [i for links in m.joint_links if links.stop - links.start == 6 for i in range(links.start, links.stop)]
    screws = np.array([i for i in screws if i not in free])
    prescribed = []
    if prescribe and len(screws) > 4:
        prescribed, screws = [m.joint_of(int(i)).split("'")[1] for i in screws[:2]], screws[2:]
    couplings = []
    for k in range(min(3, len(screws) - 1)):
        dofs = rng.permutation(screws)[: rng.integers(1, 4)]
        couplings.append(Coupling(f"equality {k}", tuple(map(int, dofs)), tuple(rng.normal(size=len(dofs))), 0.0))
    return replace(m, couplings=tuple(couplings)), prescribed


def kkt(m, M, force):
    """Accelerations and forces of the couplings from the whole system; least squares, as couplings may repeat."""
    J = np.zeros((len(m.couplings), m.nv))
    for row, coupling in zip(J, m.couplings, strict=True):
        np.add.at(row, list(coupling.dofs), coupling.coefficients)
    K = np.block([[M, J.T], [J, np.zeros((len(J), len(J)))]])
    return np.linalg.lstsq(K, np.concatenate([force, np.zeros(len(J))]), rcond=1e-13)[0][: m.nv]


def scale(m, M, force):
    """What rounding of an acceleration is measured by: the forces through the reduced inverse."""
    return np.abs(rb.reduced_inverse(m, M)) @ np.abs(force) + 1.0


@machines(25, max_dofs=20)
def test_accelerations_are_those_of_multipliers(text, seed):
    rng = np.random.default_rng(seed)
    m, _ = coupled(text, rng)
    x = random_state(m.space, rng, unnormalized=False)
    q, qd, _ = np.split(x, [m.nq, m.nq + m.nv])
    tau = rng.normal(size=m.nv)
    M, force = rb.mass_matrix(m, q), tau - rb.bias(m, q, qd)
    expected = kkt(m, M, force)
    size = scale(m, M, force)
    found = rb.forward_dynamics(m, q, qd, tau)
    # the whole system's own rounding grows with its condition
    bound = 1e-12 * np.linalg.cond(M)
    assert np.all(np.abs(found - expected) <= bound * size)
    if m.couplings:
        assert np.all(np.abs(coupled_dynamics(m, q, qd, tau) - expected) <= bound * size)
    rates = RigidBodyDynamics(m, 0.01).rates(x[None], np.zeros((1, m.nu)))[0]
    own = RigidBodyDynamics(replace(m, couplings=()), 0.01).rates(x[None], np.zeros((1, m.nu)))[0]
    force = M @ own[m.nv : 2 * m.nv]  # actuators and bias, by the tree's own recursion
    assert np.all(np.abs(rates[m.nv : 2 * m.nv] - kkt(m, M, force)) <= bound * scale(m, M, force))
    for coupling in m.couplings:
        assert abs(rates[m.nv + np.array(coupling.dofs)] @ coupling.coefficients) < 1e-10 * np.abs(rates).max()


@machines(12, max_dofs=16)
@pytest.mark.parametrize("integrator", ["rk4", "semi-implicit-euler"])
def test_derivatives_are_those_of_differences(integrator, text, seed):
    """Along random directions, prescribed joints among them; central differences of fourth order."""
    rng = np.random.default_rng(seed)
    m, prescribed = coupled(text, rng, prescribe=True)
    dynamics = RigidBodyDynamics(m, 0.005, integrator, prescribed)
    x, u = random_state(m.space, rng, unnormalized=False), rng.normal(size=dynamics.nu)
    A, B = dynamics.linearize(np.stack([x, x]), u[None])
    dx, du, h = rng.normal(size=m.space.ndx), rng.normal(size=dynamics.nu), 1e-3
    steps = h * np.array([-2.0, -1.0, 1.0, 2.0])
    ends = dynamics.step(m.space.integrate(np.tile(x, (4, 1)), steps[:, None] * dx), u + steps[:, None] * du)
    moved = m.space.difference(ends, dynamics.step(x[None], u[None]))
    slope = np.array([1.0, -8.0, 8.0, -1.0]) @ moved / (12.0 * h)
    wanted = A[0] @ dx + B[0] @ du
    # error of the differences: h^4 of derivatives that grow with the fastest rate; random trees have some of 100
    assert relative_error(wanted, slope) < 2e-5


@machines(6, max_dofs=16)
def test_derivatives_are_those_of_a_complex_step(text, seed):
    rng = np.random.default_rng(seed)
    m, _ = coupled(text, rng)
    if not m.couplings:
        return
    q, qd, _ = np.split(random_state(m.space, rng, unnormalized=False), [m.nq, m.nq + m.nv])
    tau, h = rng.normal(size=m.nv), 1e-30
    D = rb.forward_dynamics_derivatives(m, q, qd, tau)
    dq, dqd, dtau = rng.normal(size=(3, m.nv))
    moved = coupled_dynamics(m, stepped(m, q, dq, 1j * h), qd + 1j * h * dqd, tau + 1j * h * dtau)
    M = rb.mass_matrix(m, q)
    bound = 1e-13 * np.linalg.cond(M)
    slope = moved.imag / h
    assert np.abs(D.q @ dq + D.qd @ dqd + D.input @ dtau - slope).max() <= bound * (1.0 + np.abs(slope).max()) * 100.0


SLIDERS = """
<mujoco><option gravity="0 0 -9.81"/><worldbody>
  <body><joint name="a" type="slide" axis="1 0 0" damping=".3"/><geom size=".1" mass="2" contype="0"/></body>
  <body><joint name="b" type="slide" axis="0 0 1" stiffness="4"/><geom size=".1" mass="1" contype="0"/></body>
</worldbody><equality><joint joint1="b" joint2="a" polycoef="0 {ratio}"/></equality>
<actuator><motor joint="a"/></actuator></mujoco>
"""


def test_two_sliders_in_a_ratio_are_one():
    """Of mass 2 + r^2, weight r g, damping .3 and stiffness 4 r^2, written by hand."""
    r, dt = -0.7, 0.01
    m = Mechanism.from_mjcf(SLIDERS.format(ratio=r), contacts="off")
    dynamics = RigidBodyDynamics(m, dt)
    x, u = closed_state(m, np.array([0.3, 0.0, -0.2, 0.0])), np.array([1.5])
    one = x[[0, 2]]

    def rates(y):
        return np.array([y[1], (u[0] - 0.3 * y[1] - 4.0 * r * r * y[0] - r * 9.81) / (2.0 + r * r)])

    for _ in range(100):
        x = dynamics.step(x[None], u[None])[0]
        k1 = rates(one)
        k2 = rates(one + 0.5 * dt * k1)
        k3 = rates(one + 0.5 * dt * k2)
        k4 = rates(one + dt * k3)
        one = one + dt * (k1 + 2.0 * k2 + 2.0 * k3 + k4) / 6.0
    np.testing.assert_allclose(x, [one[0], r * one[0], one[1], r * one[1]], rtol=0.0, atol=1e-12)
    A, B = dynamics.linearize(np.stack([x, x]), u[None])
    f = np.array([[0.0, 1.0], [-4.0 * r * r / (2.0 + r * r), -0.3 / (2.0 + r * r)]]) * dt
    exact = np.eye(2) + f + f @ f / 2.0 + f @ f @ f / 6.0 + f @ f @ f @ f / 24.0
    T = np.array([[1.0, 0.0], [r, 0.0], [0.0, 1.0], [0.0, r]])
    np.testing.assert_allclose((A[0] @ T)[[0, 2]], exact, atol=1e-14)  # along the coupling
    assert B[0, 2, 0] == pytest.approx(dt / (2.0 + r * r), rel=1e-3)


ARM = """
<mujoco><option gravity="0 0 -9.81"/><worldbody><body><joint name="shoulder" axis="0 1 0"/>
  <inertial pos=".3 0 0" mass="2" diaginertia=".02 .1 .1"/><body pos=".6 0 0"><joint name="wrist" axis="0 1 0"/>
    <inertial pos=".1 0 0" mass=".5" diaginertia=".01 .01 .01"/>
    <body pos=".2 .03 0"><joint name="left" type="slide" axis="0 1 0"/>
      <inertial pos=".05 0 0" mass=".1" diaginertia="1e-4 1e-4 1e-4"/></body>
    <body pos=".2 -.03 0"><joint name="right" axis="0 0 1"/>
      <inertial pos=".05 0 0" mass=".1" diaginertia="1e-4 1e-4 1e-4"/></body></body></body></worldbody>
<equality><joint joint1="right" joint2="left" polycoef="0 8"/></equality>
<actuator><motor joint="shoulder"/><motor joint="wrist"/><motor joint="left"/></actuator></mujoco>
"""


def test_energy_is_kept_and_so_is_the_coupling():
    """Of a falling arm with a gripper that opens: RK4 leaves dt^4, and the coupling to rounding."""
    m = Mechanism.from_mjcf(ARM)
    start = closed_state(m, np.array([0.4, -0.3, 0.01, 0.0, 1.0, -2.0, 0.1, 0.0]))

    def energy(x):
        q, qd = x[: m.nq], x[m.nq :]
        return 0.5 * qd @ rb.mass_matrix(m, q) @ qd - m.mass.sum() * m.gravity @ center_of_mass(m, q)

    lost = []
    for steps in (200, 400):
        dynamics, x = RigidBodyDynamics(m, 1.0 / steps), start[None]
        for _ in range(steps):
            x = dynamics.step(x, np.zeros((1, 3)))
        np.testing.assert_allclose(closed_state(m, x[0]), x[0], rtol=0.0, atol=1e-12)
        lost.append(abs(energy(x[0]) - energy(start)))
    assert lost[0] < 1e-5 * abs(energy(start))
    assert lost[1] < lost[0] / 10.0  # fourth order, and dt^5 in energy


def test_what_holds_a_pose_and_follows_a_motion():
    """Controls of the reduced rows: the machine stands, and arrives."""
    m = Mechanism.from_mjcf(ARM)
    x = closed_state(m, np.array([0.4, -0.3, 0.01, 0, 0, 0, 0, 0.0]))
    dynamics = RigidBodyDynamics(m, 0.01)
    rates = dynamics.rates(x[None], quasi_static_controls(m, x)[None])
    assert np.abs(rates).max() < 1e-11
    goal = closed_state(m, np.array([0.1, 0.5, 0.02, 0, 0, 0, 0, 0.0]))
    N = 100
    us = inverse_dynamics_controls(m, *quintic(x[: m.nq], goal[: m.nq], 1.0, N))
    for u in us:
        x = dynamics.step(x[None], u[None])[0]
    assert np.abs(x - goal).max() < 1e-3  # of second order in dt


STAND = """
<mujoco><option gravity="0 0 -9.81"/><worldbody><geom name="floor" type="plane" size="1 1 .1"/>
  <body pos="0 0 .1"><joint name="lift" type="slide" axis="0 0 1"/><geom name="foot" size=".1" mass="3"/>
    <body pos="0 0 .5"><joint name="arm" type="slide" axis="0 0 1"/>
      <geom size=".1" mass="1" contype="0" conaffinity="0"/></body></body>
  <body pos="1 0 2"><joint name="weight" type="slide" axis="0 0 1"/>
    <geom size=".1" mass="2" contype="0" conaffinity="0"/></body>
</worldbody><equality><joint joint1="weight" joint2="lift" polycoef="0 -1"/></equality>
<actuator><motor joint="arm"/></actuator></mujoco>
"""


def test_the_ground_carries_what_the_couplings_leave():
    """A counterweight on a rope: the ground carries 3 + 1 - 2 kg, and nothing moves."""
    law = ContactLaw.resting(4.0)
    m = Mechanism.from_mjcf(STAND, contacts=law)
    x = static_equilibrium(m, m.home)
    np.testing.assert_array_equal(closed_state(m, x), x)
    assert contact_forces(m, x[: m.nq], np.zeros(m.nv)).forces[0, 2] == pytest.approx(2.0 * 9.81, rel=1e-6)
    u = quasi_static_controls(m, x)
    assert u == pytest.approx([9.81])
    assert np.abs(RigidBodyDynamics(m, 0.01).rates(x[None], u[None])).max() < 1e-6


def test_a_coupled_joint_cannot_be_prescribed_and_others_can():
    m = Mechanism.from_mjcf(ARM)
    with pytest.raises(PlannerError, match="couples joint 'left' and joint 'right'"):
        RigidBodyDynamics(m, 0.01, prescribed=["left"])
    dynamics = RigidBodyDynamics(m, 0.01, prescribed=["shoulder"])
    x = closed_state(m, np.array([0.4, -0.3, 0.01, 0, 1, 2, 0.1, 0.0]))
    u = np.array([0.0, 0.3, 0.1, 2.0])
    qdd = dynamics.rates(x[None], u[None])[0, 4:]
    assert qdd[0] == 2.0
    left = rb.rnea(m, x[:4], x[4:], qdd) - [0.0, 0.3, 0.1, 0.0]
    np.testing.assert_allclose((m.reduction.G.T @ left)[1:], 0.0, atol=1e-12)  # the others' equations of motion


@pytest.mark.parametrize(
    "ask",
    [
        lambda m: RigidBodyDynamics(m, 0.01).second_order_memory(),
        lambda m: rb.hybrid_dynamics(m, m.qpos0, np.zeros(4), np.zeros(4), ["shoulder"]),
    ],
)
def test_what_knows_no_couplings_says_so(ask):
    with pytest.raises(PlannerError, match=re.escape("equality number 0")):
        ask(Mechanism.from_mjcf(ARM))


def test_a_machine_without_couplings_has_none_of_it():
    m = Mechanism.from_mjcf(re.sub("<equality>.*</equality>", "", ARM))
    assert m.reduction is None
    assert RigidBodyDynamics(m, 0.01)._model.external is None
