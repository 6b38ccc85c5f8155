"""Forces on the joints besides gravity: springs, dampers and actuators, and their derivatives, on lanes.

All terms but the springs of balls are linear, so their derivatives are the lists of terms themselves.
"""

from __future__ import annotations

from planner.kernels.algebra.rotations import difference, inverse_right_jacobian
from planner.kernels.numba.jit import inline, part
from planner.kernels.numba.lanes import floats, integers, load, store
from planner.kernels.tree.mechanism_table import BALL, BALL_NEXT, TREE


@part
def add_passive(m, q, v, tau, scratch):
    """Springs and dampers onto tau (nv lanes); scratch is three lanes."""
    q_address, kind = integers(m, TREE.q_address), integers(m, TREE.kind)
    damping, stiffness, rest = floats(m, TREE.damping), floats(m, TREE.stiffness), floats(m, TREE.rest)
    for i in range(m[TREE.nv]):
        force = load(tau, i) - load(damping, i) * load(v, i)
        if load(kind, i) != BALL and load(kind, i) != BALL_NEXT:
            force -= load(stiffness, i) * (load(q, load(q_address, i)) - load(rest, i))
        store(tau, i, force)
    ball_q, ball_v = integers(m, TREE.ball_q), integers(m, TREE.ball_v)
    ball_stiffness, ball_rest = floats(m, TREE.ball_stiffness), floats(m, TREE.ball_rest)
    for ball in range(m[TREE.nballs]):
        if load(ball_stiffness, ball) != 0.0:
            difference(q, load(ball_q, ball), ball_rest, 4 * ball, scratch, 0)
            for k in range(3):
                i = load(ball_v, ball) + k
                store(tau, i, load(tau, i) - load(ball_stiffness, ball) * load(scratch, k))


@part
def add_actuators(m, q, v, u, act, tau):
    """Actuator forces but for the constant ones, by inputs u (nu lanes) and activations act (na lanes), onto tau."""
    q_address = integers(m, TREE.q_address)
    dof, index, value = integers(m, TREE.input_dof), integers(m, TREE.input_index), floats(m, TREE.input_value)
    for t in range(m[TREE.inputs]):
        i, k = load(dof, t), load(index, t)
        given = load(u, k) if k < m[TREE.nu] else load(act, k - m[TREE.nu])
        store(tau, i, load(tau, i) + load(value, t) * given)
    row, column = integers(m, TREE.position_row), integers(m, TREE.position_column)
    value = floats(m, TREE.position_value)
    for t in range(m[TREE.position_terms]):
        i = load(row, t)
        store(tau, i, load(tau, i) + load(value, t) * load(q, load(q_address, load(column, t))))
    row, column = integers(m, TREE.velocity_row), integers(m, TREE.velocity_column)
    value = floats(m, TREE.velocity_value)
    for t in range(m[TREE.velocity_terms]):
        i = load(row, t)
        store(tau, i, load(tau, i) + load(value, t) * load(v, load(column, t)))


@part
def applied_forces(m, q, v, u, act, tau, a, scratch):
    """All forces on the joints (tau), and the accelerations that u prescribes (into a)."""
    prescribed, constant = integers(m, TREE.prescribed), floats(m, TREE.constant)
    for i in range(m[TREE.nv]):
        store(tau, i, load(constant, i))
        if load(prescribed, i) >= 0:
            store(a, i, load(u, load(prescribed, i)))
    add_passive(m, q, v, tau, scratch)
    add_actuators(m, q, v, u, act, tau)


@part
def activation_rates(m, u, act, rate):
    """Rates d act/dt (na lanes)."""
    index, gain = integers(m, TREE.activation_input), floats(m, TREE.activation_gain)
    decay = floats(m, TREE.activation_rate)
    for k in range(m[TREE.na]):
        store(rate, k, load(gain, k) * load(u, load(index, k)) + load(decay, k) * load(act, k))


@inline
def add_passive_derivatives(m, q, Dq, Dv, ld, scratch):
    """Add the derivatives of springs and dampers to dtau/dq and dtau/dv, (nv, ld) lanes; scratch is twelve lanes."""
    kind = integers(m, TREE.kind)
    damping, stiffness = floats(m, TREE.damping), floats(m, TREE.stiffness)
    for i in range(m[TREE.nv]):
        k = i * ld + i
        store(Dv, k, load(Dv, k) + load(damping, i))
        if load(kind, i) != BALL and load(kind, i) != BALL_NEXT:
            store(Dq, k, load(Dq, k) + load(stiffness, i))
    ball_q, ball_v = integers(m, TREE.ball_q), integers(m, TREE.ball_v)
    ball_stiffness, ball_rest = floats(m, TREE.ball_stiffness), floats(m, TREE.ball_rest)
    for ball in range(m[TREE.nballs]):
        if load(ball_stiffness, ball) != 0.0:
            difference(q, load(ball_q, ball), ball_rest, 4 * ball, scratch, 0)
            inverse_right_jacobian(scratch, 0, scratch, 3)
            for r in range(3):
                for c in range(3):
                    k = (load(ball_v, ball) + r) * ld + load(ball_v, ball) + c
                    store(Dq, k, load(Dq, k) + load(ball_stiffness, ball) * load(scratch, 3 + 3 * r + c))


@inline
def add_actuator_derivatives(m, Dq, Dv, ld):
    """Subtract the derivatives of the actuators' forces from dtau/dq and dtau/dv of inverse dynamics."""
    row, column = integers(m, TREE.position_row), integers(m, TREE.position_column)
    value = floats(m, TREE.position_value)
    for t in range(m[TREE.position_terms]):
        k = load(row, t) * ld + load(column, t)
        store(Dq, k, load(Dq, k) - load(value, t))
    row, column = integers(m, TREE.velocity_row), integers(m, TREE.velocity_column)
    value = floats(m, TREE.velocity_value)
    for t in range(m[TREE.velocity_terms]):
        k = load(row, t) * ld + load(column, t)
        store(Dv, k, load(Dv, k) - load(value, t))
