"""Tasks among things: waypoints on both sides of a wall, an elbow that bends the other way, goals inside of things."""

import pytest
from machines import gantry

import planner
from planner.base.errors import PlannerError
from planner.dynamics.protocol import rollout_states
from planner.proof.diagnostics import suggested_fixes

# There, beside the wall, and back: each straight way leads through it.
THERE_AND_BACK = """model = "gantry.xml"
start = "left"
duration = 4.0
dt = 0.05
[avoid]
clearance = 0.03
[[goal]]
joints = { x = 0.5, z = 0.1 }
time = 2.0
[[goal]]
joints = { x = -0.5, z = 0.1 }
"""
# The lower of two elbows is in the block.
ELBOW = """<mujoco><option gravity="0 0 0"/><worldbody>
  <geom name="block" type="box" pos="0.5 0 -0.35" size="0.1 0.1 0.1"/>
  <body><joint name="shoulder" axis="0 -1 0" damping="1"/>
    <geom name="upper" type="capsule" fromto="0.1 0 0 0.5 0 0" size="0.02" mass="1"/>
    <body pos="0.5 0 0"><joint name="elbow" axis="0 -1 0" damping="1"/>
      <geom name="fore" type="capsule" fromto="0.1 0 0 0.5 0 0" size="0.02" mass="1"/>
      <site name="hand" pos="0.5 0 0"/></body></body></worldbody>
  <actuator><motor joint="shoulder"/><motor joint="elbow"/></actuator>
  <keyframe><key name="bent" qpos="-0.2 1.2"/></keyframe></mujoco>"""
REACH = """model = "elbow.xml"
start = "bent"
duration = 1.5
[[goal]]
frame = "hand"
position = [0.8, 0.0, {z}]
"""


def loaded(tmp_path, name, model, toml):
    (tmp_path / name).write_text(model)
    (tmp_path / "problem.toml").write_text(toml)
    return planner.load_problem(tmp_path / "problem.toml")


def test_the_first_guess_goes_around_between_waypoints(tmp_path):
    problem = loaded(tmp_path, "gantry.xml", gantry(), THERE_AND_BACK)
    plan = planner.solve(problem)
    assert plan.success
    assert plan.xs[:41, 1].max() > 0.38  # there: over the wall of 0.3, with the tool of 0.05 and the clearance
    assert plan.xs[41:, 1].max() > 0.38  # and back
    assert planner.prove(plan, rollouts=0).passed


def test_an_elbow_bends_the_way_that_is_free(tmp_path):
    at_end = {}
    for more in ("", "[avoid]\nclearance = 0.01\n"):
        problem = loaded(tmp_path, "elbow.xml", ELBOW, REACH.format(z=-0.2) + more)
        at_end[more] = rollout_states(problem.dynamics, problem.x0, problem.first_guess)[-1, :2]
    blind, free = at_end.values()
    assert blind[1] == pytest.approx(-free[1], abs=1e-3)  # the two elbows of one point
    assert blind[1] > 0.0 > free[1]  # the start's is the nearer one; its links are in the block


def test_a_goal_inside_of_a_thing_is_refused_with_its_name(tmp_path):
    inside = THERE_AND_BACK.replace("x = 0.5, z = 0.1", "x = 0.0, z = 0.1")
    with pytest.raises(PlannerError, match=r"goal 1 \(joints at 2 s\) is in collision: geom 'wall' and geom 'tool'"):
        loaded(tmp_path, "gantry.xml", gantry(), inside)
    with pytest.raises(PlannerError, match=r"goal 1 \(hand\) is in collision: geom 'block' and geom 'fore'"):
        loaded(tmp_path, "elbow.xml", ELBOW, REACH.replace("0.8, 0.0, {z}", "0.5, 0.0, -0.35") + "[avoid]\n")


def test_a_start_inside_of_a_thing_fails_though_nothing_is_avoided(tmp_path):
    """What is drawn into its base is let pass; this tool could be elsewhere."""
    inside = gantry(wall='type="box" size="0.05 0.5 0.3" pos="-0.43 0 0"')
    toml = THERE_AND_BACK.split("[avoid]")[0] + "[[goal]]\njoints = { x = 0.5 }\n"
    plan = planner.solve(loaded(tmp_path, "gantry.xml", inside, toml))
    proof = planner.prove(plan, rollouts=0)
    assert not proof.passed
    assert "geom 'wall' and geom 'tool' overlap by 0.03 m at the start, expected at most 0.001 m" in proof.reason
    said = " ".join(str(one) for one in suggested_fixes(plan, proof))
    assert "Another `start` is needed" in said
    assert "overlap by 0.03 m" in said


def test_a_goal_inside_of_a_thing_is_told_what_to_write(tmp_path):
    reach = REACH.replace("0.8, 0.0, {z}", "0.8, 0.0, -0.2")
    plan = planner.solve(loaded(tmp_path, "elbow.xml", ELBOW, reach))
    proof = planner.prove(plan, rollouts=0)
    assert not proof.passed
    assert "`avoid = {}`" in str(suggested_fixes(plan, proof)[0])
