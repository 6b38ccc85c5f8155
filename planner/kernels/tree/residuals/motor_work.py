"""Mechanical work of the motors over the stages of a solve, smoothed where it changes sign, on lanes.

A motor's work in a stage is w = f d, its mean force times its displacement d, and costs, with s in W,

    weight e(w),    e(w) = sqrt(w^2 + (s dt)^2) - s dt.

It depends on both ends of its stage. Along the dynamics' F = (B | A) that is one row of derivatives dw by z = (u | x).
The gradient is e'(w) dw, exact at any states: what the end gives goes to the next stage's. The Hessian is
e'(w)/w dw dw' (see problem.costs.motors), which the sweep makes of the rows sqrt(e'(w)/w) dw.
"""

from __future__ import annotations

from planner.kernels.algebra.rotations import difference_of_lanes, inverse_right_jacobian
from planner.kernels.force_laws import evaluate
from planner.kernels.lq.workspace import W
from planner.kernels.numba.jit import inline, jit, part
from planner.kernels.numba.lane_math import sqrt
from planner.kernels.numba.lanes import (
    WIDTH,
    as_floats,
    at,
    doubles,
    floats,
    integers,
    lanes,
    load,
    load4,
    pointer,
    spread,
    store,
    store4,
)
from planner.kernels.tree.actuator_arrays import MOTOR_SIZE
from planner.kernels.tree.mechanism_table import BALL, BALL_NEXT, TREE
from planner.kernels.tree.memory import MEMORY
from planner.kernels.tree.residuals.layout import RESIDUALS, TURN_SIZE, WORK_SIZE
from planner.kernels.tree.step import gather, scatter


@inline
def _is_plain(m, i):
    """Whether a degree of freedom is no ball's, so that lengths count it."""
    kind = load(integers(m, TREE.kind), i)
    return kind != BALL and kind != BALL_NEXT


@part
def _force(m, j, x, u):
    """The force of motor j and its derivatives, by what it is given, its length and its rate."""
    start, dof, factor = integers(m, TREE.motor_start), integers(m, TREE.motor_dof), floats(m, TREE.motor_factor)
    address, nq, nu, v = integers(m, TREE.q_address), m[TREE.nq], m[TREE.nu], at(x, m[TREE.nq])
    i, law = load(integers(m, TREE.motor_input), j), load(integers(m, TREE.motor_law), j)
    given = load(u, i) if i < nu else load(x, nq + m[TREE.nv] + i - nu)
    length, rate, p = spread(0.0), spread(0.0), at(floats(m, TREE.motor_value), MOTOR_SIZE * j)
    for t in range(load(start, j), load(start, j + 1)):
        k = load(dof, t)
        rate += load(factor, t) * load(v, k)
        if _is_plain(m, k):
            length += load(factor, t) * load(x, load(address, k))
    by_given, by_length, by_rate = spread(load(p, 0)), spread(load(p, 2)), spread(load(p, 3))
    force = by_given * given + (load(p, 1) + by_length * length + by_rate * rate)
    if law >= 0:
        own = evaluate(law, given, length, rate, (load(p, 4), load(p, 5), load(p, 6), load(p, 7)))
        force += own[0]
        by_given += own[1]
        by_length += own[2]
        by_rate += own[3]
    return force, by_given, by_length, by_rate


@inline
def _displace(m, p, x, end):
    """The displacements from x to the end of a stage into RESIDUALS.way (nv lanes)."""
    way, address = lanes(p, RESIDUALS.way), integers(m, TREE.q_address)
    for i in range(m[TREE.nv]):
        if _is_plain(m, i):
            k = load(address, i)
            store(way, i, load(end, k) - load(x, k))
    for b in range(m[TREE.nballs]):
        difference_of_lanes(end, x, load(integers(m, TREE.ball_q), b), way, load(integers(m, TREE.ball_v), b))


@inline
def _moved(m, p, j):
    """The displacement of motor j, after _displace."""
    start, dof, factor = integers(m, TREE.motor_start), integers(m, TREE.motor_dof), floats(m, TREE.motor_factor)
    way, d = lanes(p, RESIDUALS.way), spread(0.0)
    for t in range(load(start, j), load(start, j + 1)):
        d += load(factor, t) * load(way, load(dof, t))
    return d


@part
def work_cost(m, p, x, u, end):
    """Cost of the work of a stage from x to its end, all on lanes, under controls u."""
    J, terms = spread(0.0), floats(p, RESIDUALS.work)
    _displace(m, p, x, end)
    for j in range(m[TREE.nu]):
        w = 0.5 * (_force(m, j, x, u)[0] + _force(m, j, end, u)[0]) * _moved(m, p, j)
        for e in range(p[RESIDUALS.works]):
            s = load(terms, WORK_SIZE * e + 1) * load(terms, WORK_SIZE * e + 2)
            J += load(terms, WORK_SIZE * e) * (w * w / (sqrt(w * w + s * s) + s))  # without cancellation
    return J


@inline
def _stages(w, r, first):
    """States and controls of four stages onto lanes, and the states of their ends: x, u, end."""
    N, nx, xs = w[W.N], w[W.nx], floats(w, W.xs)
    x, u, end = lanes(r, MEMORY.x), lanes(r, MEMORY.u), lanes(w, W.trial_x)  # of a line search, which is over
    gather(xs, first, N, nx, x)
    gather(at(xs, nx), first, N, nx, end)
    gather(floats(w, W.us), first, N, w[W.nu], u)
    return x, u, end


@jit
def works(w, m, r, p, out):
    """Work (N, nu) of each motor in each stage along W.xs, W.us, J."""
    w, m, r, p, to = pointer(w), pointer(m), pointer(r), pointer(p), doubles(out)
    nu, found = m[TREE.nu], lanes(p, RESIDUALS.work_slopes)
    for first in range(0, w[W.N], WIDTH):
        x, u, end = _stages(w, r, first)
        _displace(m, p, x, end)
        for j in range(nu):
            store(found, j, 0.5 * (_force(m, j, x, u)[0] + _force(m, j, end, u)[0]) * _moved(m, p, j))
        scatter(found, first, w[W.N], nu, to)


@inline
def _turn(m, p):
    """How the rotations of balls change with both ends: the inverse Jacobians of their displacements, and back."""
    way, turns = lanes(p, RESIDUALS.way), lanes(p, RESIDUALS.turns)
    for b in range(m[TREE.nballs]):
        k, o = load(integers(m, TREE.ball_v), b), TURN_SIZE * b
        for c in range(3):
            store(turns, o + c, 0.0 - load(way, k + c))
        inverse_right_jacobian(turns, o, turns, o + 3)
        inverse_right_jacobian(way, k, turns, o + 12)


@part
def _differentiate(m, p, x, u, end, j):
    """The work of motor j, with its derivatives in RESIDUALS.work_slopes: by the start, the end and the control."""
    start, dof, factor = integers(m, TREE.motor_start), integers(m, TREE.motor_dof), floats(m, TREE.motor_factor)
    nv, states, i = m[TREE.nv], 2 * m[TREE.nv] + m[TREE.na], load(integers(m, TREE.motor_input), j)
    slopes, turns = lanes(p, RESIDUALS.work_slopes), lanes(p, RESIDUALS.turns)
    for k in range(2 * states + 1):
        store(slopes, k, 0.0)
    f0, g0, l0, r0 = _force(m, j, x, u)
    f1, g1, l1, r1 = _force(m, j, end, u)
    force, d = 0.5 * (f0 + f1), _moved(m, p, j)
    half = 0.5 * d
    for t in range(load(start, j), load(start, j + 1)):
        k, a = load(dof, t), load(factor, t)
        store(slopes, nv + k, half * a * r0)
        store(slopes, states + nv + k, half * a * r1)
        if _is_plain(m, k):
            store(slopes, k, a * (half * l0 - force))
            store(slopes, states + k, a * (half * l1 + force))
            continue
        b = load(integers(m, TREE.motor_ball), t)
        first = load(integers(m, TREE.ball_v), b)
        o = TURN_SIZE * b + 3 + 3 * (k - first)
        for c in range(3):
            e = first + c
            store(slopes, e, load(slopes, e) - a * force * load(turns, o + c))
            store(slopes, states + e, load(slopes, states + e) + a * force * load(turns, o + 9 + c))
    if i < m[TREE.nu]:
        store(slopes, 2 * states, half * (g0 + g1))
    else:
        k = 2 * nv + i - m[TREE.nu]
        store(slopes, k, half * g0)
        store(slopes, states + k, half * g1)
    return force * d


@inline
def _add(row, factor, F, width):
    for j in range(0, width, WIDTH):
        store4(row, j, load4(row, j) + factor * load4(F, j))


@inline
def _pull_back(w, m, p, n, by_end, lane, row):
    """Add to a row, by z = (u | x), what derivatives by the end of stage n are through the dynamics."""
    width, first, nv, states = w[W.width], w[W.first], m[TREE.nv], 2 * m[TREE.nv] + m[TREE.na]
    if w[W.structured] == 0:
        F = at(floats(w, W.F), n * w[W.ndx] * width)
        for i in range(states):
            c = load(by_end, i * WIDTH + lane)
            if c != 0.0:
                _add(row, c, at(F, i * width), width)
        return
    F, dt, through = (
        at(floats(w, W.F), n * nv * width),
        load(floats(p, RESIDUALS.work), 2),
        floats(p, RESIDUALS.through),
    )
    for i in range(nv):
        c = load(by_end, i * WIDTH + lane)
        store(row, first + i, load(row, first + i) + c)
        store(through, i, load(by_end, (nv + i) * WIDTH + lane) + dt * c)
    for b in range(m[TREE.nballs]):  # E's blocks in place of 1
        k, E = load(integers(m, TREE.ball_v), b), at(floats(w, W.transport), (n * m[TREE.nballs] + b) * 18)
        a0, a1, a2 = (
            load(by_end, k * WIDTH + lane), load(by_end, (k + 1) * WIDTH + lane), load(by_end, (k + 2) * WIDTH + lane)
        )  # fmt: skip
        for c in range(3):
            own = a0 if c == 0 else a1 if c == 1 else a2
            turned = a0 * load(E, c) + a1 * load(E, 3 + c) + a2 * load(E, 6 + c)
            store(row, first + k + c, load(row, first + k + c) + turned - own)
            turned = a0 * load(E, 9 + c) + a1 * load(E, 12 + c) + a2 * load(E, 15 + c)
            store(through, k + c, load(through, k + c) + dt * (turned - own))
    for i in range(nv):
        c = load(through, i)
        if c != 0.0:
            store(row, first + nv + i, load(row, first + nv + i) + c)
            _add(row, dt * c, at(F, i * width), width)


@inline
def _add_stage(w, m, p, n, j, lane):
    """The gradient of motor j's work in stage n onto W.l, and its row of the Hessian into W.rows."""
    width, first, nu, states = w[W.width], w[W.first], w[W.nu], 2 * m[TREE.nv] + m[TREE.na]
    slopes = as_floats(lanes(p, RESIDUALS.work_slopes))
    by_end, o = at(slopes, states * WIDTH), 2 * states * WIDTH + lane
    slope, root = load(slopes, o + WIDTH), load(slopes, o + 2 * WIDTH)
    row, l = at(floats(w, W.rows), (n * nu + j) * width), at(floats(w, W.l), n * width)
    for i in range(0, width, WIDTH):
        store4(row, i, spread(0.0))
    for i in range(states):
        store(row, first + i, load(slopes, i * WIDTH + lane))
    i = load(integers(m, TREE.motor_input), j)
    if i < m[TREE.nu]:
        store(row, i, load(slopes, o))
    _add(l, slope, row, width)
    for i in range(states):
        k = width + first + i
        store(l, k, load(l, k) + slope * load(by_end, i * WIDTH + lane))
    _pull_back(w, m, p, n, by_end, lane, row)
    for i in range(0, width, WIDTH):
        store4(row, i, root * load4(row, i))


@part
def quadratize_work(w, m, r, p):
    """Add the work's gradients to W.l, and leave the rows of its Hessians in W.rows; after W.F."""
    terms, slopes = floats(p, RESIDUALS.work), lanes(p, RESIDUALS.work_slopes)
    after = 2 * (2 * m[TREE.nv] + m[TREE.na]) + 1
    for first in range(0, w[W.N], WIDTH):
        x, u, end = _stages(w, r, first)
        _displace(m, p, x, end)
        _turn(m, p)
        for j in range(m[TREE.nu]):
            work, curvature = _differentiate(m, p, x, u, end, j), spread(0.0)
            for e in range(p[RESIDUALS.works]):
                s = load(terms, WORK_SIZE * e + 1) * load(terms, WORK_SIZE * e + 2)
                curvature += load(terms, WORK_SIZE * e) / sqrt(work * work + s * s)  # e'(w)/w
            store(slopes, after, curvature * work)
            store(slopes, after + 1, sqrt(curvature))
            for lane in range(min(WIDTH, w[W.N] - first)):
                _add_stage(w, m, p, first + lane, j, lane)
