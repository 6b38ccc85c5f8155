"""Goals and constraints together: what a constraint forbids is refused, and poses keep what they can."""

import numpy as np
import pytest
from arms import START, hand, mechanism, refuse, write
from commands import run

import planner
from planner.base.errors import PlannerError
from planner.cases.problem_file import load
from planner.constraints import FrameAxisAngle, FramePosition, FramePositionAlong
from planner.dynamics.kinematics import frame_pose
from planner.dynamics.protocol import rollout_states
from planner.problem.tasks.pose_constraints import PoseConstraints

GOAL = '[[goal]]\nframe = "hand"\nposition = [0.3, 0.0, -0.2]\n'
BELOW = '[[constraint]]\nframe = "hand"\nalong = "z"\nupper = {upper}\n'
KEPT = "contradicts the constraint 'place of hand'"


def test_a_goal_that_a_constraint_forbids_is_refused(tmp_path):
    path = write(tmp_path, GOAL + BELOW.format(upper=-0.3))
    refuse(path, f"goal 1 (hand) {KEPT}: where that is kept hand is at best 0.0", " m away; move the goal, or widen")
    passed = GOAL.replace("[[goal]]", "[[goal]]\ntime = 0.5\nthrough = true") + GOAL.replace("-0.2", "-0.4")
    refuse(write(tmp_path, passed + BELOW.format(upper=-0.3)), "goal 1 (hand at 0.5 s) contradicts")
    upright = '[[constraint]]\nframe = "hand"\npointing = "z"\nwithin = 0.6\n'
    turned = '[[goal]]\nframe = "hand"\npointing = [-1, 0, 0]\n'
    refuse(write(tmp_path, turned + upright), "goal 1 (hand) contradicts the constraint 'tilt of hand'", "rad away")
    joints = "[[goal]]\njoints = { shoulder = -1.5, elbow = 0.0 }\n"
    refuse(write(tmp_path, joints + BELOW.format(upper=-0.3)), f"goal 1 (joints) {KEPT}: move the goal")
    x, z = hand(0.5, -1.0)
    path = f'[follow]\nframe = "hand"\npoints = [[0, {x}, 0, {z}], [1, 0.3, 0, -0.3]]\n'
    refuse(write(tmp_path, path + BELOW.format(upper=-0.4)), "the path of hand at", KEPT)


def test_what_the_tolerance_of_a_goal_allows_is_not_refused(tmp_path):
    load(write(tmp_path, GOAL + BELOW.format(upper=-0.204)))  # 5 mm pass
    load(write(tmp_path, "[[goal]]\njoints = { shoulder = -1.5 }\n" + BELOW.format(upper=-0.2)))  # the elbow is free


def test_constraints_of_python_are_seen_too():
    above = planner.Constraint(FramePositionAlong("hand"), upper=-0.3)
    goal = planner.Goal(frame="hand", position=(0.3, 0.0, -0.2))
    with pytest.raises(PlannerError, match=KEPT):
        planner.task(mechanism(), START, goal, duration=1.0, constraint=above)
    later = planner.Constraint(FramePositionAlong("hand"), upper=-0.3, when=(0.0, 0.5))
    problem = planner.task(mechanism(), START, goal, duration=1.0, constraint=[later])
    assert problem.constraints == (later,)
    assert problem.recipe.rebuilt(duration=1.2).constraints == (later,)


def test_the_elbow_bends_the_way_that_a_constraint_asks():
    """Two poses reach the goal; the nearer one has the elbow where a constraint forbids it."""
    goal = planner.Goal(frame="hand", position=(0.3, 0.0, -0.3))
    ends = []
    for kept in ([], [planner.Constraint(FramePositionAlong("lower"), lower=-0.3, when="end")]):
        problem = planner.task(mechanism(), START, goal, duration=1.0, constraint=kept)
        ends.append(rollout_states(problem.dynamics, problem.x0, problem.first_guess)[-1, :2])
    places = [float(frame_pose(mechanism(), q, "lower")[0, 3]) for q in ends]
    np.testing.assert_allclose(places, [0.017, 0.4], rtol=0, atol=0.005)
    plan = planner.solve(problem)
    assert plan.success
    assert planner.prove(plan, rollouts=0).passed


def test_derivatives_of_what_is_missing_are_those_of_differences():
    machine = mechanism()
    dynamics = planner.RigidBodyDynamics(machine, 0.02)
    x0 = np.array([0.5, -1.0, 0.0, 0.0])
    asked = [
        planner.Constraint(FramePositionAlong("hand"), upper=-0.7, when=(0.5, 1.0)),
        planner.Constraint(FramePosition("hand"), equal=(0.1, 0.0, 0.2), when="end"),
        planner.Constraint(FrameAxisAngle("hand"), upper=0.1, when=(0.5, 1.0)),
    ]
    kept = PoseConstraints(asked, dynamics, x0, 50)
    assert kept.at(10) is None
    q, h = np.array([0.3, 0.8]), 1e-6
    missing = kept.at(50)
    r, J = missing(q)
    assert np.count_nonzero(r) >= 4
    differences = np.stack([(missing(q + e)[0] - missing(q - e)[0]) / (2.0 * h) for e in h * np.eye(2)], axis=1)
    np.testing.assert_allclose(J, differences, rtol=1e-5, atol=1e-3)
    assert str(kept.violated(50, q).constraint) == "the constraint 'tilt of hand'"


def test_a_converged_plan_that_misses_its_goal_says_so(tmp_path):
    light = "[weights]\ngoal = 0.001\n"
    write(tmp_path, GOAL + light)
    done = run("solve", "task.toml", "--out", "plan.npz", cwd=tmp_path)
    assert done.returncode == 1
    assert "but position of hand is missed by " in done.stdout
    assert "and 0.005 pass; raise its weight" in done.stdout
    assert "to pass: `weights.goal = " in done.stdout
    met = planner.solve(load(write(tmp_path, GOAL)).problem)
    assert met.missed_goals == ""
    assert met.message == met.status.value
