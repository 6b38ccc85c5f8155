"""What an MJCF has that is not modelled is named, taken out, or cannot act."""

import numpy as np
import pytest
from machines import passive, plain, state

from planner.base.errors import PlannerError
from planner.base.gl import load_mujoco
from planner.model.mechanism import Mechanism
from planner.model.mjcf.model_index import contact_pairs
from planner.model.mjcf.unsupported import KINDS

mujoco = load_mujoco()

# What is refused: kind, MJCF with a marker's worth of everything else, what the sentence must name.
TENDON = '<fixed name="t" %s><joint joint="h" coef="1"/></fixed>'
OTHER = '<fixed name="u"><joint joint="s" coef="1"/></fixed>'
BENT = '<tendon name="bent" tendon1="t" tendon2="u" polycoef="0 1 1"/>'
SPATIAL = '<spatial name="t" %s><site site="p"/><site site="q"/></spatial>'
MUSCLE = '<muscle name="biceps" joint="h" lengthrange="0 1"/>'
MOCAP = '<body name="hand" mocap="true"><body name="toy"><joint/><geom size="0.1"/></body></body>'
REFUSED = [
    ("frictionloss", plain(tendon=TENDON % 'frictionloss="1"'), ["frictionloss of tendon 't'"]),
    ("equality", plain(tendon=TENDON % "" + OTHER, equality=BENT), ["equality 'bent'"]),
    ("tendon", plain(tendon=TENDON % 'armature="1" damping="1"'), ["armature of tendon 't'"]),
    ("tendon", plain(tendon=SPATIAL % 'damping="1"'), ["damping of tendon 't'"]),
    ("tendon", plain(tendon=SPATIAL % 'range="0 9" limited="true"'), ["limit of tendon 't'"]),
    (
        "tendon",
        plain(default='<default><tendon stiffness="3" frictionloss="1"/></default>', tendon=SPATIAL % ""),
        ["stiffness, frictionloss of tendon 't'"],
    ),
    ("fluid", plain().replace("<option>", '<option viscosity="9" wind="1 0 0">'), ["fluid wind"]),
    ("actuator", plain(actuator=MUSCLE), ["actuator 'biceps'", "muscle"]),
    ("actuator", plain(actuator='<general name="x" joint="h" gaintype="user"/>'), ["'x' (user gain)"]),
    (
        "actuator",
        plain(actuator='<damper name="x" site="p" kv="1" ctrlrange="0 1"/>'),
        ["'x' (force by the position or velocity of a site)"],
    ),
    (
        "actuator",
        plain(actuator='<position name="x" site="p"/>'),
        ["'x' (force by the position or velocity of a site)"],
    ),
    ("actuator", plain(tendon=SPATIAL % "", actuator='<motor name="x" tendon="t"/>'), ["'x' (spatial tendon)"]),
    ("actuator", plain(actuator='<velocity site="p"/>'), ["actuator number 1"]),
    (
        "actuator",
        plain(actuator='<motor name="x" cranksite="p" slidersite="q" cranklength="1"/>'),
        ["'x' (slidercrank transmission)"],
    ),
    (
        "actuator",
        plain(world='<body><joint name="b" type="ball"/><geom size="0.1"/></body>')
        .replace("<option>", '<option><flag contact="disable"/>')
        .replace("<actuator>", '<actuator><position name="x" joint="b"/><velocity name="y" jointinparent="b"/>'),
        ["'x' (force by the angle of a ball joint)", "'y' (force by the position or velocity of a jointinparent)"],
    ),
    (
        "actearly",
        plain(actuator='<general name="x" joint="h" dyntype="integrator" actearly="true"/>'),
        ["actearly of actuator 'x'"],
    ),
    ("mocap", plain(world=MOCAP).replace("<option>", '<option><flag contact="disable"/>'), ["mocap body 'hand'"]),
]
# What is modelled and that `ignore` takes out all the same.
MODELLED = [
    ("equality", plain(equality='<joint name="cam" joint1="h" joint2="s" polycoef="0 1 1"/>'), ["equality 'cam'"]),
    ("equality", plain(equality='<weld body1="one"/>'), ["equality number 0"]),
    ("frictionloss", plain(joint='frictionloss="1"'), ["frictionloss of joint 'h'"]),
    ("frictionloss", plain(default='<default><joint frictionloss="1"/></default>'), ["joint 'h'", "joint 's'"]),
    ("tendon", plain(tendon=TENDON % 'stiffness="1"'), ["stiffness of tendon 't'"]),
    ("tendon", plain(tendon=TENDON % 'damping="1" range="0 9" limited="true"'), ["damping, limit of tendon 't'"]),
    ("gravcomp", plain(body='gravcomp="0.5"'), ["gravcomp of body 'one'"]),
]
NEW = [  # of MuJoCo 4
    ("polynomial", plain(joint='stiffness="1 2"'), ["polynomial stiffness of joint 'h'"]),
    ("polynomial", plain(joint='damping="1 2"'), ["polynomial damping of joint 'h'"]),
    ("plasticity", plain(joint='stiffness="1" springyield="2"'), ["plastic spring of joint 'h'"]),
    ("sleep", plain(option='<flag sleep="enable"/>'), ["sleep"]),
    ("actuator", plain(actuator='<motor name="x" joint="h" delay="0.1" nsample="9"/>'), ["'x' (delay)"]),
]


def compiles(text):
    try:
        mujoco.MjModel.from_xml_string(text)
    except ValueError:
        return False
    return True


REFUSED += [case for case in NEW if compiles(case[1])]


def as_values(m):
    """All of a mechanism but where it came from."""
    values = vars(m) | vars(m.actuators)
    values |= {"bodies": [vars(f) for f in m.bodies], "sites": {name: vars(f) for name, f in m.sites.items()}}
    return {
        name: values[name]
        for name in values.keys()
        - {"ignored", "original", "contacts_mode", "contacts_choice", "actuators", "space", "quaternions", "home"}
    }


@pytest.mark.parametrize(
    ("kind", "text", "names"), REFUSED, ids=[f"{kind}-{i}" for i, (kind, _, _) in enumerate(REFUSED)]
)
def test_refused_by_name_and_taken_out(kind, text, names):
    contacts = "model" if "contact=" in text else "off"
    with pytest.raises(PlannerError) as error:
        Mechanism.from_mjcf(text, contacts=contacts)
    for name in names:
        assert name in str(error.value)
    assert f'ignore = ["{kind}"] loads' in str(error.value)
    is_taken_out(kind, text, names, contacts)


@pytest.mark.parametrize(("kind", "text", "names"), MODELLED, ids=[f"{one[0]}-{i}" for i, one in enumerate(MODELLED)])
def test_modelled_and_taken_out_where_it_is_asked_for(kind, text, names):
    assert Mechanism.from_mjcf(text, contacts="off").ignored == ()
    is_taken_out(kind, text, names, "off")


def is_taken_out(kind, text, names, contacts):
    """Whether ignoring a kind of element takes it out of the mechanism and of its text, and nothing else."""
    m = Mechanism.from_mjcf(text, ignore=(kind,), contacts=contacts)
    assert all(any(name.strip("()") in phrase for phrase in m.ignored) for name in names)
    again = Mechanism.from_mjcf(m.mjcf)
    assert again.ignored == ()
    for name, value in as_values(again).items():
        np.testing.assert_equal(value, as_values(m)[name], err_msg=name)

    # Ignoring changes nothing else: what the mechanism says is what a model without it would be read as.
    model = mujoco.MjModel.from_xml_string(m.mjcf)
    data = state(model, 0)
    np.testing.assert_allclose(passive(m, data), data.qfrc_passive, atol=1e-12)
    assert data.nefc == 0


def test_taking_actuators_out_keeps_keyframes_and_sensors():
    text = plain(
        actuator=MUSCLE + '<general name="mid" joint="h" dyntype="integrator"/>',
        sensor='<actuatorfrc name="gone" actuator="biceps"/><actuatorfrc name="stays" actuator="mid"/>',
        key='<key name="k" qpos="1 2" act="0.3 0.4" ctrl="1 2 3 4"/>',
    )
    m = Mechanism.from_mjcf(text, ignore=("actuator",), contacts="off")
    assert m.actuators.names == ("kept", "mid", "last")
    np.testing.assert_array_equal(m.keyframe("k"), [1, 2, 0, 0, 0.4])
    model = mujoco.MjModel.from_xml_string(m.mjcf)
    np.testing.assert_array_equal(model.key_ctrl, [[1, 3, 4]])
    assert [model.sensor(i).name for i in range(model.nsensor)] == ["stays"]


def test_everything_in_one_sentence():
    text = plain(
        joint='frictionloss="1"', body='gravcomp="1"', tendon=TENDON % 'damping="1"' + OTHER, actuator=MUSCLE,
        equality=BENT,
        world='<geom name="floor" type="plane" size="1 1 1"/>',
    )  # fmt: skip
    parts = ['ignore = ["equality", "actuator"] and contacts = "avoid" loads', "'biceps'", "'bent'", "geom 'floor'"]
    with pytest.raises(PlannerError) as error:
        Mechanism.from_mjcf(text, contacts="model")
    for part in parts:
        assert part in str(error.value)
    assert "\n" not in str(error.value)
    with pytest.raises(PlannerError) as error:
        Mechanism.from_mjcf(text, ignore=("frictionloss", "tendon"))
    assert "'biceps'" in str(error.value)
    assert "frictionloss" not in str(error.value)
    m = Mechanism.from_mjcf(text, ignore=KINDS, contacts="off")
    assert len(m.ignored) == 6
    assert "contacts" in m.ignored
    assert Mechanism.from_mjcf(m.mjcf).ignored == ()


def test_elements_that_cannot_act_are_no_reason_to_refuse():
    inert = [
        plain(tendon=SPATIAL % ""),
        plain(tendon=SPATIAL % 'range="0 9" limited="true" frictionloss="1"', option='<flag constraint="disable"/>'),
        plain(equality='<joint joint1="h" active="false"/>'),
        plain(equality='<joint joint1="h"/>', option='<flag equality="disable"/>'),
        plain(joint='frictionloss="1"', option='<flag frictionloss="disable"/>'),
        plain(body='gravcomp="1"', option='<flag gravity="disable"/>'),
        plain(
            world='<body name="fixed" gravcomp="1"><geom size="0.1" pos="9 9 9" contype="0" conaffinity="0"/></body>'
        ),
        plain(actuator=MUSCLE, option='<flag actuation="disable"/>'),
        plain(actuator='<adhesion body="one" ctrlrange="0 1"/>', option='<flag contact="disable"/>'),
        plain(world='<body mocap="true"><site/></body>'),
    ]
    for text in inert:
        # The two geoms belong to parent and child, which MuJoCo does not let collide.
        m = Mechanism.from_mjcf(text)
        assert m.ignored == ()
        model = mujoco.MjModel.from_xml_string(text)
        data = state(model, 0)
        np.testing.assert_allclose(passive(m, data), data.qfrc_passive, atol=1e-12)
        assert data.nefc == 0


def test_contacts_are_taken_out_by_their_option_alone():
    text = plain(world='<geom name="floor" type="plane" size="1 1 1"/>')
    with pytest.raises(PlannerError, match="contacts of geom 'floor' and geom number 1 of body 'one' and 1 more pairs"):
        Mechanism.from_mjcf(text, contacts="model")
    with pytest.raises(PlannerError, match=r"contacts is 'on', expected one of: .* Did you mean 'model'\?"):
        Mechanism.from_mjcf(text, contacts="on")
    assert Mechanism.from_mjcf(text, contacts="off").ignored == ("contacts",)
    assert Mechanism.from_mjcf(plain(), contacts="off").ignored == ()
    assert Mechanism.from_mjcf(text.replace("<option>", '<option><flag contact="disable"/>')).ignored == ()
    with pytest.raises(PlannerError, match=r"contacts is .of., expected one of: auto, avoid"):
        Mechanism.from_mjcf(text, contacts="of")


def test_elements_to_ignore_are_given_by_name():
    """One name, several, or none; what is no name is told which there are."""
    text = plain(joint='frictionloss="1"')
    for ignore in ("frictionloss", ["frictionloss"], {"frictionloss"}):
        assert Mechanism.from_mjcf(text, ignore=ignore).ignored == ("frictionloss of joint 'h'",)
    assert Mechanism.from_mjcf(plain(), ignore=None).ignored == ()
    for ignore, told in (
        (3, "ignore is 3"),
        (True, "ignore is True"),
        ("foo", "ignore is 'foo'"),
        ([1], "ignore is 1"),
    ):
        with pytest.raises(PlannerError, match=f"^{told}, expected (some|one) of: frictionloss, equality, ") as error:
            Mechanism.from_mjcf(text, ignore=ignore)
        assert "\n" not in str(error.value)


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("flag", ["", "<flag filterparent='disable'/>"])
def test_contact_pairs_are_those_that_mujoco_finds(seed, flag):
    """Spheres about one point, so that every pair that may collide does."""
    rng = np.random.default_rng(seed)
    bodies, names = "", []
    for i in range(7):
        masks = " ".join(f'{key}="{rng.integers(4)}"' for key in ("contype", "conaffinity"))
        joint = "<joint/>" if rng.random() < 0.6 else ""
        bodies += f'<body name="b{i}">{joint}<geom name="g{i}" size="1" pos="{0.1 * i} 0 0" {masks}/>'
        names.append(f"b{i}")
        if rng.random() < 0.5:
            bodies += "</body>" * len(names)
            names = []
    bodies += "</body>" * len(names)
    a, b = rng.choice(7, 2, replace=False)
    more = f'<contact><exclude body1="b{a}" body2="b{b}"/><pair geom1="g0" geom2="g6"/></contact>'
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco><option>{flag}</option><worldbody>{bodies}</worldbody>{more}</mujoco>"
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert contact_pairs(model) == sorted({tuple(sorted(map(int, contact.geom))) for contact in data.contact})


def test_friction_of_a_tendon_that_an_equality_holds_does_nothing():
    held = plain(tendon=TENDON % 'frictionloss="1"', equality='<tendon tendon1="t"/>')
    Mechanism.from_mjcf(held)
    with pytest.raises(PlannerError, match="frictionloss of tendon 't'"):
        Mechanism.from_mjcf(plain(tendon=TENDON % 'frictionloss="1"'))


def test_who_would_take_all_actuators_out_is_told():
    """To ignore them leads to the next refusal: a machine that nothing drives."""
    text = (
        '<mujoco><worldbody><body><joint name="h"/><geom size=".1"/></body></worldbody><actuator>{}</actuator></mujoco>'
    )
    with pytest.raises(PlannerError, match="That leaves no actuator: put motors or servos on joints"):
        Mechanism.from_mjcf(text.format(MUSCLE))
    with pytest.raises(PlannerError) as caught:
        Mechanism.from_mjcf(text.format(MUSCLE + '<motor joint="h"/>'))
    assert "That leaves" not in str(caught.value)
