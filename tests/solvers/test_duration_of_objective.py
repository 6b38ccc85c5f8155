"""An objective with time: solve() chooses the duration, once, and a proof calls only such a plan optimal."""

import numpy as np
import pytest
from arms import START, mechanism
from carts import cart

import planner
from planner.__main__ import main
from planner.cases.plan_file import load_plan
from planner.costs import with_objective
from planner.problem.objective import seeks_duration
from planner.problem.rediscretize import finer, lengthened, retimed

BOTH = {"effort": 1.0, "time": 20.0}


def reach(objective):
    """Within 1 s, or between the task's own durations."""
    goal, keys = planner.Goal(joints={"elbow": 0.0}), {"dt": 0.05, "objective": objective, "durations": (0.2, 1.4)}
    return planner.task(mechanism(), START, goal, duration=1.0, **keys)


@pytest.mark.parametrize(
    "objective", ["time", pytest.param(BOTH, marks=pytest.mark.slow)], ids=["time", "effort and time"]
)
def test_solve_chooses_between_the_tasks_own_durations(objective):
    """As solve_for does, which takes the problem's objective and durations where it is told none."""
    problem = reach(objective)
    asked = planner.solve_for(problem, objective, durations=(0.2, 1.4))
    assert asked.success
    assert asked.t[-1] < 0.8  # s, of the 1 s with which it begins
    for plan in (planner.solve(problem), planner.solve_for(problem)):
        np.testing.assert_array_equal(plan.us, asked.us)
        assert plan.t[-1] == asked.t[-1]
        assert plan.options["durations"] == [0.2, 1.4]


def test_a_plan_keeps_its_duration_when_it_is_solved_again(tmp_path):
    """Also a stored one and one with finer steps; and with a warm start any problem keeps its own."""
    problem = with_objective(cart(), {"effort": 1.0, "time": 2.0})
    plan = planner.solve(problem)
    assert plan.t[-1] == pytest.approx(9.0**0.25, rel=2e-3)  # least 2 T + 6 / T^3, as in test_time_against_effort
    stored = load_plan(plan.save(tmp_path / "plan.npz")).problem
    for again in map(planner.solve, (plan.problem, stored, finer(plan.problem))):
        assert again.t[-1] == pytest.approx(plan.t[-1], rel=1e-12)
        assert "durations" not in again.options
        assert not seeks_duration(again.problem)
    kept = planner.solve(problem, warm_start=plan)
    assert kept.t[-1] == pytest.approx(problem.duration, rel=1e-12)
    assert seeks_duration(kept.problem)
    for other in (retimed(plan.problem, 3.0), lengthened(plan.problem, 1.5)):  # s; that nobody has found
        assert seeks_duration(other)


def test_only_a_duration_that_was_chosen_is_called_optimal():
    plan = planner.solve(reach(BOTH))
    kept = planner.solve(reach(BOTH), warm_start=plan)
    assert kept.t[-1] == pytest.approx(1.0)
    assert "PASS (open-loop); feasible, optimal for its duration" in planner.prove(kept, rollouts=0).headline
    headline = planner.prove(plan, rollouts=0).headline
    assert "PASS (open-loop); feasible, optimal" in headline
    assert "for its duration" not in headline


def test_a_command_searches_once(tmp_path, monkeypatch):
    """What it solves first, so that nothing is compiled in the measured time, is of the given duration."""
    searched = []
    monkeypatch.setattr(planner, "solve_for", lambda *_, **__: searched.append("by solve()"))
    words = ["--horizon", "20", "--objective", "effort=1,time=20", "--durations", "0.8,1.2"]
    main(["solve", "two-link", *words, "--out", str(tmp_path / "plan.npz"), "--quiet"])
    assert "tried" in load_plan(tmp_path / "plan.npz").options
    assert searched == []
