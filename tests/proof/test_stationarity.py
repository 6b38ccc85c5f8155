"""A vanishing gradient is no minimum by itself: own derivatives, curvature, contacts that nothing touches."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from corpus import wrong_optimality
from corpus.asking import reach
from corpus.machines import arm

import planner
from planner import FunctionDynamics, Problem, TrackingCost
from planner.dynamics.quasi_static import quasi_static_controls
from planner.proof.consistency import optimality, recomputed
from planner.proof.repair.continued import leave_saddles
from planner.solvers.work import WorkBudget


def optimality_of(plan):
    section = optimality(plan, plan.problem, recomputed(plan, plan.problem, plan.xs, plan.us))
    return {one.name: one for one in section.measured}


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (wrong_optimality.other_derivatives, "cost_derivative_error"),
        (wrong_optimality.farthest, "negative_curvature"),
        (wrong_optimality.untouched, "unreached_goals"),
    ],
)  # fmt: skip
def test_a_zero_gradient_is_not_optimal_where(make, name):
    plan = make(np.random.default_rng(11))
    assert plan.success
    assert not optimality_of(plan)[name].passed


def test_right_derivatives_and_a_minimum_pass():
    plan = planner.solve(reach(arm(np.random.default_rng(3), 2), [0.8, -0.7]))
    own = wrong_optimality.Effort(0.0, 0.0, 0.0, 2)  # value() and derivatives are zero
    found = optimality_of(planner.solve(replace(plan.problem, cost=plan.problem.cost + own)))
    assert found["cost_derivative_error"].value < 1e-6  # central differences of a quadratic cost
    assert found["negative_curvature"].value == 0.0


MILLIGRAM = """<mujoco><worldbody><body><joint name="a" axis="0 1 0" damping="1e-9"/>
  <geom type="capsule" fromto="0 0 0 .01 0 0" size=".0005" mass="5e-7" contype="0" conaffinity="0"/>
  <body pos=".01 0 0"><joint name="b" axis="0 1 0" damping="1e-9"/>
    <geom type="capsule" fromto="0 0 0 .01 0 0" size=".0005" mass="5e-7" contype="0" conaffinity="0"/></body></body>
  </worldbody><actuator><motor joint="a"/><motor joint="b"/></actuator></mujoco>"""


def test_a_curvature_that_is_rounding_is_none():
    """A cost of 4e-7, whose solve ends before its slope is zero: it falls one way, and not on average."""
    m = planner.Mechanism.from_mjcf(MILLIGRAM)
    dynamics = planner.RigidBodyDynamics(m, 0.0025)
    cost = TrackingCost.joints(
        dynamics, [0.8, -0.5, 0.0, 0.0], 200, effort=1e10, final_position=1e3, final_velocity=1e2
    )  # fmt: skip
    us = np.tile(quasi_static_controls(m, m.home), (200, 1))
    plan = planner.solve(Problem(dynamics, cost, m.home, us=us))
    assert plan.success
    assert optimality_of(plan)["negative_curvature"].passed


def double_well(wrong_sign=False, scale=1.0):
    """A mass at the top of 1/2 (x^2 - 1)^2 in its running cost: stationary at x = 0, and a maximum there."""

    class Well(wrong_optimality.Effort):
        def value(self, xs, us):
            return 0.5 * scale * float(np.sum((xs[:-1, 0] ** 2 - 1.0) ** 2))

        def quadratize(self, xs, us):
            model = super().quadratize(xs, us)
            model.q[:-1, 0] = scale * 2.0 * xs[:-1, 0] * (xs[:-1, 0] ** 2 - 1.0)
            model.Q[:-1, 0, 0] = scale * 4.0 * xs[:-1, 0] ** 2  # Gauss-Newton
            return model

    def f(x, u):
        return np.stack([x[..., 1], u[..., 0]], axis=-1)

    def jacobian(x, u):
        fx, fu = np.zeros((len(x), 2, 2)), np.zeros((len(x), 2, 1))
        fx[:, 0, 1], fu[:, 1, 0] = 1.0, -1.0 if wrong_sign else 1.0
        return fx, fu

    dynamics = FunctionDynamics(f, 2, 1, 0.1, jacobian=jacobian)
    tracking = TrackingCost.reach([0.0, 0.0], 30, final=[1e-3 * scale, 1e-3 * scale], effort=0.1 * scale)
    return Problem(dynamics, tracking + Well(1.0, 1.0, 0.0, 1), np.zeros(2), tolerance="soft")


def test_curvature_is_checked_for_any_dynamics():
    plan = planner.solve(double_well())
    assert plan.nit == 0
    assert not optimality_of(plan)["negative_curvature"].passed
    away = planner.solve(replace(double_well(), us=np.full((30, 1), 0.5)))
    assert away.cost < plan.cost
    assert optimality_of(away)["negative_curvature"].passed


@pytest.mark.parametrize("scale", [1.0, 1e-11])
def test_a_saddle_is_left_along_its_lowest_curvature(scale):
    """The repair solves again from beside it, until the proof finds no negative curvature.

    All reductions of the small cost are below the default tolerance, 1e-10: only those of the saddle count.
    """

    def prove(plan):
        section = optimality(plan, plan.problem, recomputed(plan, plan.problem, plan.xs, plan.us))
        return SimpleNamespace(sections={"optimality": section}, verdict="PASS" if section.passed else "FAIL")

    plan, budget, steps = planner.solve(double_well(scale=scale)), WorkBudget(), []
    better, proof = leave_saddles(plan, prove(plan), budget, prove, 1000, steps.append)
    assert proof.verdict == "PASS"
    assert better.cost < plan.cost == steps[0].cost
    away = planner.solve(replace(double_well(), us=np.full((30, 1), 0.5)))
    assert better.cost / scale == pytest.approx(away.cost, rel=1e-3)  # SHARE_OF_FALL of the reduction, and its rate
    assert leave_saddles(better, proof, budget, prove, 1000, steps.append) == (better, proof)


def test_a_jacobian_that_is_not_that_of_the_dynamics_is_named():
    assert optimality_of(planner.solve(double_well()))["dynamics_derivative_error"].passed
    assert not optimality_of(planner.solve(double_well(wrong_sign=True)))["dynamics_derivative_error"].passed


def test_the_first_line_says_where_the_curvature_was_not_checked():
    ball = wrong_optimality.machines.ball_on_floor(np.random.default_rng(0), 1.0)
    plan = planner.solve(reach(ball, [0.3, 0.1], contacts=wrong_optimality.ContactLaw.resting(1.0)))
    proof = planner.prove(plan, rollouts=0, optimal=False)
    assert "optimal (curvature not checked)" in proof.headline, proof.headline


@pytest.mark.parametrize(("end", "multiplier", "minimum"), [([2.0, 0.0], 2.0, False), ([0.0, 1.0], 1.0 / 3.0, True)])
@pytest.mark.parametrize("weight", [5.0, 0.05])
def test_constraints_have_penalties_that_are_stiff_enough(end, multiplier, minimum, weight):
    """Of the points where x^2 / 4 + (y^2 + y^4) / 2 = 1 the one nearest to 0, and one that is only stationary.

    At (0, 1) the Lagrangian of half the squared distance has the curvatures 1 - 1/6 along the curve and 1 - 7/3 across
    it, to which a penalty adds 9 weights: 0.05 is too little. At (2, 0) that along the curve is 1 - 2, which no penalty
    makes positive.
    """
    dynamics = FunctionDynamics(lambda x, u: x + u, 2, 2, 1.0, "discrete")
    away = planner.Constraint(
        lambda xs: xs[:, 0] ** 2 / 4.0 + 0.5 * (xs[:, 1] ** 2 + xs[:, 1] ** 4), lower=1.0, when="end", name="away"
    )
    cost = TrackingCost(
        np.stack([np.zeros((2, 2)), np.eye(2)]), 1e-9 * np.eye(2)[None], np.zeros((2, 2)), np.zeros((1, 2))
    )
    problem = Problem(dynamics, cost, np.zeros(2), us=np.array([end]), constraints=[away])
    constraints: Any = problem.trajectory_constraints
    scale, none = constraints.rows.scale[0], constraints.zero_penalties()
    lower, weights = np.where(np.isfinite(none.lower), none.lower, 0.0), 0.0 * none.weight
    lower[-1], weights[-1] = scale * (1.0 + multiplier / weight), weight / scale**2
    plan = replace(planner.solve(problem, planner.SolverOptions(max_iterations=1)), status=planner.Status.CONVERGED)
    plan = replace(
        plan,
        xs=np.array([[0.0, 0.0], end]),
        us=np.array([end]),
        bound_penalties=none._replace(lower=lower, weight=weights),
    )
    measured = optimality_of(plan)["negative_curvature"]
    assert measured.passed == minimum, measured
