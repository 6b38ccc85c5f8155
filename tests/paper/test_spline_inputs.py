"""Splines as inputs: exact gradients of both kinds, costs beside SLQ's, the derivatives of Eq. 7, motions of joints."""

import numpy as np
import pytest

import planner
from planner.cases import acrobot, hopper
from planner.cases.hopper import PAPER
from planner.dynamics import FunctionDynamics
from planner.dynamics.algorithms import hybrid_dynamics, rnea
from planner.paper.methods.adjoint import AdjointCost, ContinuousProblem, Integration
from planner.paper.methods.spline_inputs import (
    DrivenProblem,
    DrivenSystem,
    DrivenWeights,
    SplineCost,
    minimize_effort_underactuated,
    solve_by_splines,
)
from planner.paper.methods.splines import Boundary, SplineSpace
from planner.paper.studies.hopper_splines import hessian


def jump(height=20.0):
    """By explicit Euler: by semi-implicit Euler 17 coefficients do not converge."""
    return hopper(height=height, **PAPER | {"integrator": "euler"})


def linear():
    d = FunctionDynamics(lambda x, u: np.stack([x[..., 1], u[..., 0]], axis=-1), 2, 1, 0.02)
    return planner.Problem(d, planner.TrackingCost.reach([1.0, 0.0], 50, final=100.0, effort=1.0, dt=0.02), np.zeros(2))


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


UP = np.array([np.pi / 2, 0.0])


@pytest.fixture(scope="module")
def arm():
    return acrobot().dynamics.mechanism


def problem_of(arm, *integration):
    boundary = Boundary([-1.0, 0.0], UP, 0.6)
    return DrivenProblem(arm, boundary, ("elbow",), space=SplineSpace(4, 4), integration=Integration(*integration))


@pytest.fixture(scope="module")
def system(arm):
    return DrivenSystem(arm, Boundary([-1.0, 0.0], UP, 0.6), "elbow", DrivenWeights(3.0, 5.0, 2.0))


def slopes(function, x, h=1e-4):
    """Differences of fourth order."""
    steps = [np.asarray(function(x + s * h * e)) for e in np.eye(len(x)) for s in (1.0, -1.0, 2.0, -2.0)]
    groups = [steps[4 * i : 4 * i + 4] for i in range(len(x))]
    return np.stack([(8.0 * (a - b) - (c - d)) / (12.0 * h) for a, b, c, d in groups], axis=-1)


def test_partial_derivatives_are_exact(system):
    rng = np.random.default_rng(1)
    z, w = rng.normal(size=2), rng.normal(size=3)
    p = system.partials(z, w)
    assert np.allclose(p.f_z, slopes(lambda z: system.rates(z, w)[0], z), atol=1e-9)
    assert np.allclose(p.f_w, slopes(lambda w: system.rates(z, w)[0], w), atol=1e-9)
    assert np.allclose(p.L_z, slopes(lambda z: system.rates(z, w)[1], z), atol=1e-8)
    assert np.allclose(p.L_w, slopes(lambda w: system.rates(z, w)[1], w), atol=1e-8)
    _, by_z, by_w = system.final(z, w)
    assert np.allclose(by_z, slopes(lambda z: system.final(z, w)[0], z))
    assert np.allclose(by_w, slopes(lambda w: system.final(z, w)[0], w))


def test_rates_are_the_hybrid_dynamics(system, arm):
    z, w = np.array([0.3, -0.7]), np.array([0.2, 1.1, -2.0])
    qdd, tau = hybrid_dynamics(arm, [0.3, 0.2], [-0.7, 1.1], [0.0, -2.0], ("elbow",))
    rates, L = system.rates(z, w)
    assert np.allclose(rates, [-0.7, qdd[0]])
    assert pytest.approx(0.5 * 2.0 * tau[1] ** 2) == L


def test_the_gradient_is_that_of_equation_7(arm):
    problem = problem_of(arm, 1e-12, "DOP853")
    free = problem.first + 0.3 * np.random.default_rng(0).normal(size=problem.first.size)
    direction = np.random.default_rng(1).normal(size=free.size)
    J, gradient = problem(free)
    (by_differences,) = slopes(lambda s: problem.cost(problem.amplitudes(free + s * direction))[0], np.zeros(1), h=1e-3)
    assert J > 0.0
    assert gradient @ direction == pytest.approx(by_differences, rel=1e-6)


def test_the_gradient_is_worse_at_a_loose_tolerance(arm):
    exact = problem_of(arm, 1e-12, "DOP853")
    free = exact.first + 0.3 * np.random.default_rng(0).normal(size=exact.first.size)
    reference = exact(free)[1]
    errors = [np.linalg.norm(problem_of(arm, t)(free)[1] - reference) for t in (1e-3, 1e-5, 1e-8)]
    assert errors[0] > 10.0 * errors[1] > 100.0 * errors[2]


def test_a_motion_is_one_of_the_mechanism(arm):
    """What comes back satisfies Eq. 6 without a force on the shoulder, starts where asked, and costs less."""
    motion = minimize_effort_underactuated(
        arm, Boundary([-1.0, 0.1], UP, 0.6, [0.0, 0.5]), ("elbow",), space=SplineSpace(4), max_iterations=5
    )
    assert motion.cost < motion.first_cost
    assert np.allclose(motion.q[0], [-1.0, 0.1])
    assert np.allclose(motion.qd[0], [0.0, 0.5])
    assert not motion.tau[:, 0].any()
    qdd = np.gradient(motion.qd, motion.t, axis=0, edge_order=2)
    inside = slice(5, -5)
    tau = rnea(arm, motion.q, motion.qd, qdd)
    # Accelerations here are differences of samples, of second order in 2 ms.
    assert np.abs(tau - motion.tau)[inside].max() < 1e-2 * np.abs(motion.tau).max()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"driven": ()}, "driven names no joint"), ({"driven": ("shoulder", "elbow")}, "driven names every joint"),
        ({"driven": ("knee",)}, "knee"), ({"driven": 3}, "expected names of joints"),
        ({"mechanism": None}, "expected a Mechanism"), ({"guess": lambda t: t}, r"guess\(t\) has shape"),
        ({"boundary": Boundary([0.0], UP, 1.0)}, r"start is \[0.0\]"),
        ({"boundary": Boundary([0.0, 0.0], [0.0], 1.0)}, r"goal is \[0.0\]"),
        ({"boundary": Boundary([0.0, 0.0], UP, 1.0, [1.0])}, r"start_velocity is \[1.0\]"),
    ],
)  # fmt: skip
def test_wrong_arguments_are_refused_in_one_sentence(arm, changes, words):
    arguments = {"mechanism": arm, "boundary": Boundary([-1.0, 0.0], UP, 1.0), "driven": ("elbow",)} | changes
    with pytest.raises(planner.PlannerError, match=words):
        minimize_effort_underactuated(**arguments)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Integration(0.0), "tolerance is 0"), (lambda: Integration(method="ode45"), "method is 'ode45'"),
        (lambda: DrivenWeights(effort=0.0), "effort weight is 0"),
    ],
)  # fmt: skip
def test_wrong_options_are_one_sentence(make, words):
    with pytest.raises(planner.PlannerError, match=words):
        make()
