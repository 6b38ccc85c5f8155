"""Local minima in the study of Theorem 2: the exact Hessian of J, and saddles that a solve stops at."""

import dataclasses

import numpy as np
import pytest

import planner
from planner import TrackingCost, cases
from planner.dynamics.protocol import rollout_states
from planner.paper.studies.many_starts import curvature, from_many, hamiltonian_hessians, is_minimum
from planner.solvers import lq
from planner.solvers.slq import solve


def gradient(problem, us):
    xs = rollout_states(problem.dynamics, problem.x0, us)
    A, B = problem.dynamics.linearize(xs, us)
    return lq.gradient(A, B, problem.cost.quadratize(xs, us))


def hessian(problem, us, step=1e-5):
    """(N nu, N nu) by central differences of the gradient over all controls."""
    H = np.empty((us.size, us.size))
    for i, one in enumerate(np.eye(us.size)):
        moved = step * one.reshape(us.shape)
        H[i] = (gradient(problem, us + moved) - gradient(problem, us - moved)).ravel() / (2.0 * step)
    return 0.5 * (H + H.T)


def test_stages_have_the_dynamics_own_second_derivatives():
    """Differences of the Hamiltonian's gradient against the compiled second derivatives, off any minimum."""
    problem = cases.two_link(horizon=30)
    us = np.random.default_rng(0).normal(size=(30, 2))
    xs = rollout_states(problem.dynamics, problem.x0, us)
    A, _ = problem.dynamics.linearize(xs, us)
    model = problem.cost.quadratize(xs, us)
    T = problem.dynamics.second_order(xs, us, lq.costates(A, model))
    H, Q = hamiltonian_hessians(problem, xs, us)
    T[:, :4, :4] += model.Q[:-1]
    T[:, 4:, 4:] += model.R
    np.testing.assert_allclose(H, T, atol=1e-6 * np.abs(T).max())
    np.testing.assert_allclose(Q, model.Q[-1], atol=1e-6 * np.abs(Q).max())


@pytest.mark.parametrize("seed", [0, 1])
def test_negative_eigenvalues_are_those_of_the_whole_hessian(seed):
    """By the sweep, and by eigenvalues of the Hessian over all 40 controls, where whirling arms have many."""
    problem = cases.two_link(horizon=20)
    us = 5.0 * np.random.default_rng(seed).normal(size=(20, 2))
    found = curvature(problem, rollout_states(problem.dynamics, problem.x0, us), us)
    H = hessian(problem, us)
    assert found.negative == int(np.sum(np.linalg.eigvalsh(H) < 0.0)) > 0
    assert found.expected_reduction == np.inf
    along = found.direction.ravel()
    assert along @ H @ along < 0.0


def test_a_solve_ends_at_a_minimum():
    problem = cases.two_link(horizon=50)
    plan = solve(problem, expected_reduction_tolerance=1e-12)
    found = curvature(problem, plan.xs, plan.us)
    assert found.negative == 0
    assert found.expected_reduction < 1e-9 * plan.cost
    assert np.linalg.eigvalsh(hessian(problem, plan.us)).min() > 0.0
    assert is_minimum(problem, plan)


def test_a_saddle_is_no_minimum():
    """x(N) = u^2 is to be 1: at u = 0 the gradient is zero, the LQ model sees effort alone, and J falls either way."""
    dynamics = planner.FunctionDynamics(lambda x, u: u**2, 1, 1, 1.0, "discrete")
    problem = planner.Problem(dynamics, TrackingCost.reach([1.0], 3, final=1.0, effort=0.1), [0.0])
    plan = solve(problem, planner.SolverOptions(homotopy=False))  # else it begins again from shaken controls
    assert plan.success
    assert plan.us.any() == 0.0
    assert solve(problem).cost < 0.1 * plan.cost
    found = curvature(problem, plan.xs, plan.us)
    assert found.negative == 1  # that of the last control; J'' = 0.1 - 2
    assert not is_minimum(problem, plan)
    better = solve(dataclasses.replace(problem, us=np.full((3, 1), 0.1)))
    assert better.cost < plan.cost
    assert is_minimum(problem, better)


def test_every_search_has_the_same_limit_and_says_how_it_ended():
    problem = cases.build("hopper", height=1.0)
    for search in ("armijo", "exact", "wolfe", "goldstein"):
        run = from_many(problem, 1.0, 3, "open-loop", search, 2000)
        assert run["converged"] == 3
        assert sum(one["count"] for one in run["minima"]) + len(run["no_minima"]) == 3
