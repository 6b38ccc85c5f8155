"""Quasilinearization and neighbouring extremals: Newton's method on the conditions, and the feedback it gives."""

import itertools

import numpy as np
import pytest

import planner
from planner.cases.hopper import PAPER
from planner.paper.studies.extremals import (
    STUDY,
    boundary_problem,
    curvature,
    quasilinearize,
    with_curvature,
)
from planner.paper.studies.gradient import growth
from planner.solvers import lq
from tests.solves import linear


@pytest.fixture(scope="module")
def results():
    return STUDY.run({"hop": lambda: planner.cases.build("hopper", **{**PAPER, "height": 1.0})})


def test_the_boundary_problem_is_solved_with_defects_and_mixed_terms():
    """Against its own conditions, Eq. 22 to 25 with S and defects: what is left is rounding."""
    rng = np.random.default_rng(0)
    problem = linear(0)
    A, B = problem.dynamics.linearize(np.tile(problem.x0, (problem.N + 1, 1)), problem.first_guess)
    model = problem.cost.quadratize(rng.normal(size=(problem.N + 1, A.shape[1])), rng.normal(size=problem.us.shape))
    model = model._replace(S=0.1 * rng.normal(size=(*model.r.shape, A.shape[1])))
    defects = rng.normal(size=(problem.N, A.shape[1]))
    found = boundary_problem(A, B, model, defects)
    x, u, costate = found.dxs, found.dus, found.costates
    ahead = np.einsum("nij,nj->ni", A, x[:-1]) + np.einsum("nij,nj->ni", B, u) + defects
    back = model.q[:-1] + np.einsum("nij,nj->ni", model.Q[:-1], x[:-1]) + np.einsum("nij,ni->nj", model.S, u)
    stationary = model.r + np.einsum("nij,nj->ni", model.R, u) + np.einsum("nij,nj->ni", model.S, x[:-1])
    np.testing.assert_allclose(x[1:], ahead, atol=1e-9)
    np.testing.assert_allclose(costate[:-1], back + np.einsum("nij,ni->nj", A, costate[1:]), atol=1e-9)
    np.testing.assert_allclose(stationary + np.einsum("nij,ni->nj", B, costate[1:]), 0.0, atol=1e-9)


def test_curvature_is_the_second_derivative_of_the_costates_dynamics():
    problem, rng = planner.cases.two_link(horizon=5), np.random.default_rng(0)
    xs, us, costates = (rng.normal(size=(n, m)) for n, m in ((6, 4), (5, 2), (6, 4)))
    W = curvature(problem.dynamics, xs, us, costates)
    way, h = rng.normal(size=(5, 6)), 1e-3

    def value(size):
        return np.sum(costates[1:] * problem.dynamics.step(xs[:-1] + size * way[:, :4], us + size * way[:, 4:]))

    second = (value(h) - 2.0 * value(0.0) + value(-h)) / h**2
    assert np.einsum("ni,nij,nj->", way, W, way) == pytest.approx(second, rel=1e-4)


@pytest.mark.paper
def test_quasilinearization_ends_where_slq_does_on_a_low_hop():
    problem = planner.cases.build("hopper", **{**PAPER, "height": 1.0})
    found = quasilinearize(problem)
    assert found["converged"]
    assert found["cost"] == pytest.approx(planner.solve(problem).cost, rel=1e-9)
    assert not quasilinearize(planner.cases.acrobot(horizon=60))["converged"]  # full steps from far away


def test_gains_with_curvature_are_those_of_neighbouring_optimal_plans(results):
    """Off by second order in the start; those without by first order."""
    starts = results["neighbours"]["starts"]
    for one, other in itertools.pairwise(starts[1:]):
        assert np.log10(one["with W"] / other["with W"]) == pytest.approx(2.0, abs=0.1)
        assert np.log10(one["without"] / other["without"]) == pytest.approx(1.0, abs=0.1)


def test_gains_of_eq_31_are_what_a_plan_keeps():
    problem = planner.cases.two_link()
    plan = planner.solve(problem, hessian="exact")
    A, B = problem.dynamics.linearize(plan.xs, plan.us)
    model, none = problem.cost.quadratize(plan.xs, plan.us), np.zeros_like(plan.xs[1:])
    np.testing.assert_allclose(plan.K, boundary_problem(A, B, model, none).K, atol=1e-3)
    W = curvature(problem.dynamics, plan.xs, plan.us, lq.costates(A, model))
    assert np.abs(plan.K - boundary_problem(A, B, with_curvature(model, W), none).K).max() > 0.1


def test_growth_tells_where_eq_36_suffices():
    """On the two-link arm it crawls, on the hopper and the human step it does not (docs/paper.md)."""
    hop = planner.cases.build("hopper", **{**PAPER, "height": 20.0})
    arm = planner.cases.two_link()
    swing = planner.cases.human_step(phase="swing", cost="study")
    assert growth(hop, planner.solve(hop).us) < 20.0
    assert growth(swing, planner.solve(swing).us) < 200.0
    assert growth(arm, planner.solve(arm).us) > 1000.0


def test_rows_and_page_of_a_small_run(results, tmp_path):
    assert all(cell for row in STUDY.rows(results) for cell in row)
    assert "| hop |" in STUDY.page(results)
    STUDY.pictures["extremals.png"](results, tmp_path / "e.png")
    assert (tmp_path / "e.png").stat().st_size > 10_000
