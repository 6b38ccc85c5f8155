"""Controls as splines: exact gradients of both kinds, and costs beside SLQ's."""

import numpy as np
import pytest

import planner
from planner.cases import hopper
from planner.cases.hopper import PAPER
from planner.dynamics import FunctionDynamics
from planner.paper.methods.adjoint import AdjointCost, ContinuousProblem, Integration
from planner.paper.methods.control_spline import SplineCost, solve_by_splines
from planner.paper.methods.splines import SplineSpace
from planner.paper.studies.hopper_splines import hessian


def jump(height=20.0):
    """By explicit Euler: by semi-implicit Euler 17 coefficients do not converge."""
    return hopper(height=height, **PAPER | {"integrator": "euler"})


def linear():
    d = FunctionDynamics(lambda x, u: np.stack([x[..., 1], u[..., 0]], axis=-1), 2, 1, 0.02)
    return planner.Problem(d, planner.TrackingCost.reach([1.0, 0.0], 50, final=100.0, effort=1.0, dt=0.02), np.zeros(2))


def slopes(function, P, h):
    return np.array([(function(P + h * e) - function(P - h * e)) / (2.0 * h) for e in np.eye(len(P))])


def test_the_discrete_gradient_is_exact():
    cost = SplineCost(jump(), SplineSpace(5, 3).basis(1.0))
    P = 20.0 * np.random.default_rng(0).normal(size=8)
    gradient = cost(P)[1]
    assert np.linalg.norm(gradient - slopes(lambda P: cost(P)[0], P, 1e-4)) < 1e-7 * np.linalg.norm(gradient)


@pytest.mark.parametrize("problem", [jump(), linear()], ids=["hopper", "linear"])
def test_equation_7_is_the_gradient_of_the_integral(problem):
    cost = AdjointCost(
        ContinuousProblem(problem), SplineSpace(3, 3).basis(1.0), problem.x0, Integration(1e-11, "DOP853")
    )
    P, direction = np.random.default_rng(0).normal(size=(2, 6)) * [[5.0], [1.0]]
    gradient = cost(P[:, None])[1].ravel()
    ends = [cost((P + h * direction)[:, None])[0] for h in (1e-3, -1e-3)]
    assert gradient @ direction == pytest.approx((ends[0] - ends[1]) / 2e-3, rel=1e-5)


def test_the_integral_is_what_the_sum_tends_to():
    """Explicit Euler's sum is off by the order of its step: a hundredth of it, a hundredth of the error."""
    P = np.array([0.0, 30.0, -20.0, 40.0, 10.0, 0.0])
    basis = SplineSpace(3, 3).basis(1.0)
    integral = AdjointCost(ContinuousProblem(jump()), basis, np.zeros(3), Integration(1e-10))(P[:, None])[0]
    errors = [abs(SplineCost(hopper(**(PAPER | {"horizon": N})), basis)(P)[0] - integral) for N in (500, 50_000)]
    assert errors[1] < 0.02 * errors[0]


@pytest.mark.parametrize("gradient", ["discrete", "continuous"])
def test_a_linear_problem_comes_near_slqs_cost(gradient):
    """Its optimum is a straight line in time, which every spline can be; integral and sum differ by Euler's error."""
    problem = linear()
    found = solve_by_splines(problem, coefficients=6, degree=3, gradient=gradient, gradient_tolerance=1e-6)
    assert found.success
    assert found.discrete_cost == pytest.approx(planner.solve(problem).cost, rel=1e-3)


def test_the_hopper_converges_with_the_exact_gradient():
    """Section 2.4 reports failure with Eq. 7. As many coefficients as stages would be SLQ's own problem."""
    plan = planner.solve(jump(1.0), update="open-loop")
    found = solve_by_splines(jump(1.0), coefficients=17)
    assert found.success
    assert plan.cost - 1e-6 < found.cost < 1.001 * plan.cost
    assert np.all(np.diff(found.costs) <= 1e-9 * found.costs[0])
    eigenvalues = np.linalg.eigvalsh(hessian(jump(1.0), 17, found.spline.c))
    assert eigenvalues[0] > 0.0  # a minimum
    assert eigenvalues[-1] / eigenvalues[0] > 1e4  # and why it takes hundreds of iterations


@pytest.mark.parametrize(
    ("changes", "words"),
    [({"problem": None}, "expected a Problem"), ({"coefficients": 5}, "coefficients is 5"),
     ({"gradient": "exact"}, "gradient is 'exact'"), ({"degree": 0}, "degree is 0")],
)  # fmt: skip
def test_wrong_arguments_of_a_spline_are_refused_in_one_sentence(changes, words):
    with pytest.raises(planner.PlannerError, match=words):
        solve_by_splines(**({"problem": linear()} | changes))


def test_weights_that_change_on_the_way_have_no_integral():
    problem = linear()
    R = problem.cost.R.copy()
    R[3] *= 2.0
    cost = planner.TrackingCost(problem.cost.Q, R, problem.cost.x_ref)
    with pytest.raises(planner.PlannerError, match="R changes on the way"):
        ContinuousProblem(planner.Problem(problem.dynamics, cost, problem.x0))
