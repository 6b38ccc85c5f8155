"""Grippers whose equality is soft in the file: what is suggested, and gains that shake the file alone."""

from dataclasses import replace

import pytest

import planner
from planner.base.measured import Measurement, Section
from planner.proof.diagnostics import suggested_fixes
from planner.proof.original_model import EQUALITY_RATE, PATH_WITH_GAINS, TIMESTEP

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


def test_a_path_that_a_held_control_leaves_with_and_without_gains_gets_a_stiffer_equality(tmp_path, monkeypatch):
    """Gains at every step of the simulator would shake the servo; as a controller applies them they follow."""
    plan, proof = proved(tmp_path, more="dt = 0.01\n")
    assert not proof.your_file.passed
    assert all(one.name.startswith("largest_") for one in proof.your_file.failures)
    (only,) = suggested_fixes(plan, proof)
    assert only.code == "equality_gives"
    solref = f'solref="{only.values["time"]:.2g} 1"'
    assert solref in str(only)
    monkeypatch.setitem(globals(), "GRIPPER", GRIPPER.replace("/></equality>", f" {solref}/></equality>"))
    assert proved(tmp_path, more="dt = 0.01\n")[1].passed


@pytest.mark.slow
def test_a_plan_whose_gains_shake_the_file_alone_passes_for_open_loop_only(tmp_path):
    """The soft equality gives the file a mode that the plan does not know, and one period late the gains excite it.

    Friction of the file that the plan leaves out, and that acts within a step of the proof, moves the controls' path
    too: then neither mode passes.
    """
    _, proof = proved(tmp_path, more="dt = 0.0025\n")
    assert proof.refined_feedback.passed
    assert proof.your_file.passed
    assert (proof.verdict, proof.mode, proof.robustness) == ("PASS", "open-loop", "open loop only")
    assert {one.name for one in proof.lost_with_gains} >= {"replayed_angular_velocity_miss"}
    assert "open loop only: in your file with its gains " in proof.headline
    rubs = {"drive": 'frictionloss="1" solreffriction="0.001 1"', "more": 'dt = 0.0025\nignore = ["frictionloss"]\n'}
    _, rubbing = proved(tmp_path, **rubs)
    assert rubbing.refined_open_loop.passed
    assert rubbing.verdict == "FAIL"
    assert {one.name for one in rubbing.your_file.failures} >= {"largest_angle_error"}


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


def test_how_much_stiffer_an_equality_is_to_be_depends_on_what_it_lets_go(tmp_path):
    """Positions fall as the inverse square of its rate, velocities as the inverse; 2 is to spare."""
    (tmp_path / "hangs.xml").write_text(HANGS)
    (tmp_path / "problem.toml").write_text(
        'model = "hangs.xml"\nstart = { drive = 0.0 }\ngoal = { drive = 0.2 }\nduration = 1.0\ndt = 0.01\n'
    )
    plan = planner.solve(planner.load_problem(tmp_path / "problem.toml"))
    proof = planner.prove(plan, rollouts=0)

    def times(rate, failed, step=5e-4):
        found = [Measurement(name, *values) for name, values in failed.items()]
        found += [Measurement(EQUALITY_RATE, rate, "rad/s", None), Measurement(TIMESTEP, step, "s", None)]
        judged = replace(proof, sections=proof.sections | {"your_file": Section("your file", tuple(found))})
        fixes = [one for one in suggested_fixes(plan, judged) if one.code.startswith("equality_gives")]
        assert all((one.code == "equality_gives_too_much") == ("move more slowly, or" in str(one)) for one in fixes)
        return [(one.values["time"], one.code == "equality_gives") for one in fixes]

    velocity, angle = (
        {"replayed_angular_velocity_miss": (0.4, "rad/s", 0.1)},
        {"largest_angle_error": (0.04, "rad", 0.01)},
    )
    assert times(50.0, angle) == [(pytest.approx(0.02 / 8.0**0.5), True)]
    assert times(50.0, angle | velocity) == [(pytest.approx(0.02 / 8.0), True)]
    path = {"largest_angular_velocity_error": (0.4, "rad/s", 50.0 * 0.01 * 0.1)}  # a bound that rises with the rate
    assert times(50.0, path) == [(pytest.approx(0.02 / 16.0**0.5), True)]
    assert times(50.0, velocity, step=2e-3) == [(pytest.approx(4e-3), False)]  # MuJoCo takes none below two steps
    assert times(1e8, velocity) == []  # as a URDF's mimic is written: no spring, something else is the cause
