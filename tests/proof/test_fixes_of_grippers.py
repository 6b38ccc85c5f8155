"""suggested_fixes(): gains of a held control that shake a servo, and ranges that leave a joint no room."""

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
    assert first.value == pytest.approx(0.0025)  # the longest that people would write in which it swings half a radian
    assert first.code == "gains_too_fast"
    _, again = proved(tmp_path, more=f"{first.key} = {first.value}\n")
    assert again.passed
