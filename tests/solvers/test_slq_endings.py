"""Every way in which a solve can end is told rightly, with a plan that is whole."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from solves import (
    Plain,
    assert_consistent,
    assert_stationary,
    each_engine,
    engines,
    every_way,
    flight,
    hopper,
    pendulum,
    same_bits,
    stop_at,
    swing,
)

import planner
from planner import FunctionDynamics, Problem, Status, TrackingCost
from planner.costs import Quadratic
from planner.dynamics import HopperDynamics
from planner.solvers.options import UPDATES

# How a solve ends


@each_engine
@pytest.mark.parametrize("error", [KeyboardInterrupt, StopIteration])
@pytest.mark.parametrize("count", [1, 3])
def test_interrupted_plans_are_whole(engine, error, count):
    problem = engines()[engine]
    plan = planner.solve(problem, callback=stop_at(count, error))
    assert plan.status is Status.INTERRUPTED
    assert not plan.success
    assert plan.nit == count
    assert_consistent(problem, plan)
    same = planner.solve(problem, max_iterations=count)
    np.testing.assert_array_equal(plan.us, same.us)
    np.testing.assert_array_equal(plan.K, same.K)
    assert plan.history == same.history


@each_engine
def test_iterations_that_gain_little_are_an_end(engine):
    """Two in a row, below what solve or the problem itself says; the plan is whole, and at 0 never."""
    problem = engines()[engine]
    most = planner.solve(problem)
    plan = planner.solve(
        problem, actual_reduction_tolerance=1e3, expected_reduction_tolerance=0.0, gradient_tolerance=0.0
    )
    assert plan.status is Status.CONVERGED
    assert plan.nit == 2 < most.nit
    assert_consistent(problem, plan)
    same = planner.solve(
        replace(problem, actual_reduction_tolerance=1e3), expected_reduction_tolerance=0.0, gradient_tolerance=0.0
    )
    np.testing.assert_array_equal(plan.us, same.us)
    np.testing.assert_array_equal(plan.K, planner.solve(problem, max_iterations=2).K)


def test_other_errors_of_a_callback_are_the_users():
    with pytest.raises(ZeroDivisionError):
        planner.solve(hopper(), callback=lambda line: 1 / 0)
    same_bits(planner.solve(hopper()), planner.solve(hopper()))


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 900), st.sampled_from(UPDATES))
def test_ctrl_c_anywhere_leaves_states_and_controls_together(call, update):
    """Ctrl-C lands in the user's own function, wherever the solve may be."""
    calls, countdown = [0], [0]

    def f(x, u):
        calls[0] += 1
        if calls[0] == countdown[0]:
            raise KeyboardInterrupt
        return pendulum(x, u)

    problem = Problem(
        FunctionDynamics(f, 2, 1, 0.05), TrackingCost.reach([3.0, 0.0], 12, final=50.0, effort=1.0), [0.0, 0.0]
    )
    # After the first rollout (RK4 calls f four times a stage) there is a trajectory to keep.
    calls[0], countdown[0] = 0, 4 * problem.N + call
    plan = planner.solve(problem, update=update)
    interrupted, countdown[0] = calls[0] >= countdown[0], 0
    assert plan.status is (Status.INTERRUPTED if interrupted else Status.CONVERGED)
    assert_consistent(problem, plan)


@pytest.mark.parametrize(
    "problem",
    [
        # The square of 1e307 in/s is beyond the largest double.
        Problem(HopperDynamics(1.0, "euler"), flight(0, 200).cost, [0.0, 0.0, 1e307]),
        Problem(
            FunctionDynamics(lambda x, u: x**3 + 0.0 * u, 1, 1, 1.0, "euler"),
            TrackingCost.reach([0.0], 60, final=1.0, effort=1.0),
            [2.0],
        ),
    ],
    ids=["compiled", "numpy"],
)
def test_a_motion_that_runs_away_under_all_controls(problem):
    lines = []
    plan = planner.solve(problem, callback=lines.append)
    assert plan.status is Status.NOT_FINITE
    assert not np.isfinite(plan.cost)
    assert np.isnan(plan.gradient_norm)
    assert plan.history == ()
    assert plan.nit == 0
    assert lines == []
    np.testing.assert_array_equal(plan.us, problem.us)
    np.testing.assert_array_equal(plan.xs[0], problem.x0)
    assert plan.K.shape == (problem.N, problem.dynamics.nu, problem.dynamics.nx)
    assert not plan.K.any()


def test_a_first_guess_that_runs_away_from_an_own_cost():
    """The compiled hopper with a user's cost: the ending must not depend on the engine."""
    cost = Plain(flight(0, 200).cost)
    problem = Problem(HopperDynamics(1.0, "euler"), cost, [0.0, 0.0, 1e307], horizon=200)
    assert planner.solve(problem).status is Status.NOT_FINITE


@pytest.mark.parametrize("update", UPDATES)
def test_candidates_that_run_away_are_passed_over(update):
    """dx/dt = x^3 + u explodes for large steps: the search shortens them and the solve converges."""
    dynamics = FunctionDynamics(lambda x, u: x**3 + u, 1, 1, 0.1, "rk4")
    cost = TrackingCost.reach([1.2], 30, final=1e4, effort=1.0, dt=0.1)
    problem = Problem(dynamics, cost, [0.2], np.full((30, 1), -0.3))
    plan = planner.solve(problem, update=update)
    assert plan.success
    assert min(h.step for h in plan.history[:-1]) < 1.0
    assert_consistent(problem, plan)


class Lying(Plain):
    """Its gradients point uphill."""

    def quadratize(self, xs, us):
        model = self._cost.quadratize(xs, us)
        return Quadratic(model.Q, -model.q, model.R, -model.r)


class Flat(Plain):
    """Its gradients promise what the value does not know of."""

    def value(self, xs, us):
        return 1.0


# Armijo and Goldstein go on for ever where a step that gains nothing, not a digit, is taken.
@every_way
@pytest.mark.parametrize("cost", [Lying, Flat])
def test_a_lying_gradient_ends_in_no_descent(cost, update, line_search):
    honest = swing("euler", N=5)
    problem = Problem(honest.dynamics, cost(honest.cost), honest.x0, np.full((5, 1), 0.5), horizon=5)
    plan = planner.solve(problem, update=update, line_search=line_search, max_iterations=100)
    assert plan.status is Status.NO_DESCENT
    assert "check the derivatives" in plan.message
    # No step was taken, or one that rounding took for a gain of the last digit.
    np.testing.assert_allclose(plan.us, problem.us, rtol=0, atol=1e-9)
    assert plan.cost == pytest.approx(plan.history[0].cost, rel=1e-14)
    assert np.isfinite(plan.K).all()
    if cost is Flat:  # there is no digit to gain, and every line raises the regularization tenfold
        assert all(h.step == 0.0 and h.actual == 0.0 for h in plan.history)
        np.testing.assert_allclose(np.diff(np.log10([h.regularization for h in plan.history[1:-1]])), 1.0, rtol=1e-9)


@pytest.mark.parametrize("update", UPDATES)
def test_a_solve_that_gains_nothing_more_ends(update):
    """With tolerances below rounding: no line of the table has a step that did not lower the cost."""
    plan = planner.solve(hopper("paper 50"), update=update, gradient_tolerance=1e-12, expected_reduction_tolerance=0.0)
    assert all(h.actual > 0.0 for h in plan.history if h.step > 0.0)
    assert plan.status is not Status.MAX_ITERATIONS


class Wavy:
    """1 - cos(u) in place of u^2 / 2, with its true Hessian cos(u): indefinite beyond a quarter turn."""

    def value(self, xs, us):
        return float(np.sum(1.0 - np.cos(us)) + 0.05 * np.sum(xs**2))

    def quadratize(self, xs, us):
        N = len(us)
        Q = np.full((N + 1, 1, 1), 0.1)
        return Quadratic(Q, 0.1 * xs, np.cos(us)[:, :, None], np.sin(us))


@pytest.mark.parametrize("update", UPDATES)
@pytest.mark.parametrize(
    "guess",
    [
        [0.3, 2.0, 0.3, 2.0, 0.3],  # some stages indefinite
        [2.0] * 5,  # all: the largest entry of R is negative
        [np.pi / 2] * 5,  # R = 0
    ],
    ids=["some", "all", "zero"],
)
def test_an_indefinite_control_weight_is_regularized(guess, update):
    dynamics = FunctionDynamics(lambda x, u: u - x, 1, 1, 0.1, "euler")
    problem = Problem(dynamics, Wavy(), [1.0], np.array(guess)[:, None], horizon=5)
    plan = planner.solve(problem, update=update)
    assert plan.success
    assert_stationary(problem, plan)
    assert_consistent(problem, plan)  # its gains are those of the plain model
    lines = plan.history
    if min(np.cos(guess)) < -0.1:  # B'PB is of the order dt^2, and does not help
        assert lines[0].step == 0.0
        assert max(h.regularization for h in lines) > 0.0
    assert all(h.actual > 0.0 for h in lines if h.step > 0.0)


RUBBING = """
<mujoco><default><geom contype="0" conaffinity="0"/></default><worldbody><body>
  <joint name="shoulder" axis="0 1 0" damping="0.2" frictionloss="3" range="-143 143"/>
  <geom type="capsule" size="0.03" fromto="0 0 0 0.4 0 0" mass="2"/>
  <body pos="0.4 0 0">
    <joint name="elbow" axis="0 1 0" damping="0.1" frictionloss="1" range="-138 138"/>
    <geom type="capsule" size="0.03" fromto="0 0 0 0.3 0 0" mass="1"/> <geom size="0.03" pos="0.3 0 0" mass="1"/>
  </body></body></worldbody>
<actuator><motor joint="shoulder" ctrlrange="-40 40"/><motor joint="elbow" ctrlrange="-15 15"/></actuator></mujoco>
"""


def test_friction_between_two_signs_is_no_end(tmp_path):
    """Some steps gain little while joints turn from one sign of friction to the other, and full ones follow."""
    (tmp_path / "arm.xml").write_text(RUBBING)
    file = 'model = "arm.xml"\nstart = { shoulder = 1.5 }\ngoal = { shoulder = -1.0, elbow = 1.5 }\nduration = 1.0\n'
    (tmp_path / "arm.toml").write_text(file)
    problem = planner.load_problem(tmp_path / "arm.toml")
    plan = planner.solve(problem)
    assert plan.success
    assert plan.cost < 1.001 * planner.solve(problem, actual_reduction_tolerance=0.0).cost
    assert plan.nit < 100


def test_kinks_of_friction_at_control_limits_are_not_regularized(tmp_path):
    """With a weight on changes of the states it took 232 iterations to the same cost: slow ones end no solve then."""
    weak = RUBBING.replace("-40 40", "-12 12").replace("-15 15", "-4.5 4.5")  # 0.3 of them, which bind
    (tmp_path / "arm.xml").write_text(weak)
    file = 'model = "arm.xml"\nstart = { shoulder = 1.5 }\ngoal = { shoulder = -1.0, elbow = 1.5 }\nduration = 1.0\n'
    (tmp_path / "arm.toml").write_text(file)
    problem = planner.load_problem(tmp_path / "arm.toml")
    plan = planner.solve(problem, planner.SolverOptions(homotopy=False))
    assert plan.converged
    assert np.any(problem.bounds.upper - plan.us < 1e-9)
    assert max(line.regularization for line in plan.history) == 0.0
    assert plan.nit < 100
    assert plan.cost == pytest.approx(0.88711, rel=1e-3)  # that of the 232
