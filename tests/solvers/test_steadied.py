"""First guesses that run away, and gradients that are not finite."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import planner
from planner import FunctionDynamics, Mechanism, Problem, RigidBodyDynamics, Status, TrackingCost
from planner.dynamics.step_stability import fastest_mode, substeps_of
from planner.problem.limits import Limits
from planner.solvers.gains import feedback_rollout
from planner.solvers.other_guesses import has_diverged, stabilizing_guess

CART = """
<mujoco><option gravity="0 0 -9.81" timestep="0.001" integrator="RK4"/><worldbody>
  <body><joint name="cart" type="slide" axis="1 0 0" damping="0.1"/>
    <inertial mass="1" pos="0 0 0" diaginertia=".1 .1 .1"/>
    <body><joint name="pole" axis="0 1 0"/><inertial mass=".5" pos="0 0 .5" diaginertia=".01 .01 .01"/></body></body>
  </worldbody>
  <actuator><general joint="cart" gainprm="1" biastype="affine" biasprm="{bias}"/></actuator></mujoco>
"""
UPRIGHT = np.zeros(4)
MACHINES = {  # bias of the cart's actuator, start; each falls or drifts away under the controls that hold its start
    "pushed away, upright": ("0 400 0", np.array([1e-3, 0.0, 0.0, 0.0])),
    "negative damping, leaning": ("0 0 20", np.array([0.0, 0.3, 0.0, 0.0])),
    "both, moving": ("0 50 5", np.array([0.0, 0.1, 0.5, 0.0])),
}


def moved(bias, x0, duration=5.0, dt=0.02, substeps=1, **rest):
    dynamics, N = (
        RigidBodyDynamics(Mechanism.from_mjcf(CART.format(bias=bias)), dt, substeps=substeps),
        round(duration / dt),
    )
    goal = np.array([0.5, np.pi * np.round(x0[1] / np.pi), 0.0, 0.0])  # upright or hanging, as the start
    cost = TrackingCost.joints(dynamics, goal, N, effort=0.01, final_position=1e6, final_velocity=1e6)
    return Problem(dynamics, cost, x0, **rest)


@pytest.mark.parametrize("name", MACHINES)
def test_a_machine_that_runs_away_from_its_start_is_held(name):
    problem = moved(*MACHINES[name])
    cost, _ = feedback_rollout(problem, problem.first_guess)
    assert not cost < 1e20  # the guess is as bad as it is said to be
    plan = planner.solve(problem)
    assert plan.success
    assert plan.options["first_guess"].startswith("It runs away at t = ")
    np.testing.assert_allclose(plan.xs[-1], [0.5, 0.0, 0.0, 0.0], atol=1e-2)
    again = planner.solve(problem)
    np.testing.assert_array_equal(again.us, plan.us)


def test_a_given_guess_that_runs_away_is_replaced():
    quiet = moved("0 0 0", UPRIGHT, 1.0)
    plan = planner.solve(replace(quiet, us=np.full((quiet.N, 1), 1e200)))
    assert plan.success
    assert "replaced" in plan.options["first_guess"]
    assert "first_guess" not in planner.solve(quiet).options


def test_of_several_starts_those_on_a_line_do_not_run_away():
    plan = planner.solve(moved(*MACHINES["pushed away, upright"]), starts=2)
    assert plan.success
    assert [start.status for start in plan.starts] == [planner.Status.NOT_FINITE, planner.Status.CONVERGED]


def test_all_of_several_starts_run_away(monkeypatch):
    monkeypatch.setattr("planner.solvers.slq.line_to_the_end", lambda problem: None)
    problem = moved(*MACHINES["pushed away, upright"])
    plan = planner.solve(problem, starts=2)
    assert plan.success
    assert len(plan.starts) == 2
    assert "first_guess" in plan.options


def test_the_new_guess_stays_within_bounds():
    problem = replace(moved("0 50 5", np.array([0.0, 0.1, 0.0, 0.0]), 3.0), limits=Limits(control=(-30.0, 30.0)))
    us = stabilizing_guess(problem)
    assert us is not None
    assert np.abs(us).max() <= 30.0
    assert feedback_rollout(problem, us)[0] < 1e6


def test_ranges_of_states_do_not_hide_a_guess_that_runs_away():
    problem = moved(*MACHINES["pushed away, upright"], limits=Limits(position={"cart": (-1.0, 1.0)}))
    plan = planner.solve(problem)
    assert plan.success
    assert np.abs(plan.xs[:, 0]).max() <= 1.0 + Limits.tolerance


def test_own_dynamics_are_held_too():
    dynamics = FunctionDynamics(lambda x, u: x**3 + u, 1, 1, 0.1, "euler")
    problem = Problem(dynamics, TrackingCost.reach([0.0], 60, final=1.0, effort=1.0), [2.0])
    assert planner.solve(problem).success


def test_a_motion_that_no_control_reaches_is_not_held():
    dynamics = FunctionDynamics(lambda x, u: x**3 + 0.0 * u, 1, 1, 0.1, "euler")
    assert stabilizing_guess(Problem(dynamics, TrackingCost.reach([0.0], 60, final=1.0, effort=1.0), [2.0])) is None


def test_large_units_are_no_runaway():
    xs = np.array([[1.5e11, 0.0], [1.6e11, 3e4]])  # m and m/s of a planet
    assert not has_diverged(xs).any()
    assert has_diverged(np.array([[1.0, 0.0], [np.nan, 0.0], [0.0, 1e11]])).tolist() == [False, True, True]


@pytest.mark.parametrize("duration", [2.0, 8.0])
def test_stages_too_long_for_a_servo_never_end_converged(duration):
    """kv / m = 400 per s at stages of 0.02 s: RK4 multiplies by 170 at each, and costates overflow."""
    still = moved("0 -2000 -400", np.array([0.0, np.pi, 0.0, 0.0]), duration)
    plan = planner.solve(still, max_iterations=20)
    assert plan.status is Status.NOT_FINITE or np.isfinite(plan.gradient_norm)
    assert not (plan.success and not np.isfinite(plan.gradient_norm))
    assert "more substeps" in Status.NOT_FINITE.value
    followed = planner.solve(moved("0 -2000 -400", np.array([0.0, np.pi, 0.0, 0.0]), duration, substeps=5))
    assert followed.success
    assert np.isfinite(followed.gradient_norm)


def test_a_solve_whose_gradient_overflows_is_not_finite():
    still = moved("0 -2000 -400", np.array([0.0, np.pi, 0.0, 0.0]), 8.0)
    plan = planner.solve(replace(still, us=np.zeros((still.N, 1))), max_iterations=5)
    assert not np.isfinite(plan.gradient_norm)
    assert plan.status is Status.NOT_FINITE
    m = still.dynamics.mechanism
    found = fastest_mode(m, [still.x0, m.home])
    expected = f'expected integrator="rk4", substeps={substeps_of(found, still.dynamics.dt)}.'
    assert (
        plan.options["not_finite"] == f"cart has a rate of {found.rate:.4g} per s and a step takes 0.02 s, {expected}"
    )


ROD = """<mujoco><worldbody><body><joint name="hinge" axis="0 1 0"/>
  <inertial mass="1" pos="0 0 0.3" diaginertia="0.01 0.01 0.01"/></body></worldbody>
  <actuator><motor joint="hinge"/></actuator></mujoco>"""


@pytest.mark.parametrize("limits", [None, Limits(control=20.0)], ids=["free", "bounded"])
def test_a_long_motion_that_only_feedback_makes_stable_converges(limits):
    """The rod's errors grow by 5.4 per s: open-loop costates (Eq. 19) overflow over 200 s, the LQ problem's do not."""
    dynamics, N = RigidBodyDynamics(Mechanism.from_mjcf(ROD), 0.02), 10_000
    goal = np.array([0.3, 0.0])
    cost = TrackingCost.joints(dynamics, goal, N, effort=0.1, position=1.0, final_position=1e4, final_velocity=1e4)
    plan = planner.solve(Problem(dynamics, cost, np.zeros(2), limits=limits))
    assert plan.status is Status.CONVERGED
    assert not np.isfinite(plan.gradient_norm)
    assert np.isfinite(plan.K).all()
    np.testing.assert_allclose(plan.xs[-1], goal, atol=1e-3)
