"""task() takes Limits, Constraints and single objects as Python has them, and refuses what is no number."""

import numpy as np
import pytest

import planner

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
    slow = planner.Constraint(speed, most=1.15)
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


def test_a_constraint_that_is_not_a_number_is_refused():
    with pytest.raises(planner.PlannerError, match=r"nan.* at the start, expected finite numbers"):
        asked(constraint=planner.Constraint(lambda xs: np.nan * xs[:, 1], most=1.0))


def test_a_plan_in_place_of_a_problem_is_told_how_to_be_given():
    plan = planner.solve(asked())
    with pytest.raises(planner.PlannerError, match=r"write Controller\(plan\.problem, plan=plan\)"):
        planner.Controller(plan)
