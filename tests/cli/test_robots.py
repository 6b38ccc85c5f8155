"""benchmarks/robots.py: problem files by one rule, and what comes of a few machines by others."""

import math
import sysconfig
import tomllib
from pathlib import Path

import numpy as np
import pytest
from robots import tried
from robots_goals import SHARE, Goals
from robots_problems import problem_text
from robots_table import MACHINES, Machine

ARM = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body>
      <joint name="far" axis="0 1 0" limited="true" range="0.5 2.5"/>
      <geom type="capsule" size="0.02" fromto="0 0 0 0 0 0.4"/>
      <body pos="0 0 0.4">
        <joint name="near" axis="0 1 0" limited="true" range="-1 0.2"/>
        <geom type="capsule" size="0.02" fromto="0 0 0 0 0 0.4"/>
        <body pos="0 0 0.4">
          <joint name="follows" axis="0 1 0"/>
          <joint name="loose" axis="1 0 0"/>
          <geom type="capsule" size="0.02" fromto="0 0 0 0 0 0.1"/>
        </body>
      </body>
    </body>
  </worldbody>
  <equality><joint joint1="follows" joint2="near" polycoef="0.1 2 0 0 0"/></equality>
  <actuator><motor joint="far"/><motor joint="near"/></actuator>
  {keyframe}
</mujoco>
"""
HOPPER = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body pos="0 0 1">
      <freejoint/>
      <geom type="sphere" size="0.1"/>
      <body pos="0 0 -0.3">
        <joint name="knee" axis="0 1 0" limited="true" range="-1 1"/>
        <geom type="sphere" size="0.05"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="knee"/></actuator>
</mujoco>
"""
URDF = """
<robot name="two">
  <link name="base"/>
  <link name="upper"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1"/></inertial></link>
  <link name="tip"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1"/></inertial></link>
  <joint name="lift" type="prismatic"><parent link="base"/><child link="upper"/><axis xyz="0 0 1"/>
    <limit lower="0.1" upper="0.5" effort="10" velocity="1"/></joint>
  <joint name="turn" type="continuous"><parent link="upper"/><child link="tip"/><axis xyz="0 0 1"/>
    <limit effort="0"/></joint>
</robot>
"""


def table_of(folder, text, kind, name="machine.xml"):
    (folder / name).write_text(text, encoding="utf-8")
    return tomllib.loads(problem_text(folder / name, kind, folder))


def test_a_pose_outside_of_its_ranges_is_moved_inside_and_ties_are_kept(tmp_path):
    table = table_of(tmp_path, ARM.format(keyframe=""), "arm")
    # far: 0 is outside of 0.5 ... 2.5, more room upwards; near: more room downwards; follows = 0.1 + 2 near
    assert table["start"] == pytest.approx([0.5, 0.0, 0.1, 0.0])
    assert table["goal"] == pytest.approx([0.5 + 0.15 * 2.0, -0.15 * 1.2, 0.1 - 2.0 * 0.18, 0.0])
    assert table["duration"] == 1.5


def test_the_first_keyframe_is_the_start_where_it_is_within_the_ranges(tmp_path):
    keyframe = '<keyframe><key name="home" qpos="{} 0 0.1 0.3"/></keyframe>'
    assert table_of(tmp_path, ARM.format(keyframe=keyframe.format(1)), "hand")["start"] == "home"
    outside = table_of(tmp_path, ARM.format(keyframe=keyframe.format(0)), "hand")
    assert outside["start"] == pytest.approx([0.5, 0.0, 0.1, 0.3])
    assert outside["goal"][3] == 0.3  # nothing drives it


def test_a_machine_with_legs_gets_a_floor_below_its_lowest_point(tmp_path):
    table = table_of(tmp_path, HOPPER, "legged")
    assert Path(table["model"]).name != "machine.xml"
    assert 'type="plane"' in Path(table["model"]).read_text(encoding="utf-8")
    assert 'pos="0 0 0.65"' in Path(table["model"]).read_text(encoding="utf-8")  # 1 - 0.3 - 0.05
    assert table["goal"] == pytest.approx([*table["start"][:7], 0.03 * 2.0])


def test_a_urdf_has_tables_of_its_joints_also_of_those_without_an_effort(tmp_path):
    table = table_of(tmp_path, URDF, "arm", "two.urdf")
    assert table["start"] == pytest.approx({"lift": 0.1, "turn": 0.0})
    assert table["goal"] == pytest.approx({"lift": 0.1 + 0.15 * 0.4, "turn": 0.5})


def test_what_mujoco_cannot_read_is_a_row(tmp_path):
    (tmp_path / "broken.xml").write_text("<mujoco><worldbody>", encoding="utf-8")
    row = tried(Machine("nobody", "arm", "broken.xml"), tmp_path)
    assert (row.verdict, row.machine) == ("no problem", "broken")
    assert row.message


def test_names_and_kinds_are_told_apart():
    assert len({(one.package, one.path) for one in MACHINES}) == len(MACHINES) >= 30


@pytest.mark.slow
@pytest.mark.parametrize("name", ["suite/reacher", "suite/cartpole", "assets/inverted_pendulum"])
def test_machines_of_others_pass_at_the_first_try(name):
    packages = Path(sysconfig.get_paths()["purelib"])
    machine = next(one for one in MACHINES if one.path.endswith(f"{name}.xml"))
    if not (packages / machine.path).is_file():
        pytest.skip(f"{machine.package} is not installed")
    row = tried(machine, packages)
    assert row.verdict == "PASS", row.message
    assert row.load is not None
    assert row.plan is not None
    assert row.verdict_seconds is not None


def test_a_start_that_its_motor_cannot_hold_becomes_one_that_it_can(tmp_path):
    arm = """<mujoco><compiler angle="radian"/><worldbody><body>
      <joint name="a" axis="0 1 0" limited="true" range="-1.6 1.6"/>
      <geom type="capsule" size="0.02" fromto="0 0 0 0.5 0 0" mass="1"/>
    </body></worldbody><actuator><motor joint="a" ctrllimited="true" ctrlrange="-2 2"/></actuator></mujoco>"""
    (tmp_path / "arm.xml").write_text(arm)
    problem = tomllib.loads(problem_text(tmp_path / "arm.xml", "arm", tmp_path))
    for pose in ("start", "goal"):
        assert 9.81 * 0.25 * math.cos(problem[pose][0]) < 2.0


def test_a_file_without_a_unit_whose_ranges_are_radians_gets_it(tmp_path):
    (tmp_path / "arm.xml").write_text(ARM.replace('angle="radian"', "").format(keyframe=""))
    problem = tomllib.loads(problem_text(tmp_path / "arm.xml", "arm", tmp_path))
    assert problem["model"] != str(tmp_path / "arm.xml")
    assert problem["start"][0] == pytest.approx(0.5)


@pytest.mark.parametrize(("heel", "leans"), [(0.3, False), (0.01, True)])
def test_legs_that_topple_lean_at_the_ankle(tmp_path, heel, leans):
    """A rod of 1 m whose foot begins 1 cm behind its ankle, and whose weight is 2 cm behind it, falls backwards."""
    rod = f"""<mujoco><compiler angle="radian"/><worldbody><body name="rod" pos="0 0 1.05"><freejoint/>
      <geom size="0.05" pos="-0.02 0 0" mass="10"/><body pos="0 0 -1"><joint name="ankle" axis="0 1 0" range="-1 1"/>
      <geom type="box" size="{0.5 * (0.2 + heel)} 0.1 0.02" pos="{0.5 * (0.2 - heel)} 0 -0.03" mass="1"/></body></body>
    </worldbody><actuator><motor joint="ankle"/></actuator></mujoco>"""
    start = table_of(tmp_path, rod, "legged")["start"]
    assert (start[7] != 0.0) == leans
    if leans:  # the foot turns up in front of the shin, so that flat on the ground the rod leans forwards
        assert -0.1 <= start[7] < 0.0


def test_goals_of_other_sizes_and_of_seeds_stay_within_the_ranges():
    limits, ways = np.array([-1.0, 3.0]), {}
    for size in SHARE:
        ways[size] = Goals.of(size, None, "arm.xml").way(0.0, limits, "arm")
        drawn = [Goals.of(size, seed, "arm.xml") for seed in range(90)]
        assert 15 < sum(one.rng is not None for one in drawn) < 45  # a third
        assert all(-0.92 <= one.way(0.0, limits, "arm") <= abs(ways[size]) for one in drawn)
    assert ways == pytest.approx({"small": 0.6, "moderate": 0.5, "large": 2.4})
    assert Goals("large").way(1.5, limits, "arm") == pytest.approx(-2.4)  # to the side of more room
