"""Goals of free bases: their joint in a goal, and rest where something can stop it."""

import numpy as np
import pytest
from places import ROOT

import planner
from planner.base.errors import PlannerError
from planner.cases.problem_file import load
from planner.dynamics.kinematics import center_of_mass
from planner.model.capabilities import ballistic_dofs, floating_dofs
from planner.problem.costs.tracking import tracking_of
from planner.problem.goals import goals_of
from planner.problem.tasks.pose_constraints import kept_center_of_mass

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


PLANAR = """<mujoco><option gravity="0 0 {gravity}"/><worldbody>
  <body><joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide" axis="0 0 1" {more}/>
   <joint name="pitch" axis="0 1 0"/><geom size=".2" mass="4" contype="0" conaffinity="0"/>
   <body><joint name="arm" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 .5 0 0" size=".05" mass="1" contype="0"
    conaffinity="0"/></body></body></worldbody><actuator><motor joint="arm" gear="5"/></actuator></mujoco>"""


@pytest.mark.parametrize(
    ("gravity", "more", "found"),
    [
        (0, "", [True, True, True, False]),
        (-9.81, "", [True, True, True, False]),  # it falls along z, and nothing turns it
        (0, 'damping=".1"', [True, True, True, False]),  # z is slowed down, and held nowhere
        (0, 'frictionloss=".1"', [True, False, False, False]),
        (-9.81, 'stiffness="50"', [True, False, False, False]),
    ],
)
def test_bases_float_that_nothing_holds_or_drives(gravity, more, found):
    planar = planner.Mechanism.from_mjcf(PLANAR.format(gravity=gravity, more=more))
    np.testing.assert_array_equal(floating_dofs(planar), found)
    cat = CAT.format(gravity=gravity)
    assert floating_dofs(planner.Mechanism.from_mjcf(cat)).tolist() == [True] * 6 + [False]
    lifted = cat.replace("<actuator>", '<actuator><motor name="lift" joint="root" gear="0 0 1 0 0 0"/>')
    assert not floating_dofs(planner.Mechanism.from_mjcf(lifted))[2:].any()
    pendulum = cat.replace('<freejoint name="root"/>', '<joint name="root" axis="0 1 0"/>')
    assert floating_dofs(planner.Mechanism.from_mjcf(pendulum)).tolist() == [gravity == 0, False]


LEGS = """<body pos="{at} 0 0"><joint name="hip_{at}" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -.2"
  size=".02" contype="0" conaffinity="0"/><site name="foot_{at}" pos="0 0 -.2"/></body>"""


@pytest.mark.parametrize(
    ("held", "base"),
    [
        ('<joint joint1="hip_.1" joint2="hip_-.1"/>', [True] * 3),  # of two legs: an inner force moves no base
        ('<joint joint1="hip_.1" joint2="hip_-.1" polycoef="0 1 .2 0 0"/>', [True] * 3),
        ('<connect site1="foot_.1" site2="foot_-.1"/>', [True] * 3),
        ('<joint joint1="z" joint2="hip_.1" polycoef="0 .1 0 0 0"/>', [True, False, False]),  # a leg lifts the base
        ('<connect body1="trunk" body2="world" anchor="0 0 0"/>', [False] * 3),
    ],
)
def test_forces_within_a_machine_hold_no_base(held, base):
    m = planner.Mechanism.from_mjcf(f"""<mujoco><worldbody><body name="trunk"><joint name="x" type="slide"
      axis="1 0 0"/><joint name="z" type="slide"/><joint name="pitch" axis="0 1 0"/><geom size=".1" contype="0"
      conaffinity="0"/>{LEGS.format(at=".1")}{LEGS.format(at="-.1")}</body></worldbody>
      <equality>{held}</equality><actuator><motor joint="hip_-.1"/></actuator></mujoco>""")
    assert floating_dofs(m)[:3].tolist() == base


def test_a_cat_whose_tail_follows_its_hips_falls_as_without_it(tmp_path):
    """An equality of two joints does not hold the chest: 1.23 m of fall are no missed goal."""
    tail = """<body pos=".3 0 0"><joint name="tail" axis="0 1 0" damping=".01"/><geom type="capsule"
      fromto="0 0 0 .2 0 0" size=".02" mass=".1" contype="0" conaffinity="0"/></body>"""
    text = CAT.replace("</body></body>\n", tail + "</body></body>\n")
    text = text.replace("<actuator>", '<equality><joint joint1="tail" joint2="bend"/></equality><actuator>')
    (tmp_path / "cat.xml").write_text(text.format(gravity=-9.81))
    (tmp_path / "problem.toml").write_text(TEXT + "goal = { bend = 0.5 }\n")
    problem = load(tmp_path / "problem.toml").problem
    mechanism = problem.dynamics.mechanism
    np.testing.assert_array_equal(ballistic_dofs(mechanism, mechanism.home), [True] * 3 + [False] * 5)
    assert {one.name for one in goals_of(problem) if one.unit in ("rad", "m")} == {"bend", "tail"}


@pytest.mark.parametrize("gravity", [0, -9.81])
def test_a_base_that_no_goal_names_goes_where_momentum_takes_it(tmp_path, gravity):
    """Of equal halves each turns by half of the bend, against the other: the chest by -0.5 rad and not by 0."""
    problem = problem_of(tmp_path, "goal = { bend = 1.0 }\n", gravity)
    assert "root" not in " ".join(one.name for one in goals_of(problem) if one.unit in ("rad", "m"))
    plan = planner.solve(problem)
    assert plan.converged
    pitch = 2.0 * np.arctan2(plan.xs[-1, 5], plan.xs[-1, 3])
    assert pitch == pytest.approx(-0.5, abs=0.02)  # rad: with the armature of nothing, to the goal's tolerance
    assert planner.prove(plan, rollouts=0).passed


def test_a_goal_that_moves_the_centre_of_mass_of_a_floating_machine_is_refused(tmp_path):
    """The hips swing up by 1 rad: 0.15 sin(1) = 0.1262 m of their centre, of which the whole has half."""
    with pytest.raises(PlannerError, match=r"moves the centre of mass by .* root z \+0.06311 m"):
        problem_of(tmp_path, "goal = { root = [0, 0, 3, 1, 0, 0, 0], bend = 1.0 }\n", gravity=0)


def test_a_free_joint_in_a_goal_is_the_pose_of_its_body(tmp_path):
    joints = "[[goal]]\njoints = { root = [0, 0, 3, 0.995, 0, 0.0998, 0], bend = 0.5 }\ntolerance = 0.05\n"
    goals = {one.name for one in goals_of(problem_of(tmp_path, joints, gravity=0))}
    assert {"position of chest", "orientation of chest", "bend"} <= goals
    with pytest.raises(PlannerError, match=r"root of goal 1 \(joints\), \[x, y, z\] m and a quaternion"):
        problem_of(tmp_path, "[[goal]]\njoints = { root = [0, 0, 3] }\n", gravity=0)


@pytest.mark.slow
def test_a_frame_of_what_floats_goes_where_its_centre_of_mass_stays(tmp_path):
    """Nothing pushes it from outside: a frame within its size is reached by bending, one beyond is refused at once."""
    sat = ROOT / "benchmarks" / "moving"
    (tmp_path / "satellite.xml").write_text((sat / "satellite.xml").read_text())
    turn = load(sat / "satellite-turn.toml").problem
    m, ends = turn.dynamics.mechanism, tracking_of(turn.cost).x_ref[[0, -1], : turn.dynamics.mechanism.nq]
    before, after = (center_of_mass(m, q) for q in ends)
    np.testing.assert_allclose(after, before, atol=2e-3)  # 1 mm is a residual of 1, and up to 1 passes
    text = (sat / "satellite-turn.toml").read_text().replace("orientation = { yaw = 60 }", "position = [1.0, 0.0, 0.0]")
    (tmp_path / "away.toml").write_text(text)
    with pytest.raises(PlannerError, match="nothing pushes the machine from outside and its centre of mass stays"):
        load(tmp_path / "away.toml")


TABLE = """<mujoco><option gravity="{gravity}"/><worldbody><body><joint name="x" type="slide" axis="1 0 0"/>
  <joint name="y" type="slide" axis="0 1 0"/>{yaw}<geom size=".2" mass="4" contype="0" conaffinity="0"/>
  <body pos=".2 0 0"><joint name="arm" axis="0 0 1" damping=".1"/><geom type="capsule" fromto="0 0 0 .5 0 0" size=".05"
   mass="1" contype="0" conaffinity="0"/><body pos=".5 0 0"><joint name="elbow" axis="0 0 1" damping=".1"/>
   <geom type="capsule" fromto="0 0 0 .4 0 0" size=".04" mass=".6" contype="0" conaffinity="0"/>
   <site name="tip" pos=".4 0 0"/></body></body></body></worldbody>
  <actuator><motor joint="arm" ctrlrange="-5 5"/><motor joint="elbow" ctrlrange="-5 5"/></actuator></mujoco>"""


@pytest.mark.parametrize("gravity", ["0 0 0", "0 0 -9.81", "0 -9.81 0"])
@pytest.mark.parametrize("yaw", ["", '<joint name="yaw" axis="0 0 1"/>'])
def test_what_floats_on_a_table_keeps_its_centre_of_mass(tmp_path, gravity, yaw):
    """Unless the table is upright, where it falls."""
    (tmp_path / "table.xml").write_text(TABLE.format(gravity=gravity, yaw=yaw))
    goal = '[[goal]]\nframe = "tip"\nposition = [{}, 0.4, 0]\n'
    text = 'model = "table.xml"\nstart = {}\nduration = 2.0\n'
    m = planner.Mechanism.from_mjcf(TABLE.format(gravity=gravity, yaw=yaw))
    assert floating_dofs(m).tolist() == [True] * (m.nv - 2) + [False] * 2
    dynamics, falls = planner.RigidBodyDynamics(m, 0.01), gravity.startswith("0 -")
    kept = kept_center_of_mass(dynamics, m.home)
    assert (kept is None) == falls
    if falls:
        return
    (tmp_path / "near.toml").write_text(text + goal.format(0.8))
    poses = tracking_of(load(tmp_path / "near.toml").problem.cost).x_ref[[0, -1], : m.nq]
    before, after = (center_of_mass(m, q) for q in poses)
    np.testing.assert_allclose(after, before, atol=2e-3)  # as above
    assert np.abs(poses[1, :2]).max() > 0.02  # m: the base goes the other way
    (tmp_path / "away.toml").write_text(text + goal.format(2.0))
    with pytest.raises(PlannerError, match="nothing pushes the machine from outside and its centre of mass stays"):
        load(tmp_path / "away.toml")
    q, d = poses[1], 1e-6 * np.eye(m.nv)
    slopes = [(kept(q + one)[0] - kept(q - one)[0]) / 2e-6 for one in d]
    np.testing.assert_allclose(kept(q)[1], np.transpose(slopes), atol=1e-5)


def test_a_base_that_is_prescribed_goes_where_its_way_takes_it(tmp_path):
    base = "".join(
        f'<joint name="{a}" type="slide" axis="{v}"/>' for a, v in (("x", "1 0 0"), ("y", "0 1 0"), ("z", "0 0 1"))
    )
    (tmp_path / "crane.xml").write_text(
        f"""<mujoco><option gravity="0 0 0"/><worldbody><body>{base}<geom size=".1" mass="5"/>
        <body pos=".2 0 0"><joint name="e" axis="0 1 0"/><geom size=".03" mass="1"/>
        <site name="tip" pos=".3 0 0"/></body></body></worldbody>
        <actuator><motor joint="e" ctrlrange="-5 5"/></actuator></mujoco>"""
    )
    keys = 'model = "crane.xml"\nstart = {}\nduration = 1.0\n[[goal]]\nframe = "tip"\nposition = [1.5, 0.0, 0.0]\n'
    (tmp_path / "free.toml").write_text(keys)
    with pytest.raises(PlannerError, match="nothing pushes the machine from outside"):
        load(tmp_path / "free.toml")
    (tmp_path / "held.toml").write_text('prescribed = ["x", "y", "z"]\n' + keys)
    assert load(tmp_path / "held.toml").problem.N > 0
