"""Objects that lie beside a machine stay where they start in a plan, and are judged in the user's file."""

import numpy as np
import pytest

import planner
from planner.base.errors import PlannerError
from planner.base.gl import load_mujoco
from planner.cases.problem_file.build import load
from planner.model.capabilities import stands_on_ground, stationary_object_bodies, stationary_object_dofs
from planner.model.mechanism import Mechanism
from planner.model.mjcf.facts import free_bases
from planner.problem.constraints.clearance import pair_clearance_of
from planner.problem.default_weights import default_weights

TABLE = '<geom name="table" type="cylinder" size=".3 .1" pos="0 .5 .1"/>'  # its top is no ground that is planned
CUBE = (
    '<body name="cube" pos="{}"><freejoint name="cube"/>'
    '<geom name="cube" type="box" size=".02 .02 .02" mass=".1"/></body>'
)
ARM = (
    '<body name="arm" pos="0 0 .25"><joint name="arm" axis="0 0 1" damping=".1"/><geom name="arm" type="capsule" '
    'fromto=".1 0 0 .5 0 0" size=".02" mass="1"/></body>'
)
BESIDE, IN_THE_WAY = "-.2 .5 .22", ".2 .4 .22"


def text(*, at=BESIDE, table=TABLE, actuator='<motor joint="arm" ctrlrange="-9 9"/>'):
    return f"<mujoco><worldbody>{table}{CUBE.format(at)}{ARM}</worldbody><actuator>{actuator}</actuator></mujoco>"


def reach(tmp_path, goal="{ arm = 0.8 }", more="", **kind):
    (tmp_path / "scene.xml").write_text(text(**kind))
    lines = f'model = "scene.xml"\nstart = {{}}\ngoal = {goal}\nduration = 1.0\n{more}'
    (tmp_path / "reach.toml").write_text(lines)
    return load(tmp_path / "reach.toml")


def test_an_object_on_a_thing_without_a_law_floats_in_the_plan():
    m = Mechanism.from_mjcf(text())
    assert m.contacts_mode == "avoid"
    assert "body 'cube' stays at the start" in m.contacts_choice
    np.testing.assert_array_equal(stationary_object_dofs(m), [True] * 6 + [False])
    np.testing.assert_array_equal(stationary_object_bodies(m), [False, True, False])
    dynamics = planner.RigidBodyDynamics(m, dt=0.01)
    np.testing.assert_array_equal(dynamics.step(m.home[None], np.zeros((1, 1)))[0], m.home)  # nothing moves at all


def test_what_is_driven_or_meets_nothing_does_not_lie():
    driven = '<motor joint="arm"/><motor joint="cube" gear="0 0 1 0 0 0"/>'
    assert not stationary_object_dofs(Mechanism.from_mjcf(text(actuator=driven))).any()
    assert not stationary_object_dofs(Mechanism.from_mjcf(text(table=""))).any()


@pytest.mark.slow
def test_an_arm_beside_an_object_is_planned_along_a_line_and_passes(tmp_path):
    problem = reach(tmp_path).problem
    plan = planner.solve(problem)
    assert plan.success
    assert plan.nit < 10  # the line by inverse dynamics: the arm's motors reach all that is to move
    proof = planner.prove(plan, rollouts=0)
    assert proof.verdict == "PASS"
    moved = next(one for one in proof.sections["your_file"].measured if one.name == "objects_moved")
    assert 0.0 < moved.value < 1e-3  # m: it lies on the table, into which MuJoCo lets it sink


def test_a_touch_of_the_object_fails(tmp_path):
    proof = planner.prove(planner.solve(reach(tmp_path, at=IN_THE_WAY, goal="{ arm = 1.5 }").problem), rollouts=0)
    assert proof.verdict == "FAIL"
    assert "geom 'cube' and geom 'arm' touch" in proof.reason


def test_an_object_is_kept_clear_of_but_its_table_is_not(tmp_path):
    with_avoid = reach(tmp_path, more="[avoid]\n").problem
    names = [pair.names for pair in pair_clearance_of(with_avoid.constraints).pairs]
    assert any("cube" in name and "arm" in name for name in names)
    assert not any("cube" in name and "table" in name for name in names)


def test_an_object_that_is_to_move_is_refused(tmp_path):
    goal = "{ cube = [0, 0.7, 0.22, 1, 0, 0, 0], arm = 0.8 }"
    with pytest.raises(PlannerError, match="nothing drives or holds joint 'cube'"):
        reach(tmp_path, goal=goal)
    with pytest.raises(PlannerError, match=r"position of cube ends 0\.2 m from the goal whatever the controls do"):
        reach(tmp_path, goal='[{ frame = "cube", position = [0, 0.5, 0.22] }]')


FLOOR = '<geom name="floor" type="plane" size="0 0 1"/>'


@pytest.mark.parametrize("at", ["-.2 .5 .02", "-.2 .5 .3"], ids=["on the floor", "in the air"])
def test_an_object_on_the_floor_does_not_make_an_arm_a_standing_machine(tmp_path, at):
    problem = reach(tmp_path, table=FLOOR, at=at).problem
    m = problem.dynamics.mechanism
    assert m.contacts_mode == "avoid"
    assert "body 'cube' stays at the start" in m.contacts_choice
    plan = planner.solve(problem)
    proof = planner.prove(plan, rollouts=0)
    assert proof.verdict == "PASS", proof.reason
    assert "no goal" not in proof.headline
    assert " m/s off" not in proof.headline  # the cube's fall is no error of the arm's path
    assert free_bases(load_mujoco().MjModel.from_xml_string(text(table=FLOOR, at=at))) == []


def test_a_machine_that_falls_stands_with_an_object_beside_it():
    feet = '<body name="arm" pos="0 0 .25"><freejoint/><geom name="foot" type="box" size=".1 .1 .1" mass="1"/>'
    scene = text(table=FLOOR).replace('<body name="arm" pos="0 0 .25">', f'{feet}<body name="link" pos="0 0 .2">')
    m = Mechanism.from_mjcf(scene.replace("</worldbody>", "</body></worldbody>"))
    assert m.contacts_mode == "file"
    assert stands_on_ground(m)


def test_the_contacts_of_an_object_alone_are_not_those_of_a_machine():
    m = Mechanism.from_mjcf(text(table=FLOOR), contacts="ground")  # asked for: the cube gets a law
    assert m.contacts
    assert not stands_on_ground(m)
    dynamics, goal = planner.RigidBodyDynamics(m, dt=0.01), m.home.copy()
    goal[7] = 0.5
    weights = default_weights(dynamics, m.home, goal, 1.0).weights
    assert weights["hold"] == 0.0
    assert weights["final_position"][6] > 0.0  # the arm's goal is judged


PUSHED = """<mujoco><worldbody><geom name="floor" type="plane" size="0 0 1"/>
  <body pos="0 0 .05"><joint name="finger" type="slide" axis="1 0 0" damping="5"/><geom size=".03" mass=".5"/></body>
  <body name="object" pos=".2 0 .05"><freejoint name="object"/><geom type="{shape}" mass=".3"/></body></worldbody>
  <actuator><motor joint="finger" ctrlrange="-20 20"/></actuator></mujoco>"""
LAW = "contacts = { penetration = 0.003, friction = 0.8 }"


@pytest.mark.parametrize(
    ("shape", "more", "refused"),
    [('sphere" size=".05', LAW, False), ('box" size=".05 .05 .05', LAW, True), ('sphere" size=".05', "", True)],
    ids=["sphere", "box", "avoided"],
)
def test_what_only_the_ground_touches_in_the_plan_has_no_goal_elsewhere(tmp_path, shape, more, refused):
    """Spheres and capsules touch each other in a plan. A box on the floor beside a finger stays, whatever it does."""
    (tmp_path / "m.xml").write_text(PUSHED.format(shape=shape), encoding="utf-8")
    goal = '[[goal]]\nframe = "object"\nposition = [0.5, 0, 0.05]\n'
    (tmp_path / "p.toml").write_text(f'model = "m.xml"\nduration = 2\n{more}\n{goal}', encoding="utf-8")
    if refused:
        with pytest.raises(PlannerError, match=r"nothing drives or holds joint 'object'.* penetration = 0\.003"):
            load(tmp_path / "p.toml")
    else:
        load(tmp_path / "p.toml")


@pytest.mark.parametrize(("joints", "stands"), [(2, False), (1, True)], ids=["driven", "with a joint that is not"])
def test_an_arm_that_the_world_holds_stands_on_its_own_though_its_hand_may_touch_the_floor(joints, stands):
    motors = "".join(f'<motor joint="j{k}"/>' for k in range(joints))
    m = Mechanism.from_mjcf(
        f"""<mujoco><worldbody>{FLOOR}<body pos="0 0 .6"><joint name="j0" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 .2 0 0" size=".02" mass="1" contype="0" conaffinity="0"/>
        <body pos=".2 0 0"><joint name="j1" axis="0 1 0"/><geom name="hand" size=".05" mass="1"/></body></body>
        </worldbody><actuator>{motors}</actuator></mujoco>""",
        contacts=planner.contact.ContactLaw.resting(1.0),
    )
    assert m.contacts
    assert stands_on_ground(m) == stands
