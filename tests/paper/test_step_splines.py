"""f, L and phi of a problem whose cost changes on the way: exact derivatives, and the integral behind the sum."""

import numpy as np
import pytest

import planner
from planner.cases.human_step.case import human_step
from planner.dynamics.protocol import rollout_states
from planner.paper.methods.adjoint import AdjointCost, Integration
from planner.paper.methods.splines import SplineSpace
from planner.paper.studies.step_splines import TimedProblem, stiffened
from tests.solves import hopper, numpy_twin


@pytest.fixture(scope="module")
def swing():
    """The swing with penalties that act."""
    problem = stiffened(human_step(phase="swing", cost="study"), 100.0)
    return problem, TimedProblem(problem)


def slopes(f, at, h=1e-6):
    return np.array([(f(at + h * e) - f(at - h * e)) / (2.0 * h) for e in np.eye(len(at))]).T


def test_derivatives_are_exact(swing):
    problem, system = swing
    rng = np.random.default_rng(0)
    z, w = np.append(problem.x0 + 0.01 * rng.normal(size=22), 0.031), problem.first_guess[7]
    p = system.partials(z, w)
    assert np.allclose(p.L_z[:-1], slopes(lambda z: system.rates(z, w)[1], z)[:-1], rtol=1e-6, atol=1e-5)
    assert np.allclose(p.L_w, slopes(lambda w: system.rates(z, w)[1], w), atol=1e-6)
    assert np.allclose(p.f_w, slopes(lambda w: system.rates(z, w)[0], w), atol=1e-6)
    assert np.allclose(
        system.final(z, w)[1][:-1], slopes(lambda z: system.final(z, w)[0], z)[:-1], rtol=1e-5, atol=1e-4
    )
    assert np.abs(p.L_z).max() > 1.0


def test_the_integral_is_the_sum_s_and_its_gradient_is_exact(swing):
    """Within a stage's length of the sum over stages; Eq. 7 against a difference of the integral."""
    problem, system = swing
    basis = SplineSpace(2, 3).basis(problem.duration)
    P = np.linalg.lstsq(basis(problem.dynamics.dt * (np.arange(problem.N) + 0.5)), problem.first_guess)[0]
    cost = AdjointCost(system, basis, system.z0, Integration(1e-6))
    J, gradient = cost(P)
    us = basis(problem.dynamics.dt * (np.arange(problem.N) + 0.5)) @ P
    xs = rollout_states(problem.dynamics, problem.x0, us)
    assert pytest.approx(problem.cost.value(xs, us), rel=0.01) == J
    way = np.random.default_rng(1).normal(size=P.shape)
    ends = [cost.forward(P + side * 0.1 * way) for side in (1.0, -1.0)]
    both = [y.y[-1, -1] + system.final(y.y[:-1, -1], us[-1])[0] for y in ends]
    assert (both[0] - both[1]) / 0.2 == pytest.approx(np.sum(gradient * way), rel=1e-3)


def test_a_cost_of_another_kind_is_refused():
    with pytest.raises(planner.PlannerError, match="expected"):
        TimedProblem(numpy_twin(hopper()))
    assert TimedProblem(hopper()).nz == 4  # a constant cost is one, too
