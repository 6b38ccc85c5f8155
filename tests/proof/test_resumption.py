"""A solve that its work cuts goes on from where it ended, where that is worth it."""

from dataclasses import replace

import pytest

import planner
from planner import Status
from planner.proof.repair.continued import resumed
from planner.solvers.work import WorkBudget, work_of_stage


def cut(iterations):
    """The acrobot's plan of a budget for so many iterations, and the problem."""
    problem = planner.cases.acrobot()
    work = (iterations + 0.5) * problem.N * work_of_stage(problem)
    plan = planner.solve(problem, budget=WorkBudget(work))
    assert (plan.status, plan.nit) == (Status.WORK_LIMIT, iterations)
    return problem, plan


def test_a_solve_goes_on_to_the_minimum_that_it_would_have_reached():
    problem, plan = cut(100)
    done = resumed(problem, plan, WorkBudget(60.0), 1000)
    assert done.plan.status is Status.CONVERGED
    assert done.plan.cost == pytest.approx(planner.solve(problem).cost, rel=1e-6)
    assert done.plan.nit < 100  # it needs 160 from the start
    assert (done.cost, done.iterations) == (plan.cost, 100)


def test_it_does_not_go_on_without_work_or_reason():
    problem, plan = cut(100)
    assert resumed(problem, plan, WorkBudget(1e-3), 1000) is None
    assert resumed(problem, replace(plan, status=Status.NO_DESCENT), WorkBudget(60.0), 1000) is None
    still = plan.history[-1]._replace(cost=plan.cost, expected=1.0)
    assert resumed(problem, replace(plan, history=(still,) * 40), WorkBudget(60.0), 1000) is None  # it stalls
