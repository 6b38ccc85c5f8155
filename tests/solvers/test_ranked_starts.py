"""Several starts ranked by anything of a plan, and by what it costs in MuJoCo."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from solves import judged, same_bits, swing, wells

import planner
from planner import PlannerError, Status
from planner.proof.replays.replaying import proven_cost
from planner.solvers import multistart

GOOD, SLOW = Status.CONVERGED, Status.MAX_ITERATIONS


def coarse():
    """Its stages are so long that its cost says little of what it comes to."""
    return planner.cases.two_link(horizon=20, integrator="euler")


def ranked(costs, rank, statuses=None):
    """The cost of the best of starts that end with these costs."""
    statuses = statuses or [GOOD] * len(costs)
    return judged(list(zip(statuses, costs, strict=True)), rank=rank).cost


def test_the_rank_decides():
    assert ranked([3.0, 2.0, 4.0], None) == 2.0
    assert ranked([3.0, 2.0, 4.0], lambda plan: -plan.cost) == 4.0
    assert ranked([3.0, 2.0, 4.0], lambda plan: 7) == 3.0  # ties go to the first
    assert ranked([3.0, 2.0, 4.0], lambda plan: np.float64(abs(plan.cost - 3.5))) == 3.0


@pytest.mark.parametrize("nothing", [np.nan, np.inf, -np.inf])
def test_ranks_that_are_not_finite_come_last(nothing):
    assert ranked([3.0, 2.0, 4.0], lambda plan: plan.cost if plan.cost > 2.5 else nothing) == 3.0
    assert ranked([3.0, 2.0, 4.0], lambda plan: nothing) == 3.0


def test_the_converged_come_first():
    assert ranked([3.0, 2.0, 4.0], lambda plan: plan.cost, [GOOD, SLOW, GOOD]) == 3.0
    assert ranked([3.0, 2.0, 4.0], lambda plan: -plan.cost, [SLOW, SLOW, SLOW]) == 4.0
    assert ranked([3.0, 2.0], lambda plan: np.inf if plan.cost == 3.0 else 0.0, [GOOD, SLOW]) == 3.0


def test_the_cost_is_the_default():
    plain, named = (planner.solve(wells(), starts=6, spread=3.0, rank=rank) for rank in (None, lambda plan: plan.cost))
    same_bits(plain, named)
    assert "rank" not in plain.options


def test_the_same_bits_whatever_ends_first(monkeypatch):
    plans = [planner.solve(wells(), starts=6, spread=3.0, rank=lambda plan: -plan.cost) for _ in range(2)]
    monkeypatch.setattr(multistart, "processors", lambda: 1)
    plans.append(planner.solve(wells(), starts=6, spread=3.0, rank=lambda plan: -plan.cost))
    for plan in plans[1:]:
        same_bits(plan, plans[0])
        assert plan.starts == plans[0].starts
    assert plans[0].cost == max(start.cost for start in plans[0].starts if start.status is GOOD)


def test_an_interruption_while_ranking_leaves_a_plan():
    def rank(plan):
        if plan.cost < 2.5 and not asked:
            asked.append(plan)
            raise KeyboardInterrupt
        return plan.cost

    asked = []
    plan = planner.solve(wells(), starts=20, spread=3.0, rank=rank)
    assert asked
    assert plan.status is Status.INTERRUPTED
    assert 1 <= len(plan.starts) <= 20


def stopping(_):
    raise StopIteration


def mistaken(_):
    raise ZeroDivisionError("my own")


@pytest.mark.parametrize(
    ("rank", "error", "fragment"),
    [
        (3, PlannerError, "rank is 3, expected a function of a Plan"),
        (lambda plan: None, PlannerError, "rank gave None, expected a number"),
        (lambda plan: "good", PlannerError, "rank gave 'good', expected a number"),
        (stopping, PlannerError, "rank raised StopIteration"),
        (mistaken, ZeroDivisionError, "my own"),
    ],
    ids=["no function", "none", "text", "stop", "own error"],
)
def test_wrong_ranks_are_refused(rank, error, fragment):
    with pytest.raises(error, match=fragment):
        planner.solve(wells(), starts=3, rank=rank)


def test_the_proven_cost_is_the_lesser_of_both_replays():
    hop = planner.cases.hopper(height=5.0, duration=0.5, horizon=25, integrator="euler")
    for problem, better in ((coarse(), None), (hop, True)):
        plan = planner.solve(problem)
        costs = {feedback: planner.replay(plan, feedback=feedback).cost for feedback in (True, False)}
        proven = proven_cost(plan)
        assert proven == min(costs.values())
        assert proven > 1.05 * plan.cost
        if better is not None:
            assert proven == costs[better]
        reverse = replace(plan, K=-3.0 * plan.K)  # gains that do worse than none
        assert proven_cost(reverse) == costs[False]


def test_a_plan_that_is_not_finite_costs_infinitely_much():
    plan = planner.solve(swing(), max_iterations=1)
    assert proven_cost(replace(plan, us=np.full_like(plan.us, np.nan))) == np.inf
    arm = planner.solve(coarse(), max_iterations=1)
    assert proven_cost(replace(arm, us=np.full_like(arm.us, 1e15))) == np.inf


def test_ranking_by_proven_cost_without_a_twin_is_an_error():
    with pytest.raises(PlannerError, match="no MuJoCo model"):
        planner.solve(wells(), starts=2, rank=proven_cost)


def test_threads_may_ask_at_once():
    plan = planner.solve(coarse())
    with ThreadPoolExecutor(4) as pool:
        assert len(set(pool.map(proven_cost, [plan] * 8))) == 1


@pytest.mark.slow
def test_starts_are_ranked_by_what_they_come_to():
    problem = planner.cases.hopper(height=5.0, horizon=50, integrator="euler")
    cheap = planner.solve(problem, starts=3)
    proven = planner.solve(problem, starts=3, rank=proven_cost)
    np.testing.assert_equal([start[:4] for start in proven.starts], [start[:4] for start in cheap.starts])
    scores = [start.score for start in proven.starts]
    assert proven.start == int(np.argmin(scores))
    assert proven.options["rank"] == "proven_cost"
    assert proven.cost > cheap.cost
    assert proven_cost(proven) == scores[proven.start] < 0.9 * scores[cheap.start]
