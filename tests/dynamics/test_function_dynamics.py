"""A user's own f(x, u): one state or many, every integrator, derivatives given or found; and what is refused."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from planner import FunctionDynamics, PlannerError, check_derivatives

CHOICES = ("euler", "semi-implicit-euler", "rk4", "discrete")
NX, NU = 4, 2
seeds = st.integers(0, 2**32 - 1)


def f_one(x, u):
    """Two pendulums on a common shaft, from one state: unpacking and math of scalars, no axes."""
    a, b, da, db = x
    return [da, db, u[0] - np.sin(a) + 0.3 * (b - a) - 0.1 * da**3, u[1] * np.cos(b) - 2.0 * np.sin(b)]


def f_many(x, u):
    """The same with a batch in front."""
    a, b, da, db = np.moveaxis(x, -1, 0)
    return np.stack(
        [da, db, u[..., 0] - np.sin(a) + 0.3 * (b - a) - 0.1 * da**3, u[..., 1] * np.cos(b) - 2 * np.sin(b)],
        axis=-1,
    )


def jacobian_one(x, u):
    """By hand."""
    a, b, da, _ = x
    fx = np.zeros((4, 4))
    fx[0, 2] = fx[1, 3] = 1.0
    fx[2] = [-np.cos(a) - 0.3, 0.3, -0.3 * da**2, 0.0]
    fx[3, 1] = -u[1] * np.sin(b) - 2.0 * np.cos(b)
    return fx, np.array([[0.0, 0.0], [0.0, 0.0], [1.0, 0.0], [0.0, np.cos(b)]])


def jacobian_many(xs, us):
    pairs = [jacobian_one(x, u) for x, u in zip(xs, us, strict=True)]
    return np.array([fx for fx, _ in pairs]), np.array([fu for _, fu in pairs])


def stage(f, integrator, x, u, dt):
    """One step of the textbook."""
    if integrator == "discrete":
        return np.array(f(x, u))
    k1 = np.array(f(x, u))
    if integrator == "euler":
        return x + dt * k1
    if integrator == "semi-implicit-euler":
        velocities = x[2:] + dt * k1[2:]
        return np.concatenate([x[:2] + dt * velocities, velocities])
    k2 = np.array(f(x + dt / 2 * k1, u))
    k3 = np.array(f(x + dt / 2 * k2, u))
    k4 = np.array(f(x + dt * k3, u))
    return x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def points(seed, K):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(K, NX)), rng.normal(size=(K, NU))


@pytest.mark.parametrize("f", [f_one, f_many])
@pytest.mark.parametrize("integrator", CHOICES)
@given(seeds, st.integers(1, 6), st.floats(1e-3, 0.2))
@settings(max_examples=20, deadline=None)
def test_stages_are_those_of_the_textbook(f, integrator, seed, K, dt):
    dynamics = FunctionDynamics(f, NX, NU, dt, integrator)
    xs, us = points(seed, K)
    expected = [stage(f_one, integrator, x, u, dt) for x, u in zip(xs, us, strict=True)]
    np.testing.assert_allclose(dynamics.step(xs, us), expected, rtol=1e-13, atol=1e-13)
    if integrator != "discrete":
        parts = np.random.default_rng(seed).uniform(0.0, dt, K)
        expected = [stage(f_one, integrator, x, u, part) for x, u, part in zip(xs, us, parts, strict=True)]
        np.testing.assert_allclose(dynamics.step(xs, us, parts), expected, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("given_jacobian", [False, True])
@pytest.mark.parametrize("batched", [False, True])
@pytest.mark.parametrize("integrator", CHOICES)
@given(seeds, st.integers(1, 6), st.floats(1e-3, 0.2))
@settings(max_examples=10, deadline=None)
def test_jacobians_are_those_of_the_stage(integrator, batched, given_jacobian, seed, N, dt):
    """The stage's derivative through an independent difference quotient, and the user's against the found one."""
    f, jacobian = (f_many, jacobian_many) if batched else (f_one, jacobian_one)
    dynamics = FunctionDynamics(f, NX, NU, dt, integrator, jacobian if given_jacobian else None)
    assert dynamics.batched is batched
    xs, us = points(seed, N + 1)
    us = us[:N]
    A, B = dynamics.linearize(xs, us)
    assert A.shape == (N, NX, NX)
    assert B.shape == (N, NX, NU)
    # Five-point rule: its error h^4 / 30 (times fifth derivatives) and the rounding 1e-16 / h meet near 1e-12.
    h = 1e-3
    for n in range(N):
        for j in range(NX + NU):
            d = h * np.eye(NX + NU)[j]
            ends = [stage(f_one, integrator, xs[n] + m * d[:NX], us[n] + m * d[NX:], dt) for m in (-2, -1, 1, 2)]
            column = (ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / (12 * h)
            ours = A[n, :, j] if j < NX else B[n, :, j - NX]
            np.testing.assert_allclose(ours, column, rtol=0, atol=1e-8)


@pytest.mark.parametrize("integrator", CHOICES)
def test_found_jacobians_are_the_users_to_eleven_digits(integrator):
    """Central differences at h = eps^(1/3) are off by about eps^(2/3) = 4e-11 times the third derivatives."""
    xs, us = points(3, 40)
    found = FunctionDynamics(f_many, NX, NU, 0.1, integrator).linearize(xs, us[:-1])
    given_ = FunctionDynamics(f_many, NX, NU, 0.1, integrator, jacobian_many).linearize(xs, us[:-1])
    single = FunctionDynamics(f_one, NX, NU, 0.1, integrator, jacobian_one).linearize(xs, us[:-1])
    for a, b, c in zip(found, given_, single, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=2e-9)
        np.testing.assert_allclose(b, c, rtol=1e-14, atol=1e-14)


@given(seeds, st.integers(1, 5), st.integers(1, 3), st.floats(1e-3, 0.5))
@settings(max_examples=30, deadline=None)
def test_linear_rates_have_the_integrators_polynomials(seed, nx, nu, dt):
    """For dx/dt = Fx + Gu a stage is linear: A and B are partial sums of the exponential series."""
    rng = np.random.default_rng(seed)
    F, G = rng.normal(size=(nx, nx)), rng.normal(size=(nx, nu))
    xs, us = rng.normal(size=(3, nx)), rng.normal(size=(2, nu))

    def series(order):
        powers = [np.linalg.matrix_power(dt * F, i) for i in range(order + 1)]
        factorial = np.cumprod([1, *range(1, order + 2)])
        A = sum(p / factorial[i] for i, p in enumerate(powers))
        B = sum(dt * p / factorial[i + 1] for i, p in enumerate(powers[:-1])) @ G
        return A, B

    for integrator, order in (("euler", 1), ("rk4", 4)):
        dynamics = FunctionDynamics(lambda x, u: x @ F.T + u @ G.T, nx, nu, dt, integrator)
        A, B = dynamics.linearize(xs, us)
        expected_A, expected_B = series(order)
        for n in range(2):
            np.testing.assert_allclose(A[n], expected_A, rtol=0, atol=1e-8)
            np.testing.assert_allclose(B[n], expected_B, rtol=0, atol=1e-8)


@pytest.mark.parametrize(("integrator", "order"), [("euler", 1), ("semi-implicit-euler", 1), ("rk4", 4)])
def test_order_of_convergence(integrator, order):
    x0, u = np.array([1.0, -0.5, 0.5, 0.2]), np.array([0.3, -0.2])
    exact = solve_ivp(lambda t, x: f_one(x, u), (0.0, 0.6), x0, method="DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
    errors = []
    for count in (16, 32):
        dynamics, x = FunctionDynamics(f_many, NX, NU, 0.6 / count, integrator), x0[None]
        for _ in range(count):
            x = dynamics.step(x, u[None])
        errors.append(np.abs(x[0] - exact).max())
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.25)


# Whether f takes many states at once

A3 = np.arange(9.0).reshape(3, 3)
FINDINGS = {
    "ellipsis": (lambda x, u: np.stack([x[..., 1], u[..., 0], x[..., 0]], axis=-1), True),
    "matrix from the right": (lambda x, u: x @ A3.T + u, True),
    "matrix from the left": (lambda x, u: A3 @ x + u, False),  # (3, 3) @ (3, 3) has the right shape, and is wrong
    "rows for components": (lambda x, u: np.array([x[1], x[2], x[0]]), False),  # permutes states of a batch of three
    "a list": (lambda x, u: [x[1], x[2], u[0]], False),
    "scalar test": (lambda x, u: x if x[0] > 0 else 2.0 * x, False),  # raises on a batch
    "sum over all": (lambda x, u: x * np.sum(x), False),
    "sum over states": (lambda x, u: x * np.sum(x, axis=-1, keepdims=True), True),
}


@pytest.mark.parametrize("name", FINDINGS)
def test_finds_out_whether_f_is_batched(name):
    f, batched = FINDINGS[name]
    dynamics = FunctionDynamics(f, 3, 1, 0.1, "discrete")
    assert dynamics.batched is batched
    rng = np.random.default_rng(0)
    for K in (1, 3, 4):  # three is the trap: as many states as components
        xs, us = rng.normal(size=(K, 3)), rng.normal(size=(K, 1))
        expected = [f(x, u) for x, u in zip(xs, us, strict=True)]
        np.testing.assert_allclose(dynamics.step(xs, us), expected, rtol=1e-14, atol=1e-14)


def test_a_batched_function_is_called_once_per_stage():
    calls = []

    def f(x, u):
        calls.append(x.shape)
        return x + u

    dynamics = FunctionDynamics(f, 2, 2, 0.1, "euler")
    calls.clear()
    dynamics.step(np.ones((8, 2)), np.ones((8, 2)))
    assert calls == [(8, 2)]


# What is refused


def sentence(error):
    text = str(error.value)
    assert "\n" not in text
    assert text.endswith(("?", "."))
    return text


def fine(x, u):
    return 0.0 * x


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("sin", 2, 1, 0.1), "f is 'sin', expected a function f(x, u)."),
        ((fine, 0, 1, 0.1), "nx is 0, expected a whole number of at least 1."),
        ((fine, 2.0, 1, 0.1), "nx is 2.0, expected a whole number of at least 1."),
        ((fine, 2, True, 0.1), "nu is True, expected a whole number of at least 1."),
        ((fine, 2, 1, 0.0), "dt is 0.0, expected a finite number greater than 0."),
        ((fine, 2, 1, np.nan), "dt is nan, expected a finite number greater than 0."),
        (
            (fine, 2, 1, 0.1, "heun"),
            "integrator is 'heun', expected one of: euler, semi-implicit-euler, rk4, discrete.",
        ),
        (
            (fine, 3, 1, 0.1, "semi-implicit-euler"),
            "nx is 3, expected an even number for semi-implicit-euler: positions, then velocities.",
        ),
        ((lambda x, u: x[:1], 2, 1, 0.1), "f(x, u) has shape (1,), expected (2,)."),
        ((lambda x, u: 1.0, 2, 1, 0.1), "f(x, u) has shape (), expected (2,)."),
        ((lambda x, u: np.ones((2, 1)), 2, 1, 0.1), "f(x, u) has shape (2, 1), expected (2,)."),
        ((lambda x, u: None, 2, 1, 0.1), "f(x, u) has shape (), expected (2,)."),
    ],
)
def test_wrong_arguments_are_refused_in_one_sentence(arguments, expected):
    with pytest.raises(PlannerError) as error:
        FunctionDynamics(*arguments)
    assert sentence(error) == expected


# The class promises PlannerError for "an f that does not return numbers of the right shape".
@pytest.mark.parametrize("f", [lambda x, u: ["a", "b"], lambda x, u: [x[0], [x[0], x[1]]]], ids=["text", "ragged"])
def test_rates_that_are_no_numbers_are_refused_in_one_sentence(f):
    with pytest.raises(PlannerError) as error:
        FunctionDynamics(f, 2, 1, 0.1)
    sentence(error)


@pytest.mark.parametrize(
    ("jacobian", "expected"),
    [
        (lambda x, u: (np.zeros((2, 3)), np.zeros((2, 1))), "jacobian's df/dx has shape (2, 3), expected (2, 2)"),
        (lambda x, u: (np.zeros((2, 2)), np.zeros(2)), "jacobian's df/du has shape (2,), expected (2, 1)"),
        (lambda x, u: np.zeros((2, 2)), "jacobian's df/dx has shape (2,), expected (2, 2)"),
        (lambda x, u: None, "jacobian returns None, expected (df/dx, df/du)"),
        (lambda x, u: ("a", "b"), "jacobian's df/dx is 'a', expected numbers"),
        (lambda x, u: (np.zeros((*x[:, :1].shape, 2)), 0), "jacobian's df/dx has shape (3, 1, 2), expected (3, 2, 2)"),
    ],
)
def test_wrong_jacobians_are_refused_in_one_sentence(jacobian, expected):
    with pytest.raises(PlannerError) as error:
        FunctionDynamics(lambda x, u: [x[1], u[0]], 2, 1, 0.1, jacobian=jacobian)
    assert expected in sentence(error)


def test_a_jacobian_that_is_not_finite_along_the_plan_is_refused_in_one_sentence():
    dynamics = FunctionDynamics(fine, 2, 1, 0.1, jacobian=lambda x, u: (np.full((2, 2), np.nan), np.zeros((2, 1))))
    with pytest.raises(PlannerError) as error:
        dynamics.linearize(np.zeros((4, 2)), np.zeros((3, 1)))
    assert "jacobian's df/dx[0, 0, 0] is nan" in sentence(error)


@pytest.mark.parametrize("jacobian", [jacobian_one, jacobian_many])
@pytest.mark.parametrize("f", [f_one, f_many])
def test_a_jacobian_may_be_of_one_state_or_of_many_whatever_f_is(f, jacobian):
    dynamics = FunctionDynamics(f, NX, NU, 0.1, jacobian=jacobian)
    xs, us = points(0, 6)
    A, B = dynamics.linearize(xs, us[:-1])
    expected = FunctionDynamics(f_many, NX, NU, 0.1, jacobian=jacobian_many).linearize(xs, us[:-1])
    np.testing.assert_allclose(A, expected[0], rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(B, expected[1], rtol=1e-13, atol=1e-13)
    assert check_derivatives(dynamics).passed


@pytest.mark.parametrize("K", [1, 3, 4])
def test_a_jacobian_that_is_the_same_everywhere_may_be_given_once(K):
    F, G = np.array([[0.0, 1.0], [-2.0, 0.0]]), np.array([[0.0], [1.0]])
    given_ = {
        "both": lambda x, u: (F, G), "one": lambda x, u: (np.broadcast_to(F, (*x.shape[:-1], 2, 2)), G),
    }  # fmt: skip
    for jacobian in given_.values():
        dynamics = FunctionDynamics(lambda x, u: x @ F.T + u @ G.T, 2, 1, 0.1, "euler", jacobian)
        A, B = dynamics.linearize(np.ones((K + 1, 2)), np.ones((K, 1)))
        np.testing.assert_allclose(A, np.tile(np.eye(2) + 0.1 * F, (K, 1, 1)))
        np.testing.assert_allclose(B, np.tile(0.1 * G, (K, 1, 1)))


def test_the_users_own_error_in_a_jacobian_reaches_the_user():
    def jacobian(x, u):
        raise ZeroDivisionError("mass is zero")

    with pytest.raises(ZeroDivisionError, match="mass is zero"):
        FunctionDynamics(fine, 2, 1, 0.1, jacobian=jacobian)


def test_a_discrete_map_has_no_parts():
    dynamics = FunctionDynamics(lambda x, u: 0.5 * x, 2, 1, 0.1, "discrete")
    xs, us = np.ones((2, 2)), np.ones((2, 1))
    np.testing.assert_array_equal(dynamics.step(xs, us, np.full(2, 0.1)), 0.5 * xs)
    with pytest.raises(PlannerError, match="no parts of a stage"):
        dynamics.step(xs, us, np.full(2, 0.05))


def test_the_users_own_error_reaches_the_user():
    """A bug in f on one state is the user's to see, with its own type."""

    def f(x, u):
        raise ZeroDivisionError("mass is zero")

    with pytest.raises(ZeroDivisionError, match="mass is zero"):
        FunctionDynamics(f, 2, 1, 0.1)
