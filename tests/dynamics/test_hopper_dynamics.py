"""The compiled hopper is section 2.4: its spring, its integrators and their exact Jacobians, against plain Python."""

import numpy as np
import pytest
from gradients import assert_step_derivatives
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from planner import FunctionDynamics, PlannerError
from planner.dynamics import INTEGRATORS, HopperDynamics

positive = st.floats(1e-3, 1e3)
seeds = st.integers(0, 2**32 - 1)


def force(e, k, alpha):
    """F(e) as section 2.4 prints it; also of complex e, for derivatives."""
    return np.select(
        [np.real(e) < 0.0, np.real(e) < alpha], [0.0 * e, k / (2.0 * alpha) * e**2], k * e - 0.5 * k * alpha
    )


def rates(x, u, k, alpha, g):
    """dx/dt of section 2.4 in x = (y, dy/dt, y_p), u = dy_p/dt, per unit of mass."""
    y, v, p = x[..., 0], x[..., 1], x[..., 2]
    return np.stack([v, force(p - y, k, alpha) - g, u[..., 0] + 0.0 * y], axis=-1)


def stage(integrator, x, u, dt, *machine):
    """One step of the textbook, on real or complex states."""
    k1 = rates(x, u, *machine)
    if integrator == "euler":
        return x + dt * k1
    if integrator == "semi-implicit-euler":  # the rate and the piston first, then the height with the new rate
        v, p = x[..., 1] + dt * k1[..., 1], x[..., 2] + dt * k1[..., 2]
        return np.stack([x[..., 0] + dt * v, v, p], axis=-1)
    k2 = rates(x + 0.5 * dt * k1, u, *machine)
    k3 = rates(x + 0.5 * dt * k2, u, *machine)
    k4 = rates(x + dt * k3, u, *machine)
    return x + dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)


def compression_rates(e, k, alpha):
    """(F(e) / m, F'(e) / m) by way of the public methods: from rest at y = 0, g as good as zero."""
    e = np.atleast_1d(e)
    xs, us = np.stack([0.0 * e, 0.0 * e, e], axis=1), np.zeros((len(e), 1))
    machine = HopperDynamics(1.0, "euler", stiffness=k, smoothing=alpha, gravity=1e-300)
    A, _ = machine.linearize(np.vstack([xs, xs[-1:]]), us)
    np.testing.assert_array_equal(A[:, 1, 2], -A[:, 1, 0])  # F depends on p - y alone
    return machine.rates(xs, us)[:, 1], A[:, 1, 2]


@settings(max_examples=100, deadline=None)
@given(positive, positive, st.floats(-3.0, 3.0))
def test_spring_is_the_papers(k, alpha, of_alpha):
    e = alpha * np.array([of_alpha, -1.0, 0.0, 0.5, 1.0, 2.0, 100.0])
    ours, slope = compression_rates(e, k, alpha)
    np.testing.assert_allclose(ours, force(e, k, alpha), rtol=1e-13, atol=1e-13 * k * alpha)
    # Complex step: F(e + ih) = F(e) + ih F'(e), exactly, as F is quadratic at most.
    complex_step = np.imag(force(e + 1e-200j, k, alpha)) / 1e-200
    np.testing.assert_allclose(slope, complex_step, rtol=1e-13, atol=1e-13 * k)


@settings(max_examples=100, deadline=None)
@given(positive, positive, st.sampled_from([0.0, 1.0]), st.floats(1e-8, 1e-2), st.floats(1e-8, 1e-2))
def test_spring_is_c1_at_its_joints(k, alpha, joint, before, after):
    """F' is Lipschitz with k / alpha: no jump of F' (nor of F, its integral) fits that bound as the gap closes."""
    e = alpha * (joint + np.array([-before, 0.0, after]))
    f, slope = compression_rates(e, k, alpha)
    gaps = np.diff(e)
    assert (np.abs(np.diff(slope)) <= k / alpha * gaps * (1.0 + 1e-6)).all()
    # Between two compressions F gains something between the slopes at either end.
    rounding = 1e-15 * k * alpha
    assert (np.diff(f) >= slope[:-1] * gaps - rounding).all()
    assert (np.diff(f) <= slope[1:] * gaps + rounding).all()


def sample(seed, K, smoothing):
    """States on all three pieces of the spring, some near its joints, and controls."""
    rng = np.random.default_rng(seed)
    xs = rng.normal(size=(K, 3)) * [5.0, 50.0, 1.0]
    e = np.choose(
        rng.integers(0, 4, K),
        [
            -rng.uniform(0.0, 5.0, K),
            rng.uniform(0.0, smoothing, K),
            smoothing + rng.uniform(0.0, 5.0, K),
            rng.integers(0, 2, K) * smoothing + 1e-7 * rng.normal(size=K),
        ],
    )
    xs[:, 2] = xs[:, 0] + e
    return xs, 20.0 * rng.normal(size=(K, 1))


machines = st.tuples(st.floats(1.0, 1e3), st.floats(1e-3, 1.0), st.floats(1.0, 500.0))
steps = st.floats(1e-4, 0.05)


def machine(integrator, dt, parameters):
    k, alpha, g = parameters
    return HopperDynamics(dt, integrator, stiffness=k, smoothing=alpha, gravity=g)


@pytest.mark.parametrize("integrator", INTEGRATORS)
@settings(max_examples=40, deadline=None)
@given(seed=seeds, dt=steps, parameters=machines, K=st.integers(1, 20))
def test_stages_are_those_of_plain_python(integrator, seed, dt, parameters, K):
    hopper = machine(integrator, dt, parameters)
    xs, us = sample(seed, K, parameters[1])
    scale = 1e-13 * (1.0 + np.abs(xs).max() + np.abs(us).max() + parameters[0])
    np.testing.assert_allclose(hopper.step(xs, us), stage(integrator, xs, us, dt, *parameters), rtol=0, atol=scale)
    np.testing.assert_allclose(hopper.rates(xs, us), rates(xs, us, *parameters), rtol=1e-13, atol=scale)
    parts = np.random.default_rng(seed).uniform(0.0, 1.0, K) * dt
    expected = [stage(integrator, x, u, part, *parameters) for x, u, part in zip(xs, us, parts, strict=True)]
    np.testing.assert_allclose(hopper.step(xs, us, parts), expected, rtol=0, atol=scale)


def rate_jacobians(xs, us, k, alpha, g):
    """df/dx, df/du by the complex step."""
    h = 1e-200
    z = np.concatenate([xs, us], axis=-1)[..., None, :] + 1j * h * np.eye(4)
    J = np.imag(rates(z[..., :3], z[..., 3:], k, alpha, g)).swapaxes(-1, -2) / h
    return J[..., :3], J[..., 3:]


@pytest.mark.parametrize("integrator", ["euler", "rk4"])
def test_function_dynamics_of_the_same_equations_is_its_twin(integrator):
    parameters = (100.0, 0.1, 386.4)  # section 4
    hopper = machine(integrator, 0.02, parameters)
    twin = FunctionDynamics(
        lambda x, u: rates(x, u, *parameters), 3, 1, 0.02, integrator, lambda x, u: rate_jacobians(x, u, *parameters)
    )
    xs, us = sample(1, 101, 0.1)
    np.testing.assert_allclose(twin.step(xs, us), hopper.step(xs, us), rtol=1e-13, atol=1e-12)
    for ours, theirs in zip(hopper.linearize(xs, us[:-1]), twin.linearize(xs, us[:-1]), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("integrator", INTEGRATORS)
@settings(max_examples=40, deadline=None)
@given(seed=seeds, dt=steps, parameters=machines, N=st.integers(1, 20))
def test_jacobians_are_exact(integrator, seed, dt, parameters, N):
    """Against the complex step, which has no difference to cancel: A, B are right to rounding."""
    xs, us = sample(seed, N + 1, parameters[1])
    us = us[:N]
    A, B = machine(integrator, dt, parameters).linearize(xs, us)
    h = 1e-200
    for j in range(3):
        moved = xs[:N] + 1j * h * np.eye(3)[j]
        column = np.imag(stage(integrator, moved, us, dt, *parameters)) / h
        np.testing.assert_allclose(A[:, :, j], column, rtol=1e-12, atol=1e-12 * parameters[0] * dt)
    column = np.imag(stage(integrator, xs[:N] + 0j, us + 1j * h, dt, *parameters)) / h
    np.testing.assert_allclose(B[:, :, 0], column, rtol=1e-12, atol=1e-12 * parameters[0] * dt)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_jacobians_are_those_of_its_own_step(integrator):
    hopper = HopperDynamics(0.01, integrator)
    xs, us = sample(2, 51, 0.1)
    # At a joint the slope k / alpha of F' leaves an error of h k / (4 alpha) dt = 2.5e-6.
    assert_step_derivatives(hopper, xs[:-1], us[:-1], within=1e-5)


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("N", [1, 7, 8, 9, 16, 17])
def test_a_stage_does_not_feel_its_neighbours(integrator, N):
    """Eight stages share a block of lanes, and the last block may be part empty."""
    hopper = HopperDynamics(0.01, integrator)
    xs, us = sample(N, N + 1, 0.1)
    A, B = hopper.linearize(xs, us[:N])
    ends = hopper.step(xs[:N], us[:N])
    assert A.shape == (N, 3, 3)
    assert B.shape == (N, 3, 1)
    for n in range(N):
        An, Bn = hopper.linearize(xs[n : n + 2], us[n : n + 1])
        np.testing.assert_array_equal(An[0], A[n])
        np.testing.assert_array_equal(Bn[0], B[n])
        np.testing.assert_array_equal(hopper.step(xs[n : n + 1], us[n : n + 1])[0], ends[n])


# Stretches without a joint: stance beyond the smoothing (linear), and stance within a long smoothing (quadratic).
STRETCHES = {"linear": ([-20.0, 0.0, 0.0], 0.1, 5.0, 0.1), "quadratic": ([-20.0, -30.0, 0.0], 200.0, 5.0, 0.5)}
ORDER = {"euler": 1, "semi-implicit-euler": 1, "rk4": 4}


@pytest.mark.parametrize("stretch", STRETCHES)
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_order_of_convergence(integrator, stretch):
    x0, alpha, flow, duration = STRETCHES[stretch]
    parameters = (100.0, alpha, 386.4)
    u = np.array([flow])
    exact = solve_ivp(
        lambda t, x: rates(x, u, *parameters), (0.0, duration), x0, method="DOP853", rtol=1e-12, atol=1e-12
    )
    e = exact.y[2] - exact.y[0]
    assert ((e > 0.1) if stretch == "linear" else (e > 0.0) & (e < alpha)).all()  # one piece of F all the way
    errors = []
    for count in (20, 40, 80):
        hopper = machine(integrator, duration / count, parameters)
        x = np.array([x0])
        for _ in range(count):
            x = hopper.step(x, u[None])
        errors.append(np.abs(x[0] - exact.y[:, -1]).max())
    observed = np.log2(errors[0] / errors[1]), np.log2(errors[1] / errors[2])
    assert observed[1] == pytest.approx(ORDER[integrator], abs=0.15)
    assert abs(observed[1] - ORDER[integrator]) <= abs(observed[0] - ORDER[integrator]) + 0.02


@given(st.floats(1.0, 100.0), st.floats(-100.0, 100.0), st.floats(-0.5, 0.5), st.floats(1e-3, 0.1))
@settings(max_examples=50, deadline=None)
def test_runge_kutta_flies_a_parabola(height, rate, piston, dt):
    """In flight the solution is a quadratic in time, which RK4 integrates without error."""
    height += 100.0 * dt + 400.0 * dt**2 + piston  # no touchdown within the stage
    end = HopperDynamics(dt, "rk4").step([[height, rate, piston]], [[0.0]])[0]
    g = 386.4  # section 4, the default
    expected = [height + rate * dt - 0.5 * g * dt**2, rate - g * dt, piston]
    np.testing.assert_allclose(end, expected, rtol=1e-13, atol=1e-12)


def sentence(error):
    text = str(error.value)
    assert "\n" not in text
    assert text.endswith(".")
    return text


@settings(deadline=None)
@given(
    name=st.sampled_from(["dt", "stiffness", "smoothing", "gravity"]),
    value=st.sampled_from([np.nan, np.inf, -np.inf, 0.0, -0.0, "soft", None, [1.0, 2.0]]) | st.floats(max_value=0.0),
)
def test_parameters_must_be_positive_numbers(name, value):
    with pytest.raises(PlannerError) as error:
        HopperDynamics(**{"dt": 0.01, name: value})
    assert sentence(error).startswith(f"{name} is {value!r}, expected a finite number greater than 0")


@pytest.mark.parametrize("name", ["stiffness", "smoothing", "gravity"])
def test_parameters_may_not_overflow(name):
    with pytest.raises(PlannerError, match="at most 1e\\+09"):
        HopperDynamics(0.01, **{name: 2e9})


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_state_that_ran_away_stays_so(integrator):
    """A candidate of a line search may overflow: its end must say so, and its neighbours must not."""
    hopper = HopperDynamics(0.01, integrator)
    xs, us = sample(3, 9, 0.1)
    sound = hopper.step(xs, us)
    xs[4] = [np.nan, np.inf, -np.inf]
    ends = hopper.step(xs, us)
    assert not np.isfinite(ends[4]).any()
    np.testing.assert_array_equal(np.delete(ends, 4, axis=0), np.delete(sound, 4, axis=0))


def test_integrators_are_listed():
    with pytest.raises(PlannerError) as error:
        HopperDynamics(0.01, "rk45")
    assert str(error.value) == (
        "integrator is 'rk45', expected one of: euler, semi-implicit-euler, rk4. Did you mean 'rk4'?"
    )


@pytest.mark.parametrize(
    ("call", "expected"),
    [
        (lambda d: d.step(np.zeros((5, 2)), np.zeros((5, 1))), "xs has shape (5, 2), expected (K, 3)"),
        (lambda d: d.step(np.zeros(3), np.zeros((1, 1))), "xs has shape (3,), expected (K, 3)"),
        (lambda d: d.step(np.zeros((5, 3)), np.zeros((5, 2))), "us has shape (5, 2), expected (5, 1)"),
        (lambda d: d.linearize(np.zeros((5, 3)), np.zeros(4)), "us has shape (4,), expected (N, 1)"),
    ],
)
def test_wrong_shapes_are_refused(call, expected):
    with pytest.raises(PlannerError) as error:
        call(HopperDynamics(0.01))
    assert expected in sentence(error)


# A kernel that runs past the end of the shorter array reads foreign memory.
@pytest.mark.parametrize(
    "call",
    [
        lambda d: d.step(np.zeros((5, 3)), np.zeros((2, 1))),
        lambda d: d.step(np.zeros((5, 3)), np.zeros((5, 1)), np.full(2, 0.01)),
        lambda d: d.rates(np.zeros((5, 3)), np.zeros((2, 1))),
        lambda d: d.linearize(np.zeros((2, 3)), np.zeros((9, 1))),
    ],
    ids=["step us", "step dt", "rates", "linearize"],
)
def test_arrays_of_different_lengths_are_refused(call):
    with pytest.raises(PlannerError) as error:
        call(HopperDynamics(0.01))
    sentence(error)
