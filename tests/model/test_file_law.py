"""contacts = "file": planes keep the law that MuJoCo computes from the file's numbers, in plan and replay."""

from dataclasses import replace

import numpy as np
import pytest
from trees import mujoco

from planner.base.errors import ModelError, PlannerError
from planner.dynamics import RigidBodyDynamics
from planner.model.contact.laws import ContactLaw
from planner.model.mechanism import Mechanism
from planner.model.mjcf.file_law import FILE_SMOOTHING, file_law
from planner.model.mjcf.ground_law import rest_penetration
from planner.model.mjcf.model_index import ModelIndex, compile_model

# A trunk on two legs with round feet, which may touch each other, and a can, whose rims are points.
STANDING = """<mujoco><option cone="{cone}" impratio="3"/>
  <default><geom condim="{condim}" friction=".8 .02 .001"/></default>
  <worldbody><geom name="floor" type="plane" size="0 0 1" {floor}/><body name="trunk" pos="0 0 .5"><freejoint/>
    <geom type="box" size=".1 .1 .1" mass="6" contype="0" conaffinity="0"/>
    <body name="left"><joint name="hip" axis="0 1 0"/><geom name="left" pos="0 .1 -.451" size=".05" mass="1"/></body>
    <body name="right"><joint axis="0 1 0"/><geom name="right" pos="0 -.1 -.451" size=".05" mass="1"/></body></body>
  <body name="can" pos="1 0 .0995"><freejoint/><geom name="can" type="cylinder" size=".05 .1" mass="1"/></body>
  </worldbody><actuator><motor joint="hip"/></actuator></mujoco>"""


def standing(cone="pyramidal", condim=3, floor=""):
    return STANDING.format(cone=cone, condim=condim, floor=floor)


def accelerations(text, assets, q, v, count=-6):
    """MuJoCo's qacc of a model, by default without the can."""
    model = mujoco.MjModel.from_xml_string(text, assets)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = q, v
    mujoco.mj_forward(model, data)
    return data.qacc[:count]


@pytest.mark.parametrize("floor", ["", 'margin=".003" gap=".001"'])
@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
def test_the_replayed_model_has_the_accelerations_of_the_file(cone, floor):
    m = Mechanism.from_mjcf(standing(cone, floor=floor), contacts="file")
    assert m.contacts_mode == "file"
    assert m.contacts_choice.startswith("contacts of 3 pairs with planes are planned with the file's own law; 3 other")
    rng = np.random.default_rng(0)
    for _ in range(5):
        q, v = m.home[: m.nq], rng.normal(size=m.nv) * 0.1
        ours, files = accelerations(m.mjcf, m.assets, q, v), accelerations(standing(cone, floor=floor), {}, q, v)
        np.testing.assert_allclose(ours, files, atol=1e-5 * np.abs(files).max())  # MuJoCo's tolerance is 1e-8
    again = Mechanism.from_mjcf(m.mjcf)  # as a stored plan is read
    assert again.contacts_mode == "model"
    assert [one.law for one in again.contacts] == [one.law for one in m.contacts]


def test_the_law_is_the_files_with_the_smoothing_of_plans():
    m, model = Mechanism.from_mjcf(standing(), contacts="file"), compile_model(standing())
    pair = next(one for one in ModelIndex(model).pairs if model.geom("left").id in one.geoms)
    law, files = m.contacts[0].law, file_law(model, pair)
    assert (law.ramp, law.force_ramp, law.bend) == FILE_SMOOTHING
    for name in ("stiffness", "damping", "friction", "impratio", "lead", "cone", "impedance"):
        assert getattr(law, name) == getattr(files, name)
    for load in (1.0, 20.0, 1e3):  # from where the impedance rises to where it no longer does
        assert files.rest_depth(load) == pytest.approx(rest_penetration(model, pair, load)[0], rel=1e-6)


def test_a_cone_of_four_or_six_dimensions_presses_as_in_mujoco():
    """At rest all of its edges press; a box whose corners are equally deep neither turns nor slides."""
    text = """<mujoco><option cone="{}"/><default><geom condim="{}" solimp=".9 .9 .001"/></default><worldbody>
      <geom type="plane" size="0 0 1"/><body pos="0 0 .0495"><freejoint/><geom type="box" size=".1 .1 .05" mass="2"/>
      </body></worldbody></mujoco>"""
    for cone, condim in (("pyramidal", 1), ("pyramidal", 3), ("pyramidal", 4), ("pyramidal", 6), ("elliptic", 6)):
        model = compile_model(text.format(cone, condim), name=f"{cone} {condim}")
        data, law = mujoco.MjData(model), file_law(model, ModelIndex(model).pairs[0])
        mujoco.mj_forward(model, data)
        share = 1.0 + 4.0 * law.damping * law.lead / 2.0  # f = 4 (K depth - B lead a), 2 kg a = f - 2 kg g
        expected = (4.0 * law.stiffness * 5e-4 / 2.0 - 9.81) / share
        assert data.qacc[2] == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(
    ("contact", "reason"),
    [
        ('condim="3" solimp=".9 .95 .001 .5 3"', "a power of 3, expected 2"),
        ('noslip_iterations="2" impratio', "noslip_iterations 2, expected 0"),
        ('condim="3" margin="-.2"', "margin -0.2, expected at least 0"),
    ],
)
def test_what_the_law_has_not_gets_a_law_of_the_ground(contact, reason):
    text = standing().replace('condim="3"', contact) if "condim" in contact else standing().replace("impratio", contact)
    model = compile_model(text)
    with pytest.raises(ModelError, match=reason):
        file_law(model, ModelIndex(model).pairs[0])
    assert Mechanism.from_mjcf(text).contacts_mode == "ground"


@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
def test_rolling_is_resisted_alike_in_the_plan_its_replayed_model_and_the_file(cone):
    """A ball that rolls on rubber of condim 6 is braked: at most 0.7 m/s^2, by 0.01 m of it and a radius of 0.1 m."""
    text = f"""<mujoco><option cone="{cone}"/><default><geom condim="6" friction="1 .02 .01"/></default><worldbody>
      <geom type="plane" size="0 0 1"/><body pos="0 0 .0999"><freejoint/><geom size=".1" mass="2"/></body>
      <body pos="0 0 2"><joint name="fan"/><geom size=".1" mass="1"/></body></worldbody>
      <actuator><motor joint="fan"/></actuator></mujoco>"""
    m, v = Mechanism.from_mjcf(text, contacts="file"), np.array([0.1, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0])
    sharp = replace(m, contacts=tuple(replace(c, law=replace(c.law, ramp=0.0, bend=0.0)) for c in m.contacts))
    plan = RigidBodyDynamics(sharp, 0.01).rates(np.append(m.home[:8], v)[None], np.zeros((1, 1)))[0, 7]
    replayed, brakes = (accelerations(one, {}, m.home[:8], v, 7)[0] for one in (m.mjcf, text))
    assert -0.7 < brakes < -0.1
    assert replayed == pytest.approx(brakes, rel=1e-9)
    assert plan == pytest.approx(brakes, rel=1e-6)


def test_ends_stand_for_a_capsule_that_turns_the_edges_of_its_pyramid():
    """MuJoCo lays them along the capsule; those of the plan and of its replayed model lie along the world's axes."""
    text = standing().replace('name="right" pos="0 -.1 -.451" size=".05"', 'type="capsule" size=".05 .1"')
    names = [contact.name for contact in Mechanism.from_mjcf(text).contacts if "left" not in contact.name]
    assert names[:2] == ["geom 'geom number 3 (point 1)'", "geom 'geom number 3 (point 2)'"]
    planar = text.replace("<freejoint/>", '<joint type="slide" axis="0 0 1"/>', 1)
    for change, turns in (('euler="0 40 0"', False), ('euler="40 0 0"', True)):  # in the plane of its hinge, and not
        capsule = planar.replace('type="capsule"', f'type="capsule" {change}')
        rests = any("3' end" in one.name for one in Mechanism.from_mjcf(capsule).contacts)
        assert rests != turns
    names = [one.name for one in Mechanism.from_mjcf(text.replace("pyramidal", "elliptic")).contacts]
    assert "geom 'geom number 3' end 1" in names


@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
def test_a_law_that_is_given_has_its_spinning_and_rolling_friction(cone):
    law = ContactLaw(
        2e4, 200.0, 1e-3, 2.0, 0.0, 0.6, 5.0, lead=0.01, cone=cone, spinning=0.02, rolling=0.01, margin=2e-3
    )
    m = Mechanism.from_mjcf(standing(), contacts=law)
    assert (m.contacts[0].law.spinning, m.contacts[0].law.rolling) == (0.02, 0.01)
    assert m.contacts[0].law.margin == 2e-3
    assert m.contacts[0].law.stiffness == pytest.approx(2e4, rel=1e-12)
    assert compile_model(m.mjcf).pair_dim[0] == 6
    np.testing.assert_array_equal(compile_model(m.mjcf).pair_friction[0], [0.6, 0.6, 0.02, 0.01, 0.01])


@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
@pytest.mark.parametrize("friction", [0.0, 0.7])
def test_a_law_with_a_lead_that_is_given_is_replayed(cone, friction):
    law = ContactLaw(2e4, 200.0, 1e-3, 2.0, 0.0, friction, 5.0, lead=0.01, cone=cone)
    m = Mechanism.from_mjcf(standing().replace('condim="3"', 'condim="1"'), contacts=law)
    for contact in m.contacts:
        for name in ("stiffness", "damping", "ramp", "force_ramp", "friction", "bend", "lead"):
            assert getattr(contact.law, name) == pytest.approx(getattr(law, name), rel=1e-12)
        assert friction == 0.0 or (contact.law.cone == cone and contact.law.impratio == law.impratio)


@pytest.mark.parametrize(
    ("text", "contacts", "sentence"),
    [
        (standing(floor='solref="-1000 0" priority="1"'), "file", "solref -1000 0, expected stiffness and damping"),
        (
            standing().replace('type="plane" size="0 0 1"', 'type="sphere" size=".1"'),
            "file",
            "nothing in the model meets a plane",
        ),
        (standing(), ContactLaw(2e4, 2.0, lead=1e-9), "which MuJoCo has no impedance for"),
        (standing(), ContactLaw(2e4, 2.0, lead=1.0, impedance=(0.1, 0.9, 1.0, 0.5)), "expected a constant one"),
    ],
)
def test_what_has_no_such_law_is_refused(text, contacts, sentence):
    with pytest.raises((ModelError, PlannerError)) as error:
        Mechanism.from_mjcf(text, contacts=contacts)
    assert sentence in str(error.value)
