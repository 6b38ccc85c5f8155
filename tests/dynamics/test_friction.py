"""Friction loss: the kernels against NumPy and MuJoCo, their derivatives, and plans in the file that has it."""

import numpy as np
import pytest
from gradients import step_derivatives
from machines import FRICTION_ARM
from scipy.optimize import root_scalar

import planner
from planner.base.errors import PlannerError
from planner.base.gl import load_mujoco
from planner.dynamics import algorithms
from planner.dynamics.joint_forces import BEND, friction_forces
from planner.model.mechanism import Mechanism

mujoco = load_mujoco()
K = 96


def states(m, seed=0):
    """States at speeds from where friction holds the joints to where they slide, and torques."""
    rng = np.random.default_rng(seed)
    q, qd = rng.uniform(-3.0, 3.0, (K, m.nv)), rng.normal(size=(K, m.nv)) * np.geomspace(1e-5, 3.0, K)[:, None]
    return q, qd, algorithms.bias(m, q, qd) + rng.normal(size=(K, m.nv)) * np.geomspace(0.01, 10.0, K)[:, None]


def test_the_decay_of_what_slides_alone_is_mujocos():
    """With the defaults d = 0.9 and beta = 2 / (0.95 0.02): the free decay is their product."""
    m = Mechanism.from_mjcf(FRICTION_ARM)
    weight = mujoco.MjModel.from_xml_string(FRICTION_ARM).dof_invweight0
    free = m.friction_inertia * m.friction_rate / (m.friction_inertia + 1.0 / weight)
    assert free[0] == pytest.approx(0.9 * 2.0 / (0.95 * 0.02), rel=1e-12)
    assert free[1] == pytest.approx(0.9 * 60.0 / 0.95, rel=1e-12)  # the direct format
    assert free[2] == pytest.approx(0.8 * 2.0 / (0.9 * 0.02), rel=1e-12)


def with_friction(mechanism, M, tau, qd):
    """Accelerations (nv,) that solve M qdd = tau + friction(qd, qdd), by Newton's method.

    They minimize a convex function; an exact line search limits every Newton step.

    Args:
        mechanism: A mechanism with friction loss.
        M: (nv, nv) mass matrix.
        tau: (nv,) all applied forces but friction, minus the bias, N m and N.
        qd: (nv,) velocities, rad/s and m/s.
    """
    qdd = np.where(mechanism.friction_loss > 0.0, -mechanism.friction_rate * qd, 0.0)  # initial guess: all stick
    force, slope = friction_forces(mechanism, qd, qdd)
    qdd = np.linalg.solve(M - np.diag(slope), tau + force - slope * qdd)
    for _ in range(30):
        force, slope = friction_forces(mechanism, qd, qdd)
        size = mechanism.friction_loss + mechanism.friction_inertia * np.abs(qdd)
        if np.all(np.abs(M @ qdd - tau - force) <= 1e-13 * (size + np.abs(tau).max())):
            break
        step = np.linalg.solve(M - np.diag(slope), tau + force - M @ qdd)

        def uphill(part, qdd=qdd, step=step):
            there = qdd + part * step
            return float(step @ (M @ there - tau - friction_forces(mechanism, qd, there)[0]))

        qdd = qdd + step * (1.0 if uphill(1.0) <= 0.0 else root_scalar(uphill, bracket=(0.0, 1.0)).root)
    return qdd


def test_kernels_solve_the_law_that_numpy_has():
    m = Mechanism.from_mjcf(FRICTION_ARM)
    q, qd, tau = states(m)
    qdd = planner.RigidBodyDynamics(m, 0.01).rates(np.hstack([q, qd]), tau)[:, m.nv :]
    M, rest = algorithms.mass_matrix(m, q), tau - algorithms.bias(m, q, qd)
    held = 0
    for k in range(K):
        force, slope = friction_forces(m, qd[k], qdd[k])
        scale = np.abs(M[k]) @ np.abs(qdd[k]) + np.abs(rest[k]) + m.friction_inertia * np.abs(qdd[k])
        assert np.all(np.abs(M[k] @ qdd[k] - rest[k] - force) < 1e-10 * scale)  # rounding, and the inverse of M
        np.testing.assert_allclose(qdd[k], with_friction(m, M[k], rest[k], qd[k]), rtol=1e-8, atol=1e-8)
        held += int(np.sum(slope == -m.friction_inertia))
    assert 0.1 < held / (K * m.nv) < 0.9  # both sides of the law were seen


def test_accelerations_do_not_depend_on_the_states_beside_them():
    m = Mechanism.from_mjcf(FRICTION_ARM)
    dynamics, (q, qd, tau) = planner.RigidBodyDynamics(m, 0.01), states(m)
    together = dynamics.rates(np.hstack([q, qd]), tau)
    alone = np.vstack([dynamics.rates(np.hstack([q[k], qd[k]])[None], tau[k : k + 1]) for k in range(K)])
    np.testing.assert_array_equal(together, alone)


@pytest.mark.parametrize("integrator", ["semi-implicit-euler", "rk4"])
def test_derivatives_with_friction(integrator):
    """Against central differences: where the slope bends within the step they are off by it, so most must fit."""
    m = Mechanism.from_mjcf(FRICTION_ARM)
    dynamics, (q, qd, tau) = planner.RigidBodyDynamics(m, 0.004, integrator), states(m, 1)
    xs = np.hstack([q, qd])
    linear = dynamics.linearize(np.vstack([xs, xs[:1]]), tau)
    for exact, found in zip(linear, step_derivatives(dynamics, xs, tau), strict=True):
        error = np.abs(found - exact).max(axis=(1, 2)) / np.abs(exact).max(axis=(1, 2))
        assert np.median(error) < 1e-7
        assert np.mean(error < 1e-5) > 0.8


def test_parity_of_friction_and_without_it():
    section = planner.parity(Mechanism.from_mjcf(FRICTION_ARM))
    values = {one.name: one for one in section.measured}
    assert section.passed
    assert values["friction_loss_error"].bound == 1e-10
    assert 0.25 * BEND / 4.0 < values["friction_loss_bend"].value <= BEND / 4.0  # which it is in the middle of the bend
    other = planner.parity(
        Mechanism.from_mjcf(FRICTION_ARM), FRICTION_ARM.replace('frictionloss="0.4"', 'frictionloss="0.5"')
    )
    assert not other.passed


def reach(dt):
    m = Mechanism.from_mjcf(FRICTION_ARM)
    N, goal = round(1.0 / dt), np.array([0.8, -0.6, 0.7, 0.0, 0.0, 0.0])
    Q = np.zeros((N + 1, 6, 6))
    Q[:N, 3:, 3:], Q[N] = 0.1 * dt * np.eye(3), np.diag([1e4] * 3 + [1e3] * 3)
    cost = planner.TrackingCost(Q, np.tile(1e-3 * dt * np.eye(3), (N, 1, 1)), np.tile(goal, (N + 1, 1)))
    return planner.Problem(planner.RigidBodyDynamics(m, dt), cost, np.zeros(6))


def test_a_plan_with_friction_passes_in_the_file_that_has_it():
    plan = planner.solve(reach(0.01))
    proof = planner.prove(plan, rollouts=0)
    assert plan.success
    assert proof.passed, proof.reason
    assert "frictionloss" in plan.twin.mjcf


def test_the_exact_hessian_is_refused():
    with pytest.raises(PlannerError, match=r'of friction loss, tendons, gravity comp.*"gauss-newton"'):
        planner.solve(reach(0.02), hessian="exact")


def test_friction_is_taken_out_where_it_is_asked_for():
    m = Mechanism.from_mjcf(FRICTION_ARM, ignore=("frictionloss",))
    assert m.ignored == tuple(f"frictionloss of joint '{name}'" for name in ("turn", "lift", "bend"))
    assert not np.any(m.friction_loss)
    assert not np.any(mujoco.MjModel.from_xml_string(m.mjcf).opt.disableflags == 0)
