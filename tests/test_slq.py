"""solve(): what the paper proves of SLQ holds of every plan, both engines agree, and every ending is told rightly."""

import hashlib
import itertools
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba.core.runtime import _nrt_python, rtsys
from scipy.linalg import block_diag

import planner
from planner import FunctionDynamics, HopperDynamics, PlannerError, Problem, Quadratic, Status, TrackingCost, lq
from planner.cases.hopper import PAPER
from planner.engine import CompiledEngine, NumpyEngine, borrow
from planner.kernels import search
from planner.kernels.workspace import ACCEPTED, workspace
from planner.plan import Iteration
from planner.slq import LINE_SEARCHES, UPDATES

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


def swing(integrator="rk4", N=20):
    """A pendulum to its upright position, for the NumPy engine."""
    dynamics = FunctionDynamics(pendulum, 2, 1, 0.075, integrator)
    return Problem(dynamics, TrackingCost.reach([np.pi, 0.0], N, final=50.0, effort=1.0, dt=0.075), [0.0, 0.0])


HOPPERS = {
    "default": {},
    "short": {"height": 7.5, "horizon": 40, "smoothing": 0.2},
    "semi-implicit": {"height": 5.0, "integrator": "semi-implicit-euler", "horizon": 100},
    "paper 1": {**PAPER, "height": 1.0},
    "paper 10": {**PAPER, "height": 10.0},
    "paper 50": {**PAPER, "height": 50.0},
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


def same_bits(a, b):
    for name in ("t", "xs", "us", "K"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    assert a.history == b.history
    assert (a.cost, a.gradient_norm, a.status) == (b.cost, b.gradient_norm, b.status)


def assert_stationary(problem, plan):
    """Eq. 20 as far as the documented criteria carry it: a gradient of at most 1e-8, or a promised decrease
    1/2 g'H^-1 g of at most 1e-10 max(1, J), which bounds the gradient by the model's Hessian H."""
    A, B, model, _ = sweep_along(problem, plan)
    gradient = np.linalg.norm(lq.gradient(A, B, model))
    N, nx, nu = B.shape
    S, H = np.zeros((nx, N * nu)), block_diag(*model.R)  # S = dx(n) / dU
    for n in range(N):
        S = A[n] @ S
        S[:, n * nu : (n + 1) * nu] += B[n]
        H += S.T @ model.Q[n + 1] @ S
    scale = max(1.0, plan.cost)
    largest = np.linalg.eigvalsh(H)[-1]
    assert gradient <= max(1e-8, np.sqrt(2.0 * 1e-10 * scale * largest)) * (1.0 + 1e-6)
    last = plan.history[-1]
    assert last.gradient_norm <= 1e-8 or last.expected <= 1e-10 * scale
    assert all(h.gradient_norm > 1e-8 for h in plan.history[:-1])  # and not a line too late


# What the paper proves


@every_way
@pytest.mark.parametrize("make", [linear, flight])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_linear_problem_takes_one_iteration(make, seed, update, line_search):
    """The LQ subproblem is the problem: the first step is 1, its promise is kept, and the gradient is zero after."""
    problem = make(seed)
    plan = planner.solve(problem, update=update, line_search=line_search)
    assert plan.success
    assert plan.nit == 1
    first, last = plan.history
    exact = line_search == "exact"  # brackets the step to a relative 1e-6, which costs its square of the decrease
    assert first.step == pytest.approx(1.0, abs=1e-6 if exact else 0.0)
    assert first.actual == pytest.approx(first.expected, rel=1e-9)
    assert last.gradient_norm <= (2e-6 if exact else 1e-10) * first.gradient_norm
    A, B, model, _ = sweep_along(problem, plan)
    assert np.linalg.norm(lq.gradient(A, B, model)) <= (2e-6 if exact else 1e-10) * first.gradient_norm
    assert_consistent(problem, plan)


@every_way
@hoppers
def test_converged_means_stationary(name, update, line_search):
    """Theorem 2, Eq. 20: from rest and no control, each update and line search ends where the gradient vanishes."""
    problem = hopper(name)
    plan = planner.solve(problem, update=update, line_search=line_search)
    assert plan.status is Status.CONVERGED
    assert_consistent(problem, plan)
    assert_stationary(problem, plan)
    assert plan.gradient_norm <= 1e-6 * plan.history[0].gradient_norm


@every_way
@pytest.mark.parametrize("integrator", ["euler", "semi-implicit-euler", "rk4"])
def test_converged_means_stationary_for_own_dynamics(integrator, update, line_search):
    problem = swing(integrator)
    plan = planner.solve(problem, update=update, line_search=line_search)
    assert plan.status is Status.CONVERGED
    assert_consistent(problem, plan)
    assert_stationary(problem, plan)


@every_way
@pytest.mark.parametrize("name", ["default", "paper 50"])
def test_every_accepted_step_lowers_the_cost_enough(name, update, line_search):
    """Armijo's inequality holds of every line of the table, for every rule, with the slope of Eq. 42."""
    plan = planner.solve(hopper(name), update=update, line_search=line_search)
    accepted = [h for h in plan.history if h.step > 0.0]
    assert accepted
    for h in accepted:
        assert h.actual > 0.0
        if h.step < 2.0:  # the LQ model's decrease -slope a (1 - a/2) tells the slope
            slope = -h.expected / (h.step * (1.0 - 0.5 * h.step))
            assert h.actual >= -1e-4 * h.step * slope * (1.0 - 1e-9) - 1e-15 * h.cost  # c1
            if line_search == "goldstein":
                assert -0.25 * h.step * slope <= h.actual * (1.0 + 1e-9) + 1e-13 * h.cost
                assert h.actual <= -0.75 * h.step * slope * (1.0 + 1e-9) + 1e-13 * h.cost


@hoppers
def test_the_table_adds_up(name):
    """Each line's cost is the one before less what actually came; what was promised comes true in the end."""
    plan = planner.solve(hopper(name))
    for line, after in itertools.pairwise(plan.history):
        assert line.actual == line.cost - after.cost
        assert line.expected > 0.0
    if name != "paper 50":  # where the curvature of the dynamics, unknown to the model, slows the end down
        full = [h for h in plan.history if h.step == 1.0 and h.actual > 1e-9 * h.cost]  # above rounding
        assert full[-1].actual == pytest.approx(full[-1].expected, rel=0.3)  # the model is nearly right at the end


@each_engine
@pytest.mark.parametrize("count", [1, 2, 4])
def test_a_shorter_solve_is_a_prefix(engine, count):
    """So the history's costs and gradients are those of real trajectories, each the plan of a shorter solve."""
    problem = engines()[engine]
    full, short = planner.solve(problem), planner.solve(problem, max_iterations=count)
    assert full.nit > count
    assert short.status is Status.MAX_ITERATIONS
    assert "raise max_iterations" in short.message
    assert not short.success
    assert short.history[:-1] == full.history[:count]
    assert short.cost == pytest.approx(full.history[count].cost, rel=1e-13)
    assert short.gradient_norm == pytest.approx(full.history[count].gradient_norm, rel=1e-10)
    assert_consistent(problem, short)


@each_engine
def test_a_solve_goes_on_from_a_plans_controls(engine):
    problem = engines()[engine]
    full, short = planner.solve(problem), planner.solve(problem, max_iterations=3)
    rest = planner.solve(Problem(problem.dynamics, problem.cost, problem.x0, short.us, horizon=problem.N))
    assert rest.nit == full.nit - 3
    np.testing.assert_allclose(rest.us, full.us, rtol=0, atol=1e-7 * np.abs(full.us).max())


# Two engines, one algorithm


@every_way
@pytest.mark.parametrize("name", ["short", "semi-implicit", "paper 1"])
def test_engines_agree_line_by_line(name, update, line_search):
    problem = hopper(name)
    assert isinstance(borrow(problem), CompiledEngine)
    assert isinstance(borrow(numpy_twin(problem)), NumpyEngine)
    ours = planner.solve(problem, update=update, line_search=line_search)
    theirs = planner.solve(numpy_twin(problem), update=update, line_search=line_search)
    # The exact search finds a flat minimum to half of the digits at best, and other steps lead elsewhere: its first
    # line, and its end, can be compared.
    exact = line_search == "exact"
    if not exact:
        assert ours.nit == theirs.nit
    for a, b in zip(ours.history[: 1 if exact else None], theirs.history[: 1 if exact else None], strict=True):
        assert a.cost == pytest.approx(b.cost, rel=1e-10)
        # In the last lines the gradient, and what is promised, are differences of rounded numbers.
        assert a.gradient_norm == pytest.approx(b.gradient_norm, rel=1e-8, abs=1e-9 * ours.history[0].gradient_norm)
        assert a.regularisation == pytest.approx(b.regularisation, rel=1e-12)
        if a.expected > 1e-9 * a.cost:
            assert a.step == pytest.approx(b.step, rel=1e-6 if exact else 0.0)
            assert a.expected == pytest.approx(b.expected, rel=1e-6)
            assert a.actual == pytest.approx(b.actual, rel=1e-6, abs=1e-10 * a.cost)
    assert ours.cost == pytest.approx(theirs.cost, rel=1e-10)
    np.testing.assert_allclose(ours.us, theirs.us, rtol=0, atol=1e-5 * np.abs(ours.us).max())
    np.testing.assert_allclose(ours.K, theirs.K, rtol=0, atol=1e-5 * np.abs(ours.K).max())


@pytest.mark.parametrize("batched", [True, False])
@pytest.mark.parametrize("integrator", ["euler", "rk4"])
def test_a_hopper_in_plain_python_gets_the_same_plan(integrator, batched):
    """Section 2.4 typed once more, derivatives by differences: the plan does not depend on who wrote the machine."""
    problem = planner.cases.hopper(height=7.5, horizon=40, smoothing=0.5, integrator=integrator)
    k, alpha, g = 100.0, 0.5, 386.4  # section 4, but for a softer spring where differences cannot trip

    def many(x, u):
        e = x[..., 2] - x[..., 0]
        force = np.where(e < 0.0, 0.0, np.where(e < alpha, k / (2 * alpha) * e**2, k * e - k * alpha / 2))
        return np.stack([x[..., 1], force - g, u[..., 0]], axis=-1)

    def one(x, u):
        y, v, p = x
        e = p - y
        force = 0.0 if e < 0.0 else (k / (2 * alpha) * e**2 if e < alpha else k * e - k * alpha / 2)
        return [v, force - g, u[0]]

    dynamics = FunctionDynamics(many if batched else one, 3, 1, problem.dynamics.dt, integrator)
    assert dynamics.batched is batched
    ours, theirs = planner.solve(problem), planner.solve(Problem(dynamics, problem.cost, problem.x0))
    assert ours.success
    assert theirs.success
    assert theirs.cost == pytest.approx(ours.cost, rel=1e-9)
    np.testing.assert_allclose(theirs.us, ours.us, rtol=0, atol=1e-5 * np.abs(ours.us).max())
    np.testing.assert_allclose(theirs.xs, ours.xs, rtol=0, atol=1e-5 * np.abs(ours.xs).max())
    np.testing.assert_allclose(theirs.K, ours.K, rtol=0, atol=1e-4 * np.abs(ours.K).max())


# Gains


@pytest.mark.parametrize("make", [linear, flight])
def test_gains_are_the_derivative_of_the_best_controls(make):
    """On a linear problem: a plan re-solved from another start is the first plan held by its gains, exactly."""
    problem = make(3)
    plan = planner.solve(problem)
    for i in range(len(problem.x0)):
        x0 = problem.x0 + 2.0 * np.eye(len(problem.x0))[i]
        again = planner.solve(Problem(problem.dynamics, problem.cost, x0, horizon=problem.N))
        xs, us = rollout(problem, plan.us, plan.K, plan.xs, x0)
        np.testing.assert_allclose(us, again.us, rtol=0, atol=1e-8 * np.abs(again.us).max())
        np.testing.assert_allclose(xs, again.xs, rtol=0, atol=1e-8 * np.abs(again.xs).max())
        _, open_loop_us = rollout(problem, plan.us, x0=x0)
        open_loop = problem.cost.value(rollout(problem, plan.us, x0=x0)[0], open_loop_us)
        assert again.cost <= open_loop * (1.0 + 1e-12)
        assert problem.cost.value(xs, us) == pytest.approx(again.cost, rel=1e-9)


@pytest.mark.parametrize("problem", [hopper("short"), hopper("default"), swing()], ids=["short", "default", "swing"])
def test_gains_hold_the_plan(problem):
    """From a start a little off: to first order the cost changes by the costate, gains or none (envelope theorem);
    to second order the gains save what the LQ model says, so that held plans never cost more."""
    plan = planner.solve(problem)
    A, _, model, sweep = sweep_along(problem, plan)
    costate = lq.costates(A, model)[0]
    identity = [np.eye(len(problem.x0))]
    for n in range(problem.N):  # how the LQ model's states grow without gains
        identity.append(A[n] @ identity[-1])
    open_P = np.einsum("nki,nkl,nlj->ij", identity, model.Q, identity)
    for i in range(len(problem.x0)):
        d = 1e-4 * np.eye(len(problem.x0))[i]
        held, free = (
            [problem.cost.value(*rollout(problem, plan.us, *gains, x0=problem.x0 + s * d)) for s in (-1.0, 1.0)]
            for gains in ((plan.K, plan.xs), ())
        )
        for cost in (held, free):
            assert (cost[1] - cost[0]) / 2e-4 == pytest.approx(costate[i], rel=1e-3, abs=1e-4 * np.abs(costate).max())
        saved = (sum(free) - sum(held)) / 2.0
        promised = 0.5 * d @ (open_P - sweep.P[0]) @ d
        assert promised >= 0.0
        assert saved >= 0.5 * promised - 1e-13 * plan.cost


# Determinism


FRESH = """
import hashlib, sys
sys.path.insert(0, {folder!r})
import test_slq
print(test_slq.fingerprint())
"""


def fingerprint():
    """Every bit of a plan of each engine."""
    digest = hashlib.sha256()
    for problem in engines().values():
        plan = planner.solve(problem)
        for a in (plan.xs, plan.us, plan.K, np.array(plan.history)):
            digest.update(a.tobytes())
    return digest.hexdigest()


def test_the_same_bits_again_and_in_another_process():
    ours = fingerprint()
    assert fingerprint() == ours
    program = FRESH.format(folder=str(__file__).rsplit("/", 1)[0])
    fresh = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120, check=True)
    assert fresh.stdout.strip() == ours


@each_engine
def test_a_used_engine_gives_the_same_bits(engine):
    """Solves of one problem share memory one after another; other updates and endings in between leave no trace."""
    problem = engines()[engine]
    first = planner.solve(problem)
    planner.solve(problem, update="open-loop", line_search="wolfe")
    planner.solve(problem, line_search="exact", max_iterations=2)
    planner.solve(problem, callback=stop_at(3, KeyboardInterrupt))
    same_bits(planner.solve(problem), first)


@each_engine
def test_threads_give_the_same_bits(engine):
    problem = engines()[engine]
    alone = {update: planner.solve(problem, update=update) for update in UPDATES}
    with ThreadPoolExecutor(4) as pool:
        jobs = [(update, pool.submit(planner.solve, problem, update=update)) for update in UPDATES * 4]
        for update, job in jobs:
            same_bits(job.result(), alone[update])


def test_a_solve_inside_a_solve():
    """A callback may solve the very problem that is being solved."""
    problem = hopper()
    alone, inner = planner.solve(problem), []
    outer = planner.solve(problem, callback=lambda line: inner.append(planner.solve(problem)))
    same_bits(outer, alone)
    for plan in inner:
        same_bits(plan, alone)


@pytest.fixture
def statistics():
    """Numba counts what compiled code allocates."""
    enabled = _nrt_python.memsys_stats_enabled()
    _nrt_python.memsys_enable_stats()
    yield rtsys.get_allocation_stats
    if not enabled:
        _nrt_python.memsys_disable_stats()


@pytest.mark.parametrize("update", UPDATES)
@pytest.mark.parametrize("line_search", LINE_SEARCHES)
def test_compiled_iterations_allocate_nothing(statistics, update, line_search):
    """Handing an array to compiled code makes one handle; beyond these nothing, whatever N and however many batches."""
    arrays = len(workspace(*(np.eye(1)[None].repeat(n, 0) for n in (2, 1)), np.zeros((2, 1)), np.zeros((1, 1))))
    parameters = 1  # HopperDynamics' own array
    for N in (10, 300):
        problem = planner.cases.hopper(horizon=N)
        engine, rule = borrow(problem), LINE_SEARCHES.index(line_search)
        cost = engine.start(problem.x0, problem.first_guess)
        for _ in range(4):
            before = statistics()
            done = engine.iterate(update == "feedback", rule, 0.0, True, cost, 0.0, 0.0)
            after = statistics()
            assert done.kind == ACCEPTED
            cost = done.cost
            assert after.mi_alloc - before.mi_alloc == arrays + parameters
            assert after.alloc - before.alloc == arrays + parameters
            assert after.free - before.free == arrays + parameters  # and none is left


# How a solve ends


def stop_at(count, error):
    """A callback that raises at the count-th line."""
    seen = []

    def callback(line):
        seen.append(line)
        if len(seen) == count:
            raise error

    return callback


@each_engine
@pytest.mark.parametrize("error", [KeyboardInterrupt, StopIteration])
@pytest.mark.parametrize("count", [1, 3])
def test_interrupted_plans_are_whole(engine, error, count):
    problem = engines()[engine]
    plan = planner.solve(problem, callback=stop_at(count, error))
    assert plan.status is Status.INTERRUPTED
    assert not plan.success
    assert plan.nit == count
    assert_consistent(problem, plan)
    same = planner.solve(problem, max_iterations=count)
    np.testing.assert_array_equal(plan.us, same.us)
    np.testing.assert_array_equal(plan.K, same.K)
    assert plan.history == same.history


def test_other_errors_of_a_callback_are_the_users():
    with pytest.raises(ZeroDivisionError):
        planner.solve(hopper(), callback=lambda line: 1 / 0)
    same_bits(planner.solve(hopper()), planner.solve(hopper()))


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 900), st.sampled_from(UPDATES))
def test_ctrl_c_anywhere_leaves_states_and_controls_together(call, update):
    """Ctrl-C lands in the user's own function, wherever the solve may be."""
    calls, countdown = [0], [0]

    def f(x, u):
        calls[0] += 1
        if calls[0] == countdown[0]:
            raise KeyboardInterrupt
        return pendulum(x, u)

    problem = Problem(
        FunctionDynamics(f, 2, 1, 0.05), TrackingCost.reach([3.0, 0.0], 12, final=50.0, effort=1.0), [0.0, 0.0]
    )
    # After the first rollout (RK4 calls f four times a stage) there is a trajectory to keep.
    calls[0], countdown[0] = 0, 4 * problem.N + call
    plan = planner.solve(problem, update=update)
    interrupted, countdown[0] = calls[0] >= countdown[0], 0
    assert plan.status is (Status.INTERRUPTED if interrupted else Status.CONVERGED)
    assert_consistent(problem, plan)


@pytest.mark.parametrize(
    "problem",
    [
        # Piston and flow of 1e307 in/s over a second each are beyond the largest double.
        Problem(HopperDynamics(1.0, "euler"), flight(0, 200).cost, [0.0, 0.0, 0.0], np.full((200, 1), 1e307)),
        Problem(
            FunctionDynamics(lambda x, u: x**3 + u, 1, 1, 1.0, "euler"),
            TrackingCost.reach([0.0], 60, final=1.0, effort=1.0),
            [2.0],
        ),
    ],
    ids=["compiled", "numpy"],
)
def test_a_first_guess_that_runs_away(problem):
    lines = []
    plan = planner.solve(problem, callback=lines.append)
    assert plan.status is Status.NOT_FINITE
    assert not np.isfinite(plan.cost)
    assert np.isnan(plan.gradient_norm)
    assert plan.history == ()
    assert plan.nit == 0
    assert lines == []
    np.testing.assert_array_equal(plan.us, problem.us)
    np.testing.assert_array_equal(plan.xs[0], problem.x0)
    assert plan.K.shape == (problem.N, problem.dynamics.nu, problem.dynamics.nx)
    assert not plan.K.any()


def test_a_first_guess_that_runs_away_from_an_own_cost():
    """The compiled hopper with a user's cost: the ending must not depend on the engine."""
    cost = Plain(flight(0, 200).cost)
    problem = Problem(HopperDynamics(1.0, "euler"), cost, [0.0, 0.0, 0.0], np.full((200, 1), 1e307), horizon=200)
    assert planner.solve(problem).status is Status.NOT_FINITE


@pytest.mark.parametrize("update", UPDATES)
def test_candidates_that_run_away_are_passed_over(update):
    """dx/dt = x^3 + u explodes for large steps: the search shortens them and the solve converges."""
    dynamics = FunctionDynamics(lambda x, u: x**3 + u, 1, 1, 0.1, "rk4")
    cost = TrackingCost.reach([1.2], 30, final=1e4, effort=1.0, dt=0.1)
    problem = Problem(dynamics, cost, [0.2], np.full((30, 1), -0.3))
    plan = planner.solve(problem, update=update)
    assert plan.success
    assert min(h.step for h in plan.history[:-1]) < 1.0
    assert_consistent(problem, plan)


class Lying(Plain):
    """Its gradients point uphill."""

    def quadratize(self, xs, us):
        model = self._cost.quadratize(xs, us)
        return Quadratic(model.Q, -model.q, model.R, -model.r)


class Flat(Plain):
    """Its gradients promise what the value does not know of."""

    def value(self, xs, us):
        return 1.0


# Armijo and Goldstein go on for ever where a step that gains nothing, not a digit, is taken.
@every_way
@pytest.mark.parametrize("cost", [Lying, Flat])
def test_a_lying_gradient_ends_in_no_descent(cost, update, line_search):
    honest = swing("euler", N=5)
    problem = Problem(honest.dynamics, cost(honest.cost), honest.x0, np.full((5, 1), 0.5), horizon=5)
    plan = planner.solve(problem, update=update, line_search=line_search, max_iterations=100)
    assert plan.status is Status.NO_DESCENT
    assert "check the derivatives" in plan.message
    # No step was taken, or one that rounding took for a gain of the last digit.
    np.testing.assert_allclose(plan.us, problem.us, rtol=0, atol=1e-9)
    assert plan.cost == pytest.approx(plan.history[0].cost, rel=1e-14)
    assert np.isfinite(plan.K).all()
    if cost is Flat:  # there is no digit to gain, and every line raises the regularisation tenfold
        assert all(h.step == 0.0 and h.actual == 0.0 for h in plan.history)
        np.testing.assert_allclose(np.diff(np.log10([h.regularisation for h in plan.history[1:-1]])), 1.0, rtol=1e-9)


@pytest.mark.parametrize("update", UPDATES)
def test_a_solve_that_gains_nothing_more_ends(update):
    """With tolerances below rounding: no line of the table has a step that did not lower the cost."""
    plan = planner.solve(hopper("paper 50"), update=update, gradient_tolerance=1e-12, decrease_tolerance=0.0)
    assert all(h.actual > 0.0 for h in plan.history if h.step > 0.0)
    assert plan.status is not Status.MAX_ITERATIONS


class Wavy:
    """1 - cos(u) in place of u^2 / 2, with its true Hessian cos(u): indefinite beyond a quarter turn."""

    def value(self, xs, us):
        return float(np.sum(1.0 - np.cos(us)) + 0.05 * np.sum(xs**2))

    def quadratize(self, xs, us):
        N = len(us)
        Q = np.full((N + 1, 1, 1), 0.1)
        return Quadratic(Q, 0.1 * xs, np.cos(us)[:, :, None], np.sin(us))


@pytest.mark.parametrize("update", UPDATES)
@pytest.mark.parametrize(
    "guess",
    [
        [0.3, 2.0, 0.3, 2.0, 0.3],  # some stages indefinite
        [2.0] * 5,  # all: the largest entry of R is negative
        [np.pi / 2] * 5,  # R = 0
    ],
    ids=["some", "all", "zero"],
)
def test_an_indefinite_control_weight_is_regularised(guess, update):
    dynamics = FunctionDynamics(lambda x, u: u - x, 1, 1, 0.1, "euler")
    problem = Problem(dynamics, Wavy(), [1.0], np.array(guess)[:, None], horizon=5)
    plan = planner.solve(problem, update=update)
    assert plan.success
    assert_stationary(problem, plan)
    assert_consistent(problem, plan)  # its gains are those of the plain model
    lines = plan.history
    if min(np.cos(guess)) < -0.1:  # B'PB is of the order dt^2, and does not help
        assert lines[0].step == 0.0
        assert max(h.regularisation for h in lines) > 0.0
    assert all(h.actual > 0.0 for h in lines if h.step > 0.0)


# What is asked and told


@each_engine
def test_callback_gets_the_lines_of_the_history(engine):
    lines = []
    plan = planner.solve(engines()[engine], callback=lines.append)
    assert all(isinstance(line, Iteration) for line in lines)
    assert tuple(lines) == plan.history


@pytest.mark.parametrize("problem", [hopper("default"), hopper("paper 50"), swing()], ids=["hopper", "paper", "swing"])
def test_lines_stand_under_their_header(problem):
    """Every column of every line ends where its heading ends."""

    def ends(text):
        return [i + 1 for i, c in enumerate(text) if c != " " and (i + 1 == len(text) or text[i + 1] == " ")]

    header = Iteration.header()
    assert len(ends(header)) == len(Iteration._fields)
    lines = [*planner.solve(problem).history, Iteration(99999, -1.2345678e-100, 1e100, 1e-7, 1e100, -1e10, 1e10)]
    for line in lines:
        assert ends(str(line)) == ends(header)


def sentence(error):
    text = str(error.value)
    assert "\n" not in text
    assert text.endswith(("?", "."))
    return text


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ({"update": "closed-loop"}, "update is 'closed-loop', expected one of: feedback, open-loop."),
        ({"update": None}, "update is None, expected one of: feedback, open-loop."),
        ({"line_search": "wolf"}, "line_search is 'wolf', expected one of: armijo, exact, wolfe, goldstein."),
        ({"line_search": 0}, "line_search is 0, expected one of: armijo, exact, wolfe, goldstein."),
        ({"max_iterations": 0}, "max_iterations is 0, expected a whole number of at least 1."),
        ({"max_iterations": 10.0}, "max_iterations is 10.0, expected a whole number of at least 1."),
        ({"gradient_tolerance": -1e-9}, "gradient_tolerance is -1e-09, expected a finite number of at least 0."),
        ({"decrease_tolerance": np.inf}, "decrease_tolerance is inf, expected a finite number of at least 0."),
        ({"gradient_tolerance": "small"}, "gradient_tolerance is 'small', expected a finite number of at least 0."),
    ],
)
def test_wrong_arguments_are_one_sentence(arguments, expected):
    with pytest.raises(PlannerError) as error:
        planner.solve(hopper(), **arguments)
    assert sentence(error).startswith(expected)


def problem_with(**changes):
    honest = swing()
    fields = {"dynamics": honest.dynamics, "cost": honest.cost, "x0": honest.x0, **changes}
    return Problem(**fields)


class NoHorizon:
    """A user's cost that says nothing of its size."""

    def value(self, xs, us):
        return 0.0

    def quadratize(self, xs, us):
        raise NotImplementedError


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"x0": [0.0, 0.0, 0.0]}, "x0 has shape (3,), expected (2,)."),
        ({"x0": 0.0}, "x0 has shape (), expected (2,)."),
        ({"x0": [0.0, np.nan]}, "x0[1] is nan, expected finite numbers."),
        ({"x0": [-np.inf, 0.0]}, "x0[0] is -inf, expected finite numbers."),
        ({"x0": "rest"}, "x0 is not an array of numbers, expected shape (2,)."),
        ({"us": np.zeros((19, 1))}, "us has shape (19, 1), expected (20, 1)."),
        ({"us": np.zeros(20)}, "us has shape (20,), expected (N, 1)."),
        ({"us": np.full((20, 1), np.inf)}, "us[0, 0] is inf, expected finite numbers."),
        ({"horizon": 19}, "the cost is made for N = 20, expected horizon = 19."),
        ({"horizon": 0}, "horizon is 0, expected a whole number of at least 1."),
        ({"cost": flight(0).cost}, "the cost is made for nx = 3, expected dynamics.nx = 2."),
        ({"cost": linear(0, nx=2, nu=2).cost}, "the cost is made for nu = 2, expected dynamics.nu = 1."),
        ({"cost": NoHorizon()}, "the problem has no horizon, expected horizon=N or first controls us (N, nu)."),
    ],
)
def test_what_does_not_fit_together_is_one_sentence(changes, expected):
    with pytest.raises(PlannerError) as error:
        problem_with(**changes)
    assert sentence(error) == expected


def test_first_controls_of_no_shape_are_one_sentence():
    """Without a horizon the controls are asked for their length, which a number has not."""
    with pytest.raises(PlannerError) as error:
        problem_with(cost=NoHorizon(), us=3.0)
    sentence(error)


def test_the_horizon_comes_from_the_first_controls():
    problem = problem_with(cost=NoHorizon(), us=np.ones((7, 1)))
    assert problem.N == 7
    assert problem.duration == pytest.approx(7 * 0.075)
    assert problem_with(cost=NoHorizon(), horizon=9).first_guess.shape == (9, 1)


def test_a_problem_keeps_its_own_arrays():
    """Changing what was handed in, or what came out, changes no later solve."""
    x0, us = np.array([0.0, 0.0]), np.zeros((20, 1))
    problem = problem_with(x0=x0, us=us)
    first = planner.solve(problem)
    copies = first.xs.copy(), first.us.copy(), first.K.copy()
    x0[:], us[:] = 5.0, 5.0
    second = planner.solve(problem)
    same_bits(first, second)
    second.xs[:], second.us[:], second.K[:] = 0.0, 0.0, 0.0
    for ours, copy in zip((first.xs, first.us, first.K), copies, strict=True):
        np.testing.assert_array_equal(ours, copy)


def test_rules_are_named_in_the_order_of_the_kernels():
    """solve() finds a rule's number by its place in LINE_SEARCHES."""
    assert [getattr(search, name.upper()) for name in LINE_SEARCHES] == list(range(len(LINE_SEARCHES)))
