"""The chain rule through the stages of an integrator (Eq. 35), one knot at a time: exact A and B of a step.

Stage i of a Runge-Kutta method evaluates accelerations a_i, with derivatives D_i = (Du | Dq | Dv | Dact) by what they
are evaluated at and A_i by z = (u | dq | dv | dact) at the start of the step, which are sought. States there move by

    dq_i = T dq + W (dv + c_{i-1} A_{i-2} dz) + V dv,        dv_i = dv + c_i A_{i-1} dz,

where c = dt/2, dt/2, dt of RK4 and, but for rotations, T = 1, W = c_i, V = 0. So

    A_i = (Du | Dq T | Dv + Dq (W + V) | Dact) + c_{i-1} Dq W A_{i-2} + c_i Dv A_{i-1},

two products of an (nv, nv) with an (nv, width) matrix. A rotation that follows the vector theta has T = exp(-theta)
and J = Jr(theta), W = c J, with Munthe-Kaas' commutators (see kernels.tree.step) W = J (c + k [v1]) and V = -k J [v2].
"""

from __future__ import annotations

from planner.kernels.algebra.rotations import carried, right_jacobian_times
from planner.kernels.algebra.spatial import load3
from planner.kernels.algebra.tiles import four_rows
from planner.kernels.integrators import (
    END_TURNED,
    LENGTHS,
    MAX_STAGES,
    MIDDLE,
    SEMI_IMPLICIT_EULER,
    SHARE,
    TURNED,
)
from planner.kernels.numba.jit import inline, part
from planner.kernels.numba.lanes import (
    WIDTH,
    as_floats,
    at,
    floats,
    integers,
    lanes,
    load,
    load4,
    spread,
    store,
    store4,
)
from planner.kernels.tree.mechanism_table import BALL, BALL_NEXT, TREE
from planner.kernels.tree.memory import MEMORY

TURN_SIZE = 18  # of a rotation's T and J, row by row


@inline
def keep_turns(m, r, i):
    """T and J of every ball for the rotation vectors in MEMORY.theta, of stage i (MAX_STAGES: the end of the step)."""
    balls, ball_v, theta = m[TREE.nballs], integers(m, TREE.ball_v), lanes(r, MEMORY.theta)
    turns = lanes(r, MEMORY.turns)
    one, zero = spread(1.0), spread(0.0)
    for b in range(balls):
        t = load3(theta, load(ball_v, b))
        o = (i * balls + b) * TURN_SIZE
        for c in range(3):
            unit = (one if c == 0 else zero, one if c == 1 else zero, one if c == 2 else zero)
            T, J = carried(t, unit), right_jacobian_times(t, unit)
            for k in range(3):
                store(turns, o + 3 * k + c, T[k])
                store(turns, o + 9 + 3 * k + c, J[k])


@inline
def _nine(p, k):
    """A matrix (3, 3) of one knot among lanes."""
    return (
        load(p, k), load(p, k + WIDTH), load(p, k + 2 * WIDTH),
        load(p, k + 3 * WIDTH), load(p, k + 4 * WIDTH), load(p, k + 5 * WIDTH),
        load(p, k + 6 * WIDTH), load(p, k + 7 * WIDTH), load(p, k + 8 * WIDTH),
    )  # fmt: skip


@inline
def _three(p, k):
    return load(p, k), load(p, k + WIDTH), load(p, k + 2 * WIDTH)


@inline
def _row_times(x, y, z, A):
    return (
        x * A[0] + y * A[3] + z * A[6],
        x * A[1] + y * A[4] + z * A[7],
        x * A[2] + y * A[5] + z * A[8],
    )


@inline
def _cross_row(x, y, z, v):
    """(x, y, z) [v], the row times v's cross product."""
    return y * v[2] - z * v[1], z * v[0] - x * v[2], x * v[1] - y * v[0]


@inline
def copy_with(D, A, width, nv, at_q, factor):
    """A becomes D with factor times Dq added to Dv."""
    at_v, whole = at_q + nv, nv // WIDTH * WIDTH
    for i in range(nv):
        p = i * width
        for j in range(0, width, WIDTH):
            store4(A, p + j, load4(D, p + j))
        for j in range(0, whole, WIDTH):
            store4(A, p + at_v + j, load4(A, p + at_v + j) + factor * load4(D, p + at_q + j))
        for j in range(whole, nv):
            store(A, p + at_v + j, load(A, p + at_v + j) + factor * load(D, p + at_q + j))


@inline
def turn_columns(m, r, i, lane, lengths, D, A, width):
    """Put Dq T and Dq (W + V) of the balls in the columns of A for stage i, and Dq W / factor in place of Dq."""
    nv, balls, ball_v, at_q = m[TREE.nv], m[TREE.nballs], integers(m, TREE.ball_v), r[MEMORY.first]
    factor, k = lengths
    turns, v = as_floats(lanes(r, MEMORY.turns)), as_floats(lanes(r, MEMORY.v_stages))
    for b in range(balls):
        q = load(ball_v, b)
        o = ((i * balls + b) * TURN_SIZE) * WIDTH + lane
        T, J = _nine(turns, o), _nine(turns, o + 9 * WIDTH)
        v1, v2 = _three(v, q * WIDTH + lane), _three(v, (nv + q) * WIDTH + lane)
        for row in range(nv):
            p = row * width + at_q + q
            x, y, z = load3(D, p)
            g = _row_times(x, y, z, T)
            a, b_, c = _row_times(x, y, z, J)
            first, second = _cross_row(a, b_, c, v1), _cross_row(a, b_, c, v2)
            w = (a + k * first[0], b_ + k * first[1], c + k * first[2])
            for j in range(3):
                store(A, p + j, g[j])
                # the copy has added factor times the plain column
                old = x if j == 0 else y if j == 1 else z
                store(A, p + nv + j, load(A, p + nv + j) + factor * (w[j] - old - k * second[j]))
                store(D, p + j, w[j])


@inline
def add_activations(m, Xa, A, width, at_q):
    """Columns of activations: how far they have come on their own, and by control (own, given in Xa)."""
    nv, na, index = m[TREE.nv], m[TREE.na], integers(m, TREE.activation_input)
    for k in range(na):
        own, given = load(Xa, 2 * k), load(Xa, 2 * k + 1)
        for i in range(nv):
            o = i * width
            f = load(A, o + at_q + 2 * nv + k)
            store(A, o + at_q + 2 * nv + k, own * f)
            store(A, o + load(index, k), load(A, o + load(index, k)) + given * f)


@inline
def add_product(A, D, at_column, B, factor, nv, width):
    """A plus factor times a block of nv columns of D times B."""
    for i in range(0, nv, WIDTH):
        C = (A, i * width, width)
        four_rows(C, (D, i * width + at_column, 1, width), (B, 0, width), nv, factor, width, C, True)


@inline
def _turn_rows(F, width, i, T, J, at_q):
    """Rows i, i+1, i+2 of F become J times themselves, and T is added in their own columns."""
    o0, o1, o2 = i * width, (i + 1) * width, (i + 2) * width
    for j in range(0, width, WIDTH):
        x, y, z = load4(F, o0 + j), load4(F, o1 + j), load4(F, o2 + j)
        store4(F, o0 + j, J[0] * x + J[1] * y + J[2] * z)
        store4(F, o1 + j, J[3] * x + J[4] * y + J[5] * z)
        store4(F, o2 + j, J[6] * x + J[7] * y + J[8] * z)
    for k in range(3):
        for c in range(3):
            o = (i + k) * width + at_q + i + c
            store(F, o, load(F, o) + T[3 * k + c])


@inline
def add_unit(F, o, value):
    """Add a value to entry o."""
    store(F, o, load(F, o) + value)


@inline
def activation_rows(m, Xa, F, width, at_q):
    """Rows of activations at the end of the step."""
    nv, na, index = m[TREE.nv], m[TREE.na], integers(m, TREE.activation_input)
    zero = spread(0.0)
    for k in range(na):
        o = k * width
        for j in range(0, width, WIDTH):
            store4(F, o + j, zero)
        store(F, o + at_q + 2 * nv + k, load(Xa, 2 * k))
        store(F, o + load(index, k), load(Xa, 2 * k + 1))


@inline
def stage_activations(m, Xa, factor):
    """(own, given) of the next stage's activations, from those of the stage before."""
    gain, decay = floats(m, TREE.activation_gain), floats(m, TREE.activation_rate)
    for k in range(m[TREE.na]):
        own, given = load(decay, k) * load(Xa, 2 * k), load(gain, k) + load(decay, k) * load(Xa, 2 * k + 1)
        store(Xa, 2 * k, 1.0 + factor * own)
        store(Xa, 2 * k + 1, factor * given)


@inline
def sum_activations(m, Xa, weight):
    """Add weight times a stage's rates to the sums behind Xa."""
    na, gain, decay = m[TREE.na], floats(m, TREE.activation_gain), floats(m, TREE.activation_rate)
    sums = at(Xa, 2 * na)
    for k in range(na):
        own, given = load(decay, k) * load(Xa, 2 * k), load(gain, k) + load(decay, k) * load(Xa, 2 * k + 1)
        store(sums, 2 * k, load(sums, 2 * k) + weight * own)
        store(sums, 2 * k + 1, load(sums, 2 * k + 1) + weight * given)


@inline
def begin_activations(m, Xa):
    """(own, given) of the first stage, and sums of zero."""
    na = m[TREE.na]
    for k in range(na):
        store(Xa, 2 * k, 1.0)
        store(Xa, 2 * k + 1, 0.0)
        store(Xa, 2 * na + 2 * k, 0.0)
        store(Xa, 2 * na + 2 * k + 1, 0.0)


@inline
def end_activations(m, Xa, factor):
    """(own, given) at the end of the step, from the weighted sums of rates."""
    na = m[TREE.na]
    for k in range(na):
        store(Xa, 2 * k, 1.0 + factor * load(Xa, 2 * na + 2 * k))
        store(Xa, 2 * k + 1, factor * load(Xa, 2 * na + 2 * k + 1))


@inline
def add_unit_rows(m, F, width, at_q):
    """The dq of the start, for all but balls."""
    kind = integers(m, TREE.kind)
    for i in range(m[TREE.nv]):
        if load(kind, i) != BALL and load(kind, i) != BALL_NEXT:
            add_unit(F, i * width + at_q + i, 1.0)


@inline
def turn_balls(m, r, i, lane, width, F):
    """Rows of the balls, which hold d theta, become those of their rotation."""
    balls, ball_v, turns = m[TREE.nballs], integers(m, TREE.ball_v), as_floats(lanes(r, MEMORY.turns))
    for b in range(balls):
        o = ((i * balls + b) * TURN_SIZE) * WIDTH + lane
        _turn_rows(F, width, load(ball_v, b), _nine(turns, o), _nine(turns, o + 9 * WIDTH), r[MEMORY.first])


@inline
def _add_end_commutators(m, r, dt, lane, width, F, A2):
    """The end's factor times d(v1 x v4) in the balls' rows: [v1] (dv + c A2 dz) - [v4] dv, of four stages."""
    nv, ball_v, v = m[TREE.nv], integers(m, TREE.ball_v), as_floats(lanes(r, MEMORY.v_stages))
    at_v, last, method = r[MEMORY.first] + m[TREE.nv], r[MEMORY.stages] - 1, floats(r, MEMORY.method)
    k = dt * dt * load(method, END_TURNED)
    c = k * (load(method, LENGTHS + last) * dt)
    for b in range(m[TREE.nballs]):
        i = load(ball_v, b)
        v1, v4 = _three(v, i * WIDTH + lane), _three(v, (last * nv + i) * WIDTH + lane)
        p0, p1, p2 = i * width, (i + 1) * width, (i + 2) * width
        for j in range(0, width, WIDTH):
            x, y, z = load4(A2, p0 + j), load4(A2, p1 + j), load4(A2, p2 + j)
            store4(F, p0 + j, load4(F, p0 + j) + c * (v1[1] * z - v1[2] * y))
            store4(F, p1 + j, load4(F, p1 + j) + c * (v1[2] * x - v1[0] * z))
            store4(F, p2 + j, load4(F, p2 + j) + c * (v1[0] * y - v1[1] * x))
        d = (k * (v1[0] - v4[0]), k * (v1[1] - v4[1]), k * (v1[2] - v4[2]))
        o = at_v + i
        add_unit(F, o + p0 + 1, -1.0 * d[2])
        add_unit(F, o + p0 + 2, d[1])
        add_unit(F, o + p1, d[2])
        add_unit(F, o + p1 + 2, -1.0 * d[0])
        add_unit(F, o + p2, -1.0 * d[1])
        add_unit(F, o + p2 + 1, d[0])


@part
def runge_kutta(m, r, dt, lane, width, F):
    """The rows F of (B | A) of an explicit Runge-Kutta step, from D of its stages and the rotations kept."""
    nv, balls, block, last = m[TREE.nv], m[TREE.nballs], r[MEMORY.block], r[MEMORY.stages] - 1
    direct, A0, Xa = floats(r, MEMORY.direct), floats(r, MEMORY.chained), floats(r, MEMORY.Xa)
    method, at_q, factor = floats(r, MEMORY.method), r[MEMORY.first], 0.0
    at_v, middle = at_q + nv, load(method, MIDDLE)
    begin_activations(m, Xa)
    sum_activations(m, Xa, 1.0)
    for i in range(last + 1):
        D, A = at(direct, (i * WIDTH + lane) * block), at(A0, i * block)
        before, factor = factor, load(method, LENGTHS + i) * dt
        copy_with(D, A, width, nv, at_q, factor)
        if i == 0:
            continue
        if balls > 0:
            turned = load(method, TURNED) * dt / load(method, LENGTHS + 2) if i == 2 else 0.0
            turn_columns(m, r, i, lane, (factor, turned), D, A, width)
        stage_activations(m, Xa, factor)
        sum_activations(m, Xa, 1.0 if i == last else middle)
        add_activations(m, Xa, A, width, at_q)
        add_product(A, D, at_v, at(A0, (i - 1) * block), factor, nv, width)
        if i > 1:
            add_product(A, D, at_q, at(A0, (i - 2) * block), before * factor, nv, width)
    share, zero = load(method, SHARE) * dt, spread(0.0)
    for i in range(nv):
        q, v = i * width, (nv + i) * width
        for j in range(0, width, WIDTH):
            o, inner = q + j, zero
            place = load(method, LENGTHS + last) * load4(A0, (last - 1) * block + o)
            for k in range(last - 1, 0, -1):
                place += (middle * load(method, LENGTHS + k)) * load4(A0, (k - 1) * block + o)
                inner += load4(A0, k * block + o)
            store4(F, q + j, (dt * share) * place)
            store4(F, v + j, share * (load4(A0, o) + middle * inner + load4(A0, last * block + o)))
        add_unit(F, q + at_v + i, dt)
        add_unit(F, v + at_v + i, 1.0)
    if balls > 0:
        _add_end_commutators(m, r, dt, lane, width, F, at(A0, (last - 1) * block))
        turn_balls(m, r, MAX_STAGES, lane, width, F)
    add_unit_rows(m, F, width, at_q)
    end_activations(m, Xa, share)
    activation_rows(m, Xa, at(F, 2 * nv * width), width, at_q)


@part
def euler(m, r, dt, lane, width, F):
    """The same for the two Euler integrators, from D of the one stage."""
    nv, Xa, at_q = m[TREE.nv], floats(r, MEMORY.Xa), r[MEMORY.first]
    D = at(floats(r, MEMORY.direct), lane * r[MEMORY.block])
    at_v, semi_implicit = at_q + nv, r[MEMORY.integrator] == SEMI_IMPLICIT_EULER
    later = dt if semi_implicit else 0.0
    for i in range(nv):
        q, v = i * width, (nv + i) * width
        for j in range(0, width, WIDTH):
            x = dt * load4(D, q + j)
            store4(F, v + j, x)
            store4(F, q + j, later * x)
        add_unit(F, q + at_v + i, dt)
        add_unit(F, v + at_v + i, 1.0)
    turn_balls(m, r, 0, lane, width, F)
    add_unit_rows(m, F, width, at_q)
    begin_activations(m, Xa)
    stage_activations(m, Xa, dt)
    activation_rows(m, Xa, at(F, 2 * nv * width), width, at_q)
