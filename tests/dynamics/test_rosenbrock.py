"""Steps that take damping implicitly: their twin in NumPy, differences, MuJoCo's accelerations, order and stability."""

from __future__ import annotations

import re
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from gradients import assert_step_derivatives
from machines import FRICTION_ARM
from trees import CHAINS, actuated, damped, driven, machines, random_state

from planner import Mechanism, RigidBodyDynamics
from planner.base.errors import PlannerError
from planner.dynamics import product_of_exponentials
from planner.dynamics.step_stability import IMPLICIT, follows_all_but_damping, implicit_error
from planner.model.couplings import Coupling
from planner.model.passive_forces import damping_matrix, implicit_damping
from planner.proof.replays.simulation import implicit_step

GAMMA = 1.0 - np.sqrt(0.5)
FINGER = """
<mujoco><option gravity="0 0 0"/><worldbody><body><joint name="finger" axis="0 1 0" damping="{damping}"/>
  <inertial mass="1" pos="0 0 0" diaginertia="1e-6 1e-6 1e-6"/></body></worldbody>
  <actuator><motor joint="finger"/></actuator></mujoco>
"""


def twin(dynamics, x, u):
    """The formulas of kernels.tree.rosenbrock with masses by product_of_exponentials.py and forces by the rates, one
    step."""
    m, space, h = dynamics.mechanism, dynamics.space, dynamics.dt / dynamics.substeps
    nq, nv, added = m.nq, m.nv, GAMMA * h * implicit_damping(m)
    free = np.array([not any(m.joint(p).start <= i < m.joint(p).stop for p in dynamics.prescribed) for i in range(nv)])
    given = np.zeros(nv)
    given[~free] = u[m.nu :][np.argsort(np.argsort(np.flatnonzero(~free)))]

    def accelerate(x, behind):
        rates, M = dynamics.rates(x[None], u[None])[0], product_of_exponentials.mass_matrix(m, x[:nq])
        a, heavier = rates[nv : 2 * nv].copy(), (M + np.diag(added))[np.ix_(free, free)]
        a[free] = np.linalg.solve(heavier, M[np.ix_(free, free)] @ a[free] + behind[free])
        return a, rates[2 * nv :]

    v = x[nq : nq + nv]
    a, rate = accelerate(x, np.zeros(nv))
    w, later = accelerate(
        space.integrate(x, np.concatenate([h * v + GAMMA * h**2 * a, h * a, h * rate])), 2.0 * added * a
    )
    way = h * v + 0.5 * h**2 * ((1.0 - GAMMA) * a + GAMMA * w)
    return space.integrate(x, np.concatenate([way, 0.5 * h * (a + w), 0.5 * h * (rate + later)]))


def apart(m, found, wanted, x):
    """The largest difference of two ends of a step from x, beside the step or 1."""
    return np.abs(m.space.difference(found, wanted)).max() / max(1.0, np.abs(m.space.difference(wanted, x)).max())


@machines(12, max_dofs=14)
def test_a_step_is_the_twins(text, seed):
    dynamics, _, us, rng = driven(text, seed, K=5)
    m = replace(dynamics.mechanism, damping=10.0 ** rng.uniform(-1, 4, dynamics.mechanism.nv))
    xs = np.array([random_state(m.space, rng, unnormalized=False) for _ in us])
    dynamics = RigidBodyDynamics(m, 0.02, "rosenbrock", dynamics.prescribed)
    ends = dynamics.step(xs, us)
    for x, u, end in zip(xs, us, ends, strict=True):
        wanted = twin(dynamics, x, u)
        # rounding of M^-1 (M a) in the twin, by the condition of random mass matrices, up to 1e6
        assert apart(m, end, wanted, x) < 1e-8


@pytest.mark.parametrize(("integrator", "substeps"), [("rosenbrock", 1), ("rosenbrock", 3), ("implicitfast", 1)])
@pytest.mark.parametrize("name", CHAINS)
def test_derivatives_are_those_of_differences(name, integrator, substeps):
    rng = np.random.default_rng(1)
    m = Mechanism.from_mjcf(actuated(CHAINS[name], np.random.default_rng(0)))
    m = replace(m, damping=10.0 ** rng.uniform(-1, 4, m.nv))
    dynamics = RigidBodyDynamics(m, 0.03, integrator, substeps=substeps)
    x = m.space.integrate(m.home, 0.3 * rng.normal(size=m.space.ndx))
    assert_step_derivatives(dynamics, x, rng.normal(size=m.nu))


@pytest.mark.parametrize(("integrator", "substeps"), [("rosenbrock", 2), ("implicitfast", 1)])
def test_derivatives_of_what_is_coupled_prescribed_or_rubs_are_those_of_differences(integrator, substeps):
    rng = np.random.default_rng(2)
    m = replace(Mechanism.from_mjcf(FRICTION_ARM), damping=np.array([50.0, 900.0, 4000.0]))
    coupled = replace(m, couplings=(Coupling("mimic", (2, 1), (1.0, -0.7), 0.0),))
    x, u = 0.3 * rng.normal(size=6), 3.0 * rng.normal(size=3)
    x[[2, 5]] = 0.7 * x[[1, 4]]
    for machine, prescribed in ((m, ()), (coupled, ()), (m, ("lift",))):
        dynamics = RigidBodyDynamics(machine, 0.02, integrator, prescribed, substeps)
        assert_step_derivatives(dynamics, x, rng.normal(size=dynamics.nu) if prescribed else u)


@machines(8, max_dofs=12)
def test_mujocos_forces_give_the_same_step(text, seed):
    m, x, us, model = damped(text, seed)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.act[:] = np.split(x, [m.nq, m.nq + m.nv])
    data.ctrl[:] = us[0]
    implicit_step(model, 0.02, implicit_damping(m), 4)(data)
    found = np.concatenate([data.qpos, data.qvel, data.act])
    wanted = RigidBodyDynamics(m, 0.02, "rosenbrock", substeps=4).step(x[None], us)[0]
    assert apart(m, found, wanted, x) < 1e-9


@pytest.mark.parametrize("damping", [1e-6, 1e-4, 1e-3, 1e-2, 1.0, 1e3])
def test_a_jump_of_the_control_is_followed_at_any_rate(damping):
    m = Mechanism.from_mjcf(FINGER.format(damping=damping))
    rate, dt = damping / m.inertia[0, 1, 1], 0.01
    dynamics = RigidBodyDynamics(m, dt, "rosenbrock", substeps=16)
    for part in (0.05, 0.3, 1.0):  # of a stage: so the plan is read between its knots
        end = dynamics.step(np.zeros((1, 2)), np.full((1, 1), damping), np.array([part * dt]))[0]
        # the largest of |R(-Z/16)^16 - exp(-Z)| over all Z is 2.2e-4, and the velocity would become 1
        assert abs(end[1] + np.expm1(-rate * part * dt)) < 2.3e-4
        assert abs(end[0] - part * dt - np.expm1(-rate * part * dt) / rate) < 2.3e-4 * part * dt


def test_the_method_is_of_second_order():
    m, rng = Mechanism.from_mjcf(actuated(CHAINS["arm"], np.random.default_rng(0))), np.random.default_rng(3)
    x, u = 0.3 * rng.normal(size=(1, m.space.nx)), rng.normal(size=(1, m.nu))
    true = RigidBodyDynamics(m, 0.1, substeps=16).step(x, u)
    errors = [np.abs(RigidBodyDynamics(m, 0.1, "rosenbrock", substeps=k).step(x, u) - true).max() for k in (4, 8, 16)]
    np.testing.assert_allclose(np.log2(np.divide(errors[:-1], errors[1:])), 2.0, atol=0.25)


def test_rates_stay_the_machines_own():
    m = Mechanism.from_mjcf(FINGER.format(damping=1.0))
    dynamics, x, u = RigidBodyDynamics(m, 0.01, "rosenbrock"), np.array([[0.1, 2.0]]), np.array([[0.5]])
    before = dynamics.rates(x, u)
    dynamics.step(x, u)
    np.testing.assert_array_equal(dynamics.rates(x, u), before)
    assert before[0, 1] == pytest.approx((0.5 - 2.0) / m.inertia[0, 1, 1])


def test_the_damping_that_is_taken_is_no_less_than_the_machines():
    text = FRICTION_ARM.replace(
        "</actuator>", '<velocity joint="lift" kv="3"/><velocity tendon="both" kv="2"/></actuator>'
    )
    text = text.replace(
        "<actuator>", '<tendon><fixed name="both" damping="5"><joint joint="turn" coef="1"/>'
        '<joint joint="bend" coef="-2"/></fixed></tendon><actuator>'
    )  # fmt: skip
    m = Mechanism.from_mjcf(text)
    D = damping_matrix(m)
    np.testing.assert_allclose(D, [[0.2 + 7.0, 0.0, -14.0], [0.0, 3.2, 0.0], [-14.0, 0.0, 0.2 + 28.0]])
    assert np.linalg.eigvalsh(np.diag(implicit_damping(m)) - D).min() > -1e-12


def test_springs_are_not_what_it_is_for():
    m = Mechanism.from_mjcf(FINGER.format(damping=1.0))
    assert implicit_error(m, 0.01, m.home) < IMPLICIT
    assert follows_all_but_damping(m, 0.01, m.home)
    stiff = Mechanism.from_mjcf(re.sub("damping=", 'stiffness="1e4" damping=', FINGER.format(damping=1e-3)))
    assert implicit_error(stiff, 0.01, stiff.home) > IMPLICIT
    assert not follows_all_but_damping(stiff, 0.01, stiff.home)


def test_what_it_lacks_is_said():
    dynamics = RigidBodyDynamics(Mechanism.from_mjcf(FINGER.format(damping=1.0)), 0.01, "rosenbrock")
    with pytest.raises(PlannerError, match="rosenbrock"):
        dynamics.second_order_memory()
    assert dynamics.with_step(0.005, "rosenbrock").integrator == "rosenbrock"
