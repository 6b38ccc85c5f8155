"""Fig. 2 against MuJoCo and against itself backwards, and the compiled derivatives against its differences."""

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from trees import (
    mechanism_texts,
    mujoco,
    random_state,
    relative_error,
    share_of,
    simulated,
    simulated_inverse,
    site_jacobian,
    stepped,
)

from planner.dynamics import algorithms, product_of_exponentials
from planner.model.mechanism import SCREW, Mechanism
from planner.model.space import conjugate, exp_quaternion, hat, log_quaternion, product

STEP = 1e-30j  # imaginary: nothing cancels, so derivatives are exact to rounding


def machines(examples, max_dofs=40):
    """Decorator: a test of (text, rng) on that many random machines."""

    def decorate(test):
        checks = [HealthCheck.too_slow, HealthCheck.data_too_large]
        given_both = given(text=mechanism_texts(max_dofs), seed=st.integers(0, 2**32 - 1))
        return settings(max_examples=share_of(examples), deadline=None, suppress_health_check=checks)(given_both(test))

    return decorate


def drawn(text, seed):
    """The machine, its q and qd, one more vector (nv,) to use as an input, and the generator."""
    rng, mechanism = np.random.default_rng(seed), Mechanism.from_mjcf(text)
    q, qd = np.split(random_state(mechanism.space, rng), [mechanism.nq])
    return mechanism, q, 2.0 * qd, 3.0 * rng.normal(size=mechanism.nv), rng


# ---------------------------------------------------------------------------------------------- against MuJoCo


@machines(30)
def test_dynamics_are_mujocos(text, seed):
    mechanism, q, qd, tau, _ = drawn(text, seed)
    theirs = simulated(mujoco.MjModel.from_xml_string(text), q, qd, tau)
    assert relative_error(product_of_exponentials.mass_matrix(mechanism, q), theirs.M) < 1e-12
    assert relative_error(product_of_exponentials.bias(mechanism, q, qd), theirs.bias) < 1e-12
    assert relative_error(product_of_exponentials.forward_dynamics(mechanism, q, qd, tau), theirs.qacc) < 1e-10


@machines(15)
def test_inverse_dynamics_are_mujocos(text, seed):
    mechanism, q, qd, qdd, _ = drawn(text, seed)
    theirs = simulated_inverse(mujoco.MjModel.from_xml_string(text), q, qd, qdd)
    assert relative_error(product_of_exponentials.rnea(mechanism, q, qd, qdd), theirs) < 1e-12


@machines(15)
def test_kinematics_are_mujocos(text, seed):
    mechanism, q, qd, tau, _ = drawn(text, seed)
    model = mujoco.MjModel.from_xml_string(text)
    assert (
        relative_error(product_of_exponentials.forward_kinematics(mechanism, q), simulated(model, q, qd, tau).poses)
        < 1e-12
    )
    for name, frame in mechanism.sites.items():
        assert (
            relative_error(product_of_exponentials.jacobian(mechanism, q, frame), site_jacobian(model, q, name)) < 1e-12
        )


# -------------------------------------------------------------------------------------------------- identities


@machines(10)
def test_mass_matrix_is_symmetric_and_positive_definite(text, seed):
    mechanism, q, qd, qdd, _ = drawn(text, seed)
    M = product_of_exponentials.mass_matrix(mechanism, q)
    np.testing.assert_array_equal(M, M.T)
    assert np.min(np.linalg.eigvalsh(M)) > 0.0
    # and it is what rnea multiplies accelerations with
    assert (
        relative_error(
            M @ qdd + product_of_exponentials.bias(mechanism, q, qd),
            product_of_exponentials.rnea(mechanism, q, qd, qdd),
        )
        < 1e-11
    )


@machines(10)
def test_inverse_dynamics_undo_forward_dynamics(text, seed):
    mechanism, q, qd, tau, _ = drawn(text, seed)
    qdd = product_of_exponentials.forward_dynamics(mechanism, q, qd, tau)
    assert relative_error(product_of_exponentials.rnea(mechanism, q, qd, qdd), tau) < 1e-9


@machines(15)
def test_hybrid_dynamics_satisfy_the_inverse_dynamics(text, seed):
    mechanism, q, qd, inputs, rng = drawn(text, seed)
    prescribed = rng.random(mechanism.nv) < rng.choice([0.0, 0.5, 1.0])
    qdd, tau = product_of_exponentials.hybrid_dynamics(mechanism, q, qd, inputs, prescribed)
    np.testing.assert_array_equal(qdd[prescribed], inputs[prescribed])
    np.testing.assert_array_equal(tau[~prescribed], inputs[~prescribed])
    assert relative_error(product_of_exponentials.rnea(mechanism, q, qd, qdd), tau) < 1e-9
    # the other way round: hand in what came out
    qdd_back, tau_back = product_of_exponentials.hybrid_dynamics(
        mechanism, q, qd, np.where(prescribed, tau, qdd), ~prescribed
    )
    assert relative_error(qdd_back, qdd) < 1e-9
    assert relative_error(tau_back, tau) < 1e-9


def energy(mechanism, q, qd):
    """Kinetic (armature included) and potential (springs included)."""
    m = mechanism
    G = product_of_exponentials.world_poses(m, q)
    centres = np.einsum("nij,nj->ni", G[:-1, :3, :3], m.com) + G[:-1, :3, 3]
    slides_and_hinges = np.where(m.kind == SCREW, q[m.q_address] - m.spring_rest, 0.0)
    springs = 0.5 * m.stiffness @ slides_and_hinges**2
    for (a, _), stiffness, rest in zip(m.quaternions, m.ball_stiffness, m.ball_rest, strict=True):
        turned = product_of_exponentials.rotation_vector(product(conjugate(rest), q[a : a + 4]))
        springs += 0.5 * stiffness * turned @ turned
    return 0.5 * qd @ product_of_exponentials.mass_matrix(m, q) @ qd - m.mass @ (centres @ m.gravity) + springs


@machines(10)
def test_power_goes_into_energy_and_dampers(text, seed):
    mechanism, q, qd, tau, _ = drawn(text, seed)
    qdd = product_of_exponentials.forward_dynamics(mechanism, q, qd, tau)
    rate = energy(mechanism, stepped(mechanism, q, qd, STEP), qd + STEP * qdd).imag / STEP.imag
    power, lost = qd @ tau, qd @ (mechanism.damping * qd)
    assert abs(rate - (power - lost)) < 1e-9 * (abs(rate) + np.abs(qd) @ np.abs(tau) + lost)


# ------------------------------------------------------------------------------------------------- derivatives


@machines(5, max_dofs=20)
def test_derivatives_of_forward_dynamics_by_differences_on_the_group(text, seed):
    """Real steps through StateSpace.integrate: no part of it shares the imaginary step's idea of a direction."""
    mechanism, q, qd, tau, rng = drawn(text, seed)
    direction, n = rng.normal(size=2 * mechanism.nv), mechanism.nv
    for (a, _), rest in zip(mechanism.quaternions, mechanism.ball_rest, strict=True):
        # half a turn away the torque of a ball's spring jumps to the other side
        assume(np.linalg.norm(log_quaternion(product(conjugate(rest), q[a : a + 4]))) < np.pi - 0.1)
    x = np.concatenate([q, qd, np.zeros(mechanism.na)])

    def accelerations(step):
        dx = np.concatenate([step * direction, np.zeros(mechanism.na)])
        q, qd = np.split(mechanism.space.integrate(x, dx)[: mechanism.nq + n], [mechanism.nq])
        return product_of_exponentials.forward_dynamics(mechanism, q, qd, tau)

    h = 2e-3  # error of sixth order: h^6 beside rounding / h
    weights = {1: 45.0, 2: -9.0, 3: 1.0}
    slope = sum(w * (accelerations(k * h) - accelerations(-k * h)) for k, w in weights.items()) / (60.0 * h)
    by = algorithms.forward_dynamics_derivatives(mechanism, q, qd, tau)
    assert relative_error(by.q @ direction[:n] + by.qd @ direction[n:], slope) < 1e-7
    assert relative_error(by.input, np.linalg.inv(product_of_exponentials.mass_matrix(mechanism, q))) < 1e-9


# ------------------------------------------------------------------------------------------------ group elements


def as_matrix(V):
    """A twist (6,) as an element (4, 4) of se(3)."""
    A = np.zeros((4, 4))
    A[:3, :3], A[:3, 3] = hat(V[:3]), V[3:]
    return A


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-3, 1.0, 3.0])
def test_rotation_vector_is_the_log_of_quaternions(size):
    rng = np.random.default_rng(0)
    for vector in size * rng.normal(size=(20, 3)):
        quaternion = exp_quaternion(vector) * rng.uniform(-2.0, 2.0)
        expected = log_quaternion(quaternion)
        np.testing.assert_allclose(
            product_of_exponentials.rotation_vector(quaternion), expected, rtol=1e-13, atol=1e-30
        )


@pytest.mark.parametrize("revolute", [True, False])
def test_exp6_is_the_matrix_exponential(revolute):
    rng = np.random.default_rng(1)
    for _ in range(10):
        axis, point, q = rng.normal(size=3), rng.normal(size=3), rng.normal()
        axis /= np.linalg.norm(axis)
        S = np.array([*axis, *np.cross(point, axis)]) if revolute else np.array([0.0, 0.0, 0.0, *axis])
        np.testing.assert_allclose(product_of_exponentials.exp6(S, q), expm(as_matrix(S) * q), atol=1e-14)
        if revolute:  # the points of the axis stay
            np.testing.assert_allclose(product_of_exponentials.exp6(S, q)[:3] @ [*point, 1.0], point, atol=1e-14)


def test_adjoint_carries_twists_as_conjugation_does():
    """Ad(T) S is T S^ T^-1, and ad is its derivative."""
    rng = np.random.default_rng(2)
    S, U = rng.normal(size=(2, 6))
    S[:3] /= np.linalg.norm(S[:3])
    T = product_of_exponentials.exp6(S, 0.7)

    np.testing.assert_allclose(
        as_matrix(product_of_exponentials.Ad(T) @ U), T @ as_matrix(U) @ product_of_exponentials.inverse(T), atol=1e-14
    )
    rate = (product_of_exponentials.Ad(product_of_exponentials.exp6(S, STEP)) @ U).imag / STEP.imag
    np.testing.assert_allclose(product_of_exponentials.ad(S) @ U, rate, atol=1e-14)
