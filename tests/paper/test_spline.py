"""The paper's direct method: exact gradients, and motions of less effort that keep their ends."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad_vec
from scipy.optimize import check_grad

import planner
from planner.cases import two_link
from planner.dynamics.algorithms import rnea
from planner.paper.methods.splines import Boundary, Quadrature, SplineSpace, effort_of, minimize_effort

UP = np.array([np.pi / 2, 0.0])


@pytest.fixture(scope="module")
def arm():
    return two_link().dynamics.mechanism


@pytest.fixture(scope="module")
def found(arm):
    return minimize_effort(arm, Boundary(np.zeros(2), UP, 2.0))


@pytest.mark.parametrize(("degree", "intervals"), [(3, 4), (5, 12), (6, 7)])
def test_the_gradient_is_exact(arm, degree, intervals):
    quadrature = Quadrature(SplineSpace(intervals, degree).basis(2.0), 8)
    P = np.random.default_rng(degree).normal(size=(intervals + degree, 2))

    def value(p):
        return effort_of(arm, quadrature, p.reshape(-1, 2))[0]

    gradient = effort_of(arm, quadrature, P)[1].ravel()
    error = check_grad(value, lambda _: gradient, P.ravel(), epsilon=1e-7)
    assert error < 1e-5 * np.linalg.norm(gradient)


def test_the_quadrature_is_that_of_an_adaptive_rule(arm, found):
    def power(t):
        q, qd, qdd = (found.spline(np.array([t]), k) for k in range(3))
        return 0.5 * np.sum(rnea(arm, q, qd, qdd) ** 2)

    exact, _ = quad_vec(power, 0.0, 2.0, epsabs=1e-11, epsrel=1e-11, limit=2000)
    assert found.cost == pytest.approx(exact, rel=1e-8)


def test_the_papers_arm(found):
    """From the paper's first guess (its effort: 73.6) the effort falls to a local minimum."""
    assert found.first_cost == pytest.approx(72.6, abs=0.05)
    assert found.success
    assert found.cost < 0.5 * found.first_cost
    assert np.allclose(found.spline(np.array([0.0, 2.0])), [[0.0, 0.0], UP], atol=1e-12)
    assert np.allclose(found.spline(np.array([0.0, 2.0]), 1), 0.0, atol=1e-10)


def test_slq_goes_on_from_where_splines_end(arm, found):
    """From the spline's own torques SLQ finds its way out of the valley: 4.0 in place of 30.5."""
    problem = two_link(position_weight=1e6, velocity_weight=1e6)
    middle = problem.dynamics.dt * (np.arange(problem.N) + 0.5)
    us = rnea(arm, *(found.spline(middle, k) for k in range(3)))
    plan = planner.solve(replace(problem, us=us))
    assert plan.success
    assert np.abs(plan.xs[-1] - [*UP, 0.0, 0.0]).max() < 1e-4
    assert 0.5 * problem.dynamics.dt * np.sum(plan.us**2) < 0.5 * found.cost


def test_velocities_at_the_ends_are_kept(arm):
    motion = minimize_effort(arm, Boundary([0.1, 0.2], [0.5, -0.3], 1.0, [0.3, -0.1], 0.2))
    assert np.allclose(motion.spline(np.array([0.0, 1.0])), [[0.1, 0.2], [0.5, -0.3]])
    assert np.allclose(motion.spline(np.array([0.0, 1.0]), 1), [[0.3, -0.1], [0.2, 0.2]])


def test_more_intervals_cost_no_more(arm):
    boundary = Boundary(np.zeros(2), UP, 2.0)
    efforts = [minimize_effort(arm, boundary, space=SplineSpace(n)).cost for n in (6, 12, 24)]
    assert efforts[0] >= efforts[1] - 1e-6 >= efforts[2] - 2e-6


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"boundary": Boundary([0.0], UP, 2.0)}, "start has shape"),
        ({"boundary": Boundary([0.0, 0.0], [0.0, np.nan], 2.0)}, "goal"),
        ({"boundary": Boundary([0.0, 0.0], UP, 0.0)}, "duration is 0"),
        ({"space": SplineSpace(degree=2)}, "degree is 2"), ({"space": SplineSpace(1)}, "intervals is 1"),
        ({"nodes": 0}, "nodes is 0"), ({"mechanism": None}, "expected a Mechanism"),
        ({"guess": lambda t: t}, r"guess\(t\) has shape"),
    ],
)  # fmt: skip
def test_wrong_arguments_are_refused_in_one_sentence(arm, changes, words):
    with pytest.raises(planner.PlannerError, match=words):
        minimize_effort(**({"mechanism": arm, "boundary": Boundary(np.zeros(2), UP, 2.0)} | changes))


@pytest.mark.parametrize(("intervals", "degree"), [(1, 3), (4, 3), (12, 5)])
def test_basis_functions_are_a_partition_of_unity(intervals, degree):
    basis = SplineSpace(intervals, degree).basis(2.5)
    at = basis(np.linspace(0.0, 2.5, 11))
    assert at.shape == (11, intervals + degree)
    assert np.allclose(at.sum(axis=1), 1.0)
