"""Actuators at sites: moments and accelerations against MuJoCo's, derivatives against differences."""

import numpy as np
import pytest
from gradients import assert_step_derivatives
from thrusters import EVERY_WAY, QUADROTOR, random_states

from planner.base.errors import PlannerError
from planner.base.gl import load_mujoco
from planner.dynamics import RigidBodyDynamics
from planner.dynamics.joint_forces import actuator_moments
from planner.dynamics.quasi_static import quasi_static_controls
from planner.model.mechanism import Mechanism
from planner.proof.compare.differences import differences

mujoco = load_mujoco()
WAYS = [("rk4", 1), ("rk4", 3), ("euler", 1), ("semi-implicit-euler", 1), ("rosenbrock", 1), ("rosenbrock", 2)]


@pytest.fixture(scope="module")
def machine():
    return Mechanism.from_mjcf(EVERY_WAY)


@pytest.fixture
def rng():
    return np.random.default_rng(3)


def of_mujoco(mechanism, x, u):
    """MuJoCo's moments (nu, nv) and accelerations (nv,)."""
    model = mujoco.MjModel.from_xml_string(mechanism.mjcf)
    data, moments = mujoco.MjData(model), np.zeros((model.nu, model.nv))
    data.qpos, data.qvel, data.act, data.ctrl = *np.split(x, [mechanism.nq, mechanism.nq + mechanism.nv]), u
    mujoco.mj_forward(model, data)
    mujoco.mju_sparse2dense(moments, data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind)
    return moments, data.qacc.copy()


def test_moments_and_accelerations_are_mujoco_s(machine, rng):
    dynamics = RigidBodyDynamics(machine, 0.01)
    xs, us = random_states(machine, rng, 8)
    rates = dynamics.rates(xs, us)
    for x, u, rate in zip(xs, us, rates, strict=True):
        moments, qacc = of_mujoco(machine, x, u)
        np.testing.assert_allclose(actuator_moments(machine, x[: machine.nq]), moments, atol=1e-12)
        np.testing.assert_allclose(rate[machine.nv : 2 * machine.nv], qacc, rtol=1e-10, atol=1e-10 * np.abs(qacc).max())


@pytest.mark.parametrize(("integrator", "substeps"), WAYS)
def test_derivatives_are_exact(machine, rng, integrator, substeps):
    dynamics = RigidBodyDynamics(machine, 0.01, integrator, substeps=substeps)
    xs, us = random_states(machine, rng, 5)
    assert_step_derivatives(dynamics, xs, us)


def test_a_prescribed_joint_takes_no_force_of_a_site(machine, rng):
    dynamics = RigidBodyDynamics(machine, 0.01, prescribed=("shoulder", "wrist"))
    xs, us = random_states(machine, rng, 4)
    us = np.concatenate([us, rng.normal(size=(4, 4))], axis=1)
    given = dynamics.rates(xs, us)[:, machine.nv :]
    np.testing.assert_allclose(given[:, [0, 2, 3, 4]], us[:, machine.nu :])
    assert_step_derivatives(dynamics, xs, us)


def test_hover_is_static():
    mechanism = Mechanism.from_mjcf(QUADROTOR)
    dynamics = RigidBodyDynamics(mechanism, 0.01)
    u = quasi_static_controls(dynamics, mechanism.home)
    np.testing.assert_allclose(u, 0.6 * 9.81 / 4.0, rtol=1e-12)
    assert np.abs(dynamics.rates(mechanism.home[None], u[None])).max() < 1e-10


def test_no_second_derivatives_of_sites():
    dynamics = RigidBodyDynamics(Mechanism.from_mjcf(QUADROTOR.replace('<freejoint name="base"/>', "<joint/>")), 0.01)
    with pytest.raises(PlannerError, match="actuators at sites"):
        dynamics.second_order_memory()


def test_another_place_of_a_rotor_is_named():
    ours, theirs = (Mechanism.from_mjcf(text) for text in (QUADROTOR, QUADROTOR.replace("0.085 0.01", "0.095 0.01")))
    assert "what its actuators do at sites" in differences(ours, theirs)
    assert differences(ours, ours) == ""
