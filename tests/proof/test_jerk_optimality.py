"""A plan of least jerk is judged by what steps gain: its cost has the Hessian of another, whose promise is not kept."""

import pytest
from places import ROOT

import planner
from planner.cases.problem_file import load


# At the end of reach the next step promises 2.6 times the bound, at the end of reach_upright a hundredth of it.
@pytest.mark.parametrize("task", ["reach", pytest.param("reach_upright", marks=pytest.mark.slow)])
def test_a_plan_of_least_jerk_is_optimal(task):
    problem = load(ROOT / "examples" / "tasks" / f"{task}.toml", objective="jerk").problem
    plan = planner.solve(problem)
    assert plan.success
    proof = planner.prove(plan, rollouts=0)
    assert proof.passed, proof.reason
    left = {one.name: one for one in proof.optimality.measured}["decrease_left"]
    assert left.value <= left.bound
