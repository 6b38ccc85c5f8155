"""Penalties in the compiled engine: on random machines it does what the one in NumPy does; and whole solves."""

import numpy as np
import pytest
from contact_machines import leg, standing
from engines import assert_same_iterations, both_engines
from hypothesis import strategies as st
from machines import HAND_ARM
from solves import assert_consistent, assert_stationary, numpy_twin, same_bits
from trees import drawn, machines

import planner
from planner import Limits, Mechanism, PenaltyCost, Problem, RigidBodyDynamics, Status, TrackingCost
from planner.costs import Distance, Gap, Height, Point, Segment, Velocity
from planner.dynamics import INTEGRATORS
from planner.problem.costs.least_squares import ResidualCost
from planner.problem.costs.tracking import tracking_of
from planner.problem.rediscretize import finer
from planner.solvers.engine import CompiledEngine, NumpyEngine, acquire_engine


def some_point(rng, m, N):
    frame = rng.choice([None, *m.sites, *m.body_names])
    world = rng.normal(size=(N + 1, 3) if rng.random() < 0.3 else 3)
    return Point(frame, rng.normal(size=3), rng.choice([1.0, 1.0, -0.5]), world if frame is None else 0.1 * world)


def some_part(rng, m, N):
    """A point or a line."""
    if rng.random() < 0.4:
        return some_point(rng, m, N)
    return Segment(some_point(rng, m, N), some_point(rng, m, N), 0.1 * rng.random())


def some_terms(rng, m, N, count=6):
    """Heights and distances of all kinds, on and off, wanted near where things are."""
    terms = []
    for _ in range(count):
        wanted = rng.choice(["lower", "upper", "target"])
        bound = 0.5 * rng.normal(size=N + 1) + 1.0
        bound[rng.random(N + 1) < 0.2] = np.nan
        options = {
            wanted: bound if rng.random() < 0.7 else float(rng.normal()), "tolerance": 0.2 + rng.random(),
            "ramp": 0.1 + rng.random(), "weight": rng.random(N + 1) if rng.random() < 0.5 else 1.0,
            "final_weight": rng.random() if rng.random() < 0.5 else None,
        }  # fmt: skip
        kind = rng.random()
        if kind < 0.3:
            terms.append(Height(some_point(rng, m, N), normal=rng.normal(size=3), **options))
        elif kind < 0.6:
            points = [some_point(rng, m, N) for _ in range(2)]
            terms.append(Velocity(points[0], rng.normal(size=3), relative=points[1], **options))
        else:
            terms.append(Distance(some_part(rng, m, N), some_part(rng, m, N), **options))
    return terms


def penalized(text, seed, integrator, full=False, limits=False):
    """A random problem with two PenaltyCosts in its cost, perhaps with bounds and ranges."""
    task = drawn(text, seed, integrator, full)
    rng, m, N = np.random.default_rng(seed + 1), task.dynamics.mechanism, task.N
    costs = [PenaltyCost(task.dynamics, N, some_terms(rng, m, N, count)) for count in (6, 2)]
    bounds = Limits(control=0.2) if limits else None
    return Problem(task.dynamics, costs[0] + (task.cost + costs[1]), task.x0, task.first_guess, limits=bounds)


# -------------------------------------------------------------------------------------------- the other engine


@machines(24, max_dofs=14, max_bodies=5, integrator=st.sampled_from(INTEGRATORS), feedback=st.booleans())
def test_both_engines_do_the_same(text, seed, integrator, feedback):
    task = penalized(text, seed, integrator)
    assert_same_iterations(both_engines(task), task, [feedback])


@machines(16, max_dofs=14, max_bodies=5)
def test_the_kernels_model_is_the_costs(text, seed):
    """Gradients and Hessians of the stages themselves, to rounding."""
    task = penalized(text, seed, "rk4")
    ours, _ = both_engines(task)
    ours.start_from_controls(task.x0, task.first_guess)
    ours.sweep(0.0, True)
    w = ours._w
    xs, us = ours.trajectory()
    tracking = tracking_of(task.cost).quadratize(xs, us)
    models = [cost.quadratize(xs, us) for cost in task.cost.costs if isinstance(cost, ResidualCost)]
    q, Q = (sum(getattr(model, name) for model in models) for name in "qQ")
    theirs = w.l[:, w.first : w.first + task.dynamics.ndx]
    assert np.abs(theirs - q - tracking.q).max() < 1e-12 * max(1.0, np.abs(theirs).max())
    rows = w.residuals.columns
    mine = w.residuals.hessian[:, :, :rows]
    assert np.abs(np.triu(mine - Q[:, :rows, :rows])).max() < 1e-12 * max(1.0, np.abs(Q).max())


@machines(8, max_dofs=10, max_bodies=4, integrator=st.sampled_from(INTEGRATORS))
def test_bounds_hold_beside_compiled_penalties(text, seed, integrator):
    task = penalized(text, seed, integrator, limits=True)
    ours, twin = both_engines(task)
    assert_same_iterations((ours, twin), task, [True])
    assert np.abs(ours.trajectory()[1]).max() <= 0.2 + 1e-12


# ------------------------------------------------------------------------------------------------------- solves

GOAL = np.array([1.0, 0.0, 0.0, 0.0])
N = 40


@pytest.fixture(scope="module")
def dynamics():
    return RigidBodyDynamics(Mechanism.from_mjcf(HAND_ARM), 0.025)


def arm(dynamics, bound=-1.3, **more):
    """A swing whose tip would sag to -1.4, from the one that does."""
    swing = TrackingCost.joints(dynamics, GOAL, N, effort=0.01, final_position=1e3, final_velocity=1e2)
    low = PenaltyCost(dynamics, N, [Height(Point("tip"), lower=bound, tolerance=0.01)])
    x0 = [-1.0, 0.0, 0.0, 0.0]
    return Problem(dynamics, swing + low, x0, planner.solve(Problem(dynamics, swing, x0)).us, **more)


@pytest.mark.parametrize("line_search", ["armijo", "wolfe", "exact"])
def test_whole_solves(dynamics, line_search):
    task = arm(dynamics)
    assert isinstance(acquire_engine(task), CompiledEngine)
    plan = planner.solve(task, line_search=line_search)
    assert plan.status is Status.CONVERGED
    assert_consistent(task, plan)
    assert_stationary(task, plan)
    if line_search == "armijo":
        twin = planner.solve(numpy_twin(task))
        assert len(twin.history) == len(plan.history)
        assert twin.cost == pytest.approx(plan.cost, rel=1e-9)
        same_bits(plan, planner.solve(task))


def test_exact_hessians_have_penalties_of_gauss_and_newton(dynamics):
    plan = planner.solve(arm(dynamics), hessian="exact")
    twin = planner.solve(numpy_twin(arm(dynamics)), hessian="exact")
    assert plan.status is Status.CONVERGED
    assert len(twin.history) == len(plan.history)
    assert plan.cost == pytest.approx(twin.cost, rel=1e-8)
    assert plan.cost == pytest.approx(planner.solve(arm(dynamics)).cost, rel=1e-4)


def test_ranges_and_bounds_hold_beside_penalties(dynamics):
    free = planner.solve(arm(dynamics))
    limits = Limits(velocity={"b": 4.0}, control={"b": 7.0})
    assert np.abs(free.xs[:, 3]).max() > 4.1
    assert np.abs(free.us[:, 1]).max() > 7.1
    task = arm(dynamics, limits=limits)
    assert isinstance(acquire_engine(task), CompiledEngine)
    plan = planner.solve(task)
    assert plan.success
    assert np.abs(plan.xs[:, 3]).max() < 4.0 + 1e-3
    assert np.abs(plan.us[:, 1]).max() <= 7.0
    assert task.cost.costs[1].values(plan.xs).min() > -1.33


def test_each_problem_has_its_own_terms(dynamics):
    """Engines are kept for the next solve of the same problem, not for one with another bound."""
    costs = []
    for bound in (-1.3, -1.2, -1.3):
        plan = planner.solve(arm(dynamics, bound))
        costs.append(plan.cost)
    assert costs[0] == costs[2]
    assert costs[1] > costs[0] + 1e-3


def test_a_leg_on_the_floor():
    """Gap on and off, with contacts in the dynamics: the foot comes down when it is told to."""
    m = Mechanism.from_mjcf(leg(impratio=1000.0, ramp=5e-3))
    dynamics, x0 = RigidBodyDynamics(m, 5e-3), standing(m, height=0.05, speed=0.0)
    hold = TrackingCost.joints(dynamics, x0, 40, effort=1e-4, position={"hip": 1.0, "knee": 1.0}, velocity=0.01)
    down, up = np.full(41, np.nan), np.full(41, np.nan)
    up[:30], down[35:] = 0.02, 0.0
    gaps = PenaltyCost(dynamics, 40, [Gap("foot", lower=up, tolerance=2e-3, weight=10.0),
                                      Gap("foot", upper=down, tolerance=2e-3, weight=10.0)])  # fmt: skip
    task = Problem(dynamics, hold + gaps, x0)
    assert isinstance(acquire_engine(task), CompiledEngine)
    plan, twin = planner.solve(task), planner.solve(numpy_twin(task))
    assert plan.success
    assert plan.cost == pytest.approx(twin.cost, rel=1e-6)
    gap = gaps.values(plan.xs)[:, 0]
    assert gap[:30].min() > 0.015
    assert gap[36:].max() < 0.003


def test_a_plan_is_stored_and_proved_with_its_problem(dynamics, tmp_path):
    task = arm(dynamics)
    plan = planner.solve(task)
    proof = planner.prove(plan, rollouts=0)
    assert proof.passed, proof
    assert planner.proof.proven_cost(plan) == pytest.approx(plan.cost, rel=0.05)
    with pytest.warns(UserWarning, match="has the plan without its problem"):
        plan.save(tmp_path / "plan.npz")
    again = planner.load_plan(tmp_path / "plan.npz", problem=task)
    assert str(planner.prove(again, rollouts=0)) == str(proof)


def test_the_same_problem_at_half_the_stage(dynamics):
    """A sum over twice as many stages of half the weight: the same integral, nearly the same plan."""
    moving = np.linspace(-1.3, -1.2, N + 1)
    task = arm(dynamics, moving)
    fine = finer(task)
    assert isinstance(acquire_engine(fine), CompiledEngine)
    plan, better = planner.solve(task), planner.solve(fine)
    assert better.status is Status.CONVERGED
    assert better.cost == pytest.approx(plan.cost, rel=0.02)
    terms, half = task.cost.costs[1].residual_arrays, fine.cost.costs[1].residual_arrays
    np.testing.assert_array_equal(half.bound[0, :-1:2], terms.bound[0, :-1])
    np.testing.assert_array_equal(half.bound[0, 1:-1:2], terms.bound[0, :-1])
    assert half.weight[0, :-1].sum() == pytest.approx(terms.weight[0, :-1].sum())
    assert half.weight[0, -1] == terms.weight[0, -1]


# ---------------------------------------------------------------------------------------- who has which engine


def test_penalties_unknown_to_the_kernels_go_to_numpy(dynamics):
    task = arm(dynamics)
    tracking, low = task.cost.costs
    other = PenaltyCost(Mechanism.from_mjcf(HAND_ARM), N, [Height(Point("tip"), lower=-1.3, tolerance=0.01)], dt=0.025)
    for cost in (tracking + other, tracking + low + tracking):
        assert isinstance(acquire_engine(Problem(dynamics, cost, task.x0, horizon=N)), NumpyEngine)
    hopper = planner.cases.hopper(height=1.0)
    assert isinstance(acquire_engine(hopper), CompiledEngine)


def test_nothing_wanted_costs_nothing(dynamics):
    """No terms, or terms that are off: the plan without them, to the last bit."""
    task = arm(dynamics)
    tracking = task.cost.costs[0]
    plain = planner.solve(Problem(dynamics, tracking, task.x0))
    for terms in ([], [Height(Point("tip"), lower=np.full(N + 1, np.nan), tolerance=1.0)]):
        cost = PenaltyCost(dynamics, N, terms)
        assert cost.values(plain.xs).shape == (N + 1, len(terms))
        assert cost.value(plain.xs, plain.us) == 0.0
        assert not cost.quadratize(plain.xs, plain.us).Q.any()
        same_bits(plain, planner.solve(Problem(dynamics, tracking + cost, task.x0)))
