"""Reading MJCF: the links, masses and forces are MuJoCo's; what is not modelled is named, taken out, or cannot act."""

import struct

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from planner.errors import PlannerError
from planner.gl import load_mujoco
from planner.mechanism import BALL, BALL_NEXT, FILTER, INTEGRATOR, SCREW, Mechanism
from planner.mechanism_reader import read
from planner.mechanism_refusals import KINDS, contact_pairs
from planner.mjcf import model_text
from planner.space import hat, log_quaternion

mujoco = load_mujoco()

# Every kind of joint, several to a body, branches, bodies welded to links and to the world, ref, frames of any pose.
MACHINE = """
<mujoco>
  <compiler angle="degree"/>
  <option gravity="0.3 -0.2 -9.81"><flag contact="disable"/></option>
  <worldbody>
    <body name="pedestal" pos="0.1 0.2 0.3" euler="10 20 30">
      <geom type="box" size="0.1 0.2 0.3"/>
      <body name="arm" pos="0.4 0 0.1" euler="0 40 15">
        <joint name="lift" type="slide" axis="1 2 3" pos="0.1 0 0" ref="0.2" damping="0.3" armature="0.05"
               stiffness="7" springref="0.5"/>
        <joint name="swing" axis="0 1 1" pos="0.05 0.1 -0.2" ref="25" stiffness="2" springref="-15" damping="0.1"/>
        <joint name="roll" type="ball" pos="-0.1 0.2 0.3" stiffness="3" damping="0.2" armature="0.02"/>
        <joint name="slip" type="slide" axis="0 0 1"/>
        <geom type="capsule" size="0.05 0.2" pos="0.1 0 0" euler="0 30 0"/>
        <body name="plate" pos="0.2 0.1 0" euler="50 0 0">
          <geom type="ellipsoid" size="0.1 0.2 0.05" pos="0 0.1 0"/>
          <site name="edge" pos="0.1 0 0.2" euler="0 0 70"/>
          <body name="tip" pos="0 0.3 0" euler="0 0 20"><inertial pos="0.1 0 0" mass="0.7" diaginertia="0.1 0.1 0.1"/>
            <body name="wrist" pos="0 0 0.2"><joint name="turn" axis="1 0 0"/><geom size="0.1" pos="0.1 0.1 0"/></body>
          </body>
        </body>
        <body name="branch" pos="0 0 -0.4"><joint axis="0 1 0"/><geom type="box" size="0.1 0.05 0.02"/></body>
      </body>
    </body>
    <body name="kite" pos="1 2 3" euler="0 0 90">
      <joint name="fly" type="free" stiffness="4" damping="0.6" armature="0.1"/>
      <geom type="box" size="0.1 0.2 0.05" pos="0.2 0 0" euler="5 6 7"/>
      <body name="tail" pos="-0.3 0 0"><joint name="wag" type="ball"/><geom size="0.1" pos="-0.2 0 0.1"/></body>
    </body>
    <site name="mark" pos="5 6 7"/>
  </worldbody>
  <keyframe>
    <key name="there" qpos="1 2 0.6 0 0.8 0 5 6 7 8 9 10 0 1 0 0 1 0 0 0"
         qvel="1 2 3 4 5 6 7 8 9 10 11 12 13 14 15 16 17"/>
  </keyframe>
</mujoco>
"""


def state(model, seed):
    """A random state of a compiled model, and its data there."""
    rng = np.random.default_rng(seed)
    data = mujoco.MjData(model)
    mujoco.mj_integratePos(model, data.qpos, rng.normal(size=model.nv), 1.0)
    data.qvel[:] = rng.normal(size=model.nv)
    data.act[:] = rng.normal(size=model.na)
    data.ctrl[:] = rng.normal(size=model.nu)
    mujoco.mj_forward(model, data)
    return data


def pair(text):
    """A mechanism and the compiled model that it was read from."""
    return Mechanism.from_mjcf(text), mujoco.MjModel.from_xml_string(text)


def motions(m, q):
    """T (nv, 4, 4): every link's pose in its parent, as the module states it, by matrix exponentials."""
    result = []
    for i in range(m.nv):
        if m.kind[i] == BALL_NEXT:
            result.append(np.eye(4))
            continue
        twist = np.zeros((4, 4))
        if m.kind[i] == BALL:
            w, *v = q[m.q_address[i] : m.q_address[i] + 4]
            rotation = Rotation.from_quat([*v, w]).as_rotvec()
            screw = rotation @ m.S[i : i + 3]
        else:
            screw = m.S[i] * (q[m.q_address[i]] - m.q_home[i])
        twist[:3, :3], twist[:3, 3] = hat(screw[:3]), screw[3:]
        result.append(m.T_home[i] @ expm(twist))
    return result


def chained(m, q):
    """(nv, 4, 4) poses of the links in the world."""
    poses = []
    for i, T in enumerate(motions(m, q)):
        poses.append(T if m.parent[i] < 0 else poses[m.parent[i]] @ T)
    return np.array(poses)


def placed(poses, frame):
    return frame.T if frame.link < 0 else poses[frame.link] @ frame.T


def mass_matrix(m, q):
    """The sum of J' G J over the links, J by carrying every screw along."""
    total, jacobians = np.diag(m.armature), []
    for i, T in enumerate(motions(m, q)):
        J = np.zeros((6, m.nv))
        if m.parent[i] >= 0:
            R, p = T[:3, :3], T[:3, 3]
            J[:3] = R.T @ jacobians[m.parent[i]][:3]
            J[3:] = R.T @ (jacobians[m.parent[i]][3:] - hat(p) @ jacobians[m.parent[i]][:3])
        J[:, i] += m.S[i]
        jacobians.append(J)
        at_com = J[3:] - hat(m.com[i]) @ J[:3]
        total = total + J[:3].T @ m.inertia[i] @ J[:3] + m.mass[i] * at_com.T @ at_com
    return total


@pytest.mark.parametrize("seed", range(4))
def test_links_bodies_and_sites_are_where_mujoco_puts_them(seed):
    m, model = pair(MACHINE)
    data = state(model, seed)
    poses = chained(m, data.qpos)
    assert m.body_names == tuple(model.body(i).name for i in range(model.nbody))
    for i, frame in enumerate(m.bodies):
        T = placed(poses, frame)
        np.testing.assert_allclose(T[:3, 3], data.xpos[i], atol=1e-12)
        np.testing.assert_allclose(T[:3, :3].ravel(), data.xmat[i], atol=1e-12)
    assert set(m.sites) == {"edge", "mark"}
    for name in m.sites:
        T = placed(poses, m.frame(name))
        np.testing.assert_allclose(T[:3, 3], data.site(name).xpos, atol=1e-12)
        np.testing.assert_allclose(T[:3, :3].ravel(), data.site(name).xmat, atol=1e-12)


def test_masses_are_mujocos():
    m, model = pair(MACHINE)
    moving = model.body_mass[model.body_weldid != 0]
    np.testing.assert_allclose(m.mass.sum(), moving.sum(), rtol=1e-14)
    assert moving.sum() < model.body_mass.sum()  # the pedestal does not move
    for seed in range(3):
        data = state(model, seed)
        columns = np.empty((model.nv, model.nv))
        for i in range(model.nv):
            mujoco.mj_mulM(model, data, columns[i], np.eye(model.nv)[i])
        np.testing.assert_allclose(mass_matrix(m, data.qpos), columns, atol=1e-11)


def passive(m, data):
    """Springs and dampers, as the mechanism has them."""
    force = -m.damping * data.qvel
    screws = np.flatnonzero(m.kind == SCREW)
    force[screws] -= m.stiffness[screws] * (data.qpos[m.q_address[screws]] - m.spring_rest[screws])
    for k, (address, dof) in enumerate(m.quaternions):
        rest, now = m.ball_rest[k], data.qpos[address : address + 4]
        turn = Rotation.from_quat(np.roll(rest, -1)).inv() * Rotation.from_quat(np.roll(now, -1))
        force[dof : dof + 3] -= m.ball_stiffness[k] * log_quaternion(np.roll(turn.as_quat(), 1))
    return force


@pytest.mark.parametrize("flag", ["", "spring='disable'", "damper='disable'", "gravity='disable'"])
def test_springs_dampers_and_gravity_honour_the_flags(flag):
    text = MACHINE.replace('<flag contact="disable"/>', f'<flag contact="disable" {flag}/>')
    try:
        model = mujoco.MjModel.from_xml_string(text)
    except ValueError:  # one flag for both before MuJoCo 3.4
        text = text.replace("spring=", "passive=").replace("damper=", "passive=")
        model = mujoco.MjModel.from_xml_string(text)
    m, data = Mechanism.from_mjcf(text), state(model, 1)
    np.testing.assert_allclose(passive(m, data), data.qfrc_passive, atol=1e-12)
    off = "gravity" in flag
    np.testing.assert_array_equal(m.gravity, np.zeros(3) if off else model.opt.gravity)
    assert np.any(data.qfrc_passive) or "passive" in text


def test_the_tree_is_mujocos():
    m, model = pair(MACHINE)
    np.testing.assert_array_equal(m.parent, model.dof_parentid)
    for name in ("lift", "roll", "fly", "wag"):
        dofs = np.flatnonzero(model.dof_jntid == model.joint(name).id)
        assert list(range(m.nv))[m.joint(name)] == dofs.tolist()
    for address, dof in m.quaternions:
        assert list(m.base[dof : dof + 3]) == [m.parent[dof]] * 3
        assert list(m.q_address[dof : dof + 3]) == [address] * 3
    others = ~np.isin(m.kind, (BALL, BALL_NEXT))
    np.testing.assert_array_equal(m.base[others], m.parent[others])


def test_home_and_keyframes():
    m, model = pair(MACHINE)
    np.testing.assert_array_equal(m.home, [*model.qpos0, *np.zeros(model.nv)])
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    np.testing.assert_array_equal(m.keyframe("there"), [*data.qpos, *data.qvel])
    with pytest.raises(PlannerError, match=r"'ther'.*'there'"):
        m.keyframe("ther")


def test_arrays_are_read_only():
    m = Mechanism.from_mjcf(MACHINE)
    with pytest.raises(ValueError, match="read-only"):
        m.mass[0] = 1.0
    with pytest.raises(ValueError, match="read-only"):
        m.actuators.gain[...] = 1.0


TARGETS = """
<mujoco>
  <option actuatorgroupdisable="4"><flag contact="disable"/></option>
  <worldbody>
    <body><joint name="h" axis="0 1 0" range="-1 2" limited="true" actuatorfrcrange="-9 8"/><geom size="0.1"/>
      <body pos="1 0 0"><joint name="s" type="slide"/><geom size="0.1"/>
        <body name="ball" pos="1 0 0"><joint name="b" type="ball"/><geom size="0.1" pos="0.3 0 0"/></body></body></body>
    <body><joint name="f" type="free"/><geom name="g" size="0.1"/></body>
  </worldbody>
  <tendon><fixed name="t"><joint joint="h" coef="2"/><joint joint="s" coef="-3"/></fixed></tendon>
  <actuator>%s</actuator>
</mujoco>
"""

ACTUATORS = {
    "motor": '<motor joint="h" gear="3"/>',
    "position": '<position joint="s" kp="5" kv="2" gear="2"/>',
    "dampratio": '<position joint="h" kp="5" dampratio="1"/>',
    "velocity": '<velocity joint="h" kv="4"/>',
    "timeconst": '<position joint="h" kp="5" timeconst="0.2"/>',
    "intvelocity": '<intvelocity joint="h" kp="5" actrange="-2 3"/>',
    "cylinder": '<cylinder joint="s" area="2" timeconst="0.3" bias="1 2 3"/>',
    "bias": '<general joint="s" gainprm="2" biastype="affine" biasprm="3 4 5" gear="6"/>',
    "affine gain without effect": '<general joint="s" gaintype="affine" gainprm="2"/>',
    "no bias": '<general joint="s" gainprm="2" biastype="none" biasprm="3 4 5"/>',
    "integrator": '<general joint="s" gainprm="2" dyntype="integrator"/>',
    "filter": '<general joint="s" gainprm="2" dyntype="filter" dynprm="0.4"/>',
    "tendon": '<position tendon="t" kp="5" kv="2" gear="0.5"/>',
    "hinge in parent": '<motor jointinparent="h" gear="3"/>',
    "ball": '<motor joint="b" gear="1 2 3"/>',
    "ball damped": '<velocity joint="b" kv="2" gear="1 2 3"/>',
    "free": '<motor joint="f" gear="1 2 3 4 5 6"/>',
    "free with a position's bias": '<position joint="f" kp="3" kv="2" gear="1 2 3 4 5 6"/>',
    "adhesion without contacts": '<adhesion body="ball" gain="2" ctrlrange="0 1"/>',
    "off": '<general joint="h" gainprm="2" dyntype="filter" dynprm="0.4" group="4"/>',
    "off muscle": '<muscle joint="h" lengthrange="0 1" group="4"/>',
    "several": '<motor joint="s"/><general joint="h" dyntype="integrator"/><motor joint="f" gear="0 0 1"/>'
    '<general joint="h" dyntype="filter" dynprm="0.2"/>',
}


@pytest.mark.parametrize("elements", ACTUATORS.values(), ids=ACTUATORS)
@pytest.mark.parametrize("flag", ["enable", "disable"])
def test_actuators_push_as_mujocos(elements, flag):
    text = (TARGETS % elements).replace("<flag ", f'<flag actuation="{flag}" ')
    m, model = pair(text)
    actuators = m.actuators
    assert (m.nq, m.nv, m.nu, m.na) == (model.nq, model.nv, model.nu, model.na)
    scalar = np.zeros(m.nv)
    model.jnt_actfrclimited[:] = 0
    for seed in range(3):
        data = state(model, seed)
        screws = m.kind == SCREW  # with the slides of the free joint, which has no length
        scalar[screws] = data.qpos[m.q_address[screws]]
        length, rate = actuators.moment @ scalar, actuators.moment @ data.qvel
        driven = actuators.activation >= 0
        u = np.where(driven, data.act[actuators.activation] if model.na else 0.0, data.ctrl)
        bias = actuators.bias
        force = actuators.gain * u + bias[:, 0] + bias[:, 1] * length + bias[:, 2] * rate
        np.testing.assert_allclose(actuators.moment.T @ force, data.qfrc_actuator, atol=1e-12)
        # Activations move as MuJoCo steps them, one short step with Euler's rule.
        rates = np.where(actuators.dynamics == INTEGRATOR, data.ctrl, 0.0)
        rates += np.where(actuators.dynamics == FILTER, (data.ctrl - u) / actuators.time_constant, 0.0)
        before, model.opt.timestep = data.act.copy(), 1e-7
        model.actuator_actlimited[:] = 0
        mujoco.mj_step(model, data)
        np.testing.assert_allclose((data.act - before) / 1e-7, rates[driven], atol=1e-5)


def test_actuators_own_damping_and_armature():
    text = TARGETS % '<motor name="a" joint="h" gear="3"/><motor joint="f" gear="1 2 3 4 5 6"/>'
    m, model = pair(text)
    if not hasattr(model, "actuator_damping"):
        with pytest.raises(PlannerError, match="damping"):
            Mechanism.from_mjcf(text.replace("gear=", 'damping="0.5" gear='))
        return
    m, model = pair(text.replace("gear=", 'damping="0.5" armature="0.2" gear='))
    data = state(model, 0)
    np.testing.assert_allclose(passive(m, data), data.qfrc_passive, atol=1e-12)
    column = np.empty(model.nv)
    mujoco.mj_mulM(model, data, column, np.eye(model.nv)[0])
    np.testing.assert_allclose(mass_matrix(m, data.qpos)[0], column, atol=1e-12)


def test_ranges_are_data():
    elements = (
        '<motor joint="h" ctrlrange="-1 2" forcerange="-3 4"/>'
        '<intvelocity joint="s" kp="1" actrange="-5 6"/><motor joint="s"/>'
    )
    m = Mechanism.from_mjcf(TARGETS % elements)
    never = [-np.inf, np.inf]
    np.testing.assert_array_equal(m.actuators.control_range, [[-1, 2], never, never])
    np.testing.assert_array_equal(m.actuators.force_range, [[-3, 4], never, never])
    np.testing.assert_array_equal(m.actuators.activation_range, [never, [-5, 6], never])
    np.testing.assert_allclose(m.joint_range[m.joint("h")], np.deg2rad([[-1, 2]]))
    np.testing.assert_array_equal(m.joint_range[m.joint("s")], [never])
    np.testing.assert_array_equal(m.joint_force_range[m.joint("h")], [[-9, 8]])
    assert np.isinf(m.joint_force_range[1:]).all()
    off = (TARGETS % elements).replace("<flag ", '<flag limit="disable" clampctrl="disable" ')
    assert np.isinf(Mechanism.from_mjcf(off).joint_range).all()
    assert np.isinf(Mechanism.from_mjcf(off).actuators.control_range).all()


# What is refused: kind, MJCF with a marker's worth of everything else, what the sentence must name.
PLAIN = """
<mujoco>
  <option>%(option)s</option>
  %(default)s
  <worldbody>
    <body name="one" %(body)s><joint name="h" axis="0 1 0" %(joint)s/><geom size="0.1" mass="1"/>
      <site name="p" pos="0.2 0 0"/>
      <body name="two" pos="1 0 0"><joint name="s" type="slide"/><geom size="0.1"/><site name="q"/></body></body>
    %(world)s
  </worldbody>
  <tendon>%(tendon)s</tendon>
  <equality>%(equality)s</equality>
  <actuator><motor name="kept" joint="s"/>%(actuator)s<motor name="last" joint="h"/></actuator>
  <sensor>%(sensor)s</sensor>
  <keyframe>%(key)s</keyframe>
</mujoco>
"""


def plain(**parts):
    names = ("option", "default", "body", "joint", "world", "tendon", "equality", "actuator", "sensor", "key")
    return PLAIN % {name: parts.get(name, "") for name in names}


TENDON = '<fixed name="t" %s><joint joint="h" coef="1"/></fixed>'
SPATIAL = '<spatial name="t" %s><site site="p"/><site site="q"/></spatial>'
MUSCLE = '<muscle name="biceps" joint="h" lengthrange="0 1"/>'
MOCAP = '<body name="hand" mocap="true"><body name="toy"><joint/><geom size="0.1"/></body></body>'
REFUSED = [
    ("frictionloss", plain(joint='frictionloss="1"'), ["frictionloss of joint 'h'"]),
    ("frictionloss", plain(default='<default><joint frictionloss="1"/></default>'), ["joint 'h'", "joint 's'"]),
    ("frictionloss", plain(tendon=TENDON % 'frictionloss="1"'), ["frictionloss of tendon 't'"]),
    ("equality", plain(equality='<joint name="lock" joint1="h"/>'), ["equality 'lock'"]),
    ("equality", plain(equality='<weld body1="one"/>'), ["equality number 0"]),
    ("tendon", plain(tendon=TENDON % 'stiffness="1"'), ["stiffness of tendon 't'"]),
    ("tendon", plain(tendon=SPATIAL % 'damping="1"'), ["damping of tendon 't'"]),
    ("tendon", plain(tendon=SPATIAL % 'range="0 9" limited="true"'), ["limit of tendon 't'"]),
    (
        "tendon",
        plain(default='<default><tendon stiffness="3" frictionloss="1"/></default>', tendon=SPATIAL % ""),
        ["stiffness, frictionloss of tendon 't'"],
    ),
    ("fluid", plain(option='<flag contact="disable"/>').replace("<option>", '<option density="9">'), ["density"]),
    ("fluid", plain().replace("<option>", '<option viscosity="9">'), ["viscosity"]),
    ("gravcomp", plain(body='gravcomp="0.5"'), ["gravcomp of body 'one'"]),
    ("actuator", plain(actuator=MUSCLE), ["actuator 'biceps'", "muscle"]),
    ("actuator", plain(actuator='<damper name="x" joint="h" kv="1" ctrlrange="0 1"/>'), ["'x' (affine gain)"]),
    ("actuator", plain(actuator='<motor name="x" site="p" gear="1"/>'), ["'x' (site transmission)"]),
    ("actuator", plain(tendon=SPATIAL % "", actuator='<motor name="x" tendon="t"/>'), ["'x' (spatial tendon)"]),
    ("actuator", plain(actuator='<motor site="p"/>'), ["actuator number 1"]),
    (
        "actuator",
        plain(actuator='<motor name="x" cranksite="p" slidersite="q" cranklength="1"/>'),
        ["'x' (slidercrank transmission)"],
    ),
    (
        "actuator",
        plain(world='<body><joint name="b" type="ball"/><geom size="0.1"/></body>')
        .replace("<option>", '<option><flag contact="disable"/>')
        .replace("<actuator>", '<actuator><position name="x" joint="b"/><motor name="y" jointinparent="b"/>'),
        ["'x' (force by the angle of a ball joint)", "'y' (jointinparent of a ball or free joint)"],
    ),
    (
        "actearly",
        plain(actuator='<general name="x" joint="h" dyntype="integrator" actearly="true"/>'),
        ["actearly of actuator 'x'"],
    ),
    ("mocap", plain(world=MOCAP).replace("<option>", '<option><flag contact="disable"/>'), ["mocap body 'hand'"]),
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
    return {name: values[name] for name in values.keys() - {"ignored", "actuators", "space", "quaternions", "home"}}


@pytest.mark.parametrize(
    ("kind", "text", "names"), REFUSED, ids=[f"{kind}-{i}" for i, (kind, _, _) in enumerate(REFUSED)]
)
def test_refused_by_name_and_taken_out(kind, text, names):
    contacts = "on" if "contact=" in text else "off"
    with pytest.raises(PlannerError) as error:
        Mechanism.from_mjcf(text, contacts=contacts)
    for name in names:
        assert name in str(error.value)
    assert f"ignore=('{kind}',)" in str(error.value)

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
        joint='frictionloss="1"', body='gravcomp="1"', tendon=TENDON % 'damping="1"', actuator=MUSCLE,
        equality='<joint name="lock" joint1="h"/>', world='<geom name="floor" type="plane" size="1 1 1"/>',
    )  # fmt: skip
    parts = ["joint 'h'", "body 'one'", "tendon 't'", "'biceps'", "'lock'", "geom 'floor'", "contacts='off'"]
    with pytest.raises(PlannerError) as error:
        Mechanism.from_mjcf(text)
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


def test_what_cannot_act_is_no_reason_to_refuse():
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
    with pytest.raises(PlannerError, match="contacts of geom 'floor' and geom number 1 and 1 more pairs"):
        Mechanism.from_mjcf(text)
    assert Mechanism.from_mjcf(text, contacts="off").ignored == ("contacts",)
    assert Mechanism.from_mjcf(plain(), contacts="off").ignored == ()
    assert Mechanism.from_mjcf(text.replace("<option>", '<option><flag contact="disable"/>')).ignored == ()
    with pytest.raises(PlannerError, match="contacts is 'of', expected one of: on, off"):
        Mechanism.from_mjcf(text, contacts="of")


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


OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 {}\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


@pytest.fixture
def folder(tmp_path):
    """A model in several files, two of them with one name, some beside the file that includes the one naming them."""
    for part, height in (("shapes", 1), ("arm", 2), ("arm/deep", 3)):
        (tmp_path / part).mkdir()
        (tmp_path / part / "wedge.obj").write_text(OBJ.format(height))
    heights = np.arange(6, dtype=np.float32)
    (tmp_path / "shapes" / "hill.bin").write_bytes(struct.pack("<ii", 2, 3) + heights.tobytes())
    (tmp_path / "main.xml").write_text("""
      <mujoco><compiler meshdir="shapes"/><option><flag contact="disable"/></option>
        <include file="arm/arm.xml"/>
        <asset><mesh file="wedge.obj"/><hfield name="hill" file="hill.bin" size="1 1 1 1"/></asset>
        <worldbody><geom type="hfield" hfield="hill"/>
          <body><joint/><geom type="mesh" mesh="wedge"/><geom type="mesh" mesh="long"/></body></worldbody></mujoco>""")
    (tmp_path / "arm" / "arm.xml").write_text("""
      <mujocoinclude><include file="deep/more.xml"/>
        <asset><mesh name="other" file="../arm/wedge.obj" scale="2 2 2"/></asset></mujocoinclude>""")
    (tmp_path / "arm" / "deep" / "more.xml").write_text("""
      <mujocoinclude><asset><mesh name="long" file="deep/wedge.obj"/></asset></mujocoinclude>""")
    (tmp_path / "arm" / "deep" / "deep").mkdir()
    (tmp_path / "arm" / "deep" / "deep" / "wedge.obj").write_text(OBJ.format(5))
    return tmp_path


def test_a_model_of_several_files_stands_alone(folder, monkeypatch):
    whole = mujoco.MjModel.from_xml_path(str(folder / "main.xml"))
    m = Mechanism.from_mjcf(folder / "main.xml")
    assert len(m.assets) == 4  # three wedges and a hill
    elsewhere = folder / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    alone = mujoco.MjModel.from_xml_string(m.mjcf, m.assets)
    np.testing.assert_array_equal(alone.mesh_vert, whole.mesh_vert)
    np.testing.assert_array_equal(alone.hfield_data, whole.hfield_data)
    np.testing.assert_array_equal(alone.body_mass, whole.body_mass)
    again = read(m.mjcf, assets=m.assets)
    assert again.mjcf == m.mjcf
    assert again.assets == m.assets
    np.testing.assert_array_equal(again.mass, m.mass)


def test_a_missing_file_is_named(folder):
    (folder / "shapes" / "hill.bin").unlink()
    with pytest.raises(PlannerError, match=r"cannot read 'hill.bin' that the model names"):
        Mechanism.from_mjcf(folder / "main.xml")


def test_models_that_attach_models(tmp_path):
    (tmp_path / "part.xml").write_text(plain())
    text = """<mujoco><option><flag contact="disable"/></option><asset><model name="m" file="part.xml"/></asset>
      <worldbody><body name="x" pos="1 0 0"><attach model="m" body="one" prefix="p_"/></body></worldbody></mujoco>"""
    (tmp_path / "main.xml").write_text(text)
    m = Mechanism.from_mjcf(tmp_path / "main.xml")
    assert m.joint_names == ("p_h", "p_s")
    assert read(m.mjcf, assets=m.assets).joint_names == m.joint_names


def test_includes_are_found_as_mujoco_finds_them(folder):
    """Beside the file that includes, or, as the reference says, from the main file's folder."""
    (folder / "arm" / "arm.xml").write_text('<mujocoinclude><include file="arm/deep/more.xml"/></mujocoinclude>')
    assert mujoco.MjModel.from_xml_path(str(folder / "main.xml")).nmesh == 2
    assert 'name="long"' in model_text(folder / "main.xml")


BOMB = '<!DOCTYPE x [<!ENTITY a "b"><!ENTITY c "&a;&a;">]><mujoco>&c;</mujoco>'
WRONG = {
    "": "the model is an empty text",
    "  \n": "the model is an empty text",
    "no/such/file.xml": "cannot read the model no/such/file.xml: No such file",
    "null\0byte": "cannot read the model",
    "<mujoco>": "not well-formed XML",
    "<mujoco>\ud800</mujoco>": "not well-formed XML",
    "<robot/>": "root element <robot>",
    BOMB: "declares XML entities",
    "<mujoco><include/></mujoco>": "an <include> without a file",
    "<mujoco><include file='nowhere.xml'/></mujoco>": "cannot read the model nowhere.xml",
    "<mujoco><asset><mesh file='nowhere.obj'/></asset></mujoco>": "cannot read 'nowhere.obj'",
    "<mujoco><worldbody/></mujoco>": "has no joints",
    "<mujoco><worldbody><body><joint/></body></worldbody></mujoco>": "mass and inertia of moving bodies",
    "<mujoco><worldbody><body colour='red'/></worldbody></mujoco>": "colour",
    "<mujoco>" + "<worldbody>" * 5000 + "</worldbody>" * 5000 + "</mujoco>": "nested too deeply",
}


@pytest.mark.parametrize(("text", "sentence"), WRONG.items(), ids=range(len(WRONG)))
def test_wrong_input_is_one_sentence(text, sentence, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(PlannerError) as error:
        Mechanism.from_mjcf(text)
    assert sentence in str(error.value)
    assert str(error.value).endswith(".")
    assert "\n" not in str(error.value)


def test_wrong_paths_and_options(tmp_path):
    with pytest.raises(PlannerError, match="Is a directory"):
        Mechanism.from_mjcf(tmp_path)
    (tmp_path / "binary.xml").write_bytes(b"\xff\xfe\x00<")
    with pytest.raises(PlannerError, match="not text"):
        Mechanism.from_mjcf(tmp_path / "binary.xml")
    with pytest.raises(PlannerError, match="the model is a int"):
        Mechanism.from_mjcf(3)  # pyright: ignore[reportArgumentType]
    with pytest.raises(PlannerError, match=r"ignore is 'friction', expected one of: frictionloss, .*'frictionloss'"):
        Mechanism.from_mjcf(MACHINE, ignore=("friction",))
    assert Mechanism.from_mjcf(MACHINE, ignore=("frictionloss",)).ignored == ()


def test_a_file_that_includes_itself(tmp_path):
    (tmp_path / "a.xml").write_text("<mujoco><include file='a.xml'/></mujoco>")
    with pytest.raises(PlannerError, match="includes itself"):
        Mechanism.from_mjcf(tmp_path / "a.xml")
