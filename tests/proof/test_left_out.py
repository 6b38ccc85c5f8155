"""What a plan's model lacks of the user's file is said in phrases with counts, and nothing else is."""

from dataclasses import replace

import numpy as np
import pytest

from planner import Mechanism, Problem, RigidBodyDynamics, TrackingCost, cases
from planner.contact import ContactLaw
from planner.problem.costs.jerk import driven_by_jerk
from planner.proof.replays.compiled_twin import left_out, unmodelled_of

MODEL = """
<mujoco><option density="1.2">{flag}</option><worldbody><geom name="floor" type="plane" size="1 1 1"/>
  <body pos="0 0 1" gravcomp="1"><joint name="a" frictionloss="1" damping="1 2" axis="0 1 0"/>
    <geom name="ball" size=".1" pos="0 0 .3"/>
    <body pos="0 0 1"><joint name="b" frictionloss="2" axis="0 1 0"/><geom type="cylinder" size=".1 .1" pos="0 0 .5"/>
      <body name="last" pos="0 0 1"><joint name="c" axis="0 1 0"/><geom type="box" size=".1 .1 .1" pos="0 0 .5"/></body>
    </body></body></worldbody>
  <equality><joint joint1="a" joint2="b" polycoef="0 1 1"/><connect body1="last" anchor="0 0 .5"/></equality>
  <actuator><motor name="motor of a" joint="a"/><motor joint="b"/><motor joint="c"/></actuator></mujoco>
"""
OUT = ("frictionloss", "equality", "fluid", "gravcomp", "polynomial")
REST = (
    "friction loss of 2 joints", "gravity compensation of 1 body", "fluid density", "2 equalities",
    "polynomial damping of 1 joint",
)  # fmt: skip


def problem(mechanism):
    dynamics = RigidBodyDynamics(mechanism, dt=0.02)
    start = np.zeros(dynamics.nx)
    return Problem(dynamics, TrackingCost.joints(dynamics, start, 10, effort=0.1, final_position=1.0), start)


def test_everything_is_counted():
    """Floor and three bodies, of which neighbours do not meet: four pairs."""
    found = problem(Mechanism.from_mjcf(MODEL.format(flag=""), contacts="off", ignore=OUT))
    assert left_out(found) == ("contacts of 4 pairs", *REST)
    assert unmodelled_of(found).pairs[0] == "geom 'floor' and geom 'ball'"


def test_contacts_that_the_file_switches_off_are_not_left_out():
    off = MODEL.format(flag='<flag contact="disable"/>')
    assert left_out(problem(Mechanism.from_mjcf(off, ignore=OUT))) == REST


def test_a_machine_driven_by_jerk_remembers_its_file():
    machine = Mechanism.from_mjcf(MODEL.format(flag=""), contacts="off", ignore=OUT)
    found = left_out(problem(driven_by_jerk(machine, ["a"])))
    # nothing acts on the driven joint; whether the ball on it meets the floor is watched
    assert found[:2] == ("contacts of 4 pairs", "friction loss of 1 joint")


@pytest.mark.parametrize("name", cases.CASES)
def test_the_cases_lack_nothing(name):
    assert left_out(cases.build(name)) == ()


def test_a_mechanism_whose_contacts_were_taken_off_by_hand():
    """Its text has them still, so it is no secret."""
    mechanism = Mechanism.from_mjcf(MODEL.format(flag=""), contacts=ContactLaw.resting(1.0), ignore=OUT)
    assert "contacts of 1 pair" in left_out(problem(mechanism))  # of two bodies that both move
    assert "contacts of 4 pairs" in left_out(problem(replace(mechanism, contacts=())))
