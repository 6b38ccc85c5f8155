"""The tasks in examples/tasks: every file converges, meets each of its goals, and (slow) passes its proof."""

import numpy as np
import pytest
from places import ROOT

import planner
from planner.cases.problem_file import load
from planner.problem.goals import goals_of

TASKS = sorted((ROOT / "examples" / "tasks").glob("*.toml"))
# 1.5 s and more, which the proofs below share: those are slow too, so a plan is made once. Shorter ones of their kinds:
# test_walking_gaits.py, test_periodic_gaits.py, test_vehicles.py, and test_avoid.py.
LONG = dict.fromkeys(
    ("around_a_post", "boat", "differential_drive", "through_a_window", "trot", "walk", "walk_on"), pytest.mark.slow
)


@pytest.fixture(scope="module")
def plans():
    return {}


def plan_of(path, plans):
    if path not in plans:
        asked = load(path)
        own = asked.problem.periodic is not None
        plans[path] = asked.solved(lambda _: None) if own else planner.solve(asked.problem)
    return plans[path]


@pytest.mark.parametrize("path", [pytest.param(path, id=path.stem, marks=LONG.get(path.stem, ())) for path in TASKS])
def test_it_converges_and_meets_every_goal(path, plans):
    plan = plan_of(path, plans)
    assert plan.success
    goals = goals_of(plan.problem, plan.xs)
    assert goals or plan.problem.periodic.miss(plan.space, plan.xs) <= 1.0
    for one in goals:
        assert one.miss(plan.t, plan.xs) <= 0.5 * one.tolerance, one.name  # by default weights, with room
    assert np.isfinite(plan.K).all()


@pytest.mark.slow
@pytest.mark.parametrize("path", TASKS, ids=lambda path: path.stem)
def test_it_passes(path, plans):
    proof = planner.prove(plan_of(path, plans), rollouts=0)
    assert proof.passed, proof.reason
