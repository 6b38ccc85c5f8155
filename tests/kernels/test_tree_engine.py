"""The compiled iteration on trees against the NumPy one, Eq. 19 and 42 against differences of the cost, solve()."""

import gc
import tracemalloc
import weakref
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from engines import assert_same_iterations, both_engines
from hypothesis import assume
from hypothesis import strategies as st
from numba.core.runtime import _nrt_python, rtsys
from solves import Plain, assert_consistent, assert_stationary, numpy_twin, rollout, same_bits
from trees import CHAINS, actuated, chain, drawn, machines, problem

import planner
from planner import Problem, Status, TrackingCost
from planner.dynamics import INTEGRATORS, RigidBodyDynamics
from planner.kernels.lq import line_search
from planner.kernels.lq.workspace import ACCEPTED, CONVERGED, INDEFINITE
from planner.kernels.numba.lanes import WIDTH
from planner.model.mechanism import Mechanism
from planner.solvers import lq
from planner.solvers.engine import CompiledEngine, NumpyEngine, _idle, acquire_engine, release_engine

each_integrator = pytest.mark.parametrize("integrator", INTEGRATORS)
each_update = pytest.mark.parametrize("update", ["feedback", "open-loop"])
each_rule = pytest.mark.parametrize("line_search", ["armijo", "exact", "goldstein"])  # none that needs slopes


def example(name, integrator="semi-implicit-euler", N=12, seed=0):
    rng = np.random.default_rng(seed)
    m = Mechanism.from_mjcf(actuated(CHAINS[name], rng))
    dynamics = RigidBodyDynamics(m, 0.03, integrator)
    goal = m.space.integrate(m.home, 0.4 * rng.normal(size=m.space.ndx))
    cost = TrackingCost.reach(goal, N, final=100.0, running=1.0, effort=0.1, dt=0.03, nu=m.nu, space=m.space)
    return Problem(dynamics, cost, m.home)


# ------------------------------------------------------------------------------------------- the other engine


@machines(24, max_dofs=14, max_bodies=5, integrator=st.sampled_from(INTEGRATORS), full=st.booleans(),
          feedback=st.booleans())  # fmt: skip
def test_both_engines_do_the_same(text, seed, integrator, full, feedback):
    task = drawn(text, seed, integrator, full)
    assert_same_iterations(both_engines(task), task, [feedback] * 3, mus=(0.0, 0.1, 0.0))


@machines(8, max_dofs=14, max_bodies=5, integrator=st.sampled_from(INTEGRATORS))
def test_a_second_sweep_over_the_same_jacobians(text, seed, integrator):
    """As after a failure, when only the regularization changes: nothing may have been overwritten."""
    task = drawn(text, seed, integrator, full=True)
    ours, again = (CompiledEngine(task, task.dynamics, task.cost) for _ in range(2))
    for engine in (ours, again):
        engine.start_from_controls(task.x0, task.first_guess)
    ours.sweep(0.0, True)
    ours.sweep(3.0, False)
    changed = ours.gains()
    direct = again.sweep(3.0, True)
    np.testing.assert_array_equal(changed, again.gains())
    assert ours.sweep(3.0, False) == direct


@each_rule
@each_update
@pytest.mark.parametrize("name", CHAINS)
def test_whole_solves(name, update, line_search):
    task = example(name)
    assert isinstance(acquire_engine(task), CompiledEngine)
    plan = planner.solve(task, update=update, line_search=line_search)
    assert plan.converged
    assert_consistent(task, plan)
    assert_stationary(task, plan)
    assert all(after.cost < before.cost for before, after in zip(plan.history, plan.history[1:], strict=False))
    if line_search == "armijo":  # the others take the NumPy engine long
        twin = planner.solve(numpy_twin(task), update=update)
        assert twin.cost == pytest.approx(plan.cost, rel=1e-9)


@each_integrator
def test_all_integrators_solve(integrator):
    for name in ("arm", "body in space"):
        task = example(name, integrator)
        plan = planner.solve(task)
        assert plan.converged
        assert_stationary(task, plan)


# ----------------------------------------------------------------------------------------- the paper's equations


def cost_of(task, us):
    return task.cost.value(rollout(task, us)[0], us)


def slope_along(function, h):
    """Derivative at 0, of sixth order."""
    return sum(w * (function(k * h) - function(-k * h)) for k, w in {1: 45.0, 2: -9.0, 3: 1.0}.items()) / (60.0 * h)


@machines(12, max_dofs=12, max_bodies=4, integrator=st.sampled_from(INTEGRATORS), full=st.booleans())
def test_gradient_and_slope_are_those_of_the_cost(text, seed, integrator, full):
    """Eq. 16-19 and 42, on the group, with references far enough from the states that every term counts."""
    task = drawn(text, seed, integrator, full)
    engine, us = CompiledEngine(task, task.dynamics, task.cost), task.first_guess
    engine.start_from_controls(task.x0, us)
    done = engine.sweep(0.0, True)
    xs, _ = rollout(task, us)
    for a, _ in task.dynamics.mechanism.quaternions:  # a difference of half a turn jumps
        assume(np.abs(np.sum(xs[:, a : a + 4] * task.cost.x_ref[:, a : a + 4], axis=1)).min() > 0.2)
    A, B = task.dynamics.linearize(xs, us)
    model = task.cost.quadratize(xs, us)
    gradient = lq.gradient(A, B, model)
    assert done.gradient_norm == pytest.approx(np.linalg.norm(gradient), rel=1e-9)
    way = gradient / done.gradient_norm  # the derivative this way is the norm, and less any other way
    measured = slope_along(lambda step: cost_of(task, us + step * way), 1e-2)
    assert measured == pytest.approx(done.gradient_norm, rel=1e-7)
    direction = lq.direction(A, B, lq.riccati(A, B, model))[1]
    size = np.linalg.norm(direction)
    measured = size * slope_along(lambda step: cost_of(task, us + step * direction / size), 1e-2)
    assert measured == pytest.approx(done.slope, rel=1e-6)


@each_integrator
@each_update
def test_one_iteration_solves_a_linear_machine(integrator, update):
    """Slides alone: the LQ problem is the problem, the full step leads to its minimum and the promise is kept."""
    text = chain(("slide", "slide"), ("slide",), ("slide",), seed=4)
    m = Mechanism.from_mjcf(actuated(text, np.random.default_rng(1)))
    task = problem(RigidBodyDynamics(m, 0.05, integrator), np.random.default_rng(2))
    plan = planner.solve(task, update=update, gradient_tolerance=1e-7)
    assert plan.converged
    assert plan.nit == 1
    assert plan.history[0].step == 1.0
    assert plan.history[0].expected == pytest.approx(plan.history[0].actual, rel=1e-9)
    assert plan.gradient_norm < 1e-10 * plan.history[0].gradient_norm


# --------------------------------------------------------------------------------- the same again, and no more


@pytest.mark.parametrize("name", ["arm", "body in space"])
def test_the_same_bits_again(name):
    """By a fresh engine, by a used one, and on threads."""
    task = example(name)
    plan = planner.solve(task)
    same_bits(planner.solve(example(name)), plan)
    planner.solve(task, update="open-loop", line_search="exact", max_iterations=3)
    same_bits(planner.solve(task), plan)
    with ThreadPoolExecutor(4) as pool:
        for other in pool.map(lambda _: planner.solve(task), range(4)):
            same_bits(other, plan)


def test_several_starts_give_the_same_bits():
    task = example("balls")
    plans = [planner.solve(task, starts=5, seed=3) for _ in range(2)]
    same_bits(*plans)
    assert plans[0].starts == plans[1].starts
    assert len(plans[0].starts) == 5
    assert plans[0].cost <= planner.solve(task).cost


def test_many_solves_take_no_more_memory_than_one():
    task = example("body in space", "rk4", 4)
    planner.solve(task, max_iterations=3)
    engine = acquire_engine(task)
    release_engine(task, engine)
    gc.collect()
    tracemalloc.start()
    for _ in range(2):  # the first sixty fill the interpreter's free lists
        before = tracemalloc.get_traced_memory()[0]
        for _ in range(60):
            planner.solve(task, max_iterations=3)
        gc.collect()
    grown = tracemalloc.get_traced_memory()[0] - before
    tracemalloc.stop()
    assert _idle[task] == {False: [engine]}
    assert grown < 60 * 200  # bytes, over all sixty: one plan's states alone take 1,200


@pytest.mark.parametrize("line_search", ["armijo", "wolfe"])  # on a compiled engine, and on NumPy's
def test_a_problem_does_not_outlive_its_user(line_search):
    """Idle engines wait for the next solve of their problem; they must not keep it alive."""
    task = example("body in space", "rk4", 4)
    planner.solve(task, line_search=line_search, max_iterations=2)
    assert len(_idle[task]) == 1
    alive = weakref.ref(task)
    del task
    gc.collect()
    assert alive() is None


def test_iterations_allocate_nothing():
    """Nor make handles of the arrays that enter: kernels count no references (see kernels.numba.jit)."""
    _nrt_python.memsys_enable_stats()
    try:
        for N in (12, 120):
            task = example("body in space", "rk4", N)
            engine = acquire_engine(task)
            cost = engine.start_from_controls(task.x0, task.first_guess)
            for rule, feedback in ((line_search.ARMIJO, True), (line_search.EXACT, False)):
                before = rtsys.get_allocation_stats()
                outcome = engine.iterate(feedback, rule, 0.0, True, cost, 0.0, 0.0)
                after, cost = rtsys.get_allocation_stats(), outcome.cost
                assert outcome.kind == ACCEPTED
                assert after.alloc - before.alloc == after.free - before.free == 0
    finally:
        _nrt_python.memsys_disable_stats()


# ------------------------------------------------------------------------------------------------ what runs away


def test_a_first_guess_that_runs_away_ends_at_once():
    task = example("arm")
    wild = Problem(task.dynamics, task.cost, np.append(task.x0[:-1], 1e200))  # no control is that strong
    plan = planner.solve(wild)
    assert plan.status is Status.NOT_FINITE
    assert not np.isfinite(plan.cost)
    assert planner.solve(task).success  # and leaves nothing behind


def test_a_candidate_that_runs_away_is_not_taken():
    """Stiff dampers and a coarse explicit step: full steps of the open-loop update blow up, shorter ones do not."""
    task = example("balls", "euler", N=60)
    plan = planner.solve(task, update="open-loop", max_iterations=30)
    assert np.isfinite(plan.cost)
    assert plan.cost < plan.history[0].cost
    assert_consistent(task, plan)


@pytest.mark.parametrize(
    "rule", [line_search.ARMIJO, pytest.param(line_search.EXACT, marks=pytest.mark.slow), line_search.GOLDSTEIN]
)
def test_candidates_that_are_given_up_do_not_change_the_step(rule):
    """A rollout ends where no candidate can win any more; the NumPy engine rolls each of them out to the end."""
    task = example("body in space", "rk4", N=60)
    steps = assert_same_iterations(both_engines(task), task, [True] * 6, rule=rule, within=1e-6)
    assert 0.0 < min(steps) < 2.0 ** -(WIDTH - 1)  # all candidates of a first batch were given up


def test_sweeps_say_when_nothing_is_definite():
    task = example("arm")
    engine = acquire_engine(task)
    engine.start_from_controls(task.x0, task.first_guess)
    assert engine.sweep(0.0, True).kind == CONVERGED
    assert engine.sweep(-1e6, False).kind == INDEFINITE


def test_a_cost_of_ones_own_takes_the_numpy_engine():
    task = example("arm")
    assert isinstance(acquire_engine(Problem(task.dynamics, Plain(task.cost), task.x0, horizon=task.N)), NumpyEngine)
