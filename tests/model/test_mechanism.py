"""Reading MJCF: the links, masses and forces are MuJoCo's; what is not modelled is named, taken out, or cannot act."""

import numpy as np
import pytest
from machines import MACHINE, passive, state
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from planner.base.errors import PlannerError
from planner.base.gl import load_mujoco
from planner.dynamics.joint_forces import actuator_forces, actuator_moments
from planner.model.actuators import FILTER, INTEGRATOR
from planner.model.mechanism import BALL, BALL_NEXT, SCREW, Mechanism
from planner.model.space import hat

mujoco = load_mujoco()


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
    "damper": '<general joint="h" gaintype="affine" gainprm="0 0 -3" gear="2"/>',
    "affine gain": '<general tendon="t" gaintype="affine" gainprm="2 3 4" biastype="affine" biasprm="5 6 7" gear="2"/>',
    "affine gain of an activation": '<general joint="s" gaintype="affine" gainprm="2 3 4" dyntype="integrator"/>',
    "no bias": '<general joint="s" gainprm="2" biastype="none" biasprm="3 4 5"/>',
    "integrator": '<general joint="s" gainprm="2" dyntype="integrator"/>',
    "filter": '<general joint="s" gainprm="2" dyntype="filter" dynprm="0.4"/>',
    "tendon": '<position tendon="t" kp="5" kv="2" gear="0.5"/>',
    "hinge in parent": '<motor jointinparent="h" gear="3"/>',
    "ball": '<motor joint="b" gear="1 2 3"/>',
    "ball in parent": '<motor jointinparent="b" gear="1 2 3"/>',
    "free in parent": '<motor jointinparent="f" gear="1 2 3 4 5 6"/>',
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
        moment = actuator_moments(m, data.qpos)
        length, rate = actuators.moment @ scalar, actuators.moment @ data.qvel
        driven = actuators.activation >= 0
        u = np.where(driven, data.act[actuators.activation] if model.na else 0.0, data.ctrl)
        force = actuator_forces(actuators, u, length, rate)
        np.testing.assert_allclose(moment.T @ force, data.qfrc_actuator, atol=1e-12)
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
