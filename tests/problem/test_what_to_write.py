"""Refusals that say what to write: an example, a unit, the place where it is written."""

import pytest
from arms import ARM

import planner


@pytest.fixture(scope="module")
def arm():
    return planner.Mechanism.from_mjcf(ARM)


@pytest.mark.parametrize(
    ("goals", "said"),
    [
        ("home", 'goals is \'home\', expected a Goal, such as Goal(joints={"elbow": 1.0}) or Goal(joints="home")'),
        ([], "goals is empty, expected a Goal, such as"), ((), "goals is empty"),
    ],
)  # fmt: skip
def test_goals_in_python(arm, goals, said):
    with pytest.raises(planner.PlannerError) as caught:
        planner.task(arm, start=arm.home, goals=goals, duration=1.0)
    assert said in str(caught.value)
    assert "file" not in str(caught.value)  # there is none


def test_joints_of_a_goal_that_are_names():
    with pytest.raises(
        planner.PlannerError, match=r"joints of a goal is \['elbow'\], expected a table, \{\"elbow\": 1.0\}"
    ):
        planner.Goal(joints=["elbow"])


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"control": "5 Nm"}, "control of limits is '5 Nm', expected numbers, e.g. control = 5.0 or { elbow = 5.0 }"),
        ({"position": "moddel"}, "or 'model' or 'off'. Did you mean 'model'?"),
        ({"velocity": "2 rad/s"}, "expected numbers, e.g. velocity = 2.0 or { elbow = 2.0 }, rad/s or m/s"),
    ],
)
def test_limits_that_are_words(arm, given, said):
    goal = planner.Goal(joints={"elbow": 1.0})
    with pytest.raises(planner.PlannerError) as caught:
        planner.task(arm, start=arm.home, goals=goal, duration=1.0, limits=planner.Limits(**given))
    assert said in str(caught.value)
