"""A mechanism in time: rates against MuJoCo and Fig. 2, integrators by their order, Jacobians by differences."""

import numpy as np
import pytest
from hypothesis import assume
from hypothesis import strategies as st
from trees import CHAINS, actuated, data_at, driven, machines, mujoco, random_state, relative_error

from planner.dynamics import RigidBodyDynamics, product_of_exponentials
from planner.kernels.integrators import INTEGRATORS
from planner.model.actuators import FILTER
from planner.model.mechanism import SCREW, Mechanism
from planner.model.space import conjugate, log_quaternion, product

each_integrator = pytest.mark.parametrize("integrator", INTEGRATORS)


def parts(m, x):
    return np.split(x, [m.nq, m.nq + m.nv])


# ------------------------------------------------------------------------------------------------------- rates


@machines(15, max_dofs=25)
def test_rates_are_mujocos(text, seed):
    dynamics, xs, us, _ = driven(text, seed, K=3, prescribe=False)
    m = dynamics.mechanism
    model = mujoco.MjModel.from_xml_string(m.mjcf)
    for x, u, rate in zip(xs, us, dynamics.rates(xs, us), strict=True):
        q, qd, act = parts(m, x)
        data = data_at(model, q, qd)
        data.ctrl, data.act = u, act
        mujoco.mj_forward(model, data)
        theirs = np.concatenate([qd, data.qacc_smooth, data.act_dot])
        assert relative_error(rate, theirs) < 1e-10


@machines(15, max_dofs=25)
def test_rates_are_hybrid_dynamics_under_the_actuators_forces(text, seed):
    """With prescribed joints, whose own actuators do nothing: the controls first, then the accelerations."""
    dynamics, xs, us, _ = driven(text, seed, K=1)
    m, a, u = dynamics.mechanism, dynamics.mechanism.actuators, us[0]
    q, qd, act = parts(m, xs[0])
    mask = np.zeros(m.nv, dtype=bool)
    for name in dynamics.prescribed:
        mask[m.joint(name)] = True
    given = np.array([act[s] if s >= 0 else u[k] for k, s in enumerate(a.activation)])
    length = a.moment @ np.where(m.kind == SCREW, q[m.q_address], 0.0)
    inputs = a.moment.T @ (a.gain * given + a.bias[:, 0] + a.bias[:, 1] * length + a.bias[:, 2] * (a.moment @ qd))
    inputs[mask] = u[m.nu :]
    rate = dynamics.rates(xs, us)[0]
    assert (
        relative_error(rate[m.nv : 2 * m.nv], product_of_exponentials.hybrid_dynamics(m, q, qd, inputs, mask)[0])
        < 1e-10
    )
    np.testing.assert_array_equal(rate[m.nv : 2 * m.nv][mask], u[m.nu :])
    for k, s in enumerate(a.activation):
        if s >= 0:
            expected = (u[k] - act[s]) / a.time_constant[k] if a.dynamics[k] == FILTER else u[k]
            assert rate[2 * m.nv + s] == pytest.approx(expected, rel=1e-12, abs=1e-14)


# ------------------------------------------------------------------------------------------------- integrators


@machines(10, max_dofs=20)
def test_euler_steps_are_the_rates_times_dt(text, seed):
    for integrator in ("euler", "semi-implicit-euler"):
        dynamics, xs, us, _ = driven(text, seed, K=2, integrator=integrator)
        m, dt = dynamics.mechanism, dynamics.dt
        dx = dt * dynamics.rates(xs, us)
        if integrator == "semi-implicit-euler":
            dx[:, : m.nv] += dt * dx[:, m.nv : 2 * m.nv]
        ends = dynamics.step(xs, us)
        assert relative_error(ends, dynamics.space.integrate(xs, dx)) < 1e-12
        for address, _ in m.quaternions:
            np.testing.assert_allclose(np.linalg.norm(ends[:, address : address + 4], axis=1), 1.0, atol=1e-15)


each_chain = pytest.mark.parametrize("name", CHAINS)


def travelled(mechanism, integrator, steps, x, u, duration=0.4):
    """The states (steps + 1, nx) of a motion under a constant control."""
    dynamics, xs = RigidBodyDynamics(mechanism, duration / steps, integrator), [x]
    for _ in range(steps):
        xs.append(dynamics.step(xs[-1][None], u[None])[0])
    return np.array(xs)


@each_integrator
@each_chain
def test_the_integrators_have_their_order(name, integrator):
    m, rng = Mechanism.from_mjcf(actuated(CHAINS[name], np.random.default_rng(0))), np.random.default_rng(5)
    x, u = random_state(m.space, rng, unnormalized=False), rng.normal(size=m.nu)
    least = 32 if integrator == "rk4" else 128
    ends = [travelled(m, integrator, least * 2**k, x, u)[-1] for k in range(3)]
    coarse, fine = (np.linalg.norm(m.space.difference(ends[k], ends[k + 1])) for k in (0, 1))
    order = np.log2(coarse / fine)
    assert fine > 1e-12  # not yet rounding
    assert order == pytest.approx(4.0 if integrator == "rk4" else 1.0, abs=0.25)


@each_chain
def test_rk4_keeps_energy_to_its_order(name):
    """Torque-free; MuJoCo tells the energy."""
    text = CHAINS[name]
    m = Mechanism.from_mjcf(text)
    model, joints = mujoco.MjModel.from_xml_string(text), [name for name in m.joint_names if name]
    driven = Mechanism.from_mjcf(
        text.replace("</mujoco>", f'<actuator><motor joint="{joints[-1]}"/></actuator></mujoco>')
    )

    def energy(x):
        data = data_at(model, *np.split(x, [m.nq]))
        mujoco.mj_forward(model, data)
        mujoco.mj_energyPos(model, data)
        mujoco.mj_energyVel(model, data)
        return data.energy.sum()

    x = random_state(m.space, np.random.default_rng(6), unnormalized=False)
    drifts = []
    for steps in (32, 64, 128):
        ends = travelled(driven, "rk4", steps, x, np.zeros(driven.nu))
        drifts.append(abs(energy(ends[-1]) - energy(x)))
    assert drifts[2] > 1e-13 * abs(energy(x))  # not yet rounding
    assert drifts[0] / drifts[1] > 12.0
    assert drifts[1] / drifts[2] > 12.0


@machines(8, max_dofs=20)
def test_steps_of_mechanisms_without_quaternions_are_mujocos(text, seed):
    """With them MuJoCo's RK4 falls behind its order: it does not follow the turning frame within a step."""
    text = text.replace('type="ball"', 'type="hinge"').replace('type="free"', 'type="slide"')
    dynamics, xs, us, _ = driven(text, seed, K=1, dt=0.002, prescribe=False)
    m = dynamics.mechanism
    model = mujoco.MjModel.from_xml_string(m.mjcf)
    for integrator, theirs in (("semi-implicit-euler", "EULER"), ("rk4", "RK4")):
        model.opt.integrator, model.opt.timestep = getattr(mujoco.mjtIntegrator, f"mjINT_{theirs}"), dynamics.dt
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP
        ours = RigidBodyDynamics(m, dynamics.dt, integrator).step(xs, us)[0]
        q, qd, act = parts(m, xs[0])
        data = data_at(model, q, qd)
        data.act, data.ctrl = act, us[0]
        mujoco.mj_step(model, data)
        assert relative_error(ours, np.concatenate([data.qpos, data.qvel, data.act])) < 1e-12


@machines(6, max_dofs=12, integrator=st.sampled_from(INTEGRATORS))
def test_a_batch_is_its_rows_and_a_part_of_a_stage_a_stage(text, seed, integrator):
    """Bit for bit, for one to nine rows, each with a length of its own."""
    dynamics, xs, us, rng = driven(text, seed, K=9, integrator=integrator)
    lengths = dynamics.dt * rng.random(9)
    lengths[0] = 0.0
    alone = []
    for i in range(9):
        one = RigidBodyDynamics(dynamics.mechanism, max(lengths[i], 1e-9), integrator, dynamics.prescribed)
        alone.append(one.step(xs[i : i + 1], us[i : i + 1])[0] if lengths[i] else dynamics.space.integrate(
            xs[i], np.zeros(dynamics.ndx)))  # fmt: skip
    for K in range(1, 10):
        ends = dynamics.step(xs[:K], us[:K], lengths[:K])
        np.testing.assert_array_equal(ends[1:], np.reshape(alone[1:K], (K - 1, dynamics.nx)))
        np.testing.assert_allclose(ends[0], alone[0], rtol=1e-15, atol=1e-15)
        whole = dynamics.step(xs[:K], us[:K])
        np.testing.assert_array_equal(whole, dynamics.step(xs[:K], us[:K], np.full(K, dynamics.dt)))
        A, B = dynamics.linearize(xs[:K], us[:K])
        one = dynamics.linearize(xs[K - 1 : K], us[K - 1 : K])
        np.testing.assert_array_equal(A[-1], one[0][0])
        np.testing.assert_array_equal(B[-1], one[1][0])


# --------------------------------------------------------------------------------------------------- Jacobians


@machines(24, max_dofs=16, integrator=st.sampled_from(INTEGRATORS))
def test_jacobians_are_those_of_the_steps(text, seed, integrator):
    dynamics, xs, us, rng = driven(text, seed, K=6, integrator=integrator)
    m, space = dynamics.mechanism, dynamics.space
    for (a, _), rest in zip(m.quaternions, m.ball_rest, strict=True):
        # half a turn away the torque of a ball's spring jumps to the other side
        turns = log_quaternion(product(conjugate(rest), xs[:, a : a + 4]))
        assume(np.linalg.norm(turns, axis=1).max() < np.pi - 0.3)
    A, B = dynamics.linearize(np.vstack([xs, xs[:1]]), us)
    assert A.shape == (6, space.ndx, space.ndx)
    assert B.shape == (6, space.ndx, dynamics.nu)
    ends, weights = dynamics.step(xs, us), {1: 45.0, 2: -9.0, 3: 1.0}
    for _ in range(3):
        dx, du = rng.normal(size=(6, space.ndx)), rng.normal(size=(6, dynamics.nu))

        def moved(step, dx=dx, du=du):
            return space.difference(dynamics.step(space.integrate(xs, step * dx), us + step * du), ends)

        ours = np.einsum("nij,nj->ni", A, dx) + np.einsum("nij,nj->ni", B, du)
        errors = []
        for h in (2e-3, 3e-4):  # error of sixth order beside rounding / h: machines near a singularity want it small
            slope = sum(w * (moved(k * h) - moved(-k * h)) for k, w in weights.items()) / (60.0 * h)
            errors.append(relative_error(ours, slope))
        assert min(errors) < 1e-7


@each_integrator
def test_prescribed_accelerations_happen(integrator):
    """A constant acceleration gives a parabola, whatever the rest of the machine does; Euler lags or leads."""
    m = Mechanism.from_mjcf(actuated(CHAINS["arm"], np.random.default_rng(0)))
    joint, dt, acceleration = m.joint_names[1], 0.05, 1.7
    dynamics = RigidBodyDynamics(m, dt, integrator, joint)
    assert dynamics.nu == m.nu + 1
    rng = np.random.default_rng(0)
    x, u = random_state(m.space, rng), np.append(rng.normal(size=m.nu), acceleration)
    end, i = dynamics.step(x[None], u[None])[0], m.joint(joint).start
    velocity = x[m.nq + i]
    half = {"euler": 0.0, "semi-implicit-euler": 1.0, "rk4": 0.5}[integrator]
    assert end[i] == pytest.approx(x[i] + dt * velocity + half * dt**2 * acceleration, rel=1e-14)
    assert end[m.nq + i] == pytest.approx(velocity + dt * acceleration, rel=1e-14)
    A, B = dynamics.linearize(x[None], u[None])
    expected = np.zeros(dynamics.ndx)
    expected[[i, m.nv + i]] = 1.0, dt
    np.testing.assert_allclose(A[0, i], expected, atol=1e-15)
    np.testing.assert_allclose(B[0, i], np.append(np.zeros(m.nu), half * dt**2), atol=1e-15)
    np.testing.assert_allclose(B[0, m.nv + i], np.append(np.zeros(m.nu), dt), atol=1e-15)
