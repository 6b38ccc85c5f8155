"""Second-order terms T = sum_k costate_k d2 f_k / dz2 of a tree of hinges and slides, four knots at a time.

Only accelerations are not linear in what they are evaluated at. With mu_i the derivative of costate' x(n+1) by the
acceleration a_i of the integrator's stage i, and y_i = (q, v, u, act) the stage's state,

    T = sum_i (dy_i/dz)' S_i (dy_i/dz),      S_i = d2 (mu_i' a_i) / dy_i2.

mu goes backward through the stages, with p_i = (da_i/dq)' mu_i and r_i = (da_i/dv)' mu_i; for Runge-Kutta of weights
w_i and lengths c_i (the state of stage i is that of the start plus c_i times the rates of stage i - 1)

    mu_{i-1} = w_{i-1} l_v + c_i (w_i l_q + r_i + c_{i+1} p_{i+1}).

S follows from inverse dynamics, ID(q, v, a(y)) = tau(y), whose right side is linear: with eta = M^-1 mu, along a
direction d of y that carries the acceleration with it,

    S[d, y] = -(eta' d(dID/dy) + (eta' dM) da/dy).

Along each position that is a pass of inverse_dynamics_derivatives on duals. By two velocities the forces are
Christoffel's symbols of M, whose derivatives those passes give too,

    S[v_j, v_k] = -sum_i eta_i (dM_ij/dq_k + dM_ik/dq_j - dM_jk/dq_i),

by a velocity and an input S is zero, and inputs and activations have no second derivatives of their own.
"""

from __future__ import annotations

from typing import Any

from planner.kernels.integrators import LENGTHS, MIDDLE, SEMI_IMPLICIT_EULER, SHARE, Integrator
from planner.kernels.numba.duals import duals
from planner.kernels.numba.jit import inline, jit
from planner.kernels.numba.lanes import (
    WIDTH,
    as_floats,
    at,
    doubles,
    floats,
    integers,
    lane_array,
    lanes,
    load,
    padded,
    pointer,
    spread,
    store,
)
from planner.kernels.numba.layout import Layout
from planner.kernels.tree.derivatives import acceleration_derivatives
from planner.kernels.tree.mechanism_table import TREE
from planner.kernels.tree.memory import MEMORY
from planner.kernels.tree.recursion import RECORD
from planner.kernels.tree.sensitivity import inverse_dynamics_derivatives
from planner.kernels.tree.step import gather, stage_state

SECOND = Layout(
    "",
    "costate q D inverse mu eta carried Sq Svv Xq Xv A Wq Wv T "
    "q_dual a_dual links_dual tau_dual M_dual Dq_dual Dv_dual",
)


class SecondOrderMemory:
    """Scratch of second_order for a Model, beside the TreeMemory of the same integrator."""

    def __init__(self, model: Any, integrator: Integrator) -> None:
        nv, nq, nu, na = model.nv, model.nq, model.nu, model.na
        stages = integrator.stages
        ld, columns = padded(nv), padded(nu) + padded(2 * nv + na) + WIDTH
        square, rows = nv * ld, nv * columns
        lengths = {
            "costate": 2 * nv + na, "q": stages * nq, "D": stages * rows, "inverse": stages * square, "mu": stages * nv,
            "eta": nv, "carried": nv, "Sq": rows, "Svv": nv * nv, "Xq": rows, "Xv": rows, "A": rows, "Wq": rows,
            "Wv": rows, "T": columns * columns,
        }  # fmt: skip
        dual = {
            "q_dual": nq, "a_dual": nv, "links_dual": nv * RECORD, "tau_dual": nv, "M_dual": square, "Dq_dual": square,
            "Dv_dual": square,
        }  # fmt: skip
        self._arrays = {name: lane_array(count, WIDTH) for name, count in lengths.items()}
        self._arrays |= {name: lane_array(count, 2 * WIDTH) for name, count in dual.items()}
        self.table = SECOND.table({}, self._arrays)


@inline
def _velocity(m, r, x, i):
    """The velocities of stage i."""
    return at(x, m[TREE.nq]) if i == 0 else at(lanes(r, MEMORY.v_stages), i * m[TREE.nv])


@inline
def _first_derivatives(m, r, s, dt):
    """D = (Du | Dq | Dv | Dact), M^-1 and q of every stage, kept."""
    nv, nq, ld, columns = m[TREE.nv], m[TREE.nq], r[MEMORY.ld], r[MEMORY.columns]
    x, a = lanes(r, MEMORY.x), lanes(r, MEMORY.a)
    for i in range(r[MEMORY.stages]):
        q = at(lanes(s, SECOND.q), i * nq)
        if i > 0:
            stage_state(m, r, x, i, a, spread(dt))
        source = x if i == 0 else lanes(r, MEMORY.q_stage)
        for k in range(nq):
            store(q, k, load(source, k))
        D = at(lanes(s, SECOND.D), i * nv * columns)
        v = _velocity(m, r, x, i)
        acceleration_derivatives(m, r, q, v, v, at(a, i * nv), D, None)  # nothing touches, so nothing reads act
        inverse, M = at(lanes(s, SECOND.inverse), i * nv * ld), lanes(r, MEMORY.M)
        for k in range(nv * ld):
            store(inverse, k, load(M, k))


@inline
def _column_sum(D, columns, c, mu, nv):
    """Column c of D times mu."""
    total = spread(0.0)
    for i in range(nv):
        total += load(D, i * columns + c) * load(mu, i)
    return total


@inline
def _adjoints(m, r, s, dt):
    """Mu of every stage, from the costate of the end."""
    nv, columns, x0, last = m[TREE.nv], r[MEMORY.columns], r[MEMORY.first], r[MEMORY.stages] - 1
    l, all_mu, all_D = lanes(s, SECOND.costate), lanes(s, SECOND.mu), lanes(s, SECOND.D)
    if last == 0:
        later = dt * dt if r[MEMORY.integrator] == SEMI_IMPLICIT_EULER else 0.0
        for k in range(nv):
            store(all_mu, k, dt * load(l, nv + k) + later * load(l, k))
        return
    method = floats(r, MEMORY.method)
    outer, length_next = load(method, SHARE) * dt, 0.0
    inner = load(method, MIDDLE) * outer
    for k in range(nv):
        store(all_mu, last * nv + k, outer * load(l, nv + k))
    for i in range(last, 0, -1):
        D, D_next = at(all_D, i * nv * columns), at(all_D, min(i + 1, last) * nv * columns)
        mu, mu_next = at(all_mu, i * nv), at(all_mu, min(i + 1, last) * nv)
        weight, weight_before = (outer if i == last else inner), (outer if i == 1 else inner)
        length = load(method, LENGTHS + i) * dt
        for k in range(nv):
            by_rate = weight * load(l, k) + _column_sum(D, columns, x0 + nv + k, mu, nv)
            by_rate += length_next * _column_sum(D_next, columns, x0 + k, mu_next, nv)
            store(all_mu, (i - 1) * nv + k, weight_before * load(l, nv + k) + length * by_rate)
        length_next = length


@inline
def _eta(m, r, s, i):
    """Eta = M^-1 mu of stage i, zero where the acceleration is prescribed."""
    nv, ld = m[TREE.nv], r[MEMORY.ld]
    inverse, mu, eta = at(lanes(s, SECOND.inverse), i * nv * ld), at(lanes(s, SECOND.mu), i * nv), lanes(s, SECOND.eta)
    prescribed = integers(m, TREE.prescribed)
    for k in range(nv):
        total = spread(0.0)
        if load(prescribed, k) < 0:
            for j in range(nv):
                if load(prescribed, j) < 0:
                    total += load(inverse, k * ld + j) * load(mu, j)
        store(eta, k, total)


@inline
def _along_positions(m, r, s, i, x):
    """Rows of S by q, into Sq (nv, columns), and S by v and v, into Svv (nv, nv)."""
    nv, nq, ld, columns, x0 = m[TREE.nv], m[TREE.nq], r[MEMORY.ld], r[MEMORY.columns], r[MEMORY.first]
    q, a, v = at(lanes(s, SECOND.q), i * nq), at(lanes(r, MEMORY.a), i * nv), _velocity(m, r, x, i)
    D, eta, carried = at(lanes(s, SECOND.D), i * nv * columns), lanes(s, SECOND.eta), lanes(s, SECOND.carried)
    S = lanes(s, SECOND.Sq)
    Svv = lanes(s, SECOND.Svv)
    # As lanes, the derivatives of duals lie at odd places.
    dq, da, dM = lanes(s, SECOND.q_dual), lanes(s, SECOND.a_dual), lanes(s, SECOND.M_dual)
    dDq, dDv = lanes(s, SECOND.Dq_dual), lanes(s, SECOND.Dv_dual)
    qs, accelerations = duals(s, SECOND.q_dual), duals(s, SECOND.a_dual)
    links, tau = duals(s, SECOND.links_dual), duals(s, SECOND.tau_dual)
    derivatives = (duals(s, SECOND.M_dual), duals(s, SECOND.Dq_dual), duals(s, SECOND.Dv_dual))
    address, zero, one = integers(m, TREE.q_address), spread(0.0), spread(1.0)
    for k in range(nq):
        store(dq, 2 * k, load(q, k))
        store(dq, 2 * k + 1, zero)
    for k in range(nv * nv):
        store(Svv, k, zero)
    for d in range(nv):
        store(dq, 2 * load(address, d) + 1, one)
        for k in range(nv):
            store(da, 2 * k, load(a, k))
            store(da, 2 * k + 1, load(D, k * columns + x0 + d))
        inverse_dynamics_derivatives(m, qs, v, accelerations, links, tau, derivatives, ld)
        store(dq, 2 * load(address, d) + 1, zero)
        own = load(eta, d)
        for k in range(nv):
            by_a, by_q, by_v = zero, zero, zero
            for j in range(nv):
                e, o = load(eta, j), 2 * (j * ld + k) + 1
                by_a += e * load(dM, o)
                by_q += e * load(dDq, o)
                by_v += e * load(dDv, o)
                store(Svv, j * nv + k, load(Svv, j * nv + k) + own * load(dM, o))
            store(carried, k, by_a)
            store(Svv, d * nv + k, load(Svv, d * nv + k) - by_a)
            store(Svv, k * nv + d, load(Svv, k * nv + d) - by_a)
            store(S, d * columns + x0 + k, zero - by_q)
            store(S, d * columns + x0 + nv + k, zero - by_v)
        for c in range(m[TREE.nu]):
            store(S, d * columns + c, zero)
        for c in range(x0 + 2 * nv, x0 + 2 * nv + m[TREE.na]):
            store(S, d * columns + c, zero)
        for k in range(nv):
            e = load(carried, k)
            for c in range(m[TREE.nu]):
                store(S, d * columns + c, load(S, d * columns + c) - e * load(D, k * columns + c))
            for c in range(x0, x0 + 2 * nv + m[TREE.na]):
                store(S, d * columns + c, load(S, d * columns + c) - e * load(D, k * columns + c))


@inline
def _column(i, nu, x0):
    """The column of entry i of z = (u | x), without the padding between."""
    return i if i < nu else i - nu + x0


@inline
def _move_activations(m, r, i, length):
    """How far the activations of stage i have come on their own, and by their input, from those of the stage before."""
    gain, rate, Xa = floats(m, TREE.activation_gain), floats(m, TREE.activation_rate), floats(r, MEMORY.Xa)
    for k in range(m[TREE.na]):
        own, given = (load(Xa, 2 * k), load(Xa, 2 * k + 1)) if i > 0 else (0.0, 0.0)
        store(Xa, 2 * k, 1.0 + length * load(rate, k) * own)
        store(Xa, 2 * k + 1, length * (load(gain, k) + load(rate, k) * given) if i > 0 else 0.0)


@inline
def _move_states(m, r, s, i, length):
    """Xq = dq/dz and Xv = dv/dz of stage i, from those of the stage before."""
    nv, columns, x0, nz = m[TREE.nv], r[MEMORY.columns], r[MEMORY.first], m[TREE.nu] + 2 * m[TREE.nv] + m[TREE.na]
    Xq, Xv, A = lanes(s, SECOND.Xq), lanes(s, SECOND.Xv), lanes(s, SECOND.A)
    zero = spread(0.0)
    for k in range(nv):
        for j in range(nz):
            o = k * columns + _column(j, m[TREE.nu], x0)
            store(Xq, o, length * load(Xv, o) if i > 0 else zero)
            store(Xv, o, length * load(A, o) if i > 0 else zero)
        o = k * columns + x0 + k
        store(Xq, o, load(Xq, o) + 1.0)
        store(Xv, o + nv, load(Xv, o + nv) + 1.0)


@inline
def _move_accelerations(m, r, s, i):
    """A = da/dz of stage i."""
    nv, na, columns, x0, nu = m[TREE.nv], m[TREE.na], r[MEMORY.columns], r[MEMORY.first], m[TREE.nu]
    D, A, Xq = at(lanes(s, SECOND.D), i * nv * columns), lanes(s, SECOND.A), lanes(s, SECOND.Xq)
    Xv = lanes(s, SECOND.Xv)
    index, Xa = integers(m, TREE.activation_input), floats(r, MEMORY.Xa)
    for k in range(nv):
        for j in range(nu + 2 * nv + na):
            c = _column(j, nu, x0)
            total = load(D, k * columns + c) if j < nu else spread(0.0)
            for y in range(nv):
                total += load(D, k * columns + x0 + y) * load(Xq, y * columns + c)
                total += load(D, k * columns + x0 + nv + y) * load(Xv, y * columns + c)
            store(A, k * columns + c, total)
        for y in range(na):
            o, c = k * columns + load(index, y), k * columns + x0 + 2 * nv + y
            store(A, c, load(A, c) + load(Xa, 2 * y) * load(D, c))
            store(A, o, load(A, o) + load(Xa, 2 * y + 1) * load(D, c))


@inline
def _add_terms(m, r, s):
    """T plus X' S X of a stage: R + R' with R = Xq' Wq + Xv' Wv."""
    nv, na, columns, x0, nu = m[TREE.nv], m[TREE.na], r[MEMORY.columns], r[MEMORY.first], m[TREE.nu]
    Xq, Xv, Wq, Wv = lanes(s, SECOND.Xq), lanes(s, SECOND.Xv), lanes(s, SECOND.Wq), lanes(s, SECOND.Wv)
    T = lanes(s, SECOND.T)
    Sq, Svv, index = lanes(s, SECOND.Sq), lanes(s, SECOND.Svv), integers(m, TREE.activation_input)
    Xa = floats(r, MEMORY.Xa)
    nz = nu + 2 * nv + na
    for d in range(nv):
        for j in range(nz):
            c = _column(j, nu, x0)
            half, whole, rate = spread(0.0), load(Sq, d * columns + c) if j < nu else spread(0.0), spread(0.0)
            for y in range(nv):
                half += load(Sq, d * columns + x0 + y) * load(Xq, y * columns + c)
                whole += load(Sq, d * columns + x0 + nv + y) * load(Xv, y * columns + c)
                rate += load(Svv, d * nv + y) * load(Xv, y * columns + c)
            store(Wq, d * columns + c, 0.5 * half + whole)
            store(Wv, d * columns + c, 0.5 * rate)
        for y in range(na):
            o, c = d * columns + load(index, y), d * columns + x0 + 2 * nv + y
            store(Wq, c, load(Wq, c) + load(Xa, 2 * y) * load(Sq, c))
            store(Wq, o, load(Wq, o) + load(Xa, 2 * y + 1) * load(Sq, c))
    for i in range(nz):
        a = _column(i, nu, x0)
        for j in range(i, nz):
            b = _column(j, nu, x0)
            total = load(T, a * columns + b)
            for d in range(nv):
                o = d * columns
                total += load(Xq, o + a) * load(Wq, o + b) + load(Xq, o + b) * load(Wq, o + a)
                total += load(Xv, o + a) * load(Wv, o + b) + load(Xv, o + b) * load(Wv, o + a)
            store(T, a * columns + b, total)


@jit
def second_order(m, r, s, dt, xs, us, costates, T):
    """Upper triangles T (N, width, width) along xs (N+1, nx), us (N, nu), for the costates (N+1, width).

    The accelerations are those that a rollout, or `steps`, left in MEMORY.accelerations. The lower triangle
    stays zero.
    """
    m, r, s = pointer(m), pointer(r), pointer(s)
    nv, nu, columns, x0, count = m[TREE.nv], m[TREE.nu], r[MEMORY.columns], r[MEMORY.first], us.shape[0]
    width = T.shape[2]
    ndx, row = 2 * nv + m[TREE.na], costates.shape[1]
    x, T_lanes, l = lanes(r, MEMORY.x), lanes(s, SECOND.T), lanes(s, SECOND.costate)
    T_flat, to = as_floats(T_lanes), doubles(T)
    costate, l_flat = doubles(costates), as_floats(l)
    for first in range(0, count, WIDTH):
        gather(doubles(xs), first, count, xs.shape[1], x)
        gather(doubles(us), first, count, nu, lanes(r, MEMORY.u))
        gather(floats(r, MEMORY.accelerations), first, count, r[MEMORY.stages] * nv, lanes(r, MEMORY.a))
        for lane in range(WIDTH):
            o = (min(first + lane, count - 1) + 1) * row + x0
            for k in range(ndx):
                store(l_flat, k * WIDTH + lane, load(costate, o + k))
        _first_derivatives(m, r, s, dt)
        _adjoints(m, r, s, dt)
        for i in range(nu + ndx):
            for j in range(i, nu + ndx):
                store(T_lanes, _column(i, nu, x0) * columns + _column(j, nu, x0), spread(0.0))
        for i in range(r[MEMORY.stages]):
            length = load(floats(r, MEMORY.method), LENGTHS + i) * dt
            _move_activations(m, r, i, length)
            _eta(m, r, s, i)
            _along_positions(m, r, s, i, x)
            _move_states(m, r, s, i, length)
            if i + 1 < r[MEMORY.stages]:
                _move_accelerations(m, r, s, i)
            _add_terms(m, r, s)
        for lane in range(min(WIDTH, count - first)):
            for i in range(nu + ndx):
                for j in range(i, nu + ndx):
                    a, b = _column(i, nu, x0), _column(j, nu, x0)
                    store(to, ((first + lane) * width + a) * width + b, load(T_flat, (a * columns + b) * WIDTH + lane))
