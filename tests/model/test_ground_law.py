"""The rest penetration of MuJoCo's contacts, and the law of the ground: as soft as the file's where that is softer."""

import mujoco
import numpy as np
import pytest

from planner import Mechanism
from planner.dynamics.statics import static_equilibrium
from planner.dynamics.step_stability import fastest_mode
from planner.model.contact.laws import ContactLaw
from planner.model.mjcf.ground_law import DAMPING, DEEPEST, FASTEST, LOAD, REST_PENETRATION, SLIP, rest_penetration
from planner.model.mjcf.model_index import ModelIndex, compile_model

# A trunk of 20 kg on a foot of `foot` kg, a plate on an ankle that a motor holds.
HOPPER = """<mujoco><worldbody><geom name="floor" type="plane" size="0 0 1"/>
  <body pos="0 0 .5"><joint type="slide" axis="0 0 1"/><geom size=".1" mass="20"/>
    <body pos="0 0 -.4"><joint name="ankle" axis="0 1 0" damping=".1"/>
      <geom type="box" size=".1 .05 .02" pos="0 0 -.05" mass="{foot}" {contact}/>
    </body></body></worldbody><actuator><motor joint="ankle"/></actuator></mujoco>"""


def laws(foot, contact=""):
    m = Mechanism.from_mjcf(HOPPER.format(foot=foot, contact=contact), contacts="ground")
    return m, m.contacts[-1].law


def test_a_foot_that_is_not_light_has_the_damping_of_the_whole_machine():
    _, law = laws(40.0)
    whole = ContactLaw.resting(60.0, sink=REST_PENETRATION, damping_ratio=DAMPING, slip=SLIP)
    assert law.stiffness == pytest.approx(whole.stiffness, rel=1e-9)
    assert law.slip_damping == pytest.approx(whole.slip_damping, rel=1e-9)


@pytest.mark.parametrize(
    ("contact", "friction"),
    [
        ('friction=".4" priority="1"', 0.4),  # a plan with more slides in the file
        ('friction=".4"', 1.0),  # MuJoCo takes the larger one of both geoms; the floor has 1
        ('friction="2"', 1.0),  # what is beyond 1 stays a margin
        ('condim="1" priority="1"', 0.0),
    ],
)
def test_the_friction_of_a_plan_is_the_files(contact, friction):
    m, law = laws(2.0, contact)
    assert law.friction == friction
    np.testing.assert_allclose(static_equilibrium(m, m.home)[0], m.home[0], atol=0.1)  # stands without friction, too


@pytest.mark.parametrize("foot", [0.5, 0.05])
def test_light_feet_come_to_rest_no_faster_than_a_plan_follows(foot):
    m, law = laws(foot)
    whole = ContactLaw.resting(20.0 + foot, sink=REST_PENETRATION, damping_ratio=DAMPING)
    assert law.damping < 0.5 * whole.damping
    # The whole box lies flat, so its lowest four corners are those of the law; damping and friction add up.
    assert fastest_mode(m, static_equilibrium(m, m.home)).rate < 2.0 * FASTEST


def test_rubber_feet_sink_in_as_they_do_in_the_file():
    rubber = 'priority="1" solimp=".015 1 .03"'
    m, law = laws(2.0, rubber)
    model = compile_model(HOPPER.format(foot=2.0, contact=rubber))
    weight = 22.0 * 9.81
    depth, _ = rest_penetration(model, ModelIndex(model).pairs[-1], LOAD * weight)
    assert depth > LOAD * REST_PENETRATION
    assert law.stiffness == pytest.approx(LOAD * weight / depth, rel=1e-6)
    assert np.all([contact.law == law for contact in m.contacts if "box" in contact.name or contact is m.contacts[-1]])


def test_rubber_balls_are_as_deep_and_as_stiff_as_in_the_file():
    radius, weight = 0.022, 15.0 * 9.81  # of small quadrupeds: a foot sinks in by more than half of its radius
    text = f"""<mujoco><option cone="elliptic"/><worldbody><geom type="plane" size="0 0 1"/>
      <body pos="0 0 .2"><joint name="z" type="slide" axis="0 0 1"/>
        <geom size="{radius}" mass="15" priority="1" condim="6" solimp=".015 1 .05"/></body></worldbody></mujoco>"""
    contact, model = Mechanism.from_mjcf(text, contacts="ground").contacts[0], compile_model(text)
    depth, slope = rest_penetration(model, ModelIndex(model).pairs[0], LOAD * weight)
    recess = radius - contact.radius
    assert 0.5 * radius < recess < radius
    assert contact.law.stiffness == pytest.approx(slope, rel=1e-9)
    assert recess + LOAD * weight / contact.law.stiffness == pytest.approx(depth, rel=1e-6)


BALL = """<mujoco><option cone="{cone}" impratio="{impratio}" timestep=".001"/><worldbody>
  <geom type="plane" size="0 0 1"/><body pos="0 0 .1"><freejoint/>
    <geom size=".1" mass="2" priority="1" condim="{condim}" friction="{mu}" solref="{solref}" solimp="{solimp}"/>
  </body></worldbody></mujoco>"""
WEIGHT = 2.0 * 9.81


@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
@pytest.mark.parametrize(
    ("condim", "mu", "solref", "solimp", "impratio"),
    [
        (3, 1.0, ".02 1", ".9 .95 .001 .5 2", 1),  # MuJoCo's defaults
        (3, 0.6, ".02 1", ".015 1 .03 .5 2", 1),  # rubber feet, as many quadrupeds have them
        (6, 0.8, ".01 .7", ".8 .8 .01 .5 2", 1),
        (1, 1.0, "-1000 -50", ".5 .9 .01 .3 3", 1),
        (4, 0.7, ".02 1", ".9 .95 .001 .5 2", 10),
    ],
)
def test_a_ball_sinks_in_as_deep_as_the_formula_says(cone, condim, mu, solref, solimp, impratio):
    model = compile_model(BALL.format(cone=cone, condim=condim, mu=mu, solref=solref, solimp=solimp, impratio=impratio))
    data = mujoco.MjData(model)
    for _ in range(4000):
        mujoco.mj_step(model, data)
    # What is left of its fall after 4 s is below a nanometre.
    depth, _ = rest_penetration(model, ModelIndex(model).pairs[0], WEIGHT)
    assert depth == pytest.approx(0.1 - data.qpos[2], abs=1e-9)


def test_what_carries_nothing_is_as_deep_as_can_be():
    model = compile_model(
        BALL.format(cone="elliptic", condim=1, mu=1, solref="-1 -1", solimp=".1 .1 .01 .5 2", impratio=1)
    )
    assert rest_penetration(model, ModelIndex(model).pairs[0], WEIGHT)[0] == pytest.approx(DEEPEST)
