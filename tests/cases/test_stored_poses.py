"""A stored plan has its first guess and the poses of its goals: loading it seeks neither, without them it does."""

import numpy as np
import pytest
from arms import hand, write

import planner
from planner.cases.problem_file import build, load
from planner.problem.archive import PART
from planner.problem.rediscretize import retimed
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
    """The plan's file with its arrays changed."""
    with np.load(path) as file:
        content = {name: file[name] for name in file.files}
    change(content)
    np.savez(folder / "edited.npz", **content)  # pyright: ignore
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
    older = edited(path, tmp_path, lambda content: [content.pop(f"{PART}{name}") for name in ("poses", "us")])
    again = planner.load_plan(older)
    assert searches
    np.testing.assert_array_equal(again.problem.first_guess, plan.problem.first_guess)


@pytest.mark.parametrize(
    ("name", "rows", "said"),
    [
        ("poses", slice(None, -1), "poses are not at stages that rise from 0 to 50"),
        ("poses", slice(0, 0), "poses are not at stages that rise from 0 to 50"),
        ("poses", [0, -1], "poses have none at stage 25, expected one at each goal"),
        ("us", slice(1, None), r"us has shape \(49, 2\), expected \(50, 2\)"),
    ],
)
def test_poses_or_a_first_guess_of_another_task_are_refused(stored, tmp_path, name, rows, said):
    def shorter(content):
        content[f"{PART}{name}"] = content[f"{PART}{name}"][rows]

    with pytest.raises(planner.PlannerError, match=said):
        planner.load_plan(edited(stored[1], tmp_path, shorter))


def test_poses_of_a_changed_task_are_found_anew(stored, searches):
    problem = planner.load_plan(stored[1]).problem
    other = problem.recipe.rebuilt(goal=[{"frame": "hand", "position": MIDDLE}])
    assert searches
    found = other.recipe.found["poses"]
    assert len(found) == 2
    assert np.abs(found[-1] - problem.recipe.found["poses"][-1]).max() > 0.1


def test_a_plan_of_another_duration_has_its_poses_too(stored):
    problem = planner.load_plan(stored[1]).problem
    slow = retimed(problem, 2.0 * problem.duration)
    assert set(slow.recipe.found) == set(problem.recipe.found)
    np.testing.assert_allclose(slow.recipe.found["poses"][-1, 2:], problem.recipe.found["poses"][-1, 2:], atol=1e-3)
