"""What was taken out of a plan's model is in the replay of the user's file, or the first line says that it is not."""

import re
from collections.abc import Callable

import numpy as np
import pytest

import planner
from planner import FunctionDynamics, Mechanism, Problem, RigidBodyDynamics, TrackingCost, Twin
from planner.dynamics.quasi_static import quasi_static_controls
from planner.proof.original_model import OVERLAPS_THAT_PUSH

WALL = '<geom name="wall" type="box" size=".05 .05 .2" pos=".7 .8 0"/>'
ARM = """<mujoco>{option}<worldbody>{world}<body><joint name="hinge" axis="0 0 1" damping="0.1" {joint}/>
  <geom name="arm" type="capsule" fromto=".2 0 0 1 0 0" size=".02" mass="1"/><site name="tip" pos="1.1 0 0"/></body>
  </worldbody><actuator><motor name="motor" joint="hinge"/></actuator></mujoco>"""


def arm(world: str = "", joint: str = "", option: str = "") -> str:
    return ARM.format(world=world, joint=joint, option=option)


def plan_of(
    text: str, goal: list[float], prescribed: tuple[str, ...] = (), dt: float = 0.02, **reading: object
) -> planner.Plan:
    """From rest at home to rest at the joints' goal, in 50 stages."""
    mechanism = Mechanism.from_mjcf(text, **reading)
    dynamics = RigidBodyDynamics(mechanism, dt, prescribed=prescribed)
    there = np.concatenate([goal, np.zeros(mechanism.nv)])
    cost = TrackingCost.joints(dynamics, there, 50, effort=0.001, final_position=1e3, final_velocity=1e2)
    us = None if prescribed else np.tile(quasi_static_controls(mechanism, mechanism.home), (50, 1))
    return planner.solve(Problem(dynamics, cost, mechanism.home, us=us))


def proof_of(plan: planner.Plan) -> planner.Proof:
    return planner.prove(plan, rollouts=0)


def own_python(text: str, goal: float, twin: Callable[[Mechanism], Twin] = Twin.of, **reading: object) -> planner.Plan:
    """The arm by somebody's own equation, with a twin of the file that a mechanism was read from."""
    mechanism = Mechanism.from_mjcf(text, **reading)
    per_torque = float(1.0 / planner.dynamics.mass_matrix(mechanism, np.zeros(1))[0, 0])

    def rate(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return np.stack([x[..., 1], per_torque * (u[..., 0] - 0.1 * x[..., 1])], axis=-1)

    cost = TrackingCost.reach([goal, 0.0], 50, final=1e3, effort=0.01, dt=0.02)
    return planner.solve(Problem(FunctionDynamics(rate, 2, 1, 0.02, "rk4"), cost, [0.0, 0.0], twin=twin(mechanism)))


@pytest.mark.parametrize("contacts", ["off", "avoid"])
def test_own_dynamics_are_replayed_in_the_file_of_their_twin(contacts):
    proof = proof_of(own_python(arm(WALL), 1.6, contacts=contacts))
    assert proof.reason.startswith("your file: geom 'wall' and geom 'arm' touch from t = ")
    away = proof_of(own_python(arm(WALL), -1.6, contacts=contacts))
    assert away.passed, away.reason
    assert away.planned_without == ("contacts of 1 pair",)


def test_friction_that_own_dynamics_leave_out_fails_by_the_path():
    rubbing = arm(joint='frictionloss="3"')
    proof = proof_of(own_python(rubbing, -1.6, ignore=("frictionloss",)))
    assert "largest_state_error" in {one.name for one in proof.your_file.failures}


def test_a_file_that_is_not_there_is_said_in_the_line():
    def of_edited(m: Mechanism) -> Twin:
        same, none = np.eye(2), np.zeros(2)
        return Twin(m.mjcf, same, none, same[None], none[None])

    proof = proof_of(own_python(arm(WALL), 1.6, of_edited, contacts="off"))
    assert "without contacts, of a file that is not in the plan" in proof.headline


LIFT = """<mujoco><worldbody><geom name="table" type="box" size="1 1 .1" pos="1 0 {z}"/>
  <body><joint name="lift" type="slide" axis="0 0 1"/>
  <geom name="arm" type="capsule" fromto=".2 0 0 1 0 0" size=".02" mass="1"/></body></worldbody>
  <actuator><motor joint="lift"/></actuator></mujoco>"""


@pytest.mark.parametrize("gap", [0.0, 2e-5, 1e-4])
def test_what_lies_on_something_with_a_gap_keeps_its_contact(gap):
    text = LIFT.format(z=-0.12 - gap)
    into = proof_of(plan_of(text, [-0.24], contacts="off"))
    assert "geom 'table' and geom 'arm' touch from t = 0" in into.reason
    off = proof_of(plan_of(text, [0.24], contacts="off"))
    assert off.passed, off.reason
    assert off.planned_without == ("contacts of 1 pair",)
    assert not any("overlap" in phrase for phrase in off.not_checked)


def test_what_penetrates_at_the_start_must_not_go_deeper():
    text = LIFT.format(z=-0.12 + 5e-4)
    into = proof_of(plan_of(text, [-0.24], contacts="off"))
    assert "touch at the start by 0.0005 m, later by up to 0.12 m" in into.reason
    assert any(one.name == OVERLAPS_THAT_PUSH for one in into.your_file.measured)
    off = proof_of(plan_of(text, [0.24], contacts="off"))
    assert off.passed, off.reason
    assert "without contact of table and arm (0.0005 m), which overlap at the start" in off.headline


def test_a_start_inside_of_what_is_at_rest_fails_unless_the_model_excludes_the_pair():
    text = LIFT.format(z=-0.12 + 5e-3)
    inside = proof_of(plan_of(text, [0.24], contacts="off"))
    assert "overlap by 0.005 m at the start, expected at most 0.001 m" in inside.reason
    named = '<contact><exclude body1="world" body2="arm"/></contact></mujoco>'
    excluded = text.replace("<body>", '<body name="arm">').replace("</mujoco>", named)
    assert proof_of(plan_of(excluded, [0.24], contacts="off")).passed


FINGERS = """<mujoco><option gravity="0 0 0"/><worldbody>
  <body pos="0 {y} 0"><joint name="l" type="slide" axis="0 1 0"/>
    <geom name="L" type="box" size=".1 .1 .1" mass="1"/></body>
  <body pos="0 -.1 0"><joint name="r" type="slide" axis="0 1 0"/>
    <geom name="R" type="box" size=".1 .1 .1" mass="1"/></body>
  </worldbody><actuator><motor joint="l"/><motor joint="r"/></actuator></mujoco>"""


@pytest.mark.parametrize("y", [0.1, 0.1001, 0.0995])
def test_closed_fingers_open_and_do_not_cross(y):
    cross = proof_of(plan_of(FINGERS.format(y=y), [-0.1, 0.1], contacts="off"))
    assert "unknown_contacts" in {one.name for one in cross.your_file.failures}
    opened = proof_of(plan_of(FINGERS.format(y=y), [0.1, -0.1], contacts="off"))
    assert opened.passed, opened.reason


def test_what_parts_and_meets_again_fails():
    """The arm is lifted out of the table, by half a millimetre, and laid back into it."""
    dynamics = RigidBodyDynamics(Mechanism.from_mjcf(LIFT.format(z=-0.12 + 5e-4), contacts="off"), 0.02)
    way = np.zeros((51, 2))
    way[:, 0] = 0.1 * np.sin(np.pi * np.arange(51) / 50) ** 2
    Q, R = np.tile(np.diag([1e4, 1.0]), (51, 1, 1)), np.tile(np.diag([1e-3]), (50, 1, 1))
    u = np.full((50, 1), 9.81)
    plan = planner.solve(Problem(dynamics, TrackingCost(Q, R, way, u), way[0], us=u))
    assert "touch at the start, part, and meet again by up to 0.000" in proof_of(plan).reason


CART = """<mujoco><worldbody><geom name="wall" type="box" size=".05 1 .2" pos=".6 0 .6"/>
  <body pos="0 0 .5"><joint name="rail" type="slide" axis="1 0 0"/>
  <geom name="cart" type="box" size=".1 .1 .1" mass="1"/>
  <body><joint name="p" axis="0 1 0" damping=".1"/>
    <geom name="pole" type="capsule" fromto="0 0 -.15 0 0 -.4" size=".01" mass=".2"/></body></body>
  </worldbody><actuator><motor name="m" joint="p"/></actuator></mujoco>"""


def test_a_prescribed_body_does_not_pass_a_wall():
    through = proof_of(plan_of(CART, [1.0, 0.0], prescribed=("rail",), contacts="off"))
    assert "geom 'wall' and geom 'cart' touch from t = 0.4" in through.reason
    away = proof_of(plan_of(CART, [-0.5, 0.0], prescribed=("rail",), contacts="off"))
    assert away.passed, away.reason
    assert away.planned_without == ("contacts of 2 pairs",)


def test_a_payload_touches_by_its_size_and_the_line_names_one_without():
    wall = '<geom name="wall" type="box" size=".05 .05 .2" pos=".9 .95 0"/>'  # beyond the arm, in the payload's way
    payload = {"frame": "tip", "mass": 0.5}
    held = proof_of(plan_of(arm(wall), [1.6], attach=payload | {"size": [0.3, 0.1, 0.1]}))
    assert "geom 'wall' and geom 'payload' touch from t = " in held.reason
    away = proof_of(plan_of(arm(wall), [-1.6], attach=payload | {"size": [0.3, 0.1, 0.1]}))
    assert away.passed, away.reason
    unknown = proof_of(plan_of(arm(wall), [-1.6], attach=payload))
    assert unknown.passed, unknown.reason
    assert "without contacts of payload, which has a mass and no shape" in unknown.headline


COUPLED = """<mujoco><worldbody><body><joint name="a" axis="0 1 0" damping=".1"/>
  <geom type="capsule" fromto="0 0 0 .5 0 0" size=".02" mass="1"/>
  <body pos=".5 0 0"><joint name="b" axis="0 1 0" damping=".1"/>
    <geom type="capsule" fromto="0 0 0 .5 0 0" size=".02" mass="1"/></body></body></worldbody>
  <equality><joint joint1="b" joint2="a" polycoef="0 -1 0 0 0" {soft}/></equality>
  <actuator><motor joint="a"/></actuator></mujoco>"""


def test_a_soft_equality_of_the_file_is_bounded_by_the_path():
    soft = proof_of(plan_of(COUPLED.format(soft='solref=".1 1"'), [0.8, -0.8]))
    assert "largest_angle_error" in {one.name for one in soft.your_file.failures}
    firm = proof_of(plan_of(COUPLED.format(soft=""), [0.8, -0.8]))
    assert firm.passed, firm.reason


def test_the_files_own_step_is_shown_and_said_where_it_fails():
    turned = arm(option='<option timestep="{}"/>').replace('axis="0 0 1"', 'axis="0 1 0"')
    coarse = proof_of(plan_of(turned.format(0.01), [1.5]))
    assert coarse.passed, coarse.reason
    said = coarse.own_step
    assert said.startswith("At your file's own step 0.01 s Euler: with gains 0.0")
    assert "own step" not in coarse.headline  # which would contradict itself
    assert said in coarse.table()
    assert coarse.to_dict()["own_step"] == said
    written = re.search(r'<option timestep="[0-9.]+" integrator="RK4"/>', said)[0]
    mended = proof_of(plan_of(turned.replace('<option timestep="{}"/>', written), [1.5]))  # as the sentence says
    assert mended.passed
    assert mended.own_step == ""
    measured = {one.name: one.value for one in coarse.your_file.measured}
    assert measured["own_step_open_loop_angle_error"] > measured["own_step_with_gains_angle_error"] > 0.0
    fine = proof_of(plan_of(turned.format(0.0001), [1.5]))
    assert fine.own_step == ""
    assert {one.name: one.note for one in fine.your_file.measured}["own_step_errors"] == (
        "none, at your file's own step 0.0001 s Euler"
    )


def test_the_step_that_is_said_is_that_of_the_replay_though_it_has_no_end_of_digits():
    """A twentieth of a sixtieth of a second: written a little too short, a stage would take 21 steps of it."""
    turned = arm(option='<option timestep="0.01"/>').replace('axis="0 0 1"', 'axis="0 1 0"')
    coarse = proof_of(plan_of(turned, [1.5], dt=1 / 60))
    written = re.search(r'<option timestep="[0-9.]+" integrator="RK4"/>', coarse.own_step)[0]
    mended = proof_of(plan_of(turned.replace('<option timestep="0.01"/>', written), [1.5], dt=1 / 60))
    assert mended.replay.substeps == coarse.replay.substeps == 20
    notes = {one.name: one.note for one in mended.your_file.measured}
    assert notes["own_step_errors"].startswith("none beside the above")


def test_a_file_with_the_step_of_the_replay_is_not_simulated_twice():
    own = arm(option='<option timestep="0.001" integrator="RK4"/>')  # the replay's is a twentieth of the stage
    section = proof_of(plan_of(own, [1.5])).your_file
    notes = {one.name: one.note for one in section.measured}
    assert notes["own_step_errors"] == "none beside the above: your file's own step is 0.001 s RK4, too"
    assert not [name for name in notes if name.startswith("own_step_with")]
