"""Ranges of the model as limits of a plan: margins, starts and goals at the ends, defaults of a problem file."""

from dataclasses import replace

import numpy as np
import pytest
from carts import CART, refuse

import planner
from planner import Limits, Mechanism, PlannerError, Problem, RigidBodyDynamics, TrackingCost
from planner.cases.problem_file import load
from planner.model.contact.laws import Law, Stop
from planner.problem.joint_limits import GOAL_OFFSET, START_OFFSET

REACH = """
<mujoco>
  <option gravity="0 0 -9.81"/>
  <worldbody>
    <body>
      <joint name="slide" type="slide" axis="1 0 0" range="-0.5 0.5" limited="true" damping="1"/>
      <geom size="0.05" mass="2"/>
      <body>
        <joint name="turn" axis="0 1 0" range="-114.59155902616465 57.29577951308232" limited="true" damping="0.2"/>
        <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.3" mass="0.5"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="slide"/><motor name="twist" joint="turn" ctrlrange="-4 4"/></actuator>
</mujoco>
"""


def reach(start=(0.0, 0.0), goal=(0.2, 0.5), text=REACH, N=50, **limits):
    dynamics = RigidBodyDynamics(Mechanism.from_mjcf(text, contacts="off"), 0.02)
    cost = TrackingCost.joints(dynamics, [*goal, 0.0, 0.0], N, effort=0.01, final_position=1e3, final_velocity=1e3)
    limits = Limits(**({"control": "model", "position": "model"} | limits))
    return Problem(dynamics, cost, [*start, 0.0, 0.0], limits=limits)


def kept(problem):
    """Lower and upper bounds of slide and turn at the knots."""
    ranges = problem.ranges
    low, high = (side + ranges.reference[:, :2] for side in (ranges.lower[:, :2], ranges.upper[:, :2]))
    return low[1], high[1]


def test_ranges_are_kept_with_a_margin():
    low, high = kept(reach())
    np.testing.assert_allclose(low, [-0.49, -1.97])  # 1 % of 1 m and of 3 rad
    np.testing.assert_allclose(high, [0.49, 0.97])
    low, high = kept(reach(margin=0.05))
    np.testing.assert_allclose(low, [-0.45, -1.95])
    low, high = kept(reach(margin={"turn": 0.2}))
    np.testing.assert_allclose(high, [0.49, 0.8])
    low, high = kept(reach(goal=(0.0, -0.5), margin=100.0))  # never beyond the middle, but for the goal
    np.testing.assert_allclose(low, [0.0, -0.5])
    np.testing.assert_allclose(high, [0.0, 0.0])


@pytest.mark.parametrize(("range_", "margin"), [("-0.5 0.5", 0.01), ("0 0.02", 2e-4 * 5), ("0 0.004", 4e-4)])
def test_a_finger_keeps_a_margin_of_a_tenth_at_most(range_, margin):
    """A range of 20 mm keeps 1 mm, one of 4 mm a tenth."""
    problem = reach(goal=(0.001, 0.5), start=(0.001, 0.0), text=REACH.replace("-0.5 0.5", range_))
    _, high = kept(problem)
    assert high[0] == pytest.approx(float(range_.split()[1]) - margin)


def test_starts_and_goals_at_the_very_ends_are_met():
    problem = reach(start=(-0.5, 0.995), goal=(0.497, -2.0))
    low, high = kept(problem)
    np.testing.assert_allclose(low, [-0.5, -2.0])
    np.testing.assert_allclose(high, [0.497, 0.995])
    plan = planner.solve(problem)
    assert plan.success
    np.testing.assert_allclose(plan.xs[-1], [0.497, -2.0, 0.0, 0.0], atol=5e-3)
    beyond = reach(start=(-0.5 - 4e-7, 0.0))  # by rounding: taken, and the bound is the file's
    assert kept(beyond)[0][0] == pytest.approx(-0.5, abs=1e-15)


def test_what_is_outside_says_what_to_write():
    with pytest.raises(PlannerError, match=r"the start has slide at 0.7 m, expected -0.5 ... 0.5 m: write 0.5, or"):
        reach(start=(0.7, 0.0))
    with pytest.raises(PlannerError, match=r"the goal has turn at 1.2 rad, expected -2 ... 1 rad: write 1, or lim"):
        reach(goal=(0.0, 1.2))
    reach(goal=(0.0, 1.2), position={"turn": "off"})
    reach(goal=(0.0, 1.2), position="off")
    with pytest.raises(PlannerError, match="margin"):
        reach(margin=-1.0)
    with pytest.raises(PlannerError, match="margin"):
        reach(margin={"wrist": 0.1})


def test_a_plan_at_its_ranges_is_proven():
    """The swing would pass the stop by far: within its limits no step fails by it."""
    free = planner.solve(reach(goal=(0.2, 0.98), position="off", control="off"))
    assert free.xs[:, 1].max() > 0.97
    plan = planner.solve(reach(goal=(0.2, 0.98)))
    assert plan.success
    proof = planner.prove(plan, rollouts=0)
    assert proof.passed, str(proof)
    assert {one.name: one.value for one in proof.your_file.measured}["unknown_stops"] == 0.0


def test_a_stop_begins_at_the_margin_of_its_joint():
    """MuJoCo's attribute `margin`: the stop pushes from there on."""
    text = REACH.replace('axis="0 1 0" range', 'axis="0 1 0" margin="0.05" range')
    machine = Mechanism.from_mjcf(text, contacts="off")
    np.testing.assert_allclose(machine.joint_range, [[-0.5, 0.5], [-1.95, 0.95]])


def test_stops_that_the_plan_models_are_no_limits():
    stop = Stop(1, 1.0, 1, Law(1e4, 10.0))
    problem = reach()
    machine = replace(problem.dynamics.mechanism, stops=(stop,))
    again = replace(problem, dynamics=RigidBodyDynamics(machine, 0.02))
    assert problem.ranges.component.tolist() == [0, 1]
    assert again.ranges.component.tolist() == [0]


def test_limits_of_velocities_come_from_the_mechanism():
    machine = replace(Mechanism.from_mjcf(REACH, contacts="off"), velocity_limit=np.array([np.inf, 1.5]))
    dynamics = RigidBodyDynamics(machine, 0.02)
    cost = TrackingCost.joints(dynamics, [0.2, 0.5, 0.0, 0.0], 20, effort=1.0, final_position=1.0)
    ranges = Problem(dynamics, cost, np.zeros(4), limits=Limits(velocity="model")).ranges
    assert ranges.component.tolist() == [3]
    assert ranges.upper[1, 0] == 1.5
    slower = Problem(dynamics, cost, np.zeros(4), limits=Limits(velocity={"slide": 1.0})).ranges
    assert slower.component.tolist() == [2, 3]
    assert Problem(dynamics, cost, np.zeros(4), limits=Limits(velocity={"turn": "off"})).ranges is None


def problem_file(folder, limits="", goal="{ slide = 0.2, turn = 0.5 }", text=REACH):
    (folder / "reach.xml").write_text(text, encoding="utf-8")
    path = folder / "problem.toml"
    lines = ['model = "reach.xml"', "start = [0.0, 0.0]", f"goal = {goal}", "duration = 1.0", "dt = 0.02", limits]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def test_the_model_s_limits_hold_in_a_problem_file(tmp_path):
    problem = load(problem_file(tmp_path)).problem
    assert problem.bounds.upper[0].tolist() == [np.inf, 4.0]
    np.testing.assert_allclose(kept(problem)[1], [0.49, 0.97])
    again = planner.load_plan(planner.solve(problem).save(tmp_path / "plan.npz"))
    assert again.problem.limits.to_dict() == problem.limits.to_dict()
    refuse(problem_file(tmp_path, goal="{ turn = 1.2 }"), "the goal has turn at 1.2 rad", "write 1")


def test_limits_are_switched_off(tmp_path):
    problem = load(problem_file(tmp_path, 'limits = "off"')).problem
    assert problem.bounds is None
    assert problem.ranges is None
    again = planner.load_plan(planner.solve(problem).save(tmp_path / "plan.npz"))
    assert again.problem.bounds is None
    one = load(problem_file(tmp_path, '[limits]\ncontrol = "off"\nmargin = { turn = 0.1 }')).problem
    assert one.bounds is None
    np.testing.assert_allclose(kept(one)[1], [0.49, 0.9])
    other = load(problem_file(tmp_path, "[limits]\nposition = { slide = [-0.3, 0.3] }")).problem
    np.testing.assert_allclose(kept(other)[1], [0.3, 0.97])
    refuse(problem_file(tmp_path, 'limits = "none"'), "'none'", "expected one of: off")
    refuse(problem_file(tmp_path, "[limits]\nmargin = -1"), "margin")


def test_a_file_without_ranges_has_no_limits(tmp_path):
    problem = load(problem_file(tmp_path, text=CART.replace("slider", "slide").replace("pole", "turn"))).problem
    assert problem.bounds is None
    assert problem.ranges is None


def test_a_start_at_a_stop_is_put_off_it(tmp_path):
    stopped = REACH.replace('axis="0 1 0" range', 'axis="0 1 0" margin="0.01" range')
    file = problem_file(tmp_path, goal="{ slide = 0.5, turn = 0.995 }", text=stopped)
    file.write_text(file.read_text().replace("[0.0, 0.0]", "[-0.5, 0.996]"), encoding="utf-8")
    problem = load(file).problem
    turn = 1.0 - 0.01  # where the stop lets go
    np.testing.assert_allclose(problem.x0[:2], [-0.5 + START_OFFSET, turn - START_OFFSET])
    np.testing.assert_allclose(problem.cost.x_ref[-1, :2], [0.5 - GOAL_OFFSET, turn - GOAL_OFFSET])
    assert "joint 'slide' and 1 more at a stop" in problem.recipe.parameters["resolved"]["reasons"]["stops"]
    refuse(problem_file(tmp_path, goal="{ turn = 1.02 }", text=stopped), "the goal has turn at 1.02 rad")


def test_a_joint_that_others_follow_is_put_off_its_stop_with_them(tmp_path):
    tied = REACH.replace(
        "<actuator>", '<equality><joint joint1="turn" joint2="slide" polycoef="0.9 1 0 0 0"/></equality><actuator>'
    )
    tied = tied.replace('<motor name="twist" joint="turn" ctrlrange="-4 4"/>', "")
    file = problem_file(tmp_path, goal="{ slide = 0.0 }", text=tied)
    file.write_text(file.read_text().replace("[0.0, 0.0]", "[-0.5, 0.4]"), encoding="utf-8")
    slide = -0.5 + START_OFFSET
    np.testing.assert_allclose(load(file).problem.x0[:2], [slide, 0.9 + slide])


SHARED = """
<mujoco><default><geom size="0.05" contype="0" conaffinity="0"/><joint type="slide" axis="1 0 0" damping="1"/></default>
<worldbody>
  <body><joint name="a"/><geom/></body>
  <body><joint name="b" range="0 1" limited="true"/><geom/></body>
  <body><joint name="c" range="0 1" limited="true"/><geom/></body>
</worldbody>
<tendon><fixed name="sum">
  <joint joint="a" coef="1"/><joint joint="b" coef="1"/><joint joint="c" coef="1"/>
</fixed></tendon>
<equality><tendon tendon1="sum" polycoef="1 0 0 0 0"/></equality>
<actuator><motor joint="a"/><motor joint="b"/></actuator></mujoco>
"""


def test_a_joint_stays_at_its_stop_where_what_follows_it_would_leave_its_own(tmp_path):
    """a + b + c = 1: b off its stop at 0 would take c below 0."""
    (tmp_path / "shared.xml").write_text(SHARED)
    text = 'model = "shared.xml"\nstart = [1, 0, 0]\ngoal = { a = 0.7, b = 0.2 }\nduration = 1.0\n'
    (tmp_path / "shared.toml").write_text(text)
    np.testing.assert_array_equal(load(tmp_path / "shared.toml").problem.x0[:3], [1.0, 0.0, 0.0])


PASSIVE = """
<mujoco><compiler angle="radian"/><default><geom contype="0" conaffinity="0"/></default>
<worldbody><body>
  <joint name="near" axis="0 1 0" damping="0.1"/><geom size="0.02" fromto="0 0 0 0 0 -0.1" type="capsule" mass="0.1"/>
  <body pos="0 0 -0.1">
    <joint name="far" axis="0 1 0" damping="0.1" range="0 1.5"/>
    <geom size="0.02" fromto="0 0 0 0 0 -0.1" type="capsule" mass="0.1"/>
  </body></body></worldbody>
<actuator><motor joint="near"/></actuator></mujoco>
"""


def test_a_goal_far_beyond_a_stop_that_the_plan_models_is_refused(tmp_path):
    (tmp_path / "finger.xml").write_text(PASSIVE)
    text = 'model = "finger.xml"\ngoal = {{ near = 0.3, far = {} }}\nduration = 1.0\n'
    (tmp_path / "finger.toml").write_text(text.format(-0.3))  # a stop gives by less than a tenth of its range
    with pytest.raises(planner.PlannerError, match=r"the goal has far at -0.3 rad, expected 0 ... 1.5 rad: write 0"):
        planner.load_problem(tmp_path / "finger.toml")
    (tmp_path / "finger.toml").write_text(text.format(-0.1))
    assert planner.load_problem(tmp_path / "finger.toml").ranges is None
    (tmp_path / "finger.toml").write_text(text.format(-0.3) + 'limits = { position = { far = "off" } }\n')
    assert planner.load_problem(tmp_path / "finger.toml").ranges is None  # as the refusal says


def test_the_allowance_at_a_stop_is_a_share_of_the_files_range(tmp_path):
    """Margins that nearly meet leave a plan's range next to nothing, and the file's as wide as it is."""
    (tmp_path / "finger.xml").write_text(PASSIVE.replace('range="0 1.5"', 'range="0 1.5" margin="0.74"'))
    text = 'model = "finger.xml"\nstart = { far = 0.1 }\ngoal = { near = 0.3 }\nduration = 1.0\n'
    (tmp_path / "finger.toml").write_text(text)
    assert planner.load_problem(tmp_path / "finger.toml").x0[1] == 0.1


@pytest.mark.parametrize(("goal", "nearest"), [(7.0, 2.2), (-5.0, -1.8)])
def test_a_goal_that_takes_a_follower_out_of_its_range_is_told_what_to_write_of_its_leader(tmp_path, goal, nearest):
    """The tip is at 0.2 - lead and within -2 ... 2, so the lead within -1.8 ... 2.2; nobody writes the tip."""
    (tmp_path / "mirror.xml").write_text("""<mujoco><compiler angle="radian"/><worldbody><body>
      <joint name="lead" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 .1 0 0" size=".01" mass=".1"/>
      <body pos=".1 0 0"><joint name="tip" axis="0 1 0" range="-2 2" limited="true"/>
       <geom type="capsule" fromto=".02 0 0 .1 0 0" size=".01" mass=".1"/></body></body></worldbody>
      <equality><joint joint1="tip" joint2="lead" polycoef="0.2 -1 0 0 0"/></equality>
      <actuator><motor joint="lead"/></actuator></mujoco>""")
    (tmp_path / "problem.toml").write_text(f'model = "mirror.xml"\ngoal = {{ lead = {goal} }}\nduration = 1.0\n')
    with pytest.raises(PlannerError, match=rf"has tip at .* rad, expected -2 \.\.\. 2 rad: write lead = {nearest}, or"):
        load(tmp_path / "problem.toml")


def test_the_hint_about_degrees_is_for_the_leaders_unit(tmp_path):
    """A hinge that follows a slide of 7 m is told nothing of angles; a slide that follows a hinge at 60 rad is."""
    text = """<mujoco><compiler angle="radian"/><worldbody><body>
      <joint name="lead" type="{}" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 .1 0 0" size=".01" mass=".1"/>
      <body pos=".1 0 0"><joint name="tip" type="{}" axis="0 1 0" range="-2 2" limited="true"/>
       <geom type="capsule" fromto=".02 0 0 .1 0 0" size=".01" mass=".1"/></body></body></worldbody>
      <equality><joint joint1="tip" joint2="lead" polycoef="0 1 0 0 0"/></equality>
      <actuator><motor joint="lead"/></actuator></mujoco>"""
    for kinds, goal, told in ((("slide", "hinge"), 7.0, False), (("hinge", "slide"), 60.0, True)):
        (tmp_path / "mirror.xml").write_text(text.format(*kinds))
        (tmp_path / "problem.toml").write_text(f'model = "mirror.xml"\ngoal = {{ lead = {goal} }}\nduration = 1.0\n')
        with pytest.raises(PlannerError, match=r"has tip at .*: write lead = 2") as refused:
            load(tmp_path / "problem.toml")
        assert ("60 deg are 1.0472" in str(refused.value)) is told
        assert ("Angles" in str(refused.value)) is told


SPRING_LEG = """
<mujoco><worldbody><geom type="plane" size="5 5 0.1"/>
  <body pos="0 0 0.5"><joint name="lift" type="slide" axis="0 0 1"/><geom type="sphere" size="0.05" mass="3"/>
    <body pos="0 0 -0.2"><joint name="leg" type="slide" axis="0 0 1"/><geom size="0.03" mass="0.3" contype="0"/>
      <body pos="0 0 -0.1"><joint name="spring" type="slide" axis="0 0 1" range="-0.02 0.06" stiffness="3000"/>
        <geom type="sphere" size="0.03" mass="0.2"/>
      </body>
    </body>
  </body></worldbody><actuator><motor joint="leg"/></actuator></mujoco>
"""


def test_poses_are_sought_between_stops_that_the_machine_models():
    """A spring in a leg: no pose has it 8 cm long for what its leg lacks, which a goal is then refused for.

    The spring leans on a stop by a tenth of its range of 8 cm at most.
    """
    machine = planner.Mechanism.from_mjcf(SPRING_LEG, contacts="ground")
    dynamics = planner.RigidBodyDynamics(machine, 0.01)
    assert [stop.dof for stop in machine.stops] == [2, 2]
    ends = planner.Limits(position="model").position_ranges(dynamics)
    np.testing.assert_allclose(ends, [[-np.inf, np.inf], [-np.inf, np.inf], [-0.028, 0.068]])
    assert np.isinf(planner.Limits(position={"spring": "off"}).position_ranges(dynamics)).all()
