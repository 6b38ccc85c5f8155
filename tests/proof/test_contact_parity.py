"""Parity of contact forces: right twins agree in every coefficient, and a wrong coefficient is named with its pair.

Where the plan's law is plain, MuJoCo's force of a machine at rest is the same formula: right twins agree to rounding;
of two capsules the plan's closest points are smoothed, which is allowed a tenth of the bound.
"""

import re
from types import SimpleNamespace

import numpy as np
import pytest
from contact_machines import PAIRS, leg, meeting, standing
from driven import PELVIS, hanging_leg, standing_leg
from trees import mujoco

import planner
from planner.model.capabilities import Capabilities
from planner.model.contact.laws import ContactLaw
from planner.model.mechanism import Mechanism
from planner.model.twin import Twin
from planner.proof.compare.coefficients import BOUND
from planner.proof.compare.contact_parity import contact_parity
from planner.proof.replays.compiled_twin import CompiledTwin, with_model

BALL = """<mujoco><worldbody><geom name="floor" {floor}/><body name="ball" pos="0 0 .3">
  <joint type="slide" axis="0 0 1"/>
  <geom name="ball" type="sphere" size=".05" mass="1"/></body></worldbody>
  <actuator><motor joint="{joint}"/></actuator></mujoco>"""
BRICK = """<mujoco><worldbody><geom name="floor" type="box" size="1 1 .1" pos="4 0 -.1"/>
  <body name="brick" pos="0 0 .4"><freejoint name="free"/>
    <geom name="brick" type="box" size=".1 .06 .05" mass="2"/>
    <body pos="0 0 .2"><joint name="fin" axis="0 0 1"/><geom type="capsule" fromto="0 0 0 .1 0 0" size=".01" mass=".1"
      contype="0" conaffinity="0"/></body></body></worldbody>
  <actuator><motor joint="fin"/></actuator></mujoco>"""
POLE = """<mujoco><worldbody><geom name="floor" type="plane" size="1 1 1"/><body name="pole" pos="0 0 .4">
  <joint name="hinge" axis="0 1 0"/><geom name="tip" type="capsule" fromto="0 0 0 .7 0 0" size=".03" mass="1"/></body>
  </worldbody><actuator><motor joint="hinge"/></actuator></mujoco>"""


def problem(m, x0=None, prescribed=()):
    """What contact_parity asks of a problem."""
    dynamics = planner.RigidBodyDynamics(m, 0.005, prescribed=prescribed)
    return planner.Problem(
        dynamics, planner.TrackingCost.joints(dynamics, m.home, 5, effort=1.0, final_position=1.0),
        m.home if x0 is None else x0, twin=None if prescribed else Twin.of(m),
    )  # fmt: skip


def of(m, mjcf=None, x0=None):
    """The measured coefficients of a mechanism in its own model, or in another's text."""
    bare = SimpleNamespace(
        dynamics=SimpleNamespace(mechanism=m, capabilities=Capabilities.of_mechanism(m)),
        x0=m.home if x0 is None else x0,
    )
    return contact_parity(bare, CompiledTwin(with_model(Twin.of(m), mjcf)))


def failing(measured):
    return {one.name: one.note for one in measured if not one.passed}


def agrees(measured, *names):
    assert {one.name for one in measured} >= set(names)
    for one in measured:
        assert one.bound is not None, one.note
        assert one.value < 0.1 * one.bound, (one, one.note)


CONTACT = ("contact_stiffness_error", "contact_surface_error", "contact_damping_error", "contact_inertia_error")
RUBBING = (*CONTACT, "friction_error", "slip_damping_error")
STOP = ("stop_stiffness_error", "stop_end_error", "stop_damping_error")


@pytest.mark.parametrize("ramp", [None, 2e-3])
def test_a_leg_on_a_slope_with_a_stop(ramp):
    m = Mechanism.from_mjcf(leg(1000.0, ramp=ramp, tilt=0.3, stop=(200.0, 2.0, 0.0 if ramp is None else 0.03)))
    agrees(of(m, x0=standing(m)), *RUBBING, *STOP)


@pytest.mark.parametrize("ramp", [None, 5e-3])
@pytest.mark.parametrize("name", PAIRS)
def test_two_bodies(name, ramp):
    agrees(of(Mechanism.from_mjcf(meeting(name, impratio=1000.0, ramp=ramp))), *RUBBING)


def test_a_ball_that_cannot_slide_has_no_friction():
    m = Mechanism.from_mjcf(BALL.format(floor='type="plane" size="1 1 1"', joint="z").replace(
        'type="slide"', 'name="z" type="slide"'), contacts=ContactLaw.resting(1.0))  # fmt: skip
    measured = of(m)
    agrees(measured, *CONTACT)
    assert "friction_error" not in {one.name for one in measured}


def test_a_pole_that_closes_while_it_slides():
    m = Mechanism.from_mjcf(POLE, contacts=ContactLaw.resting(1.0))
    measured = of(m)
    agrees(measured, *CONTACT)  # of one end, which is the whole pair


def test_corners_of_a_brick_beside_its_floor():
    """From where it starts it falls past the floor, which MuJoCo knows and the plan's plane does not."""
    m = Mechanism.from_mjcf(BRICK, contacts=ContactLaw.resting(2.1))
    assert len(m.contacts) == 8
    measured = of(m)
    agrees(measured, *RUBBING)


def test_a_driven_leg_on_a_belt():
    m, x0 = standing_leg()
    own = problem(m, x0, PELVIS)
    agrees(contact_parity(own, CompiledTwin(own.twin)), *RUBBING, *STOP)


@pytest.mark.parametrize("phase", ["swing", "cycle"])
def test_the_human_step(phase):
    own = planner.cases.human_step(phase=phase)
    agrees(contact_parity(own, CompiledTwin(own.twin)), *STOP, *(RUBBING if phase == "cycle" else ()))


@pytest.mark.parametrize("units", [{}, {"stiffness": 400.0, "smoothing": 0.3, "gravity": 600.0}])
def test_the_hopper(units):
    """Its foot sinks into MuJoCo's ground by less than a thousandth of the compression."""
    own = planner.cases.hopper(**units)
    agrees(contact_parity(own, CompiledTwin(own.twin)), *CONTACT[:3])


def test_what_is_not_reached_is_said():
    """A ball that hangs too high on a short arm."""
    text = BALL.format(floor='type="plane" size="1 1 1"', joint="z").replace('type="slide" axis="0 0 1"', 'name="z"')
    (left,) = of(Mechanism.from_mjcf(text.replace("<joint", '<joint pos=".1 0 0"'), contacts=ContactLaw.resting(1.0)))
    assert (left.name, left.value, left.bound) == ("contacts_not_reached", 1.0, None)
    assert left.note.endswith("brings them together: ball on floor")


def test_nothing_to_compare():
    for own in (planner.cases.two_link(), planner.cases.puma()):
        assert contact_parity(own, CompiledTwin(own.twin)) == ()


def rescaled(text, attribute, factors, tag="pair"):
    """A text in which one attribute's numbers are multiplied."""

    def change(match):
        numbers = [float(word) * factor for word, factor in zip(match[2].split(), factors, strict=True)]
        return f'{match[1]}{" ".join(map(repr, numbers))}"'

    changed, count = re.subn(rf'(<{tag} [^>]*\b{attribute}=")([^"]*)"', change, text)
    assert count
    return changed


PLANTED = {
    "stiffness": (("solref", (1.012, 1.0)), "contact stiffness of foot on floor is 2.024e+04, the plan has 2e+04"),
    "damping": (("solref", (1.0, 0.95)), "contact damping of foot on floor is 95, the plan has 100"),
    "friction": (("friction", (3 / 7, 3 / 7, 1, 1, 1)), "friction of foot on floor is 0.3, the plan has 0.7"),
    "friction across": (("friction", (1, 0.5, 1, 1, 1)), "friction of foot on floor is "),
    "slip damping": (("solreffriction", (1.0, 2.0)), "slip damping of foot on floor is 2000, the plan has 1000"),
}  # fmt: skip


@pytest.mark.parametrize("ramp", [None, 2e-3])
@pytest.mark.parametrize("fault", PLANTED)
def test_a_wrong_coefficient_is_named(fault, ramp):
    """In a leg that moves in a plane across the floor's first direction too: its friction counts along."""
    (attribute, factors), sentence = PLANTED[fault]
    text = leg(1000.0, ramp=ramp)
    if fault == "friction across":
        text = text.replace('<joint name="z"', '<joint name="y" type="slide" axis="0 1 0"/><joint name="z"')
    m = Mechanism.from_mjcf(text)
    found = failing(of(m, rescaled(text, attribute, factors)))
    kind = {"stiffness": "contact_stiffness", "damping": "contact_damping"}.get(fault, fault.split(" across")[0])
    assert sentence in found.pop(f"{kind.replace(' ', '_')}_error")
    more = {"slip_damping_error"} if fault == "friction across" else set()  # which goes with it in MuJoCo's cone
    assert set(found) <= {"contact_surface_error"} | more  # no other is blamed


@pytest.mark.parametrize("share", [0.994, 1.006])
def test_differences_within_the_bound_pass(share):
    text = leg(1000.0, ramp=2e-3)
    for attribute, factors in (("solref", (share, share)), ("friction", (share, share, 1, 1, 1))):
        text = rescaled(text, attribute, factors)
    measured = of(Mechanism.from_mjcf(leg(1000.0, ramp=2e-3)), text)
    assert not failing(measured)
    by_name = {one.name: one.value for one in measured}
    for name in ("contact_stiffness_error", "contact_damping_error", "friction_error"):
        assert by_name[name] == pytest.approx(0.6, abs=1e-3)
        assert by_name[name] < BOUND


def test_a_belt_twice_as_stiff_is_named():
    m, x0 = standing_leg()
    own = problem(m, x0, PELVIS)
    stiff = CompiledTwin(with_model(own.twin, rescaled(own.twin.mjcf, "solref", (2.0, 1.0))))
    notes = failing(contact_parity(own, stiff))
    assert re.match(
        "contact stiffness of (heel|toe) on belt is 1e[+]04, the plan has 5000", notes["contact_stiffness_error"]
    )


@pytest.mark.parametrize(
    ("factors", "name", "sentence"),
    [((1.05, 1.0), "stop_stiffness_error", "stop stiffness of the stop of joint 'knee' at -"),
     ((1.0, 0.95), "stop_damping_error", "stop damping of the stop of joint 'knee' at -")],
)  # fmt: skip
def test_a_wrong_stop_is_named(factors, name, sentence):
    text = leg(stop=(200.0, 2.0, 0.03))
    m = Mechanism.from_mjcf(text)
    found = failing(of(m, rescaled(text, "solreflimit", factors, "joint"), standing(m)))
    assert sentence in found[name]


def test_a_stop_elsewhere_and_one_that_is_missing():
    text = leg(stop=(200.0, 2.0, 0.03))
    m = Mechanism.from_mjcf(text)
    found = failing(of(m, text.replace("-2 -1.1", "-2 -1.09")))
    assert "the stop of joint 'knee' at -1.1 begins 0.01 later than in the plan" in found["stop_end_error"]
    found = failing(of(m, text.replace('limited="true"', 'limited="false"')))
    assert "the stop of joint 'knee' at -2 is 0, the plan has 200" in found["stop_stiffness_error"]


def test_a_floor_elsewhere_and_one_that_is_missing():
    text = leg(1000.0, ramp=2e-3)
    m = Mechanism.from_mjcf(text)
    lower = text.replace('type="plane"', 'type="plane" pos="0 0 -.001"')
    assert "foot on floor begins 0.001 later than in the plan" in failing(of(m, lower))["contact_surface_error"]
    without = re.sub("<pair .*?/>", "", text).replace('name="foot"', 'name="foot" contype="0" conaffinity="0"')
    found = failing(of(m, without))
    assert "foot touches nothing in the model, the plan has a contact" in found["contact_stiffness_error"]


def test_a_force_that_follows_accelerations_is_not_the_plans():
    """Impedance .9 and the same force at rest: MuJoCo's contact then takes up nine times what it gives."""
    text = leg(1000.0)
    model = mujoco.MjModel.from_xml_string(text)
    soft, hard = float(model.pair_solimp[0, 0]), 0.9
    scale = (1.0 - hard) / (1.0 - soft)
    for name in ("solref", "solreffriction"):
        text = rescaled(text, name, (scale, scale))
    found = failing(
        of(Mechanism.from_mjcf(leg(1000.0)), re.sub('solimp="[^"]*"', f'solimp="{hard} {hard} 1 0.5 2"', text))
    )
    assert set(found) == {"contact_inertia_error"}
    assert "foot on floor takes up" in found["contact_inertia_error"]


def test_default_contact_is_not_the_plans():
    """As of a file that says nothing of contacts."""
    text = hanging_leg()
    m = Mechanism.from_mjcf(text)
    plain = re.sub(r' (solref|solimp|solreffriction)="[^"]*"', "", text)
    assert {"contact_stiffness_error", "contact_damping_error"} <= set(failing(of(m, plain)))


@pytest.mark.parametrize(
    ("old", "new", "name"),
    [('contype="0"', 'contype="0"', None), ('gainprm="100', 'gainprm="103', "contact_stiffness_error"),
     ('solimp="0.9999 0.9999 0.001"', 'solimp="0.1 0.1 0.001"', "contact_stiffness_error"),
     ('name="sole"', 'name="sole" contype="0" conaffinity="0"', "contact_stiffness_error"),
     ('<joint name="leg"', '<joint name="leg" damping="0.5"', "contact_damping_error")],
)  # fmt: skip
def test_faults_of_the_hoppers_ground(old, new, name):
    own = planner.cases.hopper()
    text = own.twin.mjcf
    assert old in text
    found = failing(contact_parity(own, CompiledTwin(with_model(own.twin, text.replace(old, new)))))
    assert (name in found) if name else not found


def test_the_seed_changes_the_states_and_nothing_else():
    m = Mechanism.from_mjcf(leg(1000.0, ramp=2e-3))
    bare = SimpleNamespace(
        dynamics=SimpleNamespace(mechanism=m, capabilities=Capabilities.of_mechanism(m)), x0=standing(m)
    )
    compiled = CompiledTwin(Twin.of(m))
    one, same, other = (contact_parity(bare, compiled, seed) for seed in (0, 0, 7))
    assert one == same
    assert not failing(other)
    assert np.all([len(measured) == len(RUBBING) for measured in (one, other)])
