"""Time as an unknown: against bang-bang motions, closed forms, and switching times found without a solver of ours."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from carts import arm, cart, write
from scipy.optimize import root

import planner
from planner import Limits, cases
from planner.costs import with_objective
from planner.problem.plan import Status
from planner.proof.diagnostics import suggested_fixes
from planner.solvers import free_time, other_guesses
from planner.solvers.free_time import retimed
from planner.solvers.work import WorkBudget


def test_a_cart_in_least_time_is_bang_bang():
    """1 m with 1 N and 1 kg: 2 s, first all forward, then all back. A goal met to 1e-4 m may save 1e-4 s."""
    plan = planner.solve_for(cart(control=1.0), "time", durations=(0.5, 8.0))
    assert plan.success
    assert plan.t[-1] == pytest.approx(2.0, rel=1e-3)
    assert np.mean(np.abs(plan.us) > 0.999) > 0.95
    assert np.all(plan.us[:24] > 0.99)
    assert np.all(plan.us[-24:] < -0.99)
    assert plan.problem.limits.final == "exact"
    assert plan.cost == pytest.approx(0.5 * plan.dt * np.sum(plan.us**2) + plan.t[-1], rel=1e-3)


def test_a_plan_that_leaves_its_limits_between_the_knots_took_too_little_time(monkeypatch):
    """It is within them at the knots, and its status says that it is not."""

    def leaves(problem, **options):
        plan = planner.solve(problem, **options)
        return replace(plan, status=planner.Status.OUTSIDE_LIMITS) if plan.t[-1] < 2.4 else plan

    monkeypatch.setattr(free_time, "solve", leaves)
    plan = planner.solve_for(cart(control=1.0), "time", durations=(0.5, 8.0))
    assert plan.success
    assert plan.t[-1] == pytest.approx(2.4, rel=5e-3)


@pytest.mark.parametrize("weight", [0.5, 2.0])
def test_time_against_effort(weight):
    """1/2 int u^2 is 6 d^2 / T^3 with the best force, a line in time: w T + 6 / T^3 is least at T = (18 / w)^(1/4)."""
    plan = planner.solve_for(cart(), {"effort": 1.0, "time": weight}, durations=(0.5, 8.0))
    best = (18.0 / weight) ** 0.25
    assert plan.t[-1] == pytest.approx(best, rel=2e-3)
    assert plan.cost == pytest.approx(weight * best + 6.0 / best**3, rel=1e-3)


@pytest.mark.slow
def test_the_arm_in_least_time():
    """Not later than the extremal with three switches, found by root finding alone, and on a bound in every stage."""
    problem = arm(50, control=10.0)
    dynamics = problem.dynamics

    def end(switches):
        shoulder, down, up, last = switches
        cuts, x = sorted([0.0, shoulder, down, up, last]), problem.x0
        for begin, stop in pairwise(cuts):
            middle = 0.5 * (begin + stop)
            u = np.array([10.0 if middle < shoulder else -10.0, 10.0 if down < middle < up else -10.0])
            for _ in range(20):
                x = dynamics.step(x[None], u[None], np.array([(stop - begin) / 20]))[0]
        return x - problem.cost.x_ref[-1]

    found = root(end, [0.5, 0.12, 0.54, 0.74])
    assert found.success
    plan = planner.solve_for(problem, "time", durations=(0.3, 2.0))
    assert plan.success
    assert 0.98 * found.x[-1] < plan.t[-1] < 1.003 * found.x[-1]  # more switches save less than a percent
    on_bound = np.abs(plan.us) > 0.999 * 10.0
    assert on_bound.any(axis=1).mean() > 0.95
    assert np.abs(plan.us).max() <= 10.0


def test_files_of_free_time(tmp_path):
    plan = planner.solve_for(arm(20), {"effort": 1.0, "time": 4.0}, durations=(1.0, 3.0))
    back = planner.load_plan(plan.save(tmp_path / "plan.npz"))
    assert back.problem.duration == pytest.approx(plan.t[-1], rel=1e-12)
    assert back.problem.cost.value(back.xs, back.us) == pytest.approx(plan.cost, rel=1e-12)
    assert back.options["tried"][0][0] == 2.0  # the problem's own duration comes first


def test_another_duration_is_the_same_integral():
    """Of a case made anew and of one taken apart."""
    problem = cases.two_link(horizon=20)
    for one in (problem, replace(problem, x0=np.array([0.1, 0.0, 0.0, 0.0]))):
        slow = retimed(one, 4.0)
        assert slow.duration == pytest.approx(4.0)
        assert slow.cost.R[0] == pytest.approx(2.0 * one.cost.R[0])
        np.testing.assert_array_equal(slow.cost.Q[-1], one.cost.Q[-1])
        np.testing.assert_array_equal(slow.x0, one.x0)
    assert retimed(problem, 4.0).case == "two-link"


def test_another_duration_of_a_file_makes_no_guess_of_its_own(tmp_path, monkeypatch):
    """It takes over the first one's; making it took nine tenths of a search of 8,000 stages. The recipe stays."""
    problem = planner.load_problem(write(tmp_path))
    with monkeypatch.context() as patch:
        patch.setattr("planner.solvers.other_guesses._regulator", None)  # a call would be an error
        slow = retimed(problem, 2.0)
    np.testing.assert_array_equal(slow.first_guess, problem.first_guess)
    assert slow.recipe.parameters["guess"] == problem.recipe.parameters["guess"]
    again = slow.recipe.rebuilt()
    assert (again.duration, again.N) == (pytest.approx(2.0), problem.N)


def test_a_long_line_is_linearized_at_most_a_hundred_times(tmp_path, monkeypatch):
    """And a short one every ten stages."""
    problem, calls, own = planner.load_problem(write(tmp_path)), [], other_guesses._regulator
    monkeypatch.setattr(other_guesses, "_regulator", lambda *given: calls.append(given) or own(*given))
    for N, expected in ((50, 5), (3000, 100)):
        long = problem.recipe.rebuilt(dt=1.0 / N, guess="zero")
        calls.clear()
        assert other_guesses.line_tracking_controls(long, long.cost.x_ref[-1]) is not None
        assert len(calls) == expected


def test_too_short_a_time_is_said():
    plan = planner.solve_for(replace(cart(control=1.0), limits=Limits(control=1.0)), "time", durations=(0.5, 1.0))
    assert not plan.success
    assert plan.t[-1] == pytest.approx(1.0)


def test_a_search_that_its_work_cuts_says_what_to_write():
    """The plan is the best so far; the status, the record and the advice are those of the budget."""
    whole = planner.solve_for(arm(20), {"effort": 1.0, "time": 4.0}, durations=(1.0, 3.0))
    budget = WorkBudget(2e-3)
    cut = planner.solve_for(arm(20), {"effort": 1.0, "time": 4.0}, durations=(1.0, 3.0), budget=budget)
    assert len(cut.options["tried"]) < len(whole.options["tried"])
    assert cut.status is Status.WORK_LIMIT
    assert cut.options["work"] == 2e-3
    assert "search_cut" in [one.code for one in suggested_fixes(cut)]
    assert {one.key for one in suggested_fixes(cut)}.isdisjoint({"starts", "duration"})


@pytest.mark.parametrize("stop", [KeyboardInterrupt, StopIteration])
@pytest.mark.parametrize("objective", ["time", {"effort": 1.0, "time": 2.0}], ids=["time", "effort and time"])
def test_a_search_that_is_interrupted_returns_the_best_plan_so_far(objective, stop):
    """Of three trials, from 4 s on and shorter each time, the third is the best: of effort and time 1.73 s are."""
    trials = []

    def callback(line):
        trials.append(line)
        if len(trials) == 3:
            raise stop

    plan = planner.solve_for(cart(control=5.0), objective, durations=(0.5, 8.0), callback=callback)
    assert plan.status is Status.INTERRUPTED
    assert plan.t[-1] == pytest.approx(trials[1].duration)  # the third is not judged any more
    assert len(plan.options["tried"]) == 3
    assert plan.message == Status.INTERRUPTED.value


def test_ctrl_c_in_the_free_solve_before_the_first_trial_ends_the_search(monkeypatch):
    """That solve only gives a first guess: its plan is a motion of the problem without limits."""
    solved = []

    def interrupted(problem, **options):
        solved.append(problem)
        return replace(planner.solve(problem, max_iterations=1), status=Status.INTERRUPTED)

    monkeypatch.setattr(free_time, "solve", interrupted)
    plan = planner.solve_for(cart(control=5.0), "time", durations=(0.5, 8.0))
    assert plan.status is Status.INTERRUPTED
    assert [one.limits for one in solved] == [None]
    assert plan.problem.limits.final == "exact"


def test_a_search_keeps_the_smoothing_that_an_objective_has():
    """Another objective has its own, from the plan of least effort."""
    weights = {"energy": 1.0, "effort": 1.0, "time": 2.0}
    problem = with_objective(cart(), weights | {"smoothing": 0.03})
    for plan in (planner.solve(problem), planner.solve_for(with_objective(cart(), {"energy": 1.0, "smoothing": 0.03}))):
        assert plan.problem.objective.smoothing == 0.03
    assert planner.solve_for(problem, weights, tolerance=0.1).problem.objective.smoothing != 0.03
