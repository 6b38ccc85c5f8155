"""A machine is described whatever is wrong with it: what it is, what mends it, and a problem to start from."""

from dataclasses import replace

import numpy as np
import pytest

from planner.base.errors import ModelError
from planner.base.gl import load_mujoco
from planner.cases.problem_file import load_problem
from planner.cases.problem_file.starter_file import starter_text
from planner.dynamics.algorithms import bias
from planner.model.mjcf.model_file import open_model_file
from planner.problem.description import HOME, describe, holding
from planner.problem.example_task import example_task

ARM = """<mujoco model="arm"><compiler angle="radian"/>{head}<worldbody>{world}
  <body name="upper" pos="0 0 1"><joint name="shoulder" axis="0 1 0" range="-2 2" limited="true" damping=".2"/>
    <geom name="upper" type="capsule" fromto="0 0 0 .4 0 0" size=".03" mass="2"/>
    <body name="fore" pos=".4 0 0"><joint name="elbow" axis="0 1 0" range="{elbow}" limited="true" {more}/>
      <geom name="fore" type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass="1"/></body></body></worldbody>
  <actuator>{motors}</actuator>{tail}</mujoco>"""
MOTORS = '<motor name="m1" joint="shoulder" ctrlrange="-40 40"/><motor name="m2" joint="elbow" ctrlrange="-20 20"/>'


def arm(**parts):
    parts = {"head": "", "world": "", "elbow": "-1 1", "more": "", "motors": MOTORS, "tail": ""} | parts
    return open_model_file(ARM.format(**parts))


def problems(file):
    return {trouble.problem: trouble.fix for trouble in describe(file).troubles}


def only(found, *fragments):
    """The mending of the only problem, whose sentence has these fragments."""
    assert len(found) == 1, found
    ((sentence, mend),) = found.items()
    assert all(fragment in sentence for fragment in fragments), sentence
    return mend


def test_a_sound_arm_is_described_and_nothing_is_wrong_with_it():
    known = describe(arm())
    assert (known.name, known.degrees_of_freedom, known.mass, list(known.poses)) == ("arm", 2, 3.0, [HOME])
    assert [joint["range"] for joint in known.joints] == [[-2.0, 2.0], [-1.0, 1.0]]
    assert (known.joints[0]["damping"], known.joints[0]["armature"]) == (0.2, None)
    assert known.joints[0]["velocity_limit"] is None
    assert [actuator["kind"] for actuator in known.actuators] == ["motor", "motor"]
    assert "2 degrees of freedom" in known.planned
    assert known.troubles == []
    assert known.loaded.refusal == ""


def test_kinds_of_actuators_are_told_apart():
    servos = """<position name="p" joint="shoulder" kp="50" kv="3"/><velocity name="v" joint="elbow" kv="2"/>
      <intvelocity name="i" joint="elbow" kp="9" actrange="-1 1"/><motor name="off" joint="elbow" group="3"/>
      <general name="lag" joint="elbow" dyntype="filter" dynprm=".1"/><muscle name="pull" joint="elbow"/>"""
    known = describe(arm(motors=servos, head='<option actuatorgroupdisable="3"/>'))
    assert [actuator["kind"] for actuator in known.actuators] == [
        "position servo, kp 50, kv 3", "velocity servo, kv 2", "velocity servo, kp 9", "switched off",
        "motor behind a filter", "muscle",
    ]  # fmt: skip
    assert known.loaded.mechanism is not None
    assert "actuator" in known.loaded.keys.get("ignore", [])  # the muscle is taken out, and that is said
    assert known.left_out == ["1 actuator"]


def test_what_no_plan_can_be_made_with_is_described_too():
    mocap = '<body name="hand" mocap="true" pos="0 0 3"><geom size=".1"/></body>'
    flex = '<flexcomp name="cloth" type="grid" count="3 3 1" spacing=".1 .1 .1" pos="0 0 2" dim="2" mass="1"/>'
    for extra in (mocap, flex):
        known = describe(arm(world=extra))
        assert len(known.joints) >= 2
        if known.loaded.mechanism is None:
            assert known.loaded.refusal
            assert known.left_out
    with pytest.raises(ModelError, match="no joints"):
        describe(open_model_file("<mujoco><worldbody/></mujoco>"))


WEDGE = '<asset><mesh name="wedge" vertex="0 0 0 .1 0 0 0 .1 0 0 0 .1"/></asset>'
BALL = '<body name="ball" pos="0 2 .3"><freejoint/><geom name="ball" size=".1"/></body>'


FLOOR = '<geom name="floor" type="plane" size="0 0 1"/>'
STONE = '<geom type="mesh" mesh="wedge" pos="0 0 4"/>'


@pytest.mark.parametrize(
    ("world", "mode"),
    [("", ""), (FLOOR, "avoid"), (STONE, "avoid"), (f"{FLOOR}{STONE}{BALL}", "avoid")],
    ids=["nothing to touch", "held above a floor", "a mesh", "a ball beside an arm"],
)
def test_any_contacts_are_loaded_without_a_key_and_their_mode_is_told(world, mode):
    file = arm(world=world, head=WEDGE)
    known = describe(file)
    assert known.loaded.mechanism is not None
    assert (known.loaded.keys, known.loaded.refusal) == ({}, "")
    assert (known.contacts["mode"], known.contacts["choice"]) == (mode, known.loaded.mechanism.contacts_choice)
    assert bool(known.contacts["choice"]) == bool(mode)
    assert known.contacts["with_planes"] == (mode == "ground")
    untold = [f"contacts of all {len(file.survey.pairs)} pairs of shapes that may touch"]
    assert (known.left_out == untold) == (mode == "avoid")


def test_what_is_refused_is_taken_out_and_what_is_modelled_is_told():
    bent = '<tendon tendon1="t" tendon2="u" polycoef="0 1 1"/>'
    tail = f"""<tendon><fixed name="t" stiffness="1"><joint joint="elbow" coef="1"/></fixed>
      <fixed name="u"><joint joint="shoulder" coef="1"/></fixed></tendon>
      <equality><joint joint1="elbow" joint2="shoulder"/>{bent}</equality>"""
    known = describe(arm(more='frictionloss=".1"', tail=tail))
    assert known.loaded.keys == {"ignore": ["equality"]}
    assert known.loaded.refusal.endswith('; ignore = ["equality"] loads it without.')
    assert "friction loss of 1 joint" in known.planned
    assert "1 fixed tendon" in known.planned
    assert describe(arm(tail=tail.replace(bent, ""))).planned.count("1 coupling of joints") == 1


def test_each_problem_comes_with_what_mends_it():
    assert "prescribed" in only(problems(arm(motors="")), "no actuators")
    assert "gravity" in only(problems(arm(head='<option gravity="0 0 0"/>')), "gravity is 0")
    assert only(problems(arm(elbow="0.4 1")), "elbow", "0.4 to 1") == "start = { elbow = 0.4 }"
    key = '<keyframe><key name="far" qpos="0 1.5"/></keyframe>'
    assert "keyframe" in only(problems(arm(tail=key)), "'far'", "1.5")
    weak = MOTORS.replace("-40 40", "-1 1")
    assert only(problems(arm(motors=weak)), "'m1'", "ctrlrange is -1 to 1").startswith("ctrlrange=")
    # a link of a thousandth of the other's length and mass: its inertia about its joint is smaller by 1e9
    speck = '<body name="speck" pos="0 1 0"><joint name="speck" axis="0 1 0"/><geom size="3e-4" mass="2e-3"/></body>'
    assert only(problems(arm(world=speck)), "inertia at joint 'speck'").startswith("armature=")
    ball = '<geom name="ball" size=".1" pos=".6 0 1"/>'
    assert "start" in only(problems(arm(world=ball)), "ball", "within each other")
    radians = {"elbow": "-.05 .05", "head": '<compiler angle="degree"/>'}
    assert "radian" in only(problems(arm(**radians)), "as if its range in radians were read as degrees")


def test_a_start_at_the_end_of_a_range_is_no_problem_for_rounding_and_names_are_quoted():
    """A servo at the lower end of its range, with nothing to hold but -1e-19: its ctrlrange reaches to 0."""
    servo = '<position name="p" joint="shoulder" kp="50" ctrlrange="0 2"/>'
    assert problems(arm(motors=servo, head='<option gravity="0 0 -1e-17"/>')) == {}
    text = ARM.format(head="", world="", elbow="0.4 1", more="", motors=MOTORS, tail="")
    assert only(problems(open_model_file(text.replace('"elbow"', '"left/elbow"')))) == 'start = { "left/elbow" = 0.4 }'


def test_what_falls_for_ever_and_what_has_no_name_is_told():
    text = '<mujoco><worldbody>{}<body name="b"><{}/><geom size=".1"/></body></worldbody>{}</mujoco>'
    motor = '<actuator><motor joint="j" gear="1 0 0 0 0 0"/></actuator>'
    falling = text.format("", 'joint name="j" type="free"', motor)
    assert 'type="plane"' in only(problems(open_model_file(falling)), "no floor")
    floor = '<geom type="plane" size="0 0 1" pos="0 0 -.1"/>'
    assert problems(open_model_file(text.format(floor, 'joint name="j" type="free"', motor))) == {}
    found = problems(open_model_file(text.format("", 'joint type="slide" axis="1 0 0"', "")))
    assert any("no name" in sentence for sentence in found)


def test_what_holds_a_pose_is_what_gravity_asks_of_the_driven_joints():
    mechanism = describe(arm(motors=MOTORS.replace('joint="shoulder"', 'joint="shoulder" gear="4"'))).loaded.mechanism
    assert mechanism is not None
    pose = np.array([0.3, -0.4])
    u, force = holding(mechanism, pose)
    np.testing.assert_allclose(mechanism.actuators.moment.T @ force, bias(mechanism, pose, np.zeros(2)), rtol=1e-12)
    np.testing.assert_allclose(u, force)  # a motor's gain is 1
    servo = describe(arm(motors='<position name="p" joint="shoulder" kp="50"/>')).loaded.mechanism
    assert servo is not None
    u, force = holding(servo, pose)
    assert 50.0 * (u[0] - pose[0]) == pytest.approx(force[0]) == pytest.approx(bias(servo, pose, np.zeros(2))[0])


def moved(file):
    known = describe(file)
    assert known.loaded.mechanism is not None
    return known, example_task(file.survey.model, known.loaded.mechanism, known.joints)


def test_the_first_move_takes_15_percent_of_each_range_towards_the_roomier_side():
    _, move = moved(arm(tail='<keyframe><key name="bent" qpos="-1 .5"/></keyframe>'))
    assert move.keyframe == "bent"
    assert move.goal == pytest.approx({0: -1.0 + 0.15 * 4.0, 1: 0.5 - 0.15 * 2.0})
    _, outside = moved(arm(elbow="0.4 1"))
    assert outside.keyframe == ""
    assert outside.displaced == pytest.approx({1: 0.43})  # 5 % within
    _, coupled = moved(arm(tail='<equality><joint joint1="elbow" joint2="shoulder" active="true"/></equality>'))
    assert list(coupled.goal) == [0]  # the other follows


def test_the_first_move_touches_nothing_and_what_nothing_drives_ends_where_it_rests():
    wall = '<geom name="wall" type="box" size=".5 .5 .05" pos="0 0 .5"/>'
    above = moved(arm())[1].goal[0]
    assert above == pytest.approx(0.6)  # downwards
    assert moved(arm(world=wall))[1].goal[0] < 0.6
    file = arm(motors=MOTORS.split("/>", 1)[1], tail='<keyframe><key name="k" qpos="1.5707963267948966 0"/></keyframe>')
    known, move = moved(file)
    mechanism = known.loaded.mechanism
    assert mechanism is not None
    pose = move.start.copy()
    pose[list(move.goal)] = list(move.goal.values())
    assert set(move.goal) == {0, 1}
    assert abs(bias(mechanism, pose, np.zeros(2))[0]) < 1e-6  # in N m of some 10: hangs at rest


@pytest.mark.parametrize(
    "parts",
    [
        {},
        {"elbow": "0.4 1", "more": 'frictionloss=".1"'},
        {"tail": '<keyframe><key name="bent" qpos="-1 .5"/></keyframe>'},
        {"motors": ""},
        {"elbow": "-.05 .05", "head": '<compiler angle="degree"/>'},
        {"world": '<geom type="plane" size="0 0 1"/>'},
    ],
    ids=["plain", "friction", "keyframe", "no actuators", "narrow", "floor"],
)  # fmt: skip
def test_the_written_problem_file_can_be_loaded(tmp_path, parts):
    file = arm(**parts)
    known = describe(file)
    (tmp_path / "arm.xml").write_text(ARM.format(
        **{"head": "", "world": "", "elbow": "-1 1", "more": "", "motors": MOTORS, "tail": ""} | parts
    ))  # fmt: skip
    (tmp_path / "p.toml").write_text(starter_text("arm.xml", "p.toml", file, known))
    problem = load_problem(tmp_path / "p.toml")
    model = file.survey.model
    data = load_mujoco().MjData(model)
    data.qpos[:] = problem.x0[: model.nq]
    low, high = model.jnt_range.T
    assert np.all((low <= data.qpos) & (data.qpos <= high))


def test_joints_without_names_are_written_as_lists(tmp_path):
    text = ARM.replace('name="elbow" ', "").replace(' joint="elbow"', ' jointinparent="shoulder"')
    parts = {"head": "", "world": "", "elbow": "-1 1", "more": "", "tail": ""}
    motor = '<motor name="m1" joint="shoulder" ctrlrange="-40 40"/>'
    (tmp_path / "arm.xml").write_text(text.format(motors=motor, **parts))
    file = open_model_file(tmp_path / "arm.xml")
    (tmp_path / "p.toml").write_text(starter_text("arm.xml", "p.toml", file, describe(file)))
    assert load_problem(tmp_path / "p.toml").x0.shape == (4,)


def test_the_first_move_of_a_slow_joint_is_shorter_and_one_that_is_too_slow_stays():
    def goal(*speeds):
        limits = "".join(
            f'<body pos="0 0 {i}"><joint name="j{i}" type="slide" axis="1 0 0" range="-10 10" limited="true"/>'
            f'<geom size=".1" mass="1"/></body>'
            for i in range(len(speeds))
        )
        motors = "".join(f'<motor joint="j{i}" ctrlrange="-40 40"/>' for i in range(len(speeds)))
        file = open_model_file(f"<mujoco><worldbody>{limits}</worldbody><actuator>{motors}</actuator></mujoco>")
        known = describe(file)
        assert known.loaded.mechanism is not None
        mechanism = replace(known.loaded.mechanism, velocity_limit=np.array(speeds))
        return example_task(file.survey.model, mechanism, known.joints)

    slow = goal(0.1)
    assert slow.duration == 4.0
    assert slow.goal[0] == pytest.approx(0.3 * 0.1 * 4.0 / (15.0 / 8.0), rel=1e-3)  # a peak of 0.3 of the limit
    assert list(goal(0.4, 0.01).goal) == [0]  # 0.0064 m of 0.12 or more
    alone = goal(0.01)  # or there would be none
    assert alone.duration == 4.0
    assert alone.goal[0] == pytest.approx(0.1 * slow.goal[0], rel=1e-3)


def test_of_many_joints_those_between_the_base_and_the_fingers_move():
    fingers = "".join(
        f'<body pos=".1 .02 0"><joint name="f{i}" axis="0 1 0"/><geom size=".005" mass=".01"/></body>'
        for i in range(12)
    )
    body = (
        '<body><joint name="base" axis="0 0 1"/><geom size=".1" mass="20"/>'
        '<body pos="1 0 0"><joint name="arm" axis="0 0 1"/><geom size=".05" mass="2"/>' + fingers + "</body></body>"
    )
    names = ["base", "arm", *(f"f{i}" for i in range(12))]
    motors = "".join(f'<motor joint="{name}" ctrlrange="-40 40"/>' for name in names)
    _, move = moved(open_model_file(f"<mujoco><worldbody>{body}</worldbody><actuator>{motors}</actuator></mujoco>"))
    assert list(move.goal) == [1]  # 10 % of the mass; the base carries all of it, a finger 0.05 %
