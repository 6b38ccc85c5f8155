"""Where steps converge slowly, the last ones tell where they lead; a guess that costs more leaves no trace."""

import numpy as np
import pytest

import planner
from planner.solvers.step_control import AndersonAcceleration

CASES = ("two-link", "high-dive")


@pytest.fixture(scope="module", params=[CASES[0], pytest.param(CASES[1], marks=pytest.mark.slow)])
def problem(request):
    return planner.cases.build(request.param)


@pytest.fixture(scope="module")
def slow(problem):
    with pytest.MonkeyPatch.context() as patch:
        return plain(patch, problem)


def plain(monkeypatch, problem, **options):
    """The plan of steps alone."""
    with monkeypatch.context() as without:
        without.setattr(AndersonAcceleration, "extrapolate", lambda _, cost, after, step, expected: after)
        return planner.solve(problem, **options)


def test_slow_steps_need_fewer(problem, slow):
    fast = planner.solve(problem)
    assert slow.success
    assert fast.success
    assert fast.nit < slow.nit
    # Both ended where less than 1e-10 of the cost is promised, and Gauss and Newton's promise is off by some factor.
    assert fast.cost == pytest.approx(slow.cost, rel=1e-8)


def test_a_guess_that_costs_more_leaves_no_trace(monkeypatch, problem, slow):
    """The next step begins where the last one led, to the last bit."""
    tried = []

    def astray(self, us, step):
        tried.append(step)
        return np.zeros((us[0] + 1, self._space.ndx)), np.full(us, 1e4)

    monkeypatch.setattr(AndersonAcceleration, "_point", astray)
    after = planner.solve(problem)
    assert tried
    assert after.nit == slow.nit
    for one, other in ((after.xs, slow.xs), (after.us, slow.us), (after.K, slow.K)):
        np.testing.assert_array_equal(one, other)


def test_open_loop_updates_are_the_papers(monkeypatch, problem):
    slow = plain(monkeypatch, problem, update="open-loop", max_iterations=10)
    np.testing.assert_array_equal(slow.us, planner.solve(problem, update="open-loop", max_iterations=10).us)
