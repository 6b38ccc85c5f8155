"""suggested_fixes(): gains of a held control that shake a servo, and ranges that leave a joint no room."""

import pytest

import planner
from planner.proof.diagnostics import suggested_fixes
from planner.proof.original_model import PATH_WITH_GAINS

# A servo of 20 N m/rad without damping swings with some 190 rad/s; the file's equality between the joints is soft.
GRIPPER = """<mujoco><compiler angle="radian"/><option gravity="0 0 0"/><worldbody><body>
  <joint name="drive" axis="0 -1 0" {drive}/>
  <geom type="capsule" fromto="0 0 0 .1 0 0" size=".01" mass=".05" contype="0" conaffinity="0"/>
  <body pos=".1 0 0"><joint name="tip" axis="0 -1 0" {tip}/>
    <geom type="capsule" fromto=".02 0 0 .07 0 0" size=".008" mass=".03" contype="0" conaffinity="0"/></body></body>
  </worldbody><equality><joint joint1="tip" joint2="drive" polycoef="0 -0.7 0 0 0"/></equality>
  <actuator><position name="drive" joint="drive" kp="20" ctrlrange="0 0.7"/></actuator></mujoco>"""
CLOSE = """model = "gripper.xml"
start = { drive = 0.2 }
goal = { drive = 0.3 }
duration = 1.0
"""


def proved(tmp_path, more="", drive="", tip="", toml=CLOSE):
    (tmp_path / "gripper.xml").write_text(GRIPPER.format(drive=drive, tip=tip))
    (tmp_path / "problem.toml").write_text(toml + more)
    plan = planner.solve(planner.load_problem(tmp_path / "problem.toml"))
    return plan, planner.prove(plan, rollouts=0)


def test_gains_that_shake_an_undamped_servo_get_a_shorter_stage(tmp_path):
    plan, proof = proved(tmp_path, more="dt = 0.01\n")
    assert not proof.your_file.passed
    assert proof.refined_feedback.passed
    first = suggested_fixes(plan, proof)[0]
    assert first.key == "dt"
    assert first.value == pytest.approx(0.0025)  # the longest that people would write in which it swings half a radian
    assert first.code == "gains_too_fast"
    _, again = proved(tmp_path, more=f"{first.key} = {first.value}\n")
    assert again.passed


def test_a_stage_is_no_longer_than_the_gains_of_an_undamped_servo_bear(tmp_path):
    plan, proof = proved(tmp_path)
    assert plan.dt < 1.0 / 180.0  # a radian of its swing, see GRIPPER
    assert proof.passed
    path = next(one for one in proof.your_file.measured if one.name == PATH_WITH_GAINS)
    assert path.value < 1.0


HANGS = """<mujoco><compiler angle="radian"/><worldbody><body>
  <joint name="drive" axis="0 -1 0" damping="0.02" armature="0.001"/>
  <geom type="capsule" fromto="0 0 0 .1 0 0" size=".01" mass=".05" contype="0" conaffinity="0"/></body>
  <body pos="0 0 .2"><joint name="tip" axis="0 -1 0" damping="0.02"/>
    <geom type="capsule" fromto="0 0 0 .1 0 0" size=".008" mass=".05" contype="0" conaffinity="0"/></body>
  </worldbody><equality><joint joint1="tip" joint2="drive" solref="0.04 1"/></equality>
  <actuator><position name="drive" joint="drive" kp="5"/></actuator></mujoco>"""


def test_a_path_that_soft_equalities_leave_is_not_put_down_to_the_gains(tmp_path):
    """The second link hangs on the first by a soft equality, and sinks by itself: with and without gains.

    The servo swings by 0.6 rad in a stage, more than half a radian, and the gains bear it.
    """
    (tmp_path / "hangs.xml").write_text(HANGS)
    (tmp_path / "problem.toml").write_text(
        'model = "hangs.xml"\nstart = { drive = 0.0 }\ngoal = { drive = 0.2 }\nduration = 1.0\ndt = 0.01\n'
    )
    plan = planner.solve(planner.load_problem(tmp_path / "problem.toml"))
    proof = planner.prove(plan, rollouts=0)
    assert not proof.your_file.passed
    assert [one.code for one in suggested_fixes(plan, proof)] == ["equality_gives"]
