"""A finger of four bars whose coupler a spring holds on its stop, as those of adaptive grippers are."""

import numpy as np
import pytest
from closed_chains import PARALLELOGRAM

from planner import Mechanism, PlannerError, RigidBodyDynamics, solve
from planner.cases.problem_file import load
from planner.dynamics.assembly import assembled
from planner.dynamics.rest_on_stops import rest_on_stops
from planner.problem.default_weights import default_weights
from planner.proof import prove

# The spring link is sprung to -2 rad; through the follower it turns the coupler to the end of its range, at 0.
FINGER = """<mujoco><compiler angle="radian"/><option gravity="0 0 0"/>
  <default><geom contype="0" conaffinity="0"/></default><worldbody>
  <body pos="0 .03 0"><joint name="driver" axis="1 0 0" range="0 .8" armature=".005" damping=".1"/>
    <geom type="capsule" fromto="0 0 0 0 .03 0" size=".005" mass=".02"/>
    <body name="coupler" pos="0 .03 0"><joint name="coupler" axis="1 0 0" range="-1.5 0" solreflimit=".01 1"/>
      <geom type="capsule" fromto="0 0 0 0 0 .04" size=".005" mass=".02"/></body></body>
  <body pos="0 .01 .01"><joint name="spring link" axis="1 0 0" range="-.3 .8" stiffness=".05" springref="-2"
      damping=".001"/><geom type="capsule" fromto="0 0 0 0 .03 0" size=".005" mass=".02"/>
    <body name="follower" pos="0 .02 -.01"><joint name="follower" axis="1 0 0" range="-.9 .9"/>
      <geom type="capsule" fromto="0 0 0 0 0 .03" size=".005" mass=".02"/></body></body></worldbody>
  <equality><connect body1="coupler" body2="follower" anchor="0 0 .04" solref=".004 1"/></equality>
  <actuator><position joint="driver" kp="5" kv=".3" forcerange="-3 3"/></actuator></mujoco>"""


@pytest.fixture(scope="module")
def problem(tmp_path_factory):
    folder = tmp_path_factory.mktemp("finger")
    (folder / "finger.xml").write_text(FINGER)
    (folder / "problem.toml").write_text('model = "finger.xml"\ngoal = { driver = 0.4 }\nduration = 0.5\n')
    return load(folder / "problem.toml").problem


def test_start_and_goal_lean_on_the_stop(problem):
    m = problem.dynamics.mechanism
    assert {stop.dof for stop in m.stops} == {1, 2, 3}
    notes = problem.recipe.parameters["resolved"]["reasons"]["settle"]
    assert "of the goal goes" in notes
    depth = m.stops[1].law.rest_depth(0.05 * 2.0)  # N m: the spring's whole torque, of which bars pass a part
    assert 0.0 < problem.x0[1] < 2.0 * depth  # the coupler presses on its stop
    assert np.abs(rest_on_stops(m, problem.x0) - problem.x0).max() < 1e-6


def test_a_chain_that_leans_on_nothing_stays_where_it_is():
    """A parallelogram is moved by gravity alone: nothing presses where it would hang."""
    m = Mechanism.from_mjcf(PARALLELOGRAM.replace('name="left" axis', 'name="left" range="-200 200" axis').replace(
        '<motor name="motor" joint="left"/>', '<motor name="motor" joint="right" gear="0"/>'))  # fmt: skip
    x = assembled(m, np.array([0.6, -0.6, 0.6, 0.0, 0.0, 0.0]))
    assert rest_on_stops(m, x) is x


def test_only_chains_that_lean_lose_their_weights(tmp_path):
    """A pendulum beside the finger keeps its goal, which no stop decides."""
    pendulum = '<body pos=".5 0 0"><joint name="pole" axis="0 1 0"/><geom size=".02" pos="0 0 .1" mass=".1"/></body>'
    (tmp_path / "finger.xml").write_text(FINGER.replace("</worldbody>", pendulum + "</worldbody>"))
    text = 'model = "finger.xml"\nstart = { pole = 0.0 }\ngoal = { driver = 0.4, pole = 0.2 }\nduration = 0.5\n'
    (tmp_path / "problem.toml").write_text(text)
    with pytest.raises(PlannerError, match="pole"):  # nothing drives it
        load(tmp_path / "problem.toml")
    m = Mechanism.from_mjcf((tmp_path / "finger.xml").read_text())
    x = rest_on_stops(m, np.zeros(10))
    weights = default_weights(RigidBodyDynamics(m, 0.01), x, x, 0.5).weights
    assert list(weights["final_position"] > 0.0) == [True, False, False, False, True]


def test_a_chain_whose_joint_is_named_stays_there(problem):
    m = problem.dynamics.mechanism
    x = assembled(m, np.zeros(8))
    assert rest_on_stops(m, x, given=[1]) is x


@pytest.mark.slow
def test_the_finger_closes_and_the_simulator_agrees(problem):
    plan = solve(problem)
    assert plan.success
    assert plan.xs[-1, 1] > 0.0  # it leans there, beyond the range of the file
    proof = prove(plan, rollouts=0)
    assert proof.passed, proof.reason
    stops = {one.name: one for one in proof.sections["parity"].measured if one.name.startswith("stop_")}
    assert {"stop_stiffness_error", "stop_damping_error", "stop_inertia_error"} <= set(stops)
    assert all(one.value < 0.01 for one in stops.values())  # %: the same law
