"""The LQ subproblem: the sweep against one dense linear solve, the identities of section 3, and kernels against lq."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import solve_discrete_are
from solves import kkt_solution

from planner import FunctionDynamics, TrackingCost
from planner.kernels.lq import riccati as kernels
from planner.kernels.lq.quadratic import gradients
from planner.kernels.lq.workspace import Workspace
from planner.kernels.numba.lanes import WIDTH
from planner.model.space import euclidean
from planner.problem.costs.terms import Quadratic
from planner.solvers import lq

seeds = st.integers(0, 2**32 - 1)


def spd(rng, n, least=0.1):
    """A random symmetric matrix with eigenvalues of at least `least`."""
    root = rng.normal(size=(n, n)) / np.sqrt(n)
    return root @ root.T + least * np.eye(n)


def random_problem(seed, N, nx, nu):
    """A (N, nx, nx), B, and the quadratic model; state weights of low rank where chance has it."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(N, nx, nx)) / np.sqrt(nx) * rng.uniform(0.5, 1.3)
    B = rng.normal(size=(N, nx, nu))
    Q = np.array([spd(rng, nx, 0.0) * rng.integers(0, 2) for _ in range(N + 1)])
    R = np.array([spd(rng, nu) for _ in range(N)])
    return A, B, Quadratic(Q, rng.normal(size=(N + 1, nx)), R, rng.normal(size=(N, nu)))


sizes = {"N": st.integers(1, 12), "nx": st.integers(1, 12), "nu": st.integers(1, 3)}


def dense(A, B, m, dx0):
    """The quadratic program from dx(0) = dx0, which its dynamics carry on as a first gap: see kkt_solution()."""
    gaps = np.zeros(B.shape[:2])
    gaps[0] = A[0] @ dx0
    dxs, dus, multipliers, value = kkt_solution(A, B, m, gaps)
    dxs[0] = dx0
    return dxs, dus, multipliers, value + 0.5 * dx0 @ m.Q[0] @ dx0 + m.q[0] @ dx0


def assert_close(ours, theirs, digits=9):
    scale = max(1.0, float(np.abs(theirs).max()))
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=10.0**-digits * scale)


@settings(max_examples=60, deadline=None)
@given(seed=seeds, **sizes)
def test_sweep_solves_the_quadratic_program(seed, N, nx, nu):
    A, B, m = random_problem(seed, N, nx, nu)
    sweep = lq.riccati(A, B, m)
    dxs, dus = lq.direction(A, B, sweep)
    dense_dxs, dense_dus, multipliers, value = dense(A, B, m, np.zeros(nx))
    assert_close(dxs, dense_dxs)
    assert_close(dus, dense_dus)
    # Eq. 28 in our signs: the multipliers of the dynamics are P dx + s.
    assert_close(np.einsum("nij,nj->ni", sweep.P[1:], dxs[1:]) + sweep.s[1:], multipliers)
    assert_close(0.5 * sweep.slope, value)  # the decrease promised is the least value of the model


@settings(max_examples=40, deadline=None)
@given(seed=seeds, **sizes)
def test_gains_and_value_function_hold_from_any_start(seed, N, nx, nu):
    """From dx(0) = d: du = k + K dx is the program's solution, and its value is 1/2 d'Pd + s'd plus a constant."""
    A, B, m = random_problem(seed, N, nx, nu)
    sweep = lq.riccati(A, B, m)
    d = np.random.default_rng(seed + 1).normal(size=nx)
    _, dus, _, value = dense(A, B, m, d)
    dx = d
    for n in range(N):
        du = sweep.k[n] + sweep.K[n] @ dx
        assert_close(du, dus[n])
        dx = A[n] @ dx + B[n] @ du
    assert_close(0.5 * d @ sweep.P[0] @ d + sweep.s[0] @ d + 0.5 * sweep.slope, value)
    for P in sweep.P:
        np.testing.assert_array_equal(P, P.T)
        assert np.linalg.eigvalsh(P).min() >= -1e-9 * max(1.0, np.abs(P).max())


@settings(max_examples=60, deadline=None)
@given(seed=seeds, mu=st.sampled_from([0.0, 0.0, 0.3, 30.0]), **sizes)
def test_descent_identity(seed, mu, N, nx, nu):
    """Eq. 42: grad J . dU = -(sum dx'Q dx + du'R du), all of it negative; with mu on R's diagonal."""
    A, B, m = random_problem(seed, N, nx, nu)
    sweep = lq.riccati(A, B, m, mu)
    dxs, dus = lq.direction(A, B, sweep)
    along = float(np.sum(lq.gradient(A, B, m) * dus))
    energy = np.einsum("ni,nij,nj->", dxs, m.Q, dxs) + np.einsum("ni,nij,nj->", dus, m.R, dus) + mu * np.sum(dus**2)
    assert along == pytest.approx(-energy, rel=1e-8)
    assert along == pytest.approx(sweep.slope, rel=1e-8)
    assert along < 0.0


@settings(max_examples=30, deadline=None)
@given(seed=seeds, mu=st.floats(1e-6, 1e3), **sizes)
def test_regularization_is_a_heavier_control_weight(seed, mu, N, nx, nu):
    A, B, m = random_problem(seed, N, nx, nu)
    heavier = m._replace(R=m.R + mu * np.eye(nu))
    for ours, theirs in zip(lq.riccati(A, B, m, mu)[:6], lq.riccati(A, B, heavier)[:6], strict=True):
        assert_close(ours, theirs, 11)


def table_1(A, B, Q, R, x_ref, u_ref):
    """The paper's Table 1 as printed, with its inverses M(n) and its offsets, from dx(0) = 0."""
    N, nx, nu = B.shape
    P, s = [None] * N + [Q[N]], [None] * N + [-Q[N] @ x_ref[N]]
    M = [None] * N
    for n in reversed(range(N)):
        BRB = B[n] @ np.linalg.solve(R[n], B[n].T)
        M[n] = np.linalg.inv(np.eye(nx) + BRB @ P[n + 1])
        PM = P[n + 1] @ M[n]
        P[n] = Q[n] + A[n].T @ PM @ A[n]
        s[n] = A[n].T @ (np.eye(nx) - PM @ BRB) @ s[n + 1] + A[n].T @ PM @ B[n] @ u_ref[n] - Q[n] @ x_ref[n]
    x, us = np.zeros(nx), np.empty((N, nu))
    for n in range(N):
        v = M[n] @ B[n] @ (u_ref[n] - np.linalg.solve(R[n], B[n].T @ s[n + 1]))
        x = M[n] @ A[n] @ x + v
        us[n] = u_ref[n] - np.linalg.solve(R[n], B[n].T @ (P[n + 1] @ x + s[n + 1]))
    return np.array(P), np.array(s), us


@settings(max_examples=40, deadline=None)
@given(seed=seeds, **sizes)
def test_sweep_is_table_1(seed, N, nx, nu):
    A, B, m = random_problem(seed, N, nx, nu)
    rng = np.random.default_rng(seed)
    x_ref, u_ref = rng.normal(size=(N + 1, nx)), rng.normal(size=(N, nu))
    q, r = -np.einsum("nij,nj->ni", m.Q, x_ref), -np.einsum("nij,nj->ni", m.R, u_ref)
    sweep = lq.riccati(A, B, Quadratic(m.Q, q, m.R, r))
    P, s, us = table_1(A, B, m.Q, m.R, x_ref, u_ref)
    assert_close(sweep.P, P, 8)
    assert_close(sweep.s, s, 8)
    assert_close(lq.direction(A, B, sweep)[1], us, 8)


def test_long_horizons_end_in_the_algebraic_riccati_equation():
    rng = np.random.default_rng(4)
    nx, nu, N = 4, 2, 200
    A, B, Q, R = rng.normal(size=(nx, nx)), rng.normal(size=(nx, nu)), spd(rng, nx), spd(rng, nu)
    assert np.abs(np.linalg.eigvals(A)).max() > 1.0  # an unstable plant, held by the gains
    model = Quadratic(np.tile(Q, (N + 1, 1, 1)), np.zeros((N + 1, nx)), np.tile(R, (N, 1, 1)), np.zeros((N, nu)))
    sweep = lq.riccati(np.tile(A, (N, 1, 1)), np.tile(B, (N, 1, 1)), model)
    P = solve_discrete_are(A, B, Q, R)
    np.testing.assert_allclose(sweep.P[0], P, rtol=1e-9)
    np.testing.assert_allclose(sweep.K[0], -np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A), rtol=1e-9)


def pendulum(x, u):
    return np.stack([x[..., 1], u[..., 0] - np.sin(x[..., 0]) + 0.2 * u[..., 1] * x[..., 1]], axis=-1)


def rollout(dynamics, x0, us):
    xs = [np.asarray(x0, dtype=float)]
    for u in us:
        xs.append(dynamics.step(xs[-1][None], u[None])[0])
    return np.array(xs)


@settings(max_examples=15, deadline=None)
@given(seed=seeds, N=st.integers(1, 10), integrator=st.sampled_from(["euler", "semi-implicit-euler", "rk4"]))
def test_gradient_is_that_of_the_cost(seed, N, integrator):
    """Eq. 16-19 against differences of J itself, through rollouts of nonlinear dynamics."""
    rng = np.random.default_rng(seed)
    dynamics = FunctionDynamics(pendulum, 2, 2, 0.2, integrator)
    cost = TrackingCost(
        [spd(rng, 2) for _ in range(N + 1)], [spd(rng, 2) for _ in range(N)],
        rng.normal(size=(N + 1, 2)), rng.normal(size=(N, 2)),
    )  # fmt: skip
    x0, us = rng.normal(size=2), rng.normal(size=(N, 2))
    xs = rollout(dynamics, x0, us)
    A, B = dynamics.linearize(xs, us)
    model = cost.quadratize(xs, us)
    gradient = lq.gradient(A, B, model)
    costate = lq.costates(A, model)
    h = 1e-5  # central: rounding 1e-16 J / h and h^2 leave about 1e-9

    def J(dx0, dus):
        return cost.value(rollout(dynamics, x0 + dx0, us + dus), us + dus)

    for n in range(N):
        for a in range(2):
            d = np.zeros((N, 2))
            d[n, a] = h
            assert (J(0.0, d) - J(0.0, -d)) / (2 * h) == pytest.approx(gradient[n, a], rel=1e-6, abs=1e-6)
    for i in range(2):  # Eq. 14: the costate at 0 is the derivative with respect to the start
        d = h * np.eye(2)[i]
        assert (J(d, 0.0) - J(-d, 0.0)) / (2 * h) == pytest.approx(costate[0, i], rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("stage", [0, 2, 4])
def test_an_indefinite_stage_is_found(stage):
    """R + B'PB + mu I is indefinite at one stage: None, until mu lifts its least eigenvalue above zero."""
    A, B, m = random_problem(5, 5, 3, 2)
    m = m._replace(Q=0.0 * m.Q)  # so that B'PB is zero and R decides
    m.R[stage] = np.array([[1.0, 2.0], [2.0, 1.0]])  # eigenvalues 3 and -1
    assert lq.riccati(A, B, m) is None
    assert lq.riccati(A, B, m, 0.99) is None
    assert lq.riccati(A, B, m, 1.01) is not None
    w = filled(A, B, m)
    assert [swept(w, mu)[2] for mu in (0.0, 0.99, 1.01)] == [False, False, True]


@pytest.mark.parametrize("where", [(0, 0), (1, 1), (0, 1)])
@pytest.mark.parametrize("nu", [1, 2])
def test_nan_is_not_positive_definite(nu, where):
    """A weight that is not a number has no gains; LAPACK may factorize it without complaint."""
    i, j = min(where[0], nu - 1), min(where[1], nu - 1)
    A, B, m = random_problem(6, 3, 3, nu)
    m.R[1, i, j] = m.R[1, j, i] = np.nan
    assert not swept(filled(A, B, m))[2]
    assert lq.riccati(A, B, m) is None


# The compiled sweep


def filled(A, B, m, outputs=0):
    """A workspace that holds the problem."""
    N, nx, nu = B.shape
    weights = SimpleNamespace(Q=m.Q, R=m.R, x_ref=np.zeros((N + 1, nx)), u_ref=np.zeros((N, nu)))
    w = Workspace(weights, euclidean(nx), structured=False, outputs=outputs)
    x = slice(w.first, w.first + nx)
    w.F[:, :, :nu], w.F[:, :, x] = B, A
    w.l[:N, :nu], w.l[:, x] = m.r, m.q
    return w


# (nx, nu): blocks of four columns filled and part filled, one to several.
BLOCKS = [(1, 1), (3, 1), (4, 2), (6, 2), (7, 1), (8, 1), (5, 3), (12, 3), (12, 2), (14, 2), (15, 3), (1, 3)]


@pytest.mark.parametrize(("nx", "nu"), BLOCKS)
@settings(max_examples=10, deadline=None)
@given(seed=seeds, N=st.integers(1, 10), mu=st.sampled_from([0.0, 0.5]))
def test_compiled_sweep_is_its_twin(nx, nu, seed, N, mu):
    A, B, m = random_problem(seed, N, nx, nu)
    twin = lq.riccati(A, B, m, mu)
    w = filled(A, B, m)
    norm, slope, definite = kernels.riccati_dense(w.table, mu, 0.0)
    assert definite
    gradient = lq.gradient(A, B, m)
    assert_close(w.gradient, gradient, 11)
    assert norm == pytest.approx(np.linalg.norm(gradient), rel=1e-11)
    assert slope == pytest.approx(twin.slope, rel=1e-9)
    assert_close(w.k, twin.k)
    assert_close(w.K[:, :, w.first : w.first + nx], twin.K)
    kernels.direction(w.table, 0.0)
    assert_close(w.dus, lq.direction(A, B, twin)[1])


@pytest.mark.parametrize(("nx", "nu", "outputs"), [(4, 1, 1), (8, 2, 2), (13, 3, 5), (12, 4, 4), (15, 2, 7)])
@settings(max_examples=10, deadline=None)
@given(seed=seeds, N=st.integers(1, 10), mu=st.sampled_from([0.0, 0.5]))
def test_a_sweep_may_leave_out_the_zeros_of_outputs(nx, nu, outputs, seed, N, mu):
    """No later state depends on outputs, and their weights are on nothing else; the twin knows nothing of them."""
    A, B, m = random_problem(seed, N, nx, nu)
    A[:, :, nx - outputs :] = 0.0
    k = np.arange(nx - outputs, nx)
    alone = m.Q[:, k, k]
    m.Q[:, k, :] = m.Q[:, :, k] = 0.0
    m.Q[:, k, k] = alone
    twin = lq.riccati(A, B, m, mu)
    w = filled(A, B, m, outputs)
    for _ in range(2):  # nothing of the first may be left for the second
        _, slope, definite = kernels.riccati_dense(w.table, mu, 0.0)
        assert definite
        assert slope == pytest.approx(twin.slope, rel=1e-9)
        assert_close(w.gradient, lq.gradient(A, B, m), 11)
        assert_close(w.k, twin.k)
        assert_close(w.K[:, :, w.first : w.first + nx], twin.K)


@pytest.mark.parametrize(("nv", "nu"), [(1, 1), (2, 2), (3, 1), (4, 3), (5, 5), (7, 6)])
@settings(max_examples=10, deadline=None)
@given(seed=seeds, N=st.integers(1, 10), mu=st.sampled_from([0.0, 0.5]), dt=st.sampled_from([0.1, 1.0]))
def test_a_sweep_with_rates_is_that_of_its_whole_rows(nv, nu, seed, N, mu, dt):
    """x = (q, v, a, r): qd after the stage moves q, a is the stage's acceleration, r the change of a over dt."""
    nx, q, v, a, r = 4 * nv, *(slice(k * nv, (k + 1) * nv) for k in range(4))
    by_z, own, m = random_problem(seed, N, 2 * nv, nu)  # rows of v: what the acceleration depends on
    m = random_problem(seed + 1, N, nx, nu)[2]
    k = np.arange(3 * nv, nx)
    alone = m.Q[:, k, k]
    m.Q[:, k, :] = m.Q[:, :, k] = 0.0
    m.Q[:, k, k] = alone
    A, B, one = np.zeros((N, nx, nx)), np.zeros((N, nx, nu)), np.eye(nv)
    A[:, a, : 2 * nv], B[:, a] = by_z[:, v], own[:, v]
    A[:, v], B[:, v] = dt * A[:, a], dt * B[:, a]
    A[:, v, v] += one
    A[:, q], B[:, q] = dt * A[:, v], dt * B[:, v]
    A[:, q, q] += one
    A[:, r], B[:, r] = A[:, a] / dt, B[:, a] / dt
    A[:, r, a] -= one / dt
    twin = lq.riccati(A, B, m, mu)
    weights = SimpleNamespace(Q=m.Q, R=m.R, x_ref=np.zeros((N + 1, nx)), u_ref=np.zeros((N, nu)))
    w = Workspace(weights, euclidean(nx), structured=True, outputs=nv)
    x = slice(w.first, w.first + nx)
    w.F[:, :, :nu], w.F[:, :, x] = B[:, a], A[:, a]
    w.l[:N, :nu], w.l[:, x] = m.r, m.q
    for _ in range(2):  # nothing of the first may be left for the second
        _, slope, definite = kernels.riccati_structured(w.table, mu, dt)
        assert definite
        assert slope == pytest.approx(twin.slope, rel=1e-8)
        assert_close(w.gradient, lq.gradient(A, B, m), 10)
        assert_close(w.k, twin.k, 8)
        assert_close(w.K[:, :, x], twin.K, 8)
    kernels.direction(w.table, dt)
    assert_close(w.dus, lq.direction(A, B, twin)[1], 8)


@pytest.mark.parametrize(("nx", "nu"), [(3, 1), (12, 3)])
@settings(max_examples=10, deadline=None)
@given(seed=seeds, N=st.integers(1, 10))
def test_compiled_gradients_are_the_costs(nx, nu, seed, N):
    rng = np.random.default_rng(seed)
    A, B, m = random_problem(seed, N, nx, nu)
    cost = TrackingCost(m.Q, m.R, rng.normal(size=(N + 1, nx)), rng.normal(size=(N, nu)))
    w = Workspace(cost, euclidean(nx), structured=False)
    x = slice(w.first, w.first + nx)
    w.xs[:], w.us[:] = rng.normal(size=(N + 1, nx)), rng.normal(size=(N, nu))
    w.F[:, :, :nu], w.F[:, :, x] = B, A
    gradients(w.table)
    model = cost.quadratize(w.xs, w.us)
    np.testing.assert_allclose(w.l[:N, :nu], model.r, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(w.l[:, x], model.q, rtol=1e-12, atol=1e-12)
    assert not w.l[N, :nu].any()  # there is no control at the end
    kernels.riccati_dense(w.table, 0.0, 0.0)
    assert_close(w.gradient, lq.gradient(A, B, model), 11)


def swept(w, mu=0.0):
    """The compiled sweep; the workspace is a name here, so that its memory lives as long as the call."""
    return kernels.riccati_dense(w.table, mu, 0.0)


def test_compiled_sweep_forgets_the_last_one():
    """A workspace is used again and again: nothing of an earlier sweep may leak, least of a failed one."""
    nx, nu, N = 12, 3, 6
    fresh, used = filled(*random_problem(1, N, nx, nu)), filled(*random_problem(1, N, nx, nu))
    expected = swept(fresh)
    used.F[:] *= 30.0
    swept(used)
    assert not swept(used, -1e9)[2]
    used.F[:] = fresh.F
    assert swept(used) == expected
    np.testing.assert_array_equal(used.K, fresh.K)
    np.testing.assert_array_equal(used.k, fresh.k)


def test_rows_are_whole_lanes():
    """What the sweep relies on: rows of the padded arrays are whole lanes, and x begins on one."""
    w = filled(*random_problem(0, 3, 12, 3))
    assert w.first % WIDTH == 0
    for a in (w.F, w.K, w.l):
        assert a.shape[-1] % WIDTH == 0
        assert a.ctypes.data % 64 == 0  # a cache line
