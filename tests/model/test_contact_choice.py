"""How contacts are planned is chosen by what can fall and on what: the file's law, a law of the ground, or none."""

import numpy as np
import pytest
from contact_machines import leg
from thrusters import QUADROTOR

from planner.base.errors import ModelError
from planner.base.gl import load_mujoco
from planner.model.contact.laws import ContactLaw
from planner.model.mechanism import Mechanism
from planner.model.mjcf.contact_mode import falling_trees
from planner.model.mjcf.facts import free_bases
from planner.model.mjcf.ground_law import DAMPING, REST_PENETRATION, SLIP
from planner.model.mjcf.model_index import ModelIndex

FLOOR = '<geom name="floor" type="plane" size="0 0 1"/>'
ARM = """<body name="arm"><joint name="hinge" axis="0 0 1"/>
  <geom name="link" type="capsule" fromto="0.2 0 .5 1 0 .5" size="0.02" mass="1"/></body>"""
# A trunk of 6 kg with two legs of 1 kg, driven at the hips; the legs may touch each other.
WALKER = """<body name="trunk" pos="0 0 .6"><freejoint/>
  <geom type="sphere" size=".1" mass="6" contype="0" conaffinity="0"/>
  <body name="left" pos="0 .1 0"><joint name="hip" axis="0 1 0"/>
    <geom name="left" type="capsule" fromto="0 0 -.2 0 0 -.5" size=".03" mass="1" condim="4" margin=".01"/></body>
  <body name="right" pos="0 -.1 0"><joint name="other" axis="0 1 0"/>
    <geom name="right" type="capsule" fromto="0 0 -.2 0 0 -.5" size=".03" mass="1"/></body></body>"""
CUBE = (
    """<body name="cube" pos="0 2 {z}"><freejoint/><geom name="cube" type="box" size=".05 .05 .05" mass=".2"/></body>"""
)


def model(*bodies, motors=("hinge",), option=""):
    act = "".join(f'<motor joint="{joint}"/>' for joint in motors)
    return f"<mujoco>{option}<worldbody>{''.join(bodies)}</worldbody><actuator>{act}</actuator></mujoco>"


def walker(*more, **options):
    return model(FLOOR, WALKER, *more, motors=("hip", "other"), **options)


def chosen(text, **reading):
    m = Mechanism.from_mjcf(text, **reading)
    return m.contacts_mode, m


@pytest.mark.parametrize(
    ("text", "mode"),
    [
        (model(ARM), ""),
        (model(FLOOR, ARM), "avoid"),
        (walker(), "file"),
        (walker(option='<option gravity="0 0 0"/>'), "avoid"),  # nothing falls
        (walker().replace('type="plane" size="0 0 1"', 'type="plane" size="0 0 1" zaxis="1 0 0"'), "avoid"),  # a wall
        (leg(), "model"),
        (model(FLOOR, ARM, CUBE.format(z=0.05)), "avoid"),  # the arm cannot fall,
    ],
)
def test_the_choice(text, mode):
    found, m = chosen(text)
    assert found == mode
    assert bool(m.contacts) == (mode in ("file", "model"))
    assert bool(m.contacts_choice) == (mode != "")
    assert (m.original != "") == (mode in ("file", "avoid"))  # the user's text is kept


def test_a_ground_is_for_the_mass_that_stands_on_it():
    _, m = chosen(walker(), contacts="ground")
    law = ContactLaw.resting(8.0, sink=REST_PENETRATION, damping_ratio=DAMPING, slip=SLIP)
    assert len(m.contacts) == 4  # the ends of two legs
    assert m.body_contacts == ()  # the legs must not touch each other
    for contact in m.contacts:
        assert contact.law.stiffness == pytest.approx(law.stiffness, rel=1e-9)
        assert contact.law.slip_damping == pytest.approx(law.slip_damping, rel=1e-9)
        assert contact.law.force_ramp == pytest.approx(law.force_ramp, rel=1e-9)
    assert m.contacts_choice == (
        "contacts of 2 pairs with the ground are planned with a law for 8 kg; 1 other pair must not touch"
    )


def test_a_margin_raises_the_shape():
    """There the file's own force begins; margins of both shapes count as MuJoCo combines them."""
    contacts = {c.name[:12]: c for c in chosen(walker(), contacts="ground")[1].contacts}
    assert contacts["geom 'left ("].radius == pytest.approx(0.04, abs=1e-12)  # 0.03 and a margin of 0.01
    assert contacts["geom 'right'"].radius == 0.03


def test_an_object_lies_on_what_is_under_it():
    """A cube of 0.2 kg on a table beside an arm: its own mass counts, and the arm still must not touch."""
    table = '<geom name="table" type="box" size=".5 .5 .1" pos="0 2 .3"/>'
    m = Mechanism.from_mjcf(model(FLOOR, table, ARM, CUBE.format(z=0.45)), contacts="ground")
    assert sorted({round(c.plane.offset, 9) for c in m.contacts}) == [0.0, 0.4]
    assert {round(c.law.stiffness, 6) for c in m.contacts} == {
        round(ContactLaw.resting(0.2, sink=REST_PENETRATION).stiffness, 6)
    }
    beside, m = chosen(model(table, ARM, CUBE.format(z=0.2)))  # the table's top is above it: no ground
    assert beside == "avoid"
    assert "body 'cube' stays at the start, since nothing drives it" in m.contacts_choice
    alone, m = chosen(model(ARM, CUBE.format(z=0.2)))  # nothing is there on which it could lie
    assert alone == "avoid"
    assert "body 'cube' falls in the plan: draw a plane or a box under it" in m.contacts_choice


def test_a_mode_that_does_not_fit_is_told_the_one_that_does():
    said = r'^the model has .*condim 4, expected 1 or 3.*; contacts = "file" loads it without'
    with pytest.raises(ModelError, match=said):
        Mechanism.from_mjcf(walker(), contacts="model")
    with pytest.raises(ModelError, match=r'; contacts = "avoid" loads it without'):
        Mechanism.from_mjcf(model(FLOOR, ARM), contacts="model")
    with pytest.raises(ModelError, match="contacts is 'ground', but nothing in the model falls on a plane or box"):
        Mechanism.from_mjcf(model(FLOOR, ARM), contacts="ground")


def test_a_planned_text_is_read_with_the_same_contacts():
    _, m = chosen(walker())
    again = Mechanism.from_mjcf(m.mjcf)
    assert again.contacts_mode == "model"
    for one, other in zip(m.contacts, again.contacts, strict=True):
        assert (one.name, one.link, one.radius) == (other.name, other.link, other.radius)
        np.testing.assert_array_equal(one.centre, other.centre)


def test_rotors_carry_a_machine_and_a_push_does_not():
    for gear, carried in (("0 0 1 0 0 0", True), ("1 0 0 0 0 0", False)):
        text = QUADROTOR
        for own in ("0 0 1 0 0 0.016", "0 0 1 0 0 -0.016"):
            text = text.replace(f'gear="{own}"', f'gear="{gear}"')
        model = load_mujoco().MjModel.from_xml_string(text)
        assert (falling_trees(ModelIndex(model)) == {}) == carried
        assert (free_bases(model) == []) == carried
