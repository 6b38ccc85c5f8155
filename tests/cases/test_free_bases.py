"""Goals of free bases: their joint in a goal, and rest where something can stop it."""

import numpy as np
import pytest

import planner
from planner.base.errors import PlannerError
from planner.cases.problem_file import load
from planner.model.capabilities import ballistic_dofs
from planner.problem.goals import goals_of

CAT = """<mujoco model="cat"><option gravity="0 0 {gravity}"/><worldbody>
  <body name="chest" pos="0 0 3"><freejoint name="root"/>
   <geom type="capsule" fromto="-.3 0 0 0 0 0" size=".08" mass="2" contype="0" conaffinity="0"/>
   <body name="hips"><joint name="bend" axis="0 1 0" range="-100 100" damping=".05"/>
    <geom type="capsule" fromto="0 0 0 .3 0 0" size=".08" mass="2" contype="0" conaffinity="0"/></body></body>
  </worldbody><actuator><motor name="bend" joint="bend" ctrlrange="-20 20"/></actuator></mujoco>"""
TEXT = 'model = "cat.xml"\nstart = {}\nduration = 0.5\ncontacts = "avoid"\n'


def problem_of(tmp_path, goal, gravity=-9.81):
    (tmp_path / "cat.xml").write_text(CAT.format(gravity=gravity))
    (tmp_path / "problem.toml").write_text(TEXT + goal)
    return load(tmp_path / "problem.toml").problem


def test_a_falling_cat_bends_and_is_not_asked_to_stop_its_fall(tmp_path):
    problem = problem_of(tmp_path, "[[goal]]\njoints = { bend = 1.0 }\n")
    plan = planner.solve(problem)
    assert plan.converged
    fall = plan.xs[-1, 8:11] @ [0.0, 0.0, -1.0]
    assert fall == pytest.approx(9.81 * 0.5, abs=0.5)  # m/s: the chest moves on about the falling centre
    names = [one.name for one in goals_of(problem, plan.xs) if one.unit == "m/s"]
    assert not names
    proof = planner.prove(plan, rollouts=0)
    assert proof.passed, proof


def test_what_falls_or_drifts_is_not_stopped(tmp_path):
    m = problem_of(tmp_path, "goal = { bend = 1.0 }\n").dynamics.mechanism
    np.testing.assert_array_equal(ballistic_dofs(m, m.home), [True] * 3 + [False] * 4)
    floating = problem_of(tmp_path, "goal = { bend = 1.0 }\n", gravity=0).dynamics.mechanism
    x = floating.home
    assert not ballistic_dofs(floating, x).any()
    x[floating.nq] = 0.1
    np.testing.assert_array_equal(ballistic_dofs(floating, x), [True] * 3 + [False] * 4)


def test_a_free_joint_in_a_goal_is_the_pose_of_its_body(tmp_path):
    joints = "[[goal]]\njoints = { root = [0, 0, 3, 0.995, 0, 0.0998, 0], bend = 0.5 }\ntolerance = 0.05\n"
    goals = {one.name for one in goals_of(problem_of(tmp_path, joints, gravity=0))}
    assert {"position of chest", "orientation of chest", "bend"} <= goals
    with pytest.raises(PlannerError, match=r"root of goal 1 \(joints\), \[x, y, z\] m and a quaternion"):
        problem_of(tmp_path, "[[goal]]\njoints = { root = [0, 0, 3] }\n", gravity=0)
