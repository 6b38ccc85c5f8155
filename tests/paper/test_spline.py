"""The paper's direct method: exact gradients, and motions of less effort that keep their ends."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad_vec
from scipy.optimize import check_grad

import planner
from planner.cases import two_link
from planner.dynamics.algorithms import rnea
from planner.paper.methods.splines import _Basis, _effort, minimize_effort

UP = np.array([np.pi / 2, 0.0])


@pytest.fixture(scope="module")
def arm():
    return two_link().dynamics.mechanism


@pytest.fixture(scope="module")
def found(arm):
    return minimize_effort(arm, np.zeros(2), UP, 2.0)


@pytest.mark.parametrize(("degree", "intervals"), [(3, 4), (5, 12), (6, 7)])
def test_the_gradient_is_exact(arm, degree, intervals):
    basis = _Basis(2.0, intervals, degree, 8)
    P = np.random.default_rng(degree).normal(size=(basis.size, 2))

    def value(p):
        return _effort(arm, basis, p.reshape(-1, 2))[0]

    gradient = _effort(arm, basis, P)[1].ravel()
    error = check_grad(value, lambda _: gradient, P.ravel(), epsilon=1e-7)
    assert error < 1e-5 * np.linalg.norm(gradient)


def test_the_quadrature_is_that_of_an_adaptive_rule(arm, found):
    def power(t):
        q, qd, qdd = (found.at(np.array([t]), k) for k in range(3))
        return 0.5 * np.sum(rnea(arm, q, qd, qdd) ** 2)

    exact, _ = quad_vec(power, 0.0, 2.0, epsabs=1e-11, epsrel=1e-11, limit=2000)
    assert found.effort == pytest.approx(exact, rel=1e-8)


def test_the_papers_arm(found):
    """From the paper's first guess (its effort: 73.6) the effort falls to a local minimum."""
    assert found.first_effort == pytest.approx(72.6, abs=0.05)
    assert found.success
    assert found.effort < 0.5 * found.first_effort
    assert np.allclose(found.at(np.array([0.0, 2.0])), [[0.0, 0.0], UP], atol=1e-12)
    assert np.allclose(found.at(np.array([0.0, 2.0]), 1), 0.0, atol=1e-10)


def test_slq_goes_on_from_where_splines_end(arm, found):
    """From the spline's own torques SLQ finds its way out of the valley: 4.0 in place of 30.5."""
    problem = two_link(position_weight=1e6, velocity_weight=1e6)
    middle = problem.dynamics.dt * (np.arange(problem.N) + 0.5)
    us = rnea(arm, *(found.at(middle, k) for k in range(3)))
    plan = planner.solve(replace(problem, us=us))
    assert plan.success
    assert np.abs(plan.xs[-1] - [*UP, 0.0, 0.0]).max() < 1e-4
    assert 0.5 * problem.dynamics.dt * np.sum(plan.us**2) < 0.5 * found.effort


def test_velocities_at_the_ends_are_kept(arm):
    motion = minimize_effort(arm, [0.1, 0.2], [0.5, -0.3], 1.0, start_velocity=[0.3, -0.1], goal_velocity=0.2)
    assert np.allclose(motion.at(np.array([0.0, 1.0])), [[0.1, 0.2], [0.5, -0.3]])
    assert np.allclose(motion.at(np.array([0.0, 1.0]), 1), [[0.3, -0.1], [0.2, 0.2]])


def test_more_intervals_cost_no_more(arm):
    efforts = [minimize_effort(arm, np.zeros(2), UP, 2.0, intervals=n).effort for n in (6, 12, 24)]
    assert efforts[0] >= efforts[1] - 1e-6 >= efforts[2] - 2e-6


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"start": [0.0]}, "start has shape"), ({"goal": [0.0, np.nan]}, "goal"), ({"duration": 0.0}, "duration is 0"),
        ({"degree": 2}, "degree is 2"), ({"intervals": 1}, "intervals is 1"), ({"nodes": 0}, "nodes is 0"),
        ({"mechanism": None}, "expected a Mechanism"), ({"guess": lambda t: t}, r"guess\(t\) has shape"),
    ],
)  # fmt: skip
def test_wrong_arguments_are_refused_in_one_sentence(arm, changes, words):
    arguments = {"mechanism": arm, "start": np.zeros(2), "goal": UP, "duration": 2.0} | changes
    with pytest.raises(planner.PlannerError, match=words):
        minimize_effort(**arguments)
