"""What the paper proves of SLQ holds of every plan, both engines agree, and the gains are the right ones."""

import itertools

import numpy as np
import pytest
from solves import (
    assert_consistent,
    assert_stationary,
    each_engine,
    engines,
    every_way,
    flight,
    hopper,
    hoppers,
    linear,
    numpy_twin,
    rollout,
    sweep_along,
    swing,
)

import planner
from planner import FunctionDynamics, Problem, SolverOptions, Status, cases
from planner.solvers import lq
from planner.solvers.engine import CompiledEngine, NumpyEngine, acquire_engine

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
    assert isinstance(acquire_engine(problem), CompiledEngine)
    assert isinstance(acquire_engine(numpy_twin(problem)), NumpyEngine)
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
        assert a.regularization == pytest.approx(b.regularization, rel=1e-12)
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


def test_eight_short_steps_in_a_row_have_changes_of_the_states_weighed():
    """The weight is zero up to them and above from then on, and the paper's own update never has it."""
    problem = cases.acrobot(horizon=150)
    plan, short, limit = planner.solve(problem, max_iterations=40), 0, SolverOptions().short_step
    for line in plan.history[:-1]:
        assert (line.regularization > 0.0) == (short >= SolverOptions().max_short_steps)
        short = short + 1 if line.step < limit or short >= SolverOptions().max_short_steps else 0
    assert short >= SolverOptions().max_short_steps
    printed = planner.solve(problem, update="open-loop", max_iterations=30)
    assert sum(line.step < limit for line in printed.history[:-1]) == 30
    assert not any(line.regularization for line in printed.history)
