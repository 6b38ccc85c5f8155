"""task() takes Limits, Constraints and single objects as Python has them, and refuses what is no number."""

import re
from types import MappingProxyType

import numpy as np
import pytest
from machines import gantry

import planner
from planner.cases.problem_file.keys import GOAL as GOAL_KEYS
from planner.problem.goals import goals_of
from planner.problem.tasks.timed_task import DEFAULT_TOLERANCES

CART = """<mujoco><worldbody><body><joint name="rail" type="slide" axis="1 0 0" range="-1 3"/>
  <geom type="box" size=".1 .1 .1" mass="2" contype="0" conaffinity="0"/></body></worldbody>
  <actuator><motor name="drive" joint="rail" ctrlrange="-40 40"/></actuator></mujoco>"""
GOAL = planner.Goal(joints=[1.0])


def asked(**keys):
    cart = planner.Mechanism.from_mjcf(CART)
    return planner.task(cart, start=cart.home, goals=[GOAL], duration=1.0, **keys)


def speed(xs):
    return xs[:, 1]


def test_limits_and_constraints_of_python_are_kept():
    free = planner.solve(asked())
    assert np.abs(free.us).max() > 10.0
    assert speed(free.xs).max() > 1.2
    limited = planner.solve(asked(limits=planner.Limits(control=9.5)))
    assert np.abs(limited.us).max() <= 9.5
    slow = planner.Constraint(speed, upper=1.15)
    for given in (slow, [slow]):
        plan = planner.solve(asked(constraint=given))
        assert plan.success
        assert speed(plan.xs).max() <= 1.15 + slow.allowed()


@pytest.mark.parametrize(
    "limits",
    [
        {"control": np.nan},
        {"control": [-1.0, np.nan]},
        {"position": {"rail": [np.nan, 1.0]}},
        {"velocity": {"rail": np.nan}},
    ],
)
def test_a_limit_that_is_not_a_number_is_refused(limits):
    with pytest.raises(planner.PlannerError, match=r"expected (a finite number|numbers)"):
        asked(limits=limits)


@pytest.mark.parametrize("of", [tuple, np.array], ids=["tuple", "array"])
def test_lists_and_tables_may_be_of_any_type_and_bounds_infinite(of):
    constraint = {"along": of([1.0, 0.0, 0.0]), "upper": 9.0, "when": of([0.2, 0.5]), "frame": "cart"}
    cart = planner.Mechanism.from_mjcf(CART.replace("<body>", '<body name="cart">'))
    for control in (MappingProxyType({"drive": 9.0}), np.inf, of([-9.0, 9.0])):
        limits = {"control": control, "final": of(["rail"])}
        planner.task(cart, start=cart.home, goals=[GOAL], duration=1.0, constraint=[constraint], limits=limits)


@pytest.mark.parametrize(
    ("keys", "form"),
    [
        ({"limits": {"position": 3.0}}, "elbow = [-1.0, 1.0]"),
        ({"limits": {"position": [-1.0, 1.0]}}, "elbow = [-1.0, 1.0]"),
        ({"constraint": [{"frame": "world", "along": "x", "upper": 9.0, "when": 0.5}]}, "when = [0.2, 0.5]"),
    ],
)  # fmt: skip
def test_a_wrong_value_is_told_each_form_that_is_right(keys, form):
    with pytest.raises(planner.PlannerError, match=re.escape(form)):
        asked(**keys)


def test_a_constraint_that_is_not_a_number_is_refused():
    with pytest.raises(planner.PlannerError, match=r"nan.* at the start, expected finite numbers"):
        asked(constraint=planner.Constraint(lambda xs: np.nan * xs[:, 1], upper=1.0))


def test_a_plan_in_place_of_a_problem_is_told_how_to_be_given():
    plan = planner.solve(asked())
    with pytest.raises(planner.PlannerError, match=r"write Controller\(plan\.problem, plan=plan\)"):
        planner.Controller(plan)


@pytest.mark.parametrize(
    ("words", "goal"),
    [
        ("joints = {rail = 1.0}", planner.Goal(joints={"rail": 1.0})),
        ('frame = "box"\nposition = [1.0, 0.0, 0.0]', planner.Goal(frame="box", position=[1.0, 0.0, 0.0])),
    ],
)
def test_a_goal_has_the_same_tolerances_in_a_file_and_in_python(words, goal, tmp_path):
    """Both are those of timetable.DEFAULT_TOLERANCES, which the words about the key name too."""
    (tmp_path / "cart.xml").write_text(CART.replace("<body>", '<body name="box">'))
    (tmp_path / "p.toml").write_text(f'model = "cart.xml"\nstart = {{}}\nduration = 1.0\n[[goal]]\n{words}\n')
    cart = planner.Mechanism.from_mjcf(tmp_path / "cart.xml")
    problems = planner.load_problem(tmp_path / "p.toml"), planner.task(cart, cart.home, goal, duration=1.0)
    found = [[(one.name, one.tolerance) for one in goals_of(problem)] for problem in problems]
    assert found[0] == found[1]
    assert {tolerance for _, tolerance in found[0]} == {DEFAULT_TOLERANCES["position"], DEFAULT_TOLERANCES["velocity"]}
    assert GOAL_KEYS["tolerance"].endswith("by default 5 mm, 0.02 rad, 0.05 m/s")


def test_avoid_and_one_constraint_may_be_objects_or_tables():
    machine = planner.Mechanism.from_mjcf(gantry(), contacts="avoid")
    goal = planner.Goal(joints={"x": 0.5, "z": 0.1})
    by_object, by_table = (
        planner.task(machine, "left", goal, duration=2.0, dt=0.05, avoid=avoid)
        for avoid in (planner.constraints.Avoid(clearance=0.03), {"clearance": 0.03})
    )
    assert by_object.parameters["avoid"]["clearance"] == 0.03
    np.testing.assert_array_equal(by_object.first_guess, by_table.first_guess)
    one = {"frame": "tool", "along": "z", "upper": 1.5}
    assert len(planner.task(machine, "left", goal, duration=2.0, constraint=one).constraints) == 1


@pytest.mark.parametrize(
    ("start", "expected"),
    [
        ([0.0], r"the start has shape \(1,\), expected a keyframe, or \(2,\), its positions, or \(4,\), its state"),
        ("home", "keyframe is 'home', expected one of: left, right"),
        ([np.nan, 0.0], r"the start\[0\] is nan, expected finite numbers"),
        ("text", "keyframe is 'text'"),
        ({}, "the start is {}, expected numbers"),
    ],
)
def test_a_wrong_start_of_avoid_is_one_sentence(start, expected):
    machine = planner.Mechanism.from_mjcf(gantry(), contacts="avoid")
    with pytest.raises(planner.PlannerError, match=expected):
        planner.constraints.Avoid(clearance=0.03).constraint(machine, start)
    named, given = (planner.constraints.Avoid().constraint(machine, x).notes for x in ("left", [-0.5, 0.1]))
    assert named == given
