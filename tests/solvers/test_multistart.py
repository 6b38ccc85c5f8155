"""Several starts: the best of them is the plan, whatever ends first, and every way out leaves a whole plan."""

import gc
import itertools
import os
import signal
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from solves import assert_consistent, each_engine, engines, hopper, judged, same_bits, stop_at, wells

import planner
from planner import FunctionDynamics, PlannerError, Problem, Status
from planner.problem.plan import Start
from planner.solvers import multistart
from planner.solvers.multistart import smooth


def test_a_better_minimum_is_found():
    alone, plan = planner.solve(wells()), planner.solve(wells(), starts=8, spread=3.0)
    assert alone.success
    assert alone.xs[-1, 0] > 0.9
    assert plan.success
    assert plan.xs[-1, 0] < -0.9
    assert plan.cost < alone.cost - 1.0
    assert plan.start > 0
    assert len(plan.starts) == 8
    assert plan.starts[0] == Start(0, alone.status, alone.cost, alone.nit, alone.cost)
    assert plan.starts[plan.start] == Start(plan.start, plan.status, plan.cost, plan.nit, plan.cost)
    assert plan.cost == min(start.cost for start in plan.starts if start.status is Status.CONVERGED)
    assert_consistent(wells(), plan)


@each_engine
def test_each_start_is_a_solve_of_its_own(engine):
    """The numbers in `starts` are those of single solves from the documented guesses; scale is the guess's RMS."""
    honest = engines()[engine]
    guess = planner.solve(honest).us  # of its final size: the pilot's iterations do not exceed it much
    problem = replace(honest, us=2.0 * guess)
    pilot = planner.solve(problem, max_iterations=5)
    scale = 0.1 * np.sqrt(np.maximum(np.mean(problem.us**2, axis=0), np.mean(pilot.us**2, axis=0)))
    plan = planner.solve(problem, starts=3, seed=5, spread=0.1, update="open-loop")
    for k, start in enumerate(plan.starts):
        change = scale * smooth(np.random.default_rng([5, k]), guess.shape) if k else 0.0
        single = planner.solve(replace(problem, us=problem.us + change), update="open-loop")
        if engine == "numpy":  # whose pilot is the same with either update only where its guess is larger
            scale_agrees = np.all(np.mean(problem.us**2, axis=0) >= np.mean(pilot.us**2, axis=0))
            assert scale_agrees
        assert start.number == k
        assert start.cost == pytest.approx(single.cost, rel=1e-9)


@each_engine
def test_the_same_bits_whatever_ends_first(engine, monkeypatch):
    problem = engines()[engine]
    plans = [planner.solve(problem, starts=5, seed=3) for _ in range(2)]
    monkeypatch.setattr(multistart, "processors", lambda: 1)
    plans.append(planner.solve(problem, starts=5, seed=3))
    for plan in plans[1:]:
        same_bits(plan, plans[0])
        assert plan.starts == plans[0].starts
    more = planner.solve(problem, starts=7, seed=3)
    assert more.starts[:5] == plans[0].starts  # a start depends on the seed and its own number alone
    assert planner.solve(problem, starts=5, seed=4).starts[1:] != plans[0].starts[1:]


def test_one_start_is_the_plain_solve():
    same_bits(planner.solve(hopper(), starts=1, seed=7), planner.solve(hopper()))
    assert planner.solve(hopper()).starts == ()


def test_the_callback_gets_each_start_in_order():
    lines = []
    plan = planner.solve(wells(), starts=6, callback=lines.append)
    assert tuple(lines) == plan.starts
    assert [start.number for start in lines] == list(range(6))


def test_lines_stand_under_their_header():
    header, line = Start.header(), str(Start(12, Status.CONVERGED, -1.2345678e-100, 1000, 0.0))
    for word, end in (("start", "12"), ("cost", "-1.2345678e-100"), ("iterations", "1000")):
        assert header.index(word) + len(word) == line.index(end) + len(end)
    assert header.index("status") == line.index("CONVERGED")


# Ranking


GOOD, SLOW, WILD, STUCK = Status.CONVERGED, Status.MAX_ITERATIONS, Status.NOT_FINITE, Status.NO_DESCENT


@pytest.mark.parametrize(
    ("outcomes", "best"),
    [
        ([(GOOD, 3.0), (GOOD, 2.0), (GOOD, 4.0)], 1),
        ([(GOOD, 3.0), (SLOW, 1.0), (GOOD, 2.5)], 2),  # what has not converged does not count
        ([(SLOW, 3.0), (STUCK, 1.0), (WILD, np.inf)], 1),  # unless nothing has
        ([(WILD, np.nan), (WILD, -np.inf), (SLOW, 9.0)], 2),
        ([(GOOD, 2.0), (GOOD, 2.0), (GOOD, 2.0)], 0),  # ties go to the first
        ([(WILD, np.inf), (WILD, np.inf)], 0),
    ],
)
@pytest.mark.parametrize("backwards", [False, True])
def test_the_best_is_converged_and_cheapest(outcomes, best, backwards):
    delays = [0.02 * (len(outcomes) - k if backwards else k) for k in range(len(outcomes))]
    plan = judged(outcomes, delays=delays)
    assert plan.start == best
    assert plan.status is outcomes[best][0]
    np.testing.assert_equal(plan.cost, outcomes[best][1])
    np.testing.assert_equal([start[1:3] for start in plan.starts], outcomes)


# Changes of the guess


@pytest.mark.parametrize("N", [1, 3, 50])
def test_changes_have_their_size_and_are_smooth(N):
    draws = np.array([smooth(np.random.default_rng([0, k]), (N, 2)) for k in range(2000)])
    assert np.sqrt(np.mean(draws**2)) == pytest.approx(1.0, rel=0.03)
    if N == 50:  # no frequency above the sixth cosine
        steps = np.sqrt(np.mean(np.diff(draws, axis=1) ** 2))
        assert steps < 2.0 * np.sin(np.pi * 5 / 100)


def test_the_size_is_in_the_controls_own_unit():
    """Controls measured in other units: the same starts, and none of them stays at zero."""
    scales = np.array([1.0, 1000.0])

    def made(units):
        dynamics = FunctionDynamics(lambda x, u: np.sin(x) + u / units, 2, 2, 0.2, "rk4")
        cost = planner.TrackingCost.reach([1.0, -2.0], 10, final=10.0, effort=1.0 / units**2)
        return planner.solve(Problem(dynamics, cost, [0.0, 0.0]), starts=4, max_iterations=1)

    for one, two in zip(made(np.ones(2)).starts, made(scales).starts, strict=True):
        assert one.cost == pytest.approx(two.cost, rel=1e-9)


def test_a_control_that_nothing_asks_for_is_tried_too():
    guess, later = np.zeros((5, 3)), np.tile([2.0, 0.0, -4.0], (5, 1))
    np.testing.assert_array_equal(multistart._sizes(guess, later), [2.0, 4.0, 4.0])
    np.testing.assert_array_equal(multistart._sizes(3.0 * later, later), [6.0, 12.0, 12.0])
    np.testing.assert_array_equal(multistart._sizes(guess, guess), [1.0, 1.0, 1.0])


# Ends


@pytest.mark.parametrize("error", [KeyboardInterrupt, StopIteration])
def test_interrupted_by_the_callback(error):
    def f(x, u):
        if threading.current_thread() is not threading.main_thread():
            time.sleep(2e-4)  # so that the starts do not all end before the main thread has its turn
        return u

    plan = planner.solve(wells(f), starts=50, callback=stop_at(2, error))
    assert plan.status is Status.INTERRUPTED
    assert 2 <= len(plan.starts) < 50
    assert_consistent(wells(), plan)
    assert plan.cost == pytest.approx(min(start.cost for start in plan.starts if start.status is Status.CONVERGED))


@pytest.fixture
def no_collection():
    """Python collects no garbage: Hypothesis' callback at a collection loses a signal that comes while it runs."""
    gc.collect()
    gc.disable()
    yield
    gc.enable()


@pytest.mark.parametrize("call", [1, 700])
def test_ctrl_c_while_starts_run(call, no_collection):
    """The signal comes while a thread is in the user's own function; the main thread waits."""
    calls = itertools.count(1)

    def f(x, u):
        if threading.current_thread() is not threading.main_thread() and next(calls) == call:
            os.kill(os.getpid(), signal.SIGINT)
        return u

    problem = wells(f)
    plan = planner.solve(problem, starts=500)
    assert plan.status is Status.INTERRUPTED
    assert 1 <= len(plan.starts) < 500
    assert_consistent(problem, plan)


def test_ctrl_c_before_any_start_has_begun():
    calls, end = itertools.count(1), [np.inf]

    def f(x, u):
        if next(calls) == end[0]:
            raise KeyboardInterrupt
        return u

    problem = wells(f)
    end[0] = next(calls) + problem.N + 1  # after the first rollout there is a trajectory to keep
    plan = planner.solve(problem, starts=3)
    assert plan.status is Status.INTERRUPTED
    assert [start.number for start in plan.starts] == [0]
    assert_consistent(problem, plan)


def test_errors_of_the_dynamics_are_the_users():
    def f(x, u):
        if threading.current_thread() is not threading.main_thread():
            raise ZeroDivisionError
        return u

    with pytest.raises(ZeroDivisionError):
        planner.solve(wells(f), starts=3)


def test_other_errors_of_a_callback_are_the_users():
    with pytest.raises(ZeroDivisionError):
        planner.solve(wells(), starts=30, callback=lambda start: 1 / 0)


def test_guesses_that_run_away_are_ranked_last():
    """The second state asks for nothing at the end, so there is no line to begin with."""

    def f(x, u):
        return np.concatenate([x[..., :1] ** 3 + u, x[..., :1]], axis=-1)

    cost = planner.TrackingCost.reach([1.2, 0.0], 30, final=[1e4, 0.0], effort=1.0, dt=0.1)
    problem = Problem(FunctionDynamics(f, 2, 1, 0.1, "rk4"), cost, [0.2, 0.0], np.full((30, 1), -0.3))
    plan = planner.solve(problem, starts=8, spread=20.0)
    assert plan.success
    assert Status.NOT_FINITE in [start.status for start in plan.starts]


def test_starts_are_in_the_file(tmp_path):
    plan = planner.solve(wells(), starts=3)
    with pytest.warns(UserWarning, match="has the plan without its problem"):
        back = planner.load_plan(plan.save(tmp_path / "plan.npz"))
    assert back.starts == plan.starts
    assert back.start == plan.start


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ({"starts": 0}, "starts is 0, expected a whole number of at least 1."),
        ({"starts": 2.0}, "starts is 2.0, expected a whole number of at least 1."),
        ({"starts": 2, "seed": -1}, "seed is -1, expected a whole number of at least 0."),
        ({"starts": 2, "seed": 1.5}, "seed is 1.5, expected a whole number of at least 0."),
        ({"spread": 0.0}, "spread is 0.0, expected a finite number greater than 0."),
        ({"starts": 2, "spread": "wide"}, "spread is 'wide', expected a finite number greater than 0."),
    ],
)
def test_wrong_starts_and_seeds_are_refused_in_one_sentence(arguments, expected):
    with pytest.raises(PlannerError) as error:
        planner.solve(wells(), **arguments)
    assert str(error.value) == expected
