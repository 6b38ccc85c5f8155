"""A stored plan has the poses of its goals: loading it solves no inverse kinematics, and without them it still loads."""

import json

import numpy as np
import pytest
from arms import hand, write

import planner
from planner.cases.problem_file import load
from planner.cases.problem_file.keys import POSES, RESOLVED
from planner.problem.tasks import poses

MIDDLE, END = ([float(x), 0.0, float(z)] for x, z in (hand(-2.0, -0.8), hand(-1.0, -1.2)))
GOALS = f"""
[[goal]]
frame = "hand"
position = {MIDDLE}
time = 0.5
through = true

[[goal]]
frame = "hand"
position = {END}
"""


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    """A plan of few iterations, and its file."""
    folder = tmp_path_factory.mktemp("poses")
    plan = planner.solve(load(write(folder, GOALS)).problem, max_iterations=2)
    return plan, plan.save(folder / "plan.npz")


@pytest.fixture
def searches(monkeypatch):
    """Counts searches of inverse kinematics."""
    seen, search = [], poses.inverse_kinematics

    def counted(*arguments, **options):
        seen.append(arguments)
        return search(*arguments, **options)

    monkeypatch.setattr(poses, "inverse_kinematics", counted)
    return seen


def edited(path, folder, change):
    """The plan's file, with what its table has resolved changed."""
    with np.load(path) as file:
        content = dict(file)
    meta = json.loads(str(content["meta"]))
    change(meta["recipe"]["parameters"][RESOLVED])
    np.savez(folder / "edited.npz", **content | {"meta": np.array(json.dumps(meta))})
    return folder / "edited.npz"


def test_loading_searches_for_no_pose(stored, searches):
    plan, path = stored
    again = planner.load_plan(path)
    assert not searches
    assert again.parameters == plan.parameters
    np.testing.assert_array_equal(again.problem.first_guess, plan.problem.first_guess)
    assert again.problem.cost.value(plan.xs, plan.us) == plan.problem.cost.value(plan.xs, plan.us)


def test_a_file_without_poses_is_loaded_by_searching(stored, searches, tmp_path):
    plan, path = stored
    again = planner.load_plan(edited(path, tmp_path, lambda resolved: resolved.pop(POSES)))
    assert searches
    np.testing.assert_array_equal(again.problem.first_guess, plan.problem.first_guess)


def test_poses_of_another_task_are_refused(stored, tmp_path):
    def shorter(resolved):
        resolved[POSES]["stages"][-1] -= 1

    with pytest.raises(planner.PlannerError, match=r"poses are not at stages that rise from 0 to 50"):
        planner.load_plan(edited(stored[1], tmp_path, shorter))


def test_poses_of_a_changed_task_are_found_anew(stored, searches):
    problem = planner.load_plan(stored[1]).problem
    other = problem.recipe.rebuilt(goal=[{"frame": "hand", "position": MIDDLE}])
    assert searches
    found = other.parameters[RESOLVED][POSES]
    assert len(found["q"]) == 2
    assert found["q"][-1] != problem.parameters[RESOLVED][POSES]["q"][-1]
