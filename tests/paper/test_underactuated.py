"""The gradient of Eq. 7, the derivatives it is made of, and motions of driven joints."""

import numpy as np
import pytest

import planner
from planner.cases import acrobot
from planner.dynamics.algorithms import hybrid_dynamics, rnea
from planner.paper.methods.adjoint import Integration
from planner.paper.methods.splines import Boundary, SplineSpace
from planner.paper.methods.underactuated import (
    DrivenProblem,
    DrivenSystem,
    DrivenWeights,
    minimize_effort_underactuated,
)

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
        ({"boundary": Boundary([0.0], UP, 1.0)}, "start has shape"),
        ({"boundary": Boundary([0.0, 0.0], [0.0], 1.0)}, "goal has shape"),
        ({"boundary": Boundary([0.0, 0.0], UP, 1.0, [1.0])}, "start_velocity has shape"),
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
