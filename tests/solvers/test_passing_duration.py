"""The duration in which limits hold is found, from swings of its own if need be, and bracketed by one that fails."""

from types import SimpleNamespace

import numpy as np
import pytest
from test_relaxation import DT, swing_up

import planner
from planner import Status
from planner.solvers.passing_duration import LENGTHENINGS, PRECISION, SWING_LENGTHENINGS, find_passing_duration
from planner.solvers.work import work_of_stage


@pytest.fixture(scope="module")
def weak():
    return planner.solve(swing_up(2.0, 5.0))


def test_a_longer_time_has_room_for_more_swings():
    """A tenth of the torque that holds the pendulum takes more swings than any branch of 5 s has."""
    record = planner.solve(swing_up(5.0, 1.0)).options["relaxation"]
    assert planner.solve(swing_up(record["duration"] + DT, 1.0)).success
    tried = [(step[2], step[6]) for step in record["steps"] if step[0] == "duration" and step[1] == 1.0]
    passed = [duration for duration, kept in tried if kept]
    failed = [duration for duration, _ in tried if duration < min(passed)]
    assert passed == sorted(passed, reverse=True)
    assert np.isclose(record["duration"], min(passed))
    assert min(passed) / max(failed) < PRECISION + 0.1 / 5.0  # durations are whole tenths of a second


@pytest.mark.parametrize("limit", [2.07, 2.5, 3.6, 9.0])
def test_the_duration_found_is_within_the_precision_of_one_that_fails(limit):
    """Every duration below `limit` fails, every other one passes; from 4.3 s on swings find it."""
    tried, found = list[float](), list[float]()

    def in_duration(problem, s, plan):
        tried.append(problem.duration)
        return (0.0, SimpleNamespace(problem=problem)) if problem.duration >= limit else (s, plan)

    def from_swings(problem):
        return in_duration(problem, 0.5, None)[1]

    find_passing_duration(
        swing_up(2.0, 5.0), 0.5, SimpleNamespace(), in_duration, from_swings, lambda one, _: found.append(one)
    )
    assert found == sorted(found, reverse=True)
    assert limit <= found[-1] < PRECISION * limit + 0.1
    assert len(tried) <= len(LENGTHENINGS) + len(SWING_LENGTHENINGS) + 5


def test_no_duration_is_named_where_none_passes():
    found = list[float]()
    find_passing_duration(
        swing_up(2.0, 5.0), 0.5, None, lambda _, s, plan: (s, plan), lambda _: None, lambda one, _: found.append(one)
    )  # fmt: skip
    assert not found


def test_a_duration_that_was_found_is_said_though_the_work_ends_the_search_of_shorter_ones(weak):
    """The work of the steps up to the first duration that passes, and two iterations more."""
    problem, steps = swing_up(2.0, 5.0), weak.options["relaxation"]["steps"]
    first = next(k for k, step in enumerate(steps) if step[0] == "duration" and step[1] == 1.0 and step[6])
    assert first < len(steps) - 1
    iterations = sum(step[4] for step in steps[: first + 1]) + 2
    plan = planner.solve(problem, budget=iterations * problem.N * work_of_stage(problem))
    record = plan.options["relaxation"]
    assert plan.status is Status.INFEASIBLE
    assert np.isclose(record["duration"], steps[first][2])
