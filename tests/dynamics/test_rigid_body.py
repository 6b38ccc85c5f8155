"""The compiled functions of (q, qd, input): against MuJoCo, against the figure line by line, and what they refuse."""

import numpy as np
import pytest
from trees import (
    actuated,
    machines,
    mujoco,
    random_state,
    relative_error,
    simulated,
    simulated_inverse,
    site_jacobian,
    stepped,
)

from planner import dynamics as rb
from planner.base.errors import PlannerError
from planner.dynamics import product_of_exponentials
from planner.model.mechanism import Mechanism

STEP = 1e-30j  # imaginary: nothing cancels, so derivatives are exact to rounding


def drawn(text, seed, K=1):
    """The machine, K rows of q, qd and of one more vector (K, nv) to use as an input, and the generator."""
    rng, mechanism = np.random.default_rng(seed), Mechanism.from_mjcf(text)
    states = np.array([random_state(mechanism.space, rng) for _ in range(K)])
    q, qd = np.split(states, [mechanism.nq], axis=1)
    return mechanism, q, 2.0 * qd[:, : mechanism.nv], 3.0 * rng.normal(size=(K, mechanism.nv)), rng


def names_of(mechanism, rng):
    """Some joints, and the mask (nv,) of their degrees of freedom."""
    names = [name for name in mechanism.joint_names if rng.random() < rng.choice([0.2, 0.6])]
    mask = np.zeros(mechanism.nv, dtype=bool)
    for name in names:
        mask[mechanism.joint(name)] = True
    return names, mask


def derivative(function, n):
    """(..., n) of a function of an imaginary step's direction (n,)."""
    return np.stack([function(direction).imag / STEP.imag for direction in np.eye(n)], axis=-1)


# ---------------------------------------------------------------------------------------------- against MuJoCo


@machines(25)
def test_dynamics_are_mujocos(text, seed):
    m, q, qd, tau, _ = drawn(text, seed, K=3)
    model = mujoco.MjModel.from_xml_string(text)
    ours = rb.forward_dynamics(m, q, qd, tau), rb.mass_matrix(m, q), rb.bias(m, q, qd), rb.rnea(m, q, qd, tau)
    for i in range(3):
        theirs = simulated(model, q[i], qd[i], tau[i])
        inverse = simulated_inverse(model, q[i], qd[i], tau[i])
        for mine, his in zip(ours, (theirs.qacc, theirs.M, theirs.bias, inverse), strict=True):
            assert relative_error(mine[i], his) < 1e-10


@machines(15)
def test_kinematics_are_mujocos(text, seed):
    m, q, qd, tau, _ = drawn(text, seed)
    model = mujoco.MjModel.from_xml_string(text)
    poses = simulated(model, q[0], qd[0], tau[0]).poses
    assert relative_error(rb.forward_kinematics(m, q[0]), poses) < 1e-12
    np.testing.assert_allclose(rb.frame_pose(m, q[0], m.body_names[-1]), poses[-1], atol=1e-12 * np.abs(poses).max())
    for name in m.sites:
        J = rb.jacobian(m, q[0], name)
        assert relative_error(J, site_jacobian(model, q[0], name)) < 1e-12
        # the rows are the frame's velocity: its pose moves by J qd
        moved = poe_frame(m, stepped(m, q[0], qd[0], STEP), name).imag / STEP.imag
        assert relative_error(J[:3] @ qd[0], moved[:3, 3]) < 1e-12


def poe_frame(m, q, name):
    frame = m.frame(name)
    return product_of_exponentials.world_poses(m, q)[frame.link] @ frame.T


# ------------------------------------------------------------------------------------------------- derivatives


@machines(8)
def test_derivatives_of_inverse_dynamics(text, seed):
    m, q, qd, qdd, _ = drawn(text, seed)
    q, qd, qdd = q[0], qd[0], qdd[0]
    ours = rb.rnea_derivatives(m, q, qd, qdd)
    exact = derivative(lambda e: product_of_exponentials.rnea(m, stepped(m, q, e, STEP), qd, qdd), m.nv)
    assert relative_error(ours.q, exact) < 1e-11
    by_qd = derivative(lambda e: product_of_exponentials.rnea(m, q, qd + STEP * e, qdd), m.nv)
    assert relative_error(ours.qd, by_qd) < 1e-11
    np.testing.assert_array_equal(ours.input, rb.mass_matrix(m, q))
    exact = derivative(lambda e: product_of_exponentials.bias(m, stepped(m, q, e, STEP), qd), m.nv)
    by_q, by_speed = rb.bias_derivatives(m, q, qd)
    assert relative_error(by_q, exact) < 1e-11
    assert relative_error(by_speed, by_qd) < 1e-11  # forces depend on qd and qdd separately


@machines(8, max_dofs=20)
def test_derivatives_of_forward_and_hybrid_dynamics(text, seed):
    m, q, qd, inputs, rng = drawn(text, seed)
    q, qd, inputs = q[0], qd[0], inputs[0]
    names, mask = names_of(m, rng)

    def check(ours, function, index):
        wanted = (
            derivative(lambda e: function(stepped(m, q, e, STEP), qd, inputs)[index], m.nv),
            derivative(lambda e: function(q, qd + STEP * e, inputs)[index], m.nv),
            derivative(lambda e: function(q, qd, inputs + STEP * e)[index], m.nv),
        )
        for mine, exact in zip(ours, wanted, strict=True):
            assert relative_error(mine, exact) < 1e-9

    def hybrid(*state):
        return product_of_exponentials.hybrid_dynamics(m, *state, mask)

    of_qdd, of_tau = rb.hybrid_dynamics_derivatives(m, q, qd, inputs, names)
    check(of_qdd, hybrid, 0)
    check(of_tau, hybrid, 1)
    check(
        rb.forward_dynamics_derivatives(m, q, qd, inputs),
        lambda *state: [product_of_exponentials.forward_dynamics(m, *state)],
        0,
    )


@machines(6, max_dofs=20)
def test_derivatives_of_masses_and_places(text, seed):
    m, q, _, _, _ = drawn(text, seed)
    q = q[0]
    exact = derivative(lambda e: product_of_exponentials.mass_matrix(m, stepped(m, q, e, STEP)), m.nv)
    assert relative_error(rb.mass_matrix_derivatives(m, q), exact) < 1e-11
    for name in list(m.sites)[-3:]:
        frame = m.frame(name)
        exact = derivative(
            lambda e, frame=frame: product_of_exponentials.jacobian(m, stepped(m, q, e, STEP), frame), m.nv
        )
        assert relative_error(rb.jacobian_derivatives(m, q, name), exact) < 1e-11
    twists = rb.forward_kinematics_derivatives(m, q)
    for i, body in enumerate(m.bodies):
        np.testing.assert_array_equal(twists[i], rb.jacobian(m, q, body))


# -------------------------------------------------------------------------------------------------- identities


@machines(12)
def test_hybrid_dynamics_join_the_forward_and_the_inverse(text, seed):
    m, q, qd, inputs, rng = drawn(text, seed, K=2)
    names, mask = names_of(m, rng)
    qdd, tau = rb.hybrid_dynamics(m, q, qd, inputs, names)
    np.testing.assert_array_equal(qdd[:, mask], inputs[:, mask])
    np.testing.assert_allclose(tau[:, ~mask], inputs[:, ~mask], rtol=1e-12, atol=1e-12)
    assert relative_error(rb.rnea(m, q, qd, qdd), tau) < 1e-9
    assert relative_error(rb.hybrid_dynamics(m, q, qd, inputs, ())[0], rb.forward_dynamics(m, q, qd, inputs)) < 1e-9
    everything = [name for name in m.joint_names if name]
    assert relative_error(rb.hybrid_dynamics(m, q, qd, inputs, everything)[1], rb.rnea(m, q, qd, inputs)) < 1e-9


@machines(8)
def test_power_goes_into_energy(text, seed):
    """M' - (C + C') = 0 in its energy form: qd' tau is what M, gravity, springs and dampers take."""
    m, q, qd, qdd, _ = drawn(text, seed)
    q, qd, qdd = q[0], qd[0], qdd[0]
    kinetic = qd @ rb.mass_matrix(m, q) @ qdd + 0.5 * qd @ (rb.mass_matrix_derivatives(m, q) @ qd) @ qd
    static = qd @ rb.bias(m, q, np.zeros(m.nv)) + qd @ (m.damping * qd)
    power = qd @ rb.rnea(m, q, qd, qdd)
    assert abs(power - kinetic - static) < 1e-11 * (abs(kinetic) + abs(static) + np.abs(qd) @ np.abs(qdd))


@machines(6, max_dofs=15)
def test_a_batch_is_its_rows(text, seed):
    """Bit for bit, for one to nine rows: lanes that hold no row of their own leave no trace."""
    m, q, qd, tau, rng = drawn(text, seed, K=9)
    names, _ = names_of(m, rng)
    site = next(iter(m.sites))

    def everything(rows):
        q_, qd_, tau_ = q[rows], qd[rows], tau[rows]
        yield rb.forward_dynamics(m, q_, qd_, tau_)
        yield rb.rnea(m, q_, qd_, tau_)
        yield rb.bias(m, q_, qd_)
        yield rb.mass_matrix(m, q_)
        yield rb.forward_kinematics(m, q_)
        yield rb.frame_pose(m, q_, site)
        yield rb.jacobian(m, q_, site)
        yield rb.jacobian_derivatives(m, q_, site)
        yield from rb.hybrid_dynamics(m, q_, qd_, tau_, names)
        yield from rb.rnea_derivatives(m, q_, qd_, tau_)

    alone = [[np.asarray(value) for value in everything(i)] for i in range(9)]
    for K in range(1, 10):
        for k, together in enumerate(everything(slice(0, K))):
            np.testing.assert_array_equal(together, np.stack([alone[i][k] for i in range(K)]))


def test_one_row_of_an_argument_serves_all_rows_of_the_others():
    m, q, qd, tau, _ = drawn(CRANE, 0, K=3)
    together = rb.forward_dynamics(m, q[0], qd, tau)
    np.testing.assert_array_equal(together, rb.forward_dynamics(m, np.tile(q[0], (3, 1)), qd, tau))


@machines(5, max_dofs=15)
def test_actuators_are_no_part_of_these_functions(text, seed):
    m, q, qd, tau, rng = drawn(text, seed)
    other = Mechanism.from_mjcf(actuated(text, rng))
    np.testing.assert_array_equal(rb.forward_dynamics(m, q, qd, tau), rb.forward_dynamics(other, q, qd, tau))


# ---------------------------------------------------------------------------------------------------- refusals

CRANE = """
<mujoco><worldbody><site name="mark"/><body name="bridge"><joint name="run" type="slide"/><geom size="1"/>
  <body name="load" pos="0 0 -1"><joint name="swing" type="ball"/><geom size="0.1" pos="0 0 -2"/></body></body>
</worldbody><option><flag contact="disable"/></option></mujoco>
"""
Q, V = [0.1, 1.0, 0.0, 0.0, 0.0], [0.1, 0.2, 0.3, 0.4]


def crane():
    return Mechanism.from_mjcf(CRANE)


def test_a_frame_of_the_world_does_not_move():
    m = crane()
    np.testing.assert_array_equal(rb.frame_pose(m, Q, "mark"), np.eye(4))
    assert rb.frame_pose(m, [Q, Q], "mark").shape == (2, 4, 4)
    assert not rb.jacobian(m, Q, "mark").any()
    assert not rb.jacobian_derivatives(m, Q, "mark").any()


WRONG = {
    "q[4] is nan, expected finite numbers": lambda m: rb.bias(m, [*Q[:4], np.nan], V),
    "qd[1] is inf, expected finite numbers": lambda m: rb.rnea(m, Q, [0.0, np.inf, 0.0, 0.0], V),
    "q is [0.1, 0.2, 0.3, 0.4], expected 5 numbers": lambda m: rb.mass_matrix(m, V),
    "qd is [0.1, 1.0, 0.0, 0.0, 0.0], expected 4 numbers": lambda m: rb.bias(m, Q, Q),
    "tau has shape (), expected (4,)": lambda m: rb.forward_dynamics(m, Q, V, 1.0),
    "q has shape (1, 1, 5), expected (K, 5)": lambda m: rb.forward_kinematics(m, [[Q]]),
    "qdd is not an array of numbers, expected shape (4,)": lambda m: rb.rnea(m, Q, V, "no"),
    "qd has 2 rows, expected 3 as the others, or one": lambda m: rb.bias(m, [Q] * 3, [V] * 2),
    "q[1:5] is zero, expected a quaternion": lambda m: rb.mass_matrix(m, np.zeros(5)),
    "joint is 'walk', expected one of: run, swing": lambda m: rb.hybrid_dynamics(m, Q, V, V, ["walk"]),
    "frame is 'hook', expected one of: mark, world, bridge, load": lambda m: rb.jacobian(m, Q, "hook"),
    "mechanism is 3, expected a Mechanism": lambda m: rb.mass_matrix(3, Q),
}


@pytest.mark.parametrize("sentence", WRONG)
def test_wrong_states_are_refused_in_one_sentence(sentence):
    with pytest.raises(PlannerError) as error:
        WRONG[sentence](crane())
    assert str(error.value).startswith(sentence)
    assert "\n" not in str(error.value)


def test_a_prescribed_joint_may_be_given_by_its_name_alone():
    m = crane()
    for one, several in zip(
        rb.hybrid_dynamics(m, Q, V, V, "swing"), rb.hybrid_dynamics(m, Q, V, V, ("swing",)), strict=True
    ):
        np.testing.assert_array_equal(one, several)
