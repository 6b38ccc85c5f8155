"""A stored plan has its first guess and the poses of its goals: loading it seeks neither, without them it does."""

import json

import numpy as np
import pytest
from arms import hand, write

import planner
from planner.cases.problem_file import build, load
from planner.cases.problem_file.keys import POSES, RESOLVED
from planner.problem.archive import PART
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


def edited(path, folder, change, without=()):
    """The plan's file without some arrays, and with what its table has resolved changed."""
    with np.load(path) as file:
        content = {name: file[name] for name in file.files if name not in without}
    meta = json.loads(str(content["meta"]))
    change(meta["recipe"]["parameters"][RESOLVED])
    np.savez(folder / "edited.npz", **content | {"meta": np.array(json.dumps(meta))})
    return folder / "edited.npz"


def test_loading_searches_for_no_pose_and_no_first_guess(stored, searches, monkeypatch):
    plan, path = stored
    monkeypatch.setattr(build, "first_guess", lambda *_: pytest.fail("a first guess was sought"))
    again = planner.load_plan(path)
    assert not searches
    assert again.parameters == plan.parameters
    np.testing.assert_array_equal(again.problem.first_guess, plan.problem.first_guess)
    assert again.problem.cost.value(plan.xs, plan.us) == plan.problem.cost.value(plan.xs, plan.us)


def test_a_file_of_an_older_version_is_loaded_by_searching(stored, searches, tmp_path):
    plan, path = stored
    again = planner.load_plan(edited(path, tmp_path, lambda resolved: resolved.pop(POSES), [f"{PART}us"]))
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


def test_a_first_guess_of_another_horizon_is_refused(stored, tmp_path):
    with np.load(stored[1]) as file:
        content = dict(file)
    content[f"{PART}us"] = content[f"{PART}us"][1:]
    np.savez(tmp_path / "short.npz", **content)
    with pytest.raises(planner.PlannerError, match=r"made for N = 50, expected us = 49|us has shape"):
        planner.load_plan(tmp_path / "short.npz")
