"""Exact A and B of a stage of a tree (Eq. 35), four knots at a time: the chain rule through the integrator's stages.

Columns are ordered z = (u | dq | dv | dact), as in tree_derivatives.
"""

from __future__ import annotations

from planner.kernels.jit import inline, jit, part
from planner.kernels.lane_math import transpose
from planner.kernels.lanes import WIDTH, as_floats, at, floats, integers, lanes, load, pointer, spread, store, store4
from planner.kernels.model import (
    ACTIVATION_GAIN,
    ACTIVATION_INPUT,
    ACTIVATION_RATE,
    BALL,
    BALL_NEXT,
    BALL_V,
    KIND,
    NA,
    NBALLS,
    NQ,
    NU,
    NV,
)  # fmt: skip
from planner.kernels.rotations import carried, right_jacobian_times
from planner.kernels.spatial import cross, load3, store3
from planner.kernels.tree_derivatives import acceleration_derivatives, store_four
from planner.kernels.tree_memory import (
    A_LANES,
    ACCELERATIONS,
    CHAINED,
    COLUMNS,
    DIRECT,
    FIRST_X,
    INTEGRATOR,
    Q_STAGE,
    RK4,
    ROW,
    SCRATCH,
    SEMI_IMPLICIT_EULER,
    STAGES,
    SUM_Q,
    SUM_V,
    THETA,
    U_LANES,
    V_STAGES,
    X_LANES,
    XA,
    XQ,
    XV,
)  # fmt: skip
from planner.kernels.tree_step import end_rotation, gather, stage_state


@inline
def _chained(m, D, at_q, Xq, Xv, i0, i1, j0, columns):
    """Rows i0 and i1 of (da/dq) Xq + (da/dv) Xv in four columns from j0."""
    nv = m[NV]
    z = spread(0.0)
    a0, a1, a2, a3, b0, b1, b2, b3 = z, z, z, z, z, z, z, z
    for half in range(2):
        X, first = (Xq, at_q) if half == 0 else (Xv, at_q + nv)
        for k in range(nv):
            o = k * columns + j0
            f, g = load(D, i0 * columns + first + k), load(D, i1 * columns + first + k)
            d0, d1, d2, d3 = load(X, o), load(X, o + 1), load(X, o + 2), load(X, o + 3)
            a0 += f * d0
            b0 += g * d0
            a1 += f * d1
            b1 += g * d1
            a2 += f * d2
            b2 += g * d2
            a3 += f * d3
            b3 += g * d3
    return (a0, a1, a2, a3), (b0, b1, b2, b3)


@inline
def _chain(m, D, Xq, Xv, Xa, dA, columns, x0):
    """Total derivative dA of a stage's accelerations by the whole stage's start and controls."""
    nv, nu = m[NV], m[NU]
    index = integers(m, ACTIVATION_INPUT)
    for j0 in range(0, columns, WIDTH):
        for i0 in range(0, nv, 2):
            i1 = min(i0 + 1, nv - 1)
            first, second = _chained(m, D, x0, Xq, Xv, i0, i1, j0, columns)
            store_four(dA, i0 * columns + j0, first)
            store_four(dA, i1 * columns + j0, second)
    for i in range(nv):
        row = i * columns
        for j in range(nu):
            store(dA, row + j, load(dA, row + j) + load(D, row + j))
        for k in range(m[NA]):
            own, given = row + x0 + 2 * nv + k, row + load(index, k)
            f = load(D, own)
            store(dA, own, load(dA, own) + f * load(Xa, 2 * k))
            store(dA, given, load(dA, given) + f * load(Xa, 2 * k + 1))


@inline
def _move_configuration(m, X, columns, theta, at_q):
    """From d theta to dq+ of q+ = q exp(theta), in place: Jr d theta, and the start's dq carried along."""
    one, zero = spread(1.0), spread(0.0)
    kind, ball_v = integers(m, KIND), integers(m, BALL_V)
    for i in range(m[NV]):
        if load(kind, i) != BALL and load(kind, i) != BALL_NEXT:
            o = i * columns + at_q + i
            store(X, o, load(X, o) + one)
    for b in range(m[NBALLS]):
        i = load(ball_v, b)
        t = load3(theta, i)
        o0, o1, o2 = i * columns, (i + 1) * columns, (i + 2) * columns
        for j in range(columns):
            d = right_jacobian_times(t, (load(X, o0 + j), load(X, o1 + j), load(X, o2 + j)))
            store(X, o0 + j, d[0])
            store(X, o1 + j, d[1])
            store(X, o2 + j, d[2])
        for c in range(3):
            d = carried(t, (one if c == 0 else zero, one if c == 1 else zero, one if c == 2 else zero))
            j = at_q + i + c
            store(X, o0 + j, load(X, o0 + j) + d[0])
            store(X, o1 + j, load(X, o1 + j) + d[1])
            store(X, o2 + j, load(X, o2 + j) + d[2])


@inline
def _add_commutator_derivative(m, X, columns, at_v, first, second, dsecond, factor):
    """Add factor times d(first x second) to the ball rows of X, d first being the start's dv."""
    one, zero = spread(1.0), spread(0.0)
    ball_v = integers(m, BALL_V)
    for b in range(m[NBALLS]):
        i = load(ball_v, b)
        f, s = load3(first, i), load3(second, i)
        o0, o1, o2 = i * columns, (i + 1) * columns, (i + 2) * columns
        for j in range(columns):
            x = cross(f, (load(dsecond, o0 + j), load(dsecond, o1 + j), load(dsecond, o2 + j)))
            store(X, o0 + j, load(X, o0 + j) + factor * x[0])
            store(X, o1 + j, load(X, o1 + j) + factor * x[1])
            store(X, o2 + j, load(X, o2 + j) + factor * x[2])
        for c in range(3):
            x = cross((one if c == 0 else zero, one if c == 1 else zero, one if c == 2 else zero), s)
            j = at_v + i + c
            store(X, o0 + j, load(X, o0 + j) + factor * x[0])
            store(X, o1 + j, load(X, o1 + j) + factor * x[1])
            store(X, o2 + j, load(X, o2 + j) + factor * x[2])


@inline
def _velocity(m, X, columns, at_v, factor, dA):
    """Rows dv of the start plus factor times dA."""
    for i in range(m[NV]):
        for j in range(columns):
            store(X, i * columns + j, factor * load(dA, i * columns + j))
        o = i * columns + at_v + i
        store(X, o, load(X, o) + 1.0)


@part
def _runge_kutta(m, r, x, a, dt):
    """Derivatives of an RK4 stage: dq+ in XQ, dv+ in XV, dact+ in XA (own, by control)."""
    nv, na, columns = m[NV], m[NA], r[COLUMNS]
    D, dA, Xq, Xv, Xa = lanes(r, DIRECT), lanes(r, CHAINED), lanes(r, XQ), lanes(r, XV), lanes(r, XA)
    sum_q, sum_v, theta, v1 = lanes(r, SUM_Q), lanes(r, SUM_V), lanes(r, THETA), lanes(r, V_STAGES)
    gain, decay, sums = floats(m, ACTIVATION_GAIN), floats(m, ACTIVATION_RATE), at(Xa, 2 * na)
    at_q, at_v = r[FIRST_X], r[FIRST_X] + nv
    acceleration_derivatives(m, r, x, at(x, m[NQ]), at(a, 0), dA)
    for k in range(nv * columns):
        store(sum_v, k, load(dA, k))
        store(sum_q, k, load(dA, k))
    _velocity(m, Xv, columns, at_v, 0.0, dA)
    for k in range(na):
        store(Xa, 2 * k, spread(1.0))
        store(Xa, 2 * k + 1, spread(0.0))
        store(sums, 2 * k, spread(load(decay, k)))
        store(sums, 2 * k + 1, spread(load(gain, k)))
    for i in range(1, 4):
        stage_state(m, r, x, i, a, spread(dt))
        factor = dt if i == 3 else 0.5 * dt
        for k in range(nv * columns):  # d theta, by the velocity of the stage before
            store(Xq, k, factor * load(Xv, k))
        if i == 2:
            _add_commutator_derivative(m, Xq, columns, at_v, v1, at(v1, nv), Xv, 0.125 * dt * dt)
        _move_configuration(m, Xq, columns, theta, at_q)
        _velocity(m, Xv, columns, at_v, factor, dA)
        for k in range(na):
            own, given = load(decay, k) * load(Xa, 2 * k), load(gain, k) + load(decay, k) * load(Xa, 2 * k + 1)
            store(Xa, 2 * k, 1.0 + factor * own)
            store(Xa, 2 * k + 1, factor * given)
        acceleration_derivatives(m, r, lanes(r, Q_STAGE), at(v1, i * nv), at(a, i * nv), D)
        _chain(m, D, Xq, Xv, Xa, dA, columns, at_q)
        weight = 1.0 if i == 3 else 2.0
        for k in range(nv * columns):
            store(sum_v, k, load(sum_v, k) + weight * load(dA, k))
        if i < 3:
            for k in range(nv * columns):
                store(sum_q, k, load(sum_q, k) + load(dA, k))
        for k in range(na):
            own, given = load(decay, k) * load(Xa, 2 * k), load(gain, k) + load(decay, k) * load(Xa, 2 * k + 1)
            store(sums, 2 * k, load(sums, 2 * k) + weight * own)
            store(sums, 2 * k + 1, load(sums, 2 * k + 1) + weight * given)
    end_rotation(m, r, x, a, spread(dt))
    _velocity(m, Xq, columns, at_v, dt / 6.0, sum_q)
    for k in range(nv * columns):
        store(Xq, k, dt * load(Xq, k))
    _add_commutator_derivative(m, Xq, columns, at_v, v1, at(v1, 3 * nv), Xv, dt * dt / 12.0)
    _move_configuration(m, Xq, columns, theta, at_q)
    _velocity(m, Xv, columns, at_v, dt / 6.0, sum_v)
    for k in range(na):
        store(Xa, 2 * k, 1.0 + (dt / 6.0) * load(sums, 2 * k))
        store(Xa, 2 * k + 1, (dt / 6.0) * load(sums, 2 * k + 1))


@part
def _euler(m, r, x, a, dt):
    """The same for the two Euler integrators; the rotation vector dt v or dt v+ is left in THETA."""
    nv, na, columns = m[NV], m[NA], r[COLUMNS]
    at_q, at_v = r[FIRST_X], r[FIRST_X] + nv
    dA, Xq, Xv, Xa, theta = lanes(r, CHAINED), lanes(r, SUM_Q), lanes(r, SUM_V), lanes(r, XA), lanes(r, THETA)
    gain, decay = floats(m, ACTIVATION_GAIN), floats(m, ACTIVATION_RATE)
    semi_implicit = r[INTEGRATOR] == SEMI_IMPLICIT_EULER
    v = at(x, m[NQ])
    acceleration_derivatives(m, r, x, v, a, dA)
    for i in range(nv):
        rate = load(v, i) + dt * load(a, i) if semi_implicit else load(v, i)
        store(theta, i, dt * rate)
    _velocity(m, Xv, columns, at_v, dt, dA)
    _velocity(m, Xq, columns, at_v, dt if semi_implicit else 0.0, dA)
    for k in range(nv * columns):
        store(Xq, k, dt * load(Xq, k))
    _move_configuration(m, Xq, columns, theta, at_q)
    for k in range(na):
        store(Xa, 2 * k, spread(1.0 + dt * load(decay, k)))
        store(Xa, 2 * k + 1, spread(dt * load(gain, k)))


@inline
def _scatter_row(X, row, F, f, count, stride, width):
    """A row of lanes, width of them, to the same row of `count` knots."""
    for j0 in range(0, width, WIDTH):
        o, k = row + j0, f + j0
        e0, e1, e2, e3 = transpose((load(X, o), load(X, o + 1), load(X, o + 2), load(X, o + 3)))
        store4(F, k, e0)
        if count > 1:
            store4(F, k + stride, e1)
        if count > 2:
            store4(F, k + 2 * stride, e2)
        if count > 3:
            store4(F, k + 3 * stride, e3)


@inline
def _transport(m, r, x, a, dt, transport, first, count):
    """E's blocks of the balls, [T J] with dq+ = T dq + dt J dv+, for semi-implicit Euler."""
    balls, ball_v, v, scratch = m[NBALLS], integers(m, BALL_V), at(x, m[NQ]), lanes(r, SCRATCH)
    one, zero = spread(1.0), spread(0.0)
    flat = as_floats(scratch)
    for b in range(balls):
        i = load(ball_v, b)
        t = (
            dt * (load(v, i) + dt * load(a, i)), dt * (load(v, i + 1) + dt * load(a, i + 1)),
            dt * (load(v, i + 2) + dt * load(a, i + 2)),
        )  # fmt: skip
        for half in range(2):
            for c in range(3):
                unit = (one if c == 0 else zero, one if c == 1 else zero, one if c == 2 else zero)
                d = carried(t, unit) if half == 0 else right_jacobian_times(t, unit)
                store3(scratch, 0, d)
                for lane in range(count):
                    o = ((first + lane) * balls + b) * 18 + 9 * half + c
                    store(transport, o, load(flat, lane))
                    store(transport, o + 3, load(flat, WIDTH + lane))
                    store(transport, o + 6, load(flat, 2 * WIDTH + lane))


@inline
def _gathered(m, r, xs, us, first, count):
    """States, controls and the rollout's accelerations of four stages onto lanes."""
    gather(pointer(xs.reshape(-1)), first, count, m[NQ] + m[NV] + m[NA], lanes(r, X_LANES))
    gather(pointer(us.reshape(-1)), first, count, m[NU], lanes(r, U_LANES))
    gather(floats(r, ACCELERATIONS), first, count, r[STAGES] * m[NV], lanes(r, A_LANES))


@jit
def linearize_structured(m, r, dt, xs, us, F, transport):
    """Rows da/dz of F (N, nv, width) along xs (N+1, nx), us (N, nu), and E's blocks of the balls.

    The accelerations are those that a rollout, or `steps`, left in ACCELERATIONS; so for linearize_dense.
    """
    m, r = pointer(m), pointer(r)
    nv, columns, count, width = m[NV], r[COLUMNS], us.shape[0], F.shape[2]
    x, a, dA = lanes(r, X_LANES), lanes(r, A_LANES), lanes(r, CHAINED)
    flat, blocks, stride = pointer(F.reshape(-1)), pointer(transport.reshape(-1)), nv * width
    for first in range(0, count, WIDTH):
        present = min(WIDTH, count - first)
        _gathered(m, r, xs, us, first, count)
        acceleration_derivatives(m, r, x, at(x, m[NQ]), a, dA)
        for i in range(nv):
            _scatter_row(dA, i * columns, flat, first * stride + i * width, present, stride, width)
        _transport(m, r, x, a, dt, blocks, first, present)


@jit
def linearize_dense(m, r, dt, xs, us, F):
    """F = (B | A) (N, ndx, width) along xs (N+1, nx), us (N, nu)."""
    m, r = pointer(m), pointer(r)
    nv, na, columns, count, width = m[NV], m[NA], r[COLUMNS], us.shape[0], F.shape[2]
    x, a, row, Xa = lanes(r, X_LANES), lanes(r, A_LANES), lanes(r, ROW), lanes(r, XA)
    flat, stride = pointer(F.reshape(-1)), (2 * nv + na) * width
    index, zero = integers(m, ACTIVATION_INPUT), spread(0.0)
    for first in range(0, count, WIDTH):
        present = min(WIDTH, count - first)
        _gathered(m, r, xs, us, first, count)
        if r[INTEGRATOR] == RK4:
            _runge_kutta(m, r, x, a, dt)
            Xq, Xv = lanes(r, XQ), lanes(r, XV)
        else:
            _euler(m, r, x, a, dt)
            Xq, Xv = lanes(r, SUM_Q), lanes(r, SUM_V)
        o = first * stride
        for i in range(nv):
            _scatter_row(Xq, i * columns, flat, o + i * width, present, stride, width)
            _scatter_row(Xv, i * columns, flat, o + (nv + i) * width, present, stride, width)
        for k in range(na):
            for j in range(columns):
                store(row, j, zero)
            store(row, r[FIRST_X] + 2 * nv + k, load(Xa, 2 * k))
            store(row, load(index, k), load(Xa, 2 * k + 1))
            _scatter_row(row, 0, flat, o + (2 * nv + k) * width, present, stride, width)
