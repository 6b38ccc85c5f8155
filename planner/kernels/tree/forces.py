"""What acts on the joints besides gravity: springs, dampers and actuators, and their derivatives, on lanes.

All terms but the springs of balls are linear, so their derivatives are the lists of terms themselves.
"""

from __future__ import annotations

from planner.kernels.algebra.rotations import difference, inverse_right_jacobian
from planner.kernels.numba.jit import part
from planner.kernels.numba.lanes import floats, integers, load, store
from planner.kernels.tree.model import (  # fmt: skip
    ACTIVATION_GAIN,
    ACTIVATION_INPUT,
    ACTIVATION_RATE,
    BALL,
    BALL_NEXT,
    BALL_Q,
    BALL_REST,
    BALL_STIFFNESS,
    BALL_V,
    CONSTANT,
    DAMPING,
    INPUT_DOF,
    INPUT_INDEX,
    INPUT_VALUE,
    INPUTS,
    KIND,
    NA,
    NBALLS,
    NU,
    NV,
    POSITION_COLUMN,
    POSITION_ROW,
    POSITION_TERMS,
    POSITION_VALUE,
    PRESCRIBED,
    Q_ADDRESS,
    REST,
    STIFFNESS,
    VELOCITY_COLUMN,
    VELOCITY_ROW,
    VELOCITY_TERMS,
    VELOCITY_VALUE,
)


@part
def add_passive(m, q, v, tau, scratch):
    """Springs and dampers onto tau (nv lanes); scratch is three lanes."""
    q_address, kind = integers(m, Q_ADDRESS), integers(m, KIND)
    damping, stiffness, rest = floats(m, DAMPING), floats(m, STIFFNESS), floats(m, REST)
    for i in range(m[NV]):
        force = load(tau, i) - load(damping, i) * load(v, i)
        if load(kind, i) != BALL and load(kind, i) != BALL_NEXT:
            force -= load(stiffness, i) * (load(q, load(q_address, i)) - load(rest, i))
        store(tau, i, force)
    ball_q, ball_v = integers(m, BALL_Q), integers(m, BALL_V)
    ball_stiffness, ball_rest = floats(m, BALL_STIFFNESS), floats(m, BALL_REST)
    for ball in range(m[NBALLS]):
        if load(ball_stiffness, ball) != 0.0:
            difference(q, load(ball_q, ball), ball_rest, 4 * ball, scratch, 0)
            for k in range(3):
                i = load(ball_v, ball) + k
                store(tau, i, load(tau, i) - load(ball_stiffness, ball) * load(scratch, k))


@part
def add_actuators(m, q, v, u, act, tau):
    """Actuator forces but for the constant ones, by inputs u (nu lanes) and activations act (na lanes), onto tau."""
    q_address = integers(m, Q_ADDRESS)
    dof, index, value = integers(m, INPUT_DOF), integers(m, INPUT_INDEX), floats(m, INPUT_VALUE)
    for t in range(m[INPUTS]):
        i, k = load(dof, t), load(index, t)
        given = load(u, k) if k < m[NU] else load(act, k - m[NU])
        store(tau, i, load(tau, i) + load(value, t) * given)
    row, column, value = integers(m, POSITION_ROW), integers(m, POSITION_COLUMN), floats(m, POSITION_VALUE)
    for t in range(m[POSITION_TERMS]):
        i = load(row, t)
        store(tau, i, load(tau, i) + load(value, t) * load(q, load(q_address, load(column, t))))
    row, column, value = integers(m, VELOCITY_ROW), integers(m, VELOCITY_COLUMN), floats(m, VELOCITY_VALUE)
    for t in range(m[VELOCITY_TERMS]):
        i = load(row, t)
        store(tau, i, load(tau, i) + load(value, t) * load(v, load(column, t)))


@part
def applied_forces(m, q, v, u, act, tau, a, scratch):
    """All forces on the joints (tau), and the accelerations that u prescribes (into a)."""
    prescribed, constant = integers(m, PRESCRIBED), floats(m, CONSTANT)
    for i in range(m[NV]):
        store(tau, i, load(constant, i))
        if load(prescribed, i) >= 0:
            store(a, i, load(u, load(prescribed, i)))
    add_passive(m, q, v, tau, scratch)
    add_actuators(m, q, v, u, act, tau)


@part
def activation_rates(m, u, act, rate):
    """Rates d act/dt (na lanes)."""
    index, gain, decay = integers(m, ACTIVATION_INPUT), floats(m, ACTIVATION_GAIN), floats(m, ACTIVATION_RATE)
    for k in range(m[NA]):
        store(rate, k, load(gain, k) * load(u, load(index, k)) + load(decay, k) * load(act, k))


@part
def add_passive_derivatives(m, q, Dq, Dv, ld, scratch):
    """What springs and dampers add to dtau/dq and dtau/dv of inverse dynamics, (nv, ld) lanes; scratch is twelve."""
    kind = integers(m, KIND)
    damping, stiffness = floats(m, DAMPING), floats(m, STIFFNESS)
    for i in range(m[NV]):
        k = i * ld + i
        store(Dv, k, load(Dv, k) + load(damping, i))
        if load(kind, i) != BALL and load(kind, i) != BALL_NEXT:
            store(Dq, k, load(Dq, k) + load(stiffness, i))
    ball_q, ball_v = integers(m, BALL_Q), integers(m, BALL_V)
    ball_stiffness, ball_rest = floats(m, BALL_STIFFNESS), floats(m, BALL_REST)
    for ball in range(m[NBALLS]):
        if load(ball_stiffness, ball) != 0.0:
            difference(q, load(ball_q, ball), ball_rest, 4 * ball, scratch, 0)
            inverse_right_jacobian(scratch, 0, scratch, 3)
            for r in range(3):
                for c in range(3):
                    k = (load(ball_v, ball) + r) * ld + load(ball_v, ball) + c
                    store(Dq, k, load(Dq, k) + load(ball_stiffness, ball) * load(scratch, 3 + 3 * r + c))


@part
def add_actuator_derivatives(m, Dq, Dv, ld):
    """What actuators take from dtau/dq and dtau/dv of inverse dynamics."""
    row, column, value = integers(m, POSITION_ROW), integers(m, POSITION_COLUMN), floats(m, POSITION_VALUE)
    for t in range(m[POSITION_TERMS]):
        k = load(row, t) * ld + load(column, t)
        store(Dq, k, load(Dq, k) - load(value, t))
    row, column, value = integers(m, VELOCITY_ROW), integers(m, VELOCITY_COLUMN), floats(m, VELOCITY_VALUE)
    for t in range(m[VELOCITY_TERMS]):
        k = load(row, t) * ld + load(column, t)
        store(Dv, k, load(Dv, k) - load(value, t))
