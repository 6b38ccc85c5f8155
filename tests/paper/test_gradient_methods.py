"""Gradient methods on the discrete problem: the costate gradient, steepest descent and L-BFGS."""

import numpy as np
import pytest

import planner
from planner import FunctionDynamics, Problem, TrackingCost
from planner.base.errors import PlannerError
from planner.paper.methods.gradient_methods import METHODS, cost_and_gradient, minimize_by_gradient
from planner.paper.studies.gradient import STUDY
from planner.problem.plan import Status
from tests.solves import flight, hopper, linear, numpy_twin, rollout, swing

methods = pytest.mark.parametrize("method", METHODS)


@pytest.mark.parametrize(
    "problem",
    [hopper(), swing(), numpy_twin(hopper()), planner.cases.acrobot(horizon=60)],
    ids=["hopper", "numpy", "twin", "acrobot"],
)
def test_gradient_is_that_of_the_cost(problem):
    rng = np.random.default_rng(0)
    us = problem.first_guess + rng.normal(size=problem.first_guess.shape)
    cost, gradient = cost_and_gradient(problem, us)
    assert cost == pytest.approx(problem.cost.value(*rollout(problem, us)), rel=1e-12)
    for _ in range(3):
        way, h = rng.normal(size=us.shape), 1e-4
        J = [cost_and_gradient(problem, us + k * h * way)[0] for k in (-2, -1, 1, 2)]
        difference = (J[0] - 8 * J[1] + 8 * J[2] - J[3]) / (12 * h)  # of fourth order
        assert np.sum(gradient * way) == pytest.approx(difference, rel=1e-6)


@pytest.mark.parametrize(
    ("problem", "method"),
    [(linear(3), "l-bfgs"), (flight(1), "l-bfgs"), (flight(1), "steepest-descent")],
    ids=["numpy", "compiled", "steepest"],
)
def test_reaches_the_minimum_of_a_convex_problem(problem, method):
    """There it is unique, and SLQ has it after one iteration."""
    best = planner.solve(problem)
    tolerance = 1e-6 * np.linalg.norm(cost_and_gradient(problem, problem.first_guess)[1])
    found = minimize_by_gradient(problem, method, gradient_tolerance=tolerance, max_iterations=20_000)
    assert found.success
    assert found.gradient_norm <= tolerance
    assert found.cost == pytest.approx(best.cost, rel=1e-8)


@methods
def test_history_descends_and_belongs_to_the_result(method):
    problem, seen = hopper("paper 1"), []
    found = minimize_by_gradient(problem, method, max_iterations=30, callback=seen.append)
    assert tuple(seen) == found.history
    costs = [line.cost for line in found.history]
    assert all(np.diff(costs) < 0.0)
    assert costs[0] == cost_and_gradient(problem, problem.first_guess)[0]
    xs, us = rollout(problem, found.us)
    np.testing.assert_allclose(found.xs, xs, rtol=1e-12, atol=1e-12)
    assert found.cost == pytest.approx(problem.cost.value(xs, us), rel=1e-12)
    assert found.gradient_norm == np.linalg.norm(cost_and_gradient(problem, found.us)[1])


@methods
def test_limit_and_interruption(method):
    def stop(line):
        if line.iteration == 2:
            raise StopIteration

    def interrupt(line):
        if line.iteration == 2:
            raise KeyboardInterrupt

    limited = minimize_by_gradient(hopper(), method, max_iterations=2)
    assert (limited.status, limited.nit) == (Status.MAX_ITERATIONS, 2)
    for callback in (stop, interrupt):
        ended = minimize_by_gradient(hopper(), method, callback=callback)
        assert (ended.status, ended.nit) == (Status.INTERRUPTED, 2)
        assert ended.cost == limited.cost
    assert minimize_by_gradient(hopper(), method, gradient_tolerance=1e9).nit == 0


@methods
def test_a_guess_that_runs_away_is_a_status(method):
    blowing = FunctionDynamics(lambda x, u: x * x + u, 1, 1, 1.0, "discrete")
    cost = TrackingCost.reach([0.0], 20, final=1.0, effort=1.0, dt=1.0)
    assert minimize_by_gradient(Problem(blowing, cost, [3.0]), method).status is Status.NOT_FINITE
    # Steps that leave the range of numbers are shortened: from 0.9 on, a tenth more would run away.
    edge = Problem(blowing, cost, [0.9], us=np.full((20, 1), -0.01))
    found = minimize_by_gradient(edge, method, max_iterations=500)
    assert np.isfinite(found.cost)
    assert found.cost < found.history[0].cost


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"method": "newton"}, "expected one of: l-bfgs, steepest-descent"),
        ({"max_iterations": 0}, "max_iterations is 0"),
        ({"gradient_tolerance": -1.0}, "gradient_tolerance is -1.0"),
        ({"callback": 3}, "expected a function"),
    ],
)
def test_bad_arguments(change, words):
    with pytest.raises(PlannerError, match=words):
        minimize_by_gradient(hopper(), **{"method": "l-bfgs", **change})
    with pytest.raises(PlannerError, match="expected a Problem"):
        minimize_by_gradient("hopper")


def test_study_of_one_small_problem(tmp_path):
    results = STUDY.run({"small": lambda: hopper("paper 1")}, limit=15)
    (case,) = results["cases"]
    assert case["gradient_error"] < 1e-5
    for name, entry in case["methods"].items():
        assert name in STUDY.page(results)
        assert entry["curve"]["iteration"][-1] == entry["iterations"] <= 15
        assert entry["curve"]["cost"][-1] == pytest.approx(entry["cost"], rel=1e-12)
        assert entry["curve"]["seconds"][0] >= 0.0
    slq, *_, steepest = case["methods"].values()
    assert slq["cost"] < steepest["cost"]  # the direction of the LQ problem is not steepest descent (3.3)
    assert all(cell for row in STUDY.rows(results) for cell in row)
    STUDY.pictures["gradients.png"](results, tmp_path / "g.png")
    assert (tmp_path / "g.png").stat().st_size > 10_000
