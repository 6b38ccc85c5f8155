"""Ranges that equalities leave of each other, and files that contradict themselves."""

import numpy as np
import pytest

from planner import Limits, Mechanism, PlannerError, Problem, RigidBodyDynamics, costs
from planner.model.couplings import contradiction, narrowed
from planner.model.mjcf.model_file import open_model_file
from planner.problem.description import describe

TWO = """
<mujoco><compiler angle="radian"/><worldbody>
  <body><joint name="a" axis="0 1 0" range="{a}" limited="true"/><geom size=".1" pos=".2 0 0"/></body>
  <body pos="0 1 0"><joint name="b" axis="0 1 0" range="{b}" limited="true"/><geom size=".1" pos=".2 0 0"/></body>
</worldbody>
<equality><joint name="tie" joint1="a" joint2="b" polycoef="{c} {k} 0 0 0"/></equality>
<actuator><motor joint="b"/></actuator></mujoco>
"""


def two(a: str, b: str, c: float, k: float) -> str:
    return TWO.format(a=a, b=b, c=c, k=k)


def test_ranges_are_narrowed_to_what_the_other_joint_allows():
    machine = Mechanism.from_mjcf(two("-1 0.5", "0 2", 0.1, 0.5))
    left = narrowed(machine, machine.joint_range)
    np.testing.assert_allclose(left, [[0.1, 0.5], [0.0, 0.8]], atol=1e-12)
    assert contradiction(machine, machine.joint_range) == ""


def test_a_file_without_a_pose_is_refused_with_the_range_that_would_do():
    machine = Mechanism.from_mjcf(two("0 1", "0 1", 1.5, 0.5))
    dynamics = RigidBodyDynamics(machine, dt=0.01)
    start = np.array([1.5, 0.0, 0.0, 0.0])
    cost = costs.default_cost(dynamics, start, start, 10)
    with pytest.raises(PlannerError, match=r"equality 'tie' asks .* write range=\"1.5 2\" for joint 'a'"):
        Problem(dynamics, cost, start, limits=Limits.of_model())


def test_joints_that_are_held_at_one_place_are_told():
    known = describe(open_model_file(two("0 1", "0 1", 0.0, -1.0)))
    assert any("hold joint 'a', joint 'b' at one place" in one.problem for one in known.troubles)
