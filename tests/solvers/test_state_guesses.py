"""States as a first guess: the sweep across gaps against one linear solve and its twin, solves from poor guesses."""

import numpy as np
import pytest
from solves import assert_consistent, assert_stationary, hopper, kkt_solution, linear, numpy_twin, same_bits, swing
from trees import CHAINS, actuated

import planner
from planner import Constraint, FunctionDynamics, Limits, PlannerError, Problem, TrackingCost
from planner.dynamics import RigidBodyDynamics
from planner.model.mechanism import Mechanism
from planner.problem.costs.terms import Quadratic
from planner.problem.initial_guess import interpolated_states
from planner.solvers import lq
from planner.solvers.engine import CompiledEngine, ConstrainedEngine, NumpyEngine
from planner.solvers.multiple_shooting import close_defects


@pytest.mark.parametrize("seed", range(6))
def test_the_sweep_across_gaps_solves_the_quadratic_program(seed):
    rng = np.random.default_rng(seed)
    N, nx, nu = rng.integers(1, 9), rng.integers(1, 6), rng.integers(1, 4)
    A, B, gaps = rng.normal(size=(N, nx, nx)), rng.normal(size=(N, nx, nu)), rng.normal(size=(N, nx))
    Q, R = rng.normal(size=(N + 1, nx, nx)), rng.normal(size=(N, nu, nu))
    m = Quadratic(Q @ Q.swapaxes(1, 2), rng.normal(size=(N + 1, nx)), R @ R.swapaxes(1, 2) + np.eye(nu),
                  rng.normal(size=(N, nu)))  # fmt: skip
    sweep = lq.riccati(A, B, m, defects=gaps)
    dxs, dus = lq.direction(A, B, sweep, None, gaps)
    multipliers = np.einsum("nij,nj->ni", sweep.P[1:], dxs[1:]) + sweep.s[1:]
    for ours, theirs in zip((dxs, dus, multipliers), kkt_solution(A, B, m, gaps)[:3], strict=True):
        # 1e-9: the KKT matrix of such a size has a condition of some 1e5
        np.testing.assert_allclose(ours, theirs, rtol=0.0, atol=1e-9 * max(1.0, np.abs(theirs).max()))


def guessed(name, integrator, limits=None, constraints=()):
    """A chain's problem, and states and controls that do not fit."""
    rng = np.random.default_rng(3)
    m = Mechanism.from_mjcf(actuated(CHAINS[name], rng))
    dynamics = RigidBodyDynamics(m, 0.03, integrator)
    goal = m.space.integrate(m.home, 0.4 * rng.normal(size=m.space.ndx))
    cost = TrackingCost.reach(goal, 12, final=100.0, running=1.0, effort=0.1, dt=0.03, nu=m.nu, space=m.space)
    problem = Problem(dynamics, cost, m.home, limits=limits, constraints=constraints)
    xs = interpolated_states(m.space, m.home, goal, 0.36, 12)
    xs[1:] = m.space.integrate(xs[1:], 0.1 * rng.normal(size=(12, m.space.ndx)))
    us = rng.normal(size=(12, m.nu))
    return problem, xs, us if problem.bounds is None else problem.bounds.clip(slice(None), us, xs[:-1])


@pytest.mark.parametrize("integrator", ["rk4", "semi-implicit-euler"])
@pytest.mark.parametrize("name", ["arm", "balls"])
@pytest.mark.parametrize("limits", [None, Limits(control=(-0.5, 0.5), position=None, velocity=None)])
def test_both_engines_cross_gaps_alike(name, integrator, limits):
    problem, xs, us = guessed(name, integrator, limits)
    ours, twin = CompiledEngine(problem, problem.dynamics, problem.cost), NumpyEngine(problem)
    for hold in (0.0, 0.3):
        ways = []
        for engine in (ours, twin):
            engine.start_from_controls(problem.x0, us)
            gaps = engine.set_trajectory(xs, us)
            engine.state_regularization = hold
            ways.append(engine.defect_direction(gaps, True))
        assert np.abs(gaps).max() > 0.01
        for a, b in zip(*ways, strict=True):
            np.testing.assert_allclose(a, b, rtol=0.0, atol=1e-9 * max(1.0, np.abs(b).max()))  # sums in another order
    steps = [engine.rollout_closing_defects(np.inf, 0.0) for engine in (ours, twin)]
    np.testing.assert_allclose(steps[0], steps[1], rtol=1e-8)
    assert steps[0][0] > 0.0
    assert np.abs(ours.set_trajectory(*ours.trajectory())).max() < 1e-12  # a rollout has no gaps


@pytest.mark.parametrize("exact", [False, True])
def test_rows_of_constraints_stand_beside_gaps_and_what_holds_states(exact):
    """A user's own function goes to the sweep by the same array as second derivatives and weights on the states."""
    power = Constraint(lambda xs, us: us[:, 0] * xs[:, -1], upper=0.01, name="power")
    problem, xs, us = guessed("arm", "rk4", constraints=[power])
    hinges = problem.trajectory_constraints.zero_penalties()
    hinges.weight[:] = 50.0 * np.isfinite(problem.trajectory_constraints.upper)
    engines = (
        ConstrainedEngine(problem, problem.trajectory_constraints, problem.dynamics, problem.cost),
        NumpyEngine(problem),
    )
    ways, gains = [], []
    for engine in engines:
        engine.set_penalties(hinges)
        engine.start_from_controls(problem.x0, us, exact)
        gaps = engine.set_trajectory(xs, us)
        engine.state_regularization = 0.3
        ways.append(engine.defect_direction(gaps, True))
        engine.rollout_closing_defects(np.inf, 0.0)
        engine.use_second_order(exact)
        for hold, second in ((0.3, exact), (0.2, False), (0.0, exact)):
            engine.state_regularization = hold
            engine.use_second_order(second)
            engine.sweep(1.0, hold == 0.3)
            gains.append(engine.gains())
    for a, b in [*zip(*ways, strict=True), *zip(gains[:3], gains[3:], strict=True)]:
        np.testing.assert_allclose(a, b, rtol=0.0, atol=1e-8 * max(1.0, np.abs(b).max()))  # sums in another order
    assert np.abs(gains[0] - gains[1]).max() > 1e-3


def test_states_lead_to_a_minimum_within_constraints():
    power = Constraint(lambda xs, us: us[:, 0] * xs[:, -1], upper=0.01, name="power")
    problem, xs, _ = guessed("arm", "rk4", constraints=[power])
    free, plan = planner.solve(problem), planner.solve(problem, states=xs)
    assert free.success
    assert plan.success
    assert problem.trajectory_constraints.violation(plan.xs, plan.us).max() <= problem.trajectory_constraints.tolerance
    assert plan.cost == pytest.approx(free.cost, rel=1e-4)  # both within tolerances, not on the bound


def test_hinges_of_a_first_solve_count_in_the_merit():
    """What keeps shapes apart has hinges from the beginning: its engine's costs are those of the lines across gaps."""
    high = Constraint(lambda xs: xs[:, 0], lower=0.5, when="end")
    problem, xs, us = guessed("arm", "rk4", constraints=[high])
    hinges = problem.trajectory_constraints.zero_penalties()
    hinges.weight[:] = 50.0 * np.isfinite(problem.trajectory_constraints.lower)
    engine = ConstrainedEngine(problem, problem.trajectory_constraints, problem.dynamics, problem.cost)
    engine.set_penalties(hinges)
    cost, lines, _ = close_defects(problem, engine, False, xs, us, 100, None, hinges)
    begun = np.concatenate([problem.x0[None], xs[1:]])
    pull = problem.trajectory_constraints.value(hinges, begun, us)
    assert pull > 1e-3
    assert lines[0].cost == pytest.approx(problem.cost.value(begun, us) + pull, rel=1e-12)
    xs, us = engine.trajectory()
    assert cost == pytest.approx(
        problem.cost.value(xs, us) + problem.trajectory_constraints.value(hinges, xs, us), rel=1e-12
    )


@pytest.mark.parametrize("integrator", ["rk4", "semi-implicit-euler"])
def test_gaps_of_zero_change_no_bit(integrator):
    problem, _, us = guessed("arm", integrator)
    plain, engine = (CompiledEngine(problem, problem.dynamics, problem.cost) for _ in range(2))
    for each in (plain, engine):
        each.start_from_controls(problem.x0, us)
    engine.defect_direction(np.zeros((12, problem.dynamics.ndx)), True)
    plain.sweep(0.0, True)
    np.testing.assert_array_equal(engine.gains(), plain.gains())
    np.testing.assert_array_equal(engine.gradient(), plain.gradient())
    np.testing.assert_array_equal(engine._w.k, plain._w.k)


def test_holding_states_is_a_heavier_weight_on_them():
    problem, _, us = guessed("arm", "rk4")
    engine = NumpyEngine(problem)
    engine.start_from_controls(problem.x0, us)
    engine.state_regularization = 0.7
    engine.sweep(0.0, True)
    Q = engine._model.Q.copy()
    mean = np.abs(np.diagonal(problem.cost.Q, axis1=1, axis2=2)).sum(axis=0) / problem.N
    Q[1:-1] += 0.7 * np.diag(mean)  # neither the start, which is given, nor the end
    heavier = lq.riccati(engine._A, engine._B, engine._model._replace(Q=Q))
    np.testing.assert_allclose(engine.gains(), heavier.K, rtol=0.0, atol=1e-10)


@pytest.mark.parametrize("make", [linear, lambda seed: swing("rk4"), lambda seed: hopper("default")])
def test_states_lead_to_a_minimum(make):
    """Also on the NumPy engine, for own dynamics, and for a hopper; on a linear problem to the same one."""
    problem, rng = make(0), np.random.default_rng(1)
    free = planner.solve(problem)
    xs = free.xs + 0.05 * rng.normal(size=free.xs.shape)
    for task in (problem, numpy_twin(problem)):
        plan = planner.solve(task, states=xs)
        assert plan.success
        assert plan.options["states"] == "given"
        assert_consistent(task, plan)
        assert_stationary(task, plan)
        assert plan.cost == pytest.approx(free.cost, rel=1e-6)


def test_states_lead_where_the_rollout_of_the_controls_has_no_cost():
    dynamics = FunctionDynamics(lambda x, u: x**3 + u, 1, 1, 0.1, "euler")
    problem = Problem(dynamics, TrackingCost.reach([0.0], 60, final=1.0, effort=1.0), [2.0])
    plan = planner.solve(problem, states="line")
    assert plan.success
    assert "first_guess" not in plan.options  # it was not replaced
    assert_consistent(problem, plan)


def test_states_and_controls_of_a_plan_are_its_end():
    problem = planner.cases.build("two-link", horizon=40)
    plan = planner.solve(problem)
    again = planner.solve(Problem(problem.dynamics, problem.cost, problem.x0, plan.us), states=plan.xs)
    assert again.success
    assert again.nit <= 3
    assert again.cost == pytest.approx(plan.cost, rel=1e-9)


def test_ten_random_starts_of_the_two_link_arm_all_converge():
    """Of these ten, 3 converge within 300 iterations from the states that their controls lead to."""
    problem = planner.cases.build("two-link")
    plan = planner.solve(problem, starts=10, states="line", hessian="exact", max_iterations=60)
    assert all(start.status is planner.Status.CONVERGED for start in plan.starts)
    same_bits(plan, planner.solve(problem, starts=10, states="line", hessian="exact", max_iterations=60))


def test_the_two_link_arm_takes_at_most_30_iterations_by_exact_hessians():
    problem = planner.cases.build("two-link")
    plan = planner.solve(problem, hessian="exact")
    assert plan.success
    assert plan.nit <= 30  # issue 17; fatrop takes 23
    assert plan.cost == pytest.approx(planner.solve(problem).cost, rel=1e-6)


def test_steps_across_gaps_lower_the_merit_and_close():
    problem = planner.cases.build("two-link", horizon=60)
    engine, rng = NumpyEngine(numpy_twin(problem)), np.random.default_rng(0)
    us = problem.first_guess + 20.0 * rng.normal(size=problem.first_guess.shape)
    xs = interpolated_states(problem.dynamics.space, problem.x0, problem.cost.x_ref[-1], problem.duration, problem.N)
    cost, lines, interrupted = close_defects(problem, engine, False, xs, us, 100, None)
    assert not interrupted
    assert 0 < len(lines) <= 60
    assert np.abs(engine.set_trajectory(*engine.trajectory())).max() == 0.0
    assert cost == pytest.approx(problem.cost.value(*engine.trajectory()), rel=1e-12)


def test_a_smaller_closing_share_ends_nearer_to_the_states():
    """A rollout that costs hardly more than the states with their defects comes later, and costs less."""
    problem, found = planner.cases.build("two-link", horizon=60), {}
    engine, us = NumpyEngine(numpy_twin(problem)), np.zeros_like(problem.first_guess)
    xs = interpolated_states(problem.dynamics.space, problem.x0, problem.cost.x_ref[-1], problem.duration, problem.N)
    for share in (1.0, 0.01):
        options = planner.SolverOptions(closing_share=share)
        cost, lines, _ = close_defects(problem, engine, False, xs, us, 100, None, options=options)
        assert np.abs(engine.set_trajectory(*engine.trajectory())).max() == 0.0
        found[share] = cost, len(lines)
    assert found[0.01][0] < found[1.0][0]
    assert found[0.01][1] > found[1.0][1]


@pytest.mark.parametrize(("share", "rollouts"), [(1.0, 1), (0.5, 2)])
def test_a_rollout_that_closes_no_defects_is_tried_again_only_where_more_is_allowed(monkeypatch, share, rollouts):
    """In the last iteration the limit of its cost is that of a share of 1."""
    problem, limits = planner.cases.build("two-link", horizon=20), []
    engine, us = NumpyEngine(numpy_twin(problem)), np.zeros_like(problem.first_guess)
    xs = interpolated_states(problem.dynamics.space, problem.x0, problem.cost.x_ref[-1], problem.duration, problem.N)
    monkeypatch.setattr(engine, "rollout_closing_defects", lambda cost, slope: limits.append(cost) or (0.0, cost))
    close_defects(problem, engine, False, xs, us, 1, None, options=planner.SolverOptions(closing_share=share))
    assert len(limits) == rollouts


def test_poor_states_are_refused():
    problem = planner.cases.build("two-link", horizon=20)
    with pytest.raises(PlannerError, match=r"states is 'arc', expected one of: line\."):
        planner.solve(problem, states="arc")
    with pytest.raises(PlannerError, match=r"states .*\(21, 4\)"):
        planner.solve(problem, states=np.zeros((20, 4)))
    with pytest.raises(PlannerError, match="no reference state"):
        planner.solve(numpy_twin(problem), states="line")


def test_a_callback_sees_the_lines_across_gaps_and_may_stop():
    problem, seen = planner.cases.build("two-link", horizon=40), []

    def callback(line):
        seen.append(line)
        if len(seen) == 3:
            raise StopIteration

    plan = planner.solve(problem, states="line", callback=callback)
    assert plan.status is planner.Status.INTERRUPTED
    assert [line.iteration for line in seen] == [0, 1, 2]
