"""suggested_fixes(): gains of a held control that shake a servo without damping, and ranges that leave a joint no room."""

import pytest

import planner
from planner.proof.diagnostics import suggested_fixes

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
    plan, proof = proved(tmp_path)
    assert not proof.your_file.passed
    assert proof.refined_feedback.passed
    first = suggested_fixes(plan, proof)[0]
    assert first.key == "dt"
    assert first.value == pytest.approx(0.005)  # the longest that people would write in which it swings 1 rad
    assert "without the plan's gains and not with them" in first.sentence
    _, again = proved(tmp_path, more=f"{first}".split("`")[1] + "\n")
    assert again.passed


def test_ranges_that_leave_a_joint_one_position_are_named(tmp_path):
    ranges = {"drive": 'limited="true" range="0 1"', "tip": 'limited="true" range="0 1"'}  # and tip = -0.7 drive
    still = CLOSE.replace("0.2", "0.0").replace("0.3", "0.05") + '[limits]\nposition = "off"\n'
    plan, proof = proved(tmp_path, toml=still, **ranges)
    assert not proof.passed
    first = suggested_fixes(plan, proof)[0]
    assert first.value is None
    assert "leaves joint 'drive', joint 'tip' one position alone" in first.sentence
    roomy = ranges | {"tip": 'limited="true" range="-1 1"'}
    plan, proof = proved(tmp_path, toml=CLOSE, **roomy)
    assert not any("one position alone" in one.sentence for one in suggested_fixes(plan, proof))
