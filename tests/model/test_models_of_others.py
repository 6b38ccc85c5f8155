"""The MJCF files inside two packages that others made, dm-control and gymnasium, as they are; nothing of them is run.

.ci/setup fetches the packages without what they need to run.
"""

from copy import copy
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from places import PLACES, path
from trees import (
    data_at,
    mujoco,
    relative_error,
    simulated,
    simulated_inverse,
    site_jacobian,
)

from planner import dynamics as rb
from planner.base.errors import ModelError, PlannerError
from planner.dynamics import RigidBodyDynamics
from planner.model.actuators import DIRECT
from planner.model.mechanism import Mechanism

pytestmark = pytest.mark.skipif(
    None in PLACES.values(), reason="no models: pip install --no-deps dm-control==1.0.50 gymnasium==1.4.0"
)

WHOLE = [
    "dm acrobot", "dm cartpole", "dm cheetah", "dm dog", "dm finger", "dm fish", "dm hopper", "dm humanoid",
    "dm humanoid_CMU", "dm manipulator", "dm pendulum", "dm point_mass", "dm quadruped", "dm reacher", "dm stacker",
    "dm swimmer", "dm walker", "gym ant", "gym half_cheetah", "gym hopper", "gym humanoid", "gym humanoidstandup",
    "gym inverted_double_pendulum", "gym inverted_pendulum", "gym point", "gym pusher", "gym pusher_v5",
    "gym reacher", "gym swimmer", "gym walker2d", "gym walker2d_v5",
]  # fmt: skip
# What takes out of a file what is not modelled, and words of the sentence that refuses it.
REFUSED = {
    "dm ball_in_cup": (("tendon",), "limit of tendon 'string'"),
}
SLOW = {"dm dog": pytest.mark.slow}  # its meshes take MuJoCo 3 s
each = pytest.mark.parametrize("name", [pytest.param(name, marks=SLOW.get(name, ())) for name in (*WHOLE, *REFUSED)])


@cache
def machine(name):
    """The mechanism and MuJoCo's model: of the file itself, unless something had to be taken out of it.

    Without couplings, stops and friction loss: MuJoCo's constraints are off here, and tests/dynamics has those.
    """
    ignore = REFUSED[name][0] if name in REFUSED else ()
    mechanism = Mechanism.from_mjcf(path(name), ignore=ignore, contacts="off")
    if name in REFUSED:
        model = mujoco.MjModel.from_xml_string(mechanism.mjcf, mechanism.assets)
    else:
        model = mujoco.MjModel.from_xml_path(str(path(name)))
    bits = mujoco.mjtDisableBit
    model.opt.disableflags |= bits.mjDSBL_CONSTRAINT | bits.mjDSBL_EULERDAMP  # contacts, limits; damping as elsewhere
    return replace(mechanism, couplings=(), stops=(), friction_loss=np.zeros(mechanism.nv)), model


def drawn(name):
    """The machine, states near where its file puts it, and one more vector."""
    mechanism, model = machine(name)
    model = copy(model)  # tests change its options
    rng = np.random.default_rng(0)
    x = np.array([mechanism.space.integrate(
        mechanism.home, 0.5 * rng.normal(size=mechanism.space.ndx)) for _ in range(3)])  # fmt: skip
    q, qd, act = np.split(x, [mechanism.nq, mechanism.nq + mechanism.nv], axis=1)
    return mechanism, model, q, qd, act, rng.normal(size=(3, mechanism.nv))


def test_every_file_is_on_one_of_the_lists():
    """But for one, which has nothing to move: dm-control fills it in by a program."""
    files = {f"{place} {file.stem}" for place, at in PLACES.items() for file in at.glob("*.xml")}
    assert files == {*WHOLE, *REFUSED, "dm lqr"}
    with pytest.raises(ModelError, match="has no joints"):
        Mechanism.from_mjcf(path("dm lqr"))


@pytest.mark.parametrize("name", REFUSED)
def test_elements_that_are_not_modelled_are_named(name):
    ignore, words = REFUSED[name]
    with pytest.raises(ModelError) as error:
        Mechanism.from_mjcf(path(name), contacts="off")
    assert words in str(error.value)
    assert f'ignore = ["{ignore[0]}"] loads' in str(error.value)  # what to do about it


@each
def test_dynamics_are_mujocos(name):
    m, model, q, qd, _, tau = drawn(name)
    qdd, M, bias = rb.forward_dynamics(m, q, qd, tau), rb.mass_matrix(m, q), rb.bias(m, q, qd)
    forces, poses = rb.rnea(m, q, qd, tau), rb.forward_kinematics(m, q)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION  # servos push without a control
    for i in range(3):
        theirs = simulated(model, q[i], qd[i], tau[i])
        assert relative_error(M[i], theirs.M) < 1e-10
        assert relative_error(bias[i], theirs.bias) < 1e-10
        assert relative_error(qdd[i], theirs.qacc) < 1e-10
        assert relative_error(forces[i], simulated_inverse(model, q[i], qd[i], tau[i])) < 1e-10
        assert relative_error(poses[i], theirs.poses) < 1e-12
        for site in list(m.sites)[:5]:
            assert relative_error(rb.jacobian(m, q[i], site), site_jacobian(model, q[i], site)) < 1e-12


@each
def test_steps_are_mujocos(name):
    """Twenty of them, by velocities first, under controls within their ranges."""
    m, model, q, qd, act, _ = drawn(name)
    D = rb.forward_dynamics_derivatives(m, q[0], qd[0], np.zeros(m.nv))
    fastest = np.abs(np.linalg.eigvals(D.qd)).max() + np.sqrt(np.abs(np.linalg.eigvals(D.q)).max())
    dt = min(1e-3, 0.1 / fastest)  # dampers and springs of some need more than a millisecond
    model.opt.integrator, model.opt.timestep = mujoco.mjtIntegrator.mjINT_EULER, dt
    if m.nu == 0:  # a program adds the joints that its motors would move
        assert name == "dm swimmer"
        with pytest.raises(PlannerError, match="no actuators"):
            RigidBodyDynamics(m, dt)
        return
    dynamics = RigidBodyDynamics(m, dt, "semi-implicit-euler")
    u = 0.1 * np.random.default_rng(1).random(dynamics.nu)
    x = np.concatenate([q[0], 0.1 * qd[0], 0.1 * np.abs(act[0])])
    data = data_at(model, q[0], 0.1 * qd[0])
    data.act, data.ctrl = x[m.nq + m.nv :], u
    for _ in range(20):
        x = dynamics.step(x[None], u[None])[0]
        mujoco.mj_step(model, data)
    assert relative_error(x, np.concatenate([data.qpos, data.qvel, data.act])) < 1e-11


@each
def test_derivatives_are_those_of_differences(name):
    m, _, q, qd, _, tau = drawn(name)
    rng, h = np.random.default_rng(2), 1e-3  # error of sixth order
    dq, dqd, dtau = rng.normal(size=(3, m.nv))
    x = np.concatenate([q[0], qd[0], np.zeros(m.na)])
    dx = np.concatenate([dq, dqd, np.zeros(m.na)])
    steps = h * np.array([-3.0, -2.0, -1.0, 1.0, 2.0, 3.0])
    moved = m.space.integrate(x, steps[:, None] * dx)
    around = rb.forward_dynamics(m, moved[:, : m.nq], moved[:, m.nq : m.nq + m.nv], tau[0] + steps[:, None] * dtau)
    slope = np.array([-1.0, 9.0, -45.0, 45.0, -9.0, 1.0]) @ around / (60.0 * h)
    D = rb.forward_dynamics_derivatives(m, q[0], qd[0], tau[0])
    assert relative_error(D.q @ dq + D.qd @ dqd + D.input @ dtau, slope) < 1e-7


@pytest.mark.slow
def test_activations_are_among_them():
    """The dog's muscles are filters: otherwise no model here would have any."""
    assert np.all(machine("dm dog")[0].actuators.dynamics != DIRECT)
