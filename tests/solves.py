"""Problems that the tests of solve() share, and what holds of every plan."""

import hashlib
import itertools
import time
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import strategies as st
from scipy.linalg import block_diag

import planner
from planner import FunctionDynamics, Problem, TrackingCost
from planner.cases.hopper import PAPER
from planner.costs import Quadratic
from planner.dynamics import HopperDynamics
from planner.solvers import lq
from planner.solvers.multistart import best_of, smooth
from planner.solvers.options import LINE_SEARCHES, UPDATES, SolverOptions

seeds = st.integers(0, 2**32 - 1)
every_way = pytest.mark.parametrize(("update", "line_search"), list(itertools.product(UPDATES, LINE_SEARCHES)))


# Problems


class Plain:
    """A user's own cost that happens to be a TrackingCost: the same numbers, but nothing the compiled engine knows."""

    def __init__(self, cost):
        self._cost = cost

    def value(self, xs, us):
        return self._cost.value(xs, us)

    def quadratize(self, xs, us):
        return self._cost.quadratize(xs, us)


def numpy_twin(problem):
    """The same problem for the other engine."""
    return Problem(problem.dynamics, Plain(problem.cost), problem.x0, problem.us, horizon=problem.N)


def linear(seed, N=6, nx=3, nu=2):
    """Random linear dynamics and tracking cost, for the NumPy engine."""
    rng = np.random.default_rng(seed)
    A, B = rng.normal(size=(nx, nx)) / np.sqrt(nx), rng.normal(size=(nx, nu))
    roots_x, roots_u = rng.normal(size=(N + 1, nx, nx)), rng.normal(size=(N, nu, nu))
    cost = TrackingCost(
        roots_x @ roots_x.swapaxes(1, 2), roots_u @ roots_u.swapaxes(1, 2) + np.eye(nu),
        rng.normal(size=(N + 1, nx)), rng.normal(size=(N, nu)),
    )  # fmt: skip
    dynamics = FunctionDynamics(lambda x, u: x @ A.T + u @ B.T, nx, nu, 0.1, "discrete", lambda x, u: (
        np.tile(A, (len(x), 1, 1)), np.tile(B, (len(x), 1, 1))))  # fmt: skip
    return Problem(dynamics, cost, rng.normal(size=nx), rng.normal(size=(N, nu)))


def flight(seed, N=11):
    """The hopper high above the ground, where its dynamics are linear, for the compiled engine."""
    rng = np.random.default_rng(seed)
    x_ref = rng.normal(size=(N + 1, 3)) * [0.0, 0.0, 20.0] + [500.0, 0.0, 0.0]
    cost = TrackingCost(np.tile(np.diag([0.0, 0.0, 30.0]), (N + 1, 1, 1)), np.full((N, 1, 1), 0.1), x_ref, 1.0)
    integrator = ("euler", "semi-implicit-euler", "rk4")[seed % 3]
    return Problem(HopperDynamics(0.02, integrator), cost, [500.0, 10.0, 1.0], 50.0 * rng.normal(size=(N, 1)))


def pendulum(x, u):
    return np.stack([x[..., 1], u[..., 0] - 9.81 * np.sin(x[..., 0])], axis=-1)


def pendulum_jacobian(x, u, gravity=9.81):
    fx, fu = np.zeros((len(x), 2, 2)), np.zeros((len(x), 2, 1))
    fx[:, 0, 1], fx[:, 1, 0], fu[:, 1, 0] = 1.0, -gravity * np.cos(x[:, 0]), 1.0
    return fx, fu


def swing(integrator="rk4", N=20):
    """A pendulum to its upright position, for the NumPy engine."""
    dynamics = FunctionDynamics(pendulum, 2, 1, 0.075, integrator)
    return Problem(dynamics, TrackingCost.reach([np.pi, 0.0], N, final=50.0, effort=1.0, dt=0.075), [0.0, 0.0])


HOPPERS = {
    "default": {},
    "short": {"height": 7.5, "horizon": 40, "smoothing": 0.2},
    "semi-implicit": {"height": 5.0, "integrator": "semi-implicit-euler", "horizon": 100},
    "paper 1": {**PAPER, "integrator": "euler", "height": 1.0},
    "paper 10": {**PAPER, "integrator": "euler", "height": 10.0},
    "paper 50": {**PAPER, "integrator": "euler", "height": 50.0},
}
hoppers = pytest.mark.parametrize("name", HOPPERS)


def hopper(name="short"):
    return planner.cases.hopper(**HOPPERS[name])


def engines():
    """One small problem per engine."""
    return {"compiled": hopper(), "numpy": swing()}


each_engine = pytest.mark.parametrize("engine", ["compiled", "numpy"])


def rollout(problem, us, K=None, xs=None, x0=None):
    """States and controls from scratch, stage by stage; held by gains around xs where given."""
    x = np.array(problem.x0 if x0 is None else x0, dtype=float)
    states, controls = [x], []
    for n in range(problem.N):
        u = us[n] if K is None else us[n] + K[n] @ (x - xs[n])
        x = problem.dynamics.step(x[None], u[None])[0]
        states.append(x)
        controls.append(u)
    return np.array(states), np.array(controls)


def first_rollout(problem):
    """States (N+1, nx) of the first guess."""
    return rollout(problem, problem.first_guess)[0]


def sweep_along(problem, plan):
    A, B = problem.dynamics.linearize(plan.xs, plan.us)
    model = problem.cost.quadratize(plan.xs, plan.us)
    return A, B, model, lq.riccati(A, B, model)


def assert_consistent(problem, plan):
    """Whatever the status: states, cost, gradient and gains all belong to the plan's own controls."""
    xs, _ = rollout(problem, plan.us)
    np.testing.assert_allclose(plan.xs, xs, rtol=1e-12, atol=1e-12)
    assert plan.cost == pytest.approx(problem.cost.value(xs, plan.us), rel=1e-12)
    A, B, model, sweep = sweep_along(problem, plan)
    gradient = lq.gradient(A, B, model)
    # Rounding of the sum that is the gradient: its terms are as large as the gradient of the zero plan.
    rounding = 1e-12 * max(1.0, np.abs(model.q).max(), np.abs(model.r).max()) * problem.N
    assert plan.gradient_norm == pytest.approx(np.linalg.norm(gradient), rel=1e-6, abs=rounding)
    if sweep is not None:
        np.testing.assert_allclose(plan.K, sweep.K, rtol=1e-7, atol=1e-9 * max(1.0, np.abs(sweep.K).max()))
    assert np.isfinite(plan.K).all()
    assert plan.history[-1].cost == plan.cost
    assert plan.history[-1].gradient_norm == plan.gradient_norm
    assert [h.iteration for h in plan.history] == list(range(len(plan.history)))
    assert plan.nit == len(plan.history) - 1
    np.testing.assert_array_equal(plan.t, problem.dynamics.dt * np.arange(problem.N + 1))


def kkt_solution(A, B, m, gaps):
    """The whole quadratic program at once, dx(n+1) = A dx + B du + gap from dx(0) = 0: over all dx(1..N), du(0..N-1).

    Returns dxs (N+1, nx), dus (N, nu), the multipliers (N, nx) of the dynamics and the least value.
    """
    N, nx, nu = B.shape
    H, g = block_diag(*m.R, *m.Q[1:]), np.concatenate([m.r.ravel(), m.q[1:].ravel()])
    C = np.zeros((N * nx, len(g)))  # A dx(n) + B du(n) - dx(n+1) = -gap
    for n in range(N):
        rows = slice(n * nx, (n + 1) * nx)
        C[rows, n * nu : (n + 1) * nu] = B[n]
        C[rows, N * nu + n * nx : N * nu + (n + 1) * nx] = -np.eye(nx)
        if n > 0:
            C[rows, N * nu + (n - 1) * nx : N * nu + n * nx] = A[n]
    kkt = np.block([[H, C.T], [C, np.zeros((N * nx, N * nx))]])
    z, multipliers = np.split(np.linalg.solve(kkt, -np.concatenate([g, gaps.ravel()])), [len(g)])
    dxs = np.vstack([np.zeros(nx), z[N * nu :].reshape(N, nx)])
    return dxs, z[: N * nu].reshape(N, nu), multipliers.reshape(N, nx), 0.5 * z @ H @ z + g @ z


def same_bits(a, b):
    for name in ("t", "xs", "us", "K"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    assert a.history == b.history
    assert (a.cost, a.gradient_norm, a.status) == (b.cost, b.gradient_norm, b.status)


def reduced_hessian(A, B, model):
    """Of the LQ problem by its controls, (N nu, N nu), with the states as functions of them."""
    (N, ndx, nu), H = B.shape, block_diag(*model.R)
    by_u = np.zeros((ndx, N * nu))
    for n in range(N):
        by_u = A[n] @ by_u
        by_u[:, n * nu : (n + 1) * nu] += B[n]
        H += by_u.T @ model.Q[n + 1] @ by_u
    return H


def assert_stationary(problem, plan):
    """Eq. 20 as far as the documented criteria carry it: a gradient of at most 1e-8, or a promised decrease
    1/2 g'H^-1 g of at most 1e-10 max(1, J), which bounds the gradient by the model's Hessian H."""
    A, B, model, _ = sweep_along(problem, plan)
    gradient, scale = np.linalg.norm(lq.gradient(A, B, model)), max(1.0, plan.cost)
    largest = np.linalg.eigvalsh(reduced_hessian(A, B, model))[-1]
    assert gradient <= max(1e-8, np.sqrt(2.0 * 1e-10 * scale * largest)) * (1.0 + 1e-6)
    last = plan.history[-1]
    assert last.gradient_norm <= 1e-8 or last.expected <= 1e-10 * scale
    assert all(h.gradient_norm > 1e-8 for h in plan.history[:-1])  # and not a line too late


def stop_at(count, error):
    """A callback that raises at the count-th line."""
    seen = []

    def callback(line):
        seen.append(line)
        if len(seen) == count:
            raise error

    return callback


def fingerprint():
    """Every bit of a plan of each engine."""
    digest = hashlib.sha256()
    for problem in engines().values():
        plan = planner.solve(problem)
        for a in (plan.xs, plan.us, plan.K, np.array(plan.history)):
            digest.update(a.tobytes())
    return digest.hexdigest()


# -------------------- Problems with several minima, and starts that end as they are told.


class Wells:
    """Two places to end at, one better; the first guess leads to the worse."""

    N, nx, nu = 8, 1, 1

    def value(self, xs, us):
        x = xs[-1, 0]
        return float(0.05 * np.sum(us**2) + 10.0 * (x**2 - 1.0) ** 2 + x + 2.0)

    def quadratize(self, xs, us):
        x, (N, _) = xs[-1, 0], us.shape
        q, Q = np.zeros((N + 1, 1)), np.zeros((N + 1, 1, 1))
        q[-1], Q[-1] = 40.0 * x * (x**2 - 1.0) + 1.0, 80.0 * x**2
        return Quadratic(Q, q, np.full((N, 1, 1), 0.1), 0.1 * us)


def wells(f=lambda x, u: u):
    return Problem(FunctionDynamics(f, 1, 1, 0.25, "euler"), Wells(), [0.5])


def judged(outcomes, callback=None, delays=None, rank=None):
    """best_of over starts that end as told, each after a delay."""
    problem, whole = swing(), planner.solve(swing())
    numbers = {}

    def descend(first_guess, max_iterations, heed):
        if heed is None:  # the pilot
            return whole
        key = first_guess.tobytes()
        k = numbers[key] = 0 if key == problem.us.tobytes() else order(first_guess)
        time.sleep(delays[k] if delays else 0.0)
        status, cost = outcomes[k]
        return replace(whole, status=status, cost=cost)

    def order(first_guess):
        scale = np.sqrt(np.mean(whole.us**2, axis=0))
        for k in range(1, len(outcomes)):
            if np.allclose(first_guess, scale * smooth(np.random.default_rng([0, k]), first_guess.shape)):
                return k
        raise AssertionError("no documented guess")

    return best_of(problem.first_guess, descend, SolverOptions(max_iterations=10, starts=len(outcomes)), callback, rank)
