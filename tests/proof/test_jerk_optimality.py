"""A plan of least jerk is judged by what steps gain: its cost has the Hessian of another, whose promise is not kept."""

from places import ROOT

import planner
from planner.cases.problem_file import load


def test_a_plan_of_least_jerk_is_optimal():
    problem = load(ROOT / "examples" / "tasks" / "reach_upright.toml", objective="jerk").problem
    plan = planner.solve(problem)
    assert plan.success
    proof = planner.prove(plan, rollouts=0)
    left = {one.name: one for one in proof.optimality.measured}["decrease_left"]
    assert proof.passed, proof.reason
    assert "more steps of SLQ gain" in left.note  # the next step promises more than the cost itself
