"""Differences and sums of states: inverse to each other, MuJoCo's own, with the Jacobians they claim."""

import json

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from trees import mechanism_texts, mujoco, random_state

from planner.dynamics.product_of_exponentials import rotation
from planner.model.mechanism import Mechanism
from planner.model.space import (
    StateSpace,
    conjugate,
    euclidean,
    exp_quaternion,
    hat,
    log_jacobian,
    log_quaternion,
    product,
    space_of,
    unit,
)

SPACE = StateSpace(13, 11, ((2, 2), (9, 8)))  # two numbers, a quaternion, three numbers, a quaternion
# Where formulas break: nothing, below and about the switches to series, ordinary, almost half a turn.
SIZES = [0.0, 1e-13, 1e-9, 0.99e-4, 1.01e-4, 1e-2, 1.0, 3.1]
seeds = st.integers(0, 2**32 - 1)


def exp_jacobian(rotation: np.ndarray) -> np.ndarray:
    """SO(3)'s right Jacobian (..., 3, 3): exp(r + e) = exp(r) exp(Jr(r) e) to first order in e."""
    square = np.sum(rotation**2, axis=-1)[..., None, None]
    angle2 = np.maximum(square, 1e-4**2)
    angle = np.sqrt(angle2)
    first = np.where(square > 1e-4**2, 2.0 * np.sin(0.5 * angle) ** 2 / angle2, 0.5 - square / 24.0)
    second = np.where(square > 1e-4**2, (angle - np.sin(angle)) / (angle2 * angle), 1.0 / 6.0 - square / 120.0)
    H = hat(rotation)
    return np.eye(3) - first * H + second * (H @ H)


def rotation_vectors(size, count=20):
    """(count, 3) of one length."""
    directions = np.random.default_rng(3).normal(size=(count, 3))
    return size * directions / np.linalg.norm(directions, axis=-1, keepdims=True)


def slope(function, h=1e-2):
    """Derivative at 0 of a function of one number by differences of sixth order."""
    weights = {1: 45.0, 2: -9.0, 3: 1.0}
    return sum(w * (function(k * h) - function(-k * h)) for k, w in weights.items()) / (60.0 * h)


# ------------------------------------------------------------------------------------------------------- states


@given(seed=seeds)
@settings(max_examples=50, deadline=None)
def test_integrate_and_difference_are_inverse(seed):
    rng = np.random.default_rng(seed)
    x_ref, x = random_state(SPACE, rng), random_state(SPACE, rng, unnormalized=False)
    back = SPACE.integrate(x_ref, SPACE.difference(x, x_ref))
    for i, _ in SPACE.quaternions:  # a quaternion and its negative are one orientation
        back[i : i + 4] *= np.sign(back[i : i + 4] @ x[i : i + 4])
    np.testing.assert_allclose(back, x, atol=1e-14)
    dx = rng.uniform(-1.0, 1.0, SPACE.ndx)
    np.testing.assert_allclose(SPACE.difference(SPACE.integrate(x_ref, dx), x_ref), dx, atol=1e-14)


@given(text=mechanism_texts(), seed=seeds)
@settings(max_examples=10, deadline=None, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large])
def test_integrate_and_difference_are_mujocos(text, seed):
    model, rng, mechanism = mujoco.MjModel.from_xml_string(text), np.random.default_rng(seed), Mechanism.from_mjcf(text)
    space, nq, nv = mechanism.space, mechanism.nq, mechanism.nv
    assert (nq, nv) == (model.nq, model.nv)
    x, other, dx = random_state(space, rng), random_state(space, rng, unnormalized=False), rng.normal(size=space.ndx)
    qpos = x[:nq].copy()
    mujoco.mj_integratePos(model, qpos, dx[:nv], 1.0)
    np.testing.assert_allclose(space.integrate(x, dx)[:nq], qpos, atol=1e-13)
    velocity = np.empty(nv)
    mujoco.mj_differentiatePos(model, velocity, 1.0, x[:nq], other[:nq])
    np.testing.assert_allclose(space.difference(other, x)[:nv], velocity, atol=1e-13)


@given(seed=seeds)
@settings(max_examples=20, deadline=None)
def test_difference_jacobian(seed):
    rng = np.random.default_rng(seed)
    x_ref, deviation = random_state(SPACE, rng), rng.uniform(-1.0, 1.0, SPACE.ndx)
    x = SPACE.integrate(x_ref, deviation)
    expected = np.array([slope(lambda t, e=e: SPACE.difference(SPACE.integrate(x, t * e), x_ref)) for e in np.eye(11)])
    np.testing.assert_allclose(SPACE.difference_jacobian(deviation), expected.T, atol=1e-9)


def test_batches_are_rows():
    rng = np.random.default_rng(0)
    xs, dxs = np.array([random_state(SPACE, rng) for _ in range(6)]).reshape(2, 3, 13), rng.normal(size=(2, 3, 11))
    sums, jacobians = SPACE.integrate(xs, dxs), SPACE.difference_jacobian(dxs)
    differences = SPACE.difference(xs, xs[0, 0])
    for k in np.ndindex(2, 3):
        np.testing.assert_array_equal(sums[k], SPACE.integrate(xs[k], dxs[k]))
        np.testing.assert_array_equal(differences[k], SPACE.difference(xs[k], xs[0, 0]))
        np.testing.assert_array_equal(jacobians[k], SPACE.difference_jacobian(dxs[k]))


def test_plain_vectors_are_subtracted():
    class Dynamics:
        nx = 3

    space, (x, y) = space_of(Dynamics()), np.random.default_rng(0).normal(size=(2, 3))
    assert space == euclidean(3)
    np.testing.assert_array_equal(space.difference(x, y), x - y)
    np.testing.assert_array_equal(space.integrate(x, y), x + y)
    np.testing.assert_array_equal(space.difference_jacobian(x), np.eye(3))


def test_a_dynamics_with_a_space_keeps_it():
    class Dynamics:
        nx, space = 13, SPACE

    assert space_of(Dynamics()) is SPACE


def test_a_space_survives_json():
    layout = json.loads(json.dumps(SPACE.to_dict()))
    pairs = tuple((i, j) for i, j in layout.pop("quaternions"))
    assert StateSpace(**layout, quaternions=pairs) == SPACE


# -------------------------------------------------------------------------------------------------- quaternions


@pytest.mark.parametrize("size", SIZES)
def test_log_undoes_exp(size):
    vectors = rotation_vectors(size)
    np.testing.assert_allclose(log_quaternion(exp_quaternion(vectors)), vectors, rtol=1e-12, atol=1e-30)
    np.testing.assert_allclose(log_quaternion(-2.5 * exp_quaternion(vectors)), vectors, rtol=1e-12, atol=1e-30)


@pytest.mark.parametrize("size", SIZES)
def test_exp_is_a_rotation_about_the_vector(size):
    for vector in rotation_vectors(size):
        R = rotation(exp_quaternion(vector))
        np.testing.assert_allclose(R @ vector, vector, atol=1e-14)
        np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-14)
        assert abs(np.trace(R) - (1.0 + 2.0 * np.cos(size))) < 1e-14


def test_products_are_those_of_rotations():
    a, b = np.random.default_rng(1).normal(size=(2, 20, 4))
    for p, left, right in zip(product(a, b), a, b, strict=True):
        np.testing.assert_allclose(rotation(p), rotation(left) @ rotation(right), atol=1e-14)
        np.testing.assert_allclose(rotation(conjugate(left)), rotation(left).T, atol=1e-14)
        np.testing.assert_allclose(rotation(unit(left)), rotation(left), atol=1e-14)
    np.testing.assert_allclose(np.linalg.norm(unit(a), axis=-1), 1.0, rtol=1e-15)


def test_hat_is_the_cross_product():
    v, w = np.random.default_rng(2).normal(size=(2, 20, 3))
    np.testing.assert_allclose((hat(v) @ w[..., None])[..., 0], np.cross(v, w), atol=1e-15)


@pytest.mark.parametrize("size", SIZES)
def test_jacobians_of_log_and_exp(size):
    vectors = rotation_vectors(size)
    Q, of_log, of_exp = conjugate(exp_quaternion(vectors)), log_jacobian(vectors), exp_jacobian(vectors)
    np.testing.assert_allclose(of_log @ of_exp, np.broadcast_to(np.eye(3), (20, 3, 3)), atol=1e-13)
    for k, axis in enumerate(np.eye(3)):  # exp(r + e) = exp(r) exp(Jr e)
        expected = slope(lambda t, axis=axis: log_quaternion(product(Q, exp_quaternion(vectors + t * axis))))
        np.testing.assert_allclose(of_exp[:, :, k], expected, atol=1e-10)


@pytest.mark.parametrize("scale", [1.0, 1e-8, 0.0])
def test_a_single_difference_is_that_of_arrays(scale):
    space, rng = StateSpace(9, 8, ((2, 2),)), np.random.default_rng(0)
    for sign in (1.0, -1.0):
        x = rng.standard_normal(9)
        x[2:6] /= np.linalg.norm(x[2:6])
        other = x + scale * rng.standard_normal(9)
        other[2:6] *= sign / np.linalg.norm(other[2:6])
        np.testing.assert_allclose(space.single_difference(x, other), space.difference(x, other), atol=1e-13)
