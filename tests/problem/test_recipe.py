"""A problem keeps its recipe as long as the recipe would build it again."""

from dataclasses import replace

import numpy as np
import pytest

import planner
from planner.problem.objective import base_problem, with_objective


@pytest.fixture
def problem():
    return planner.cases.two_link(horizon=20)


def other_cost(problem):
    cost = problem.cost
    return planner.TrackingCost(2.0 * cost.Q, cost.R, cost.x_ref, cost.u_ref, cost.space)


OTHER_PROBLEMS = {
    "dynamics": lambda p: replace(p, dynamics=planner.RigidBodyDynamics(p.dynamics.mechanism, 0.5 * p.dynamics.dt)),
    "cost": lambda p: replace(p, cost=other_cost(p)),
    "cost of an objective": lambda p: with_objective(replace(p, cost=other_cost(p)), "jerk"),
    "start": lambda p: replace(p, x0=p.x0 + 0.1),
    "horizon": lambda p: replace(p, horizon=10, us=p.us[:10], cost=first_stages(p.cost, 10)),
}
SAME_PROBLEMS = {
    "first guess": lambda p: replace(p, us=p.us + 0.1),
    "limits": lambda p: replace(p, limits=planner.Limits(control=50.0)),
    "twin": lambda p: replace(p, twin=replace(p.twin, mjcf=p.twin.mjcf.replace("<mujoco", "<!-- --><mujoco", 1))),
    "equal start": lambda p: replace(p, x0=p.x0.copy()),
    "objective": lambda p: with_objective(p, "energy"),
    "objectives in turn": lambda p: with_objective(with_objective(p, {"effort": 1.0, "jerk": 1e-3}), "energy"),
    "objective and limits": lambda p: replace(with_objective(p, "jerk"), limits=planner.Limits(control=50.0)),
    "objective taken back": lambda p: base_problem(with_objective(p, "energy")),
}


def first_stages(cost, N):
    return planner.TrackingCost(
        np.concatenate([cost.Q[:N], cost.Q[-1:]]), cost.R[:N], cost.x_ref[: N + 1], cost.u_ref[:N], cost.space
    )


@pytest.mark.parametrize("name", OTHER_PROBLEMS)
def test_another_problem_has_no_recipe(problem, name):
    changed = OTHER_PROBLEMS[name](problem)
    assert changed.recipe is None
    assert changed.case is None
    assert changed.parameters == {}
    assert problem.case == "two-link"


@pytest.mark.parametrize("name", SAME_PROBLEMS)
def test_the_same_task_keeps_its_recipe(problem, name):
    changed = SAME_PROBLEMS[name](problem)
    assert changed.case == "two-link"
    assert changed.parameters == problem.parameters
    again = changed.recipe.rebuilt()
    np.testing.assert_array_equal(again.cost.Q, base_problem(changed).cost.Q)
    np.testing.assert_array_equal(again.x0, changed.x0)


def test_a_recipe_is_of_one_horizon(problem):
    parts = problem.dynamics, problem.cost, problem.x0
    assert problem.recipe.of(*parts, 20) is problem.recipe
    assert problem.recipe.of(*parts, 10) is None


def test_a_recipe_without_its_function_says_so(problem):
    with pytest.raises(planner.PlannerError, match="what builds 'two-link' is not known here"):
        replace(problem.recipe, build=None).rebuilt()
