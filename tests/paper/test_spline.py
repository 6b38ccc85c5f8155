"""The paper's direct method: exact gradients, and motions of less effort that keep their ends."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad_vec
from scipy.optimize import check_grad

import planner
from planner.cases import two_link
from planner.dynamics.algorithms import rnea
from planner.paper.methods.splines import (
    NODES,
    Boundary,
    Quadrature,
    SplineSpace,
    adaptive_simpson,
    effort_of,
    minimize_effort,
)

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


def test_simpson_s_rule_is_exact_for_cubics_and_as_good_as_its_tolerance():
    breaks = np.linspace(0.0, 2.0, 4)
    cubic = adaptive_simpson(lambda t: (t**3)[:, None], breaks, 1e-12)
    assert cubic[0] == pytest.approx(4.0, rel=1e-14)
    peak = adaptive_simpson(lambda t: np.stack([1.0 / (1e-2 + t**2), np.exp(t)], axis=1), breaks, 1e-8)
    assert np.isnan(adaptive_simpson(lambda t: np.full((len(t), 1), np.nan), breaks, 1e-8)).all()
    assert peak == pytest.approx([10.0 * np.arctan(20.0), np.expm1(2.0)], abs=1e-8)


def test_quadrature_does_not_matter(arm):
    quadrature = Quadrature(SplineSpace(7).basis(2.0), 8)
    P = 0.2 * np.random.default_rng(0).normal(size=(12, 2))
    by_gauss, by_simpson = (effort_of(arm, quadrature, P, tolerance) for tolerance in (None, 1e-6))
    assert by_simpson[0] == pytest.approx(by_gauss[0], rel=1e-6)
    assert np.abs(by_simpson[1] - by_gauss[1]).max() < 1e-6 * np.abs(by_gauss[1]).max()


def test_soft_ends_are_eq_5(arm):
    """J is the effort and the misses with c1 = c2 = 100; at its minimum it is below that of exact ends."""
    space, goal, c = SplineSpace(7), np.array([UP, np.zeros(2)]), (100.0, 100.0)
    soft = minimize_effort(arm, Boundary(np.zeros(2), UP, 2.0), space=space, end_weights=c)
    end = np.array([soft.spline(2.0), soft.spline(2.0, 1)])
    assert soft.success
    assert soft.cost == pytest.approx(soft.effort + 100.0 * np.sum((end - goal) ** 2), rel=1e-12)
    assert soft.cost < minimize_effort(arm, Boundary(np.zeros(2), UP, 2.0), space=space).cost
    # Stationary: the gradient of Eq. 5 by every free amplitude is zero to BFGS's tolerance.
    quadrature = Quadrature(space.basis(2.0), NODES)
    last = np.array([quadrature.basis(2.0, nu=order) for order in range(2)])
    gradient = effort_of(arm, quadrature, soft.spline.c)[1] + 200.0 * last.T @ (end - goal)
    assert np.abs(gradient[2:]).max() < 1e-4


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
        ({"boundary": Boundary([0.0], UP, 2.0)}, r"start is \[0.0\]"),
        ({"boundary": Boundary([0.0, 0.0], [0.0, np.nan], 2.0)}, "goal"),
        ({"boundary": Boundary([0.0, 0.0], UP, 0.0)}, "duration is 0"),
        ({"space": SplineSpace(degree=2)}, "degree is 2"), ({"space": SplineSpace(1)}, "intervals is 1"),
        ({"nodes": 0}, "nodes is 0"), ({"mechanism": None}, "expected a Mechanism"),
        ({"end_weights": (1.0, -1.0)}, "end weight is -1"), ({"end_weights": (1.0,)}, r"end_weights is \(1.0,\)"),
        ({"simpson": 0.0}, "simpson is 0"),
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
