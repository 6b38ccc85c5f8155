"""Continuous-time rates, the Hamiltonian flow, and shooting that finds SLQ's extremal on a short horizon."""

import numpy as np
import pytest

import planner
from planner.cases import hopper, two_link
from planner.dynamics import FunctionDynamics
from planner.paper.methods.adjoint import ContinuousDynamics
from planner.paper.methods.shooting import HamiltonianFlow, shoot
from planner.paper.studies.shooting import shooting_jacobian
from planner.solvers.lq import costates

SHORT = 0.1  # s, on which shooting still works from zero


def pendulum():
    return FunctionDynamics(lambda x, u: np.stack([x[..., 1], u[..., 0] - np.sin(x[..., 0])], axis=-1), 2, 1, 0.1)


@pytest.mark.parametrize(
    "dynamics", [two_link().dynamics, hopper().dynamics, pendulum()], ids=lambda d: type(d).__name__
)
def test_partial_derivatives_of_rates_are_exact(dynamics):
    rates, rng = ContinuousDynamics(dynamics), np.random.default_rng(2)
    x, u = rng.normal(size=rates.nx), rng.normal(size=rates.nu)
    x[-1] += 5.0  # the hopper's piston: well in contact, where its spring is smooth
    f_x, f_u = rates.partials(x, u)
    h = 1e-5
    by_x = np.stack([(rates(x + h * e, u) - rates(x - h * e, u)) / (2.0 * h) for e in np.eye(rates.nx)], axis=1)
    by_u = np.stack([(rates(x, u + h * e) - rates(x, u - h * e)) / (2.0 * h) for e in np.eye(rates.nu)], axis=1)
    assert np.allclose(f_x, by_x, rtol=1e-6, atol=1e-6)
    assert np.allclose(f_u, by_u, rtol=1e-6, atol=1e-6)


def test_rates_are_those_of_a_small_step():
    d = two_link(horizon=20_000).dynamics
    x, u = np.array([0.1, 0.4, -1.0, 2.0]), np.array([0.3, -0.2])
    assert np.allclose(ContinuousDynamics(d)(x, u), (d.step(x[None], u[None])[0] - x) / d.dt, atol=1e-2)


@pytest.mark.slow
def test_the_hamiltonian_is_constant_along_a_flow():
    """H does not depend on time, so it stays what it was (Eq. 3)."""
    flow = HamiltonianFlow(two_link(duration=0.5), tolerance=1e-11)
    ys = flow.integrate(np.array([0.5, 0.2, -0.3, 0.1]), np.linspace(0.0, 0.5, 6))

    def H(y):
        x, costate = y[:4], y[4:]
        u = flow.control(x, costate)
        return flow.system.rates(x, u)[1] + costate @ flow.system.f(x, u)

    assert np.allclose([H(y) for y in ys], H(ys[0]), rtol=1e-8)


@pytest.mark.slow
def test_states_and_costates_keep_their_product():
    """The flow is symplectic: two changes of lambda(0) stay conjugate, X'L = L'X."""
    flow = HamiltonianFlow(two_link(duration=0.5), tolerance=1e-11)
    X, L = np.split(flow.sensitivity(np.array([0.5, 0.2, -0.3, 0.1]), np.array([0.5]))[0], 2)
    assert np.allclose(X.T @ L, L.T @ X, atol=1e-5 * np.abs(X.T @ L).max())


@pytest.mark.slow
def test_a_short_horizon_is_found_from_zero_and_is_slqs():
    problem = two_link(duration=SHORT, horizon=200)
    found = shoot(problem, np.zeros(4))
    assert found.success
    assert found.residual < 1e-6 * found.scale
    plan = planner.solve(problem)
    A, _ = problem.dynamics.linearize(plan.xs, plan.us)
    first = costates(A, problem.cost.quadratize(plan.xs, plan.us))[0]
    assert np.allclose(found.costate0, first, rtol=1e-2, atol=1e-2 * np.abs(first).max())
    assert np.abs(found.xs - plan.xs).max() < 1e-2 * np.abs(plan.xs).max()


@pytest.mark.slow
def test_two_seconds_are_not_found_from_zero():
    """The paper, section 2.1: "the shooting method failed when applied to this problem"."""
    found = shoot(two_link(), np.zeros(4), max_evaluations=12)
    assert not found.success
    assert found.message


@pytest.mark.slow
def test_the_jacobian_of_the_miss_is_exact():
    flow = HamiltonianFlow(two_link(duration=SHORT), tolerance=1e-11)
    start, span = np.array([0.5, 0.2, -0.3, 0.1]), np.array([SHORT])
    J = shooting_jacobian(flow, flow.sensitivity(start, span)[0])
    h = 1e-5
    rows = [
        (flow.miss(flow.integrate(start + h * e, span)[-1])[0] - flow.miss(flow.integrate(start - h * e, span)[-1])[0])
        / (2.0 * h)
        for e in np.eye(4)
    ]
    assert np.allclose(J, np.array(rows).T, rtol=1e-5, atol=1e-5 * np.abs(J).max())


@pytest.mark.parametrize(
    ("changes", "words"),
    [({"problem": None}, "expected a Problem"), ({"costate0": [0.0]}, r"costate0 is \[0.0\]"),
     ({"root": "newton"}, "root is 'newton'"), ({"tolerance": 0.0}, "tolerance is 0")],
)  # fmt: skip
def test_wrong_arguments_of_shooting_are_refused(changes, words):
    with pytest.raises(planner.PlannerError, match=words):
        shoot(**({"problem": two_link(duration=SHORT), "costate0": np.zeros(4)} | changes))


def test_dynamics_that_are_not_affine_in_the_control_are_refused():
    d = FunctionDynamics(lambda x, u: u**3 - x, 1, 1, 0.1)
    cost = planner.TrackingCost.reach([1.0], 5, final=1.0, effort=1.0)
    with pytest.raises(planner.PlannerError, match="affine"):
        shoot(planner.Problem(d, cost, np.zeros(1)), np.zeros(1))
