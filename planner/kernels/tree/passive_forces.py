"""Passive forces on a tree (planner.model.passive_forces): drag, tendons, gravity compensation, exponential torques.

On lanes, with their derivatives. Of drag, with g a term's direction moved to the tree's origin and x = g' V, the term's
wrench and its slope by the twist are

    W = -(linear + quadratic |x|) x g,   K = dW/dV = -(linear + 2 quadratic |x|) g g',

and with both summed over the links beyond i, Y_i = V_base x S_i as in kernels.tree.sensitivity, for dof i at or beyond
dof j

    dtau_j/dv_i = S_j' K S_i                         dtau_i/dv_j = S_i' K S_j
    dtau_j/dq_i = S_j' (K Y_i + S_i x* W)            dtau_i/dq_j = S_i' K Y_j

where the term with W falls away between the axes of one ball.

Gravity compensation (MuJoCo's gravcomp) is the weight of other masses, upwards: with g the acceleration of the base,
and m and h the mass that is carried and its first moment about the tree's origin, of link i and all beyond it, link i's
joint feels

    tau_i = S_i' F_i,   F = (h x g, m g).

A turn by joint j at or before i carries S_i and h with it, so that S_j' changes tau_i as if g turned back; a turn by
joint i beyond j moves h alone:

    dtau_i/dq_j = S_i' (h_i x z_j, m_i z_j),   z_j = g x w_j          dtau_j/dq_i = w_j' ((w_i x h_i + m_i v_i) x g)
"""

from __future__ import annotations

from planner.kernels.algebra.spatial import (
    add,
    add3,
    add6,
    axpy,
    cross,
    dot,
    load3,
    load6,
    rotated,
    scaled,
    store3,
    symmetric,
)
from planner.kernels.numba.jit import inline, part
from planner.kernels.numba.lane_math import exp
from planner.kernels.numba.lanes import floats, integers, load, maximum, minimum, select, spread, store
from planner.kernels.tree.mechanism_table import TREE
from planner.kernels.tree.passive_force_arrays import DRAG_SIZE, LIFTED_SIZE, TENDON_SIZE
from planner.kernels.tree.recursion import PLACE, RECORD, SCREW_AXIS, TWIST
from planner.kernels.tree.sensitivity import FIRST_MOMENT, Y

# Offsets in a link's record. The wrench of forces stands beside all that the recursions need; for derivatives, those
# of inverse dynamics are done and leave their place: K in rows J (6) | B (9) | L (6), and the wrench.
WRENCH = 71
SLOPE, CARRIED = FIRST_MOMENT, FIRST_MOMENT + 21


@inline
def _term(m, k, ws):
    """Link's record, direction (moment, force) at the tree's origin, rate x, its size, and coefficients of term k."""
    value, o = floats(m, TREE.drag_value), k * DRAG_SIZE
    b = load(integers(m, TREE.drag_link), k) * RECORD
    R = (
        load(ws, b), load(ws, b + 1), load(ws, b + 2), load(ws, b + 3), load(ws, b + 4), load(ws, b + 5),
        load(ws, b + 6), load(ws, b + 7), load(ws, b + 8),
    )  # fmt: skip
    f = rotated(R, load3(value, o + 3))
    n = add(rotated(R, load3(value, o)), cross(load3(ws, b + PLACE), f))
    x = dot(n, load3(ws, b + TWIST)) + dot(f, load3(ws, b + TWIST + 3))
    return b, n, f, x, maximum(x, spread(0.0) - x), load(value, o + 6), load(value, o + 7)


@part
def add_drag(m, ws, tau):
    """The forces on the joints, of links whose poses, screws and twists are known, onto tau (nv lanes)."""
    parent, zero = integers(m, TREE.parent), spread(0.0)
    for i in range(m[TREE.nv]):
        for k in range(6):
            store(ws, i * RECORD + WRENCH + k, zero)
    for k in range(m[TREE.drags]):
        b, n, f, x, size, linear, quadratic = _term(m, k, ws)
        force = zero - (linear + quadratic * size) * x
        store3(ws, b + WRENCH, axpy(load3(ws, b + WRENCH), force, n))
        store3(ws, b + WRENCH + 3, axpy(load3(ws, b + WRENCH + 3), force, f))
    for i in range(m[TREE.nv] - 1, -1, -1):
        b, p = i * RECORD, load(parent, i)
        n, f = load3(ws, b + WRENCH), load3(ws, b + WRENCH + 3)
        store(tau, i, load(tau, i) + dot(load3(ws, b + SCREW_AXIS), n) + dot(load3(ws, b + SCREW_AXIS + 3), f))
        if p >= 0:
            add3(ws, p * RECORD + WRENCH, n)
            add3(ws, p * RECORD + WRENCH + 3, f)


@inline
def _add_slope(ws, o, slope, n, f):
    """Add slope g g' of a direction g = (n, f) to K at ws[o]."""
    a, b = (slope * n[0], slope * n[1], slope * n[2]), (slope * f[0], slope * f[1], slope * f[2])
    add6(ws, o, (a[0] * n[0], a[0] * n[1], a[0] * n[2], a[1] * n[1], a[1] * n[2], a[2] * n[2]))
    add3(ws, o + 6, (a[0] * f[0], a[0] * f[1], a[0] * f[2]))
    add3(ws, o + 9, (a[1] * f[0], a[1] * f[1], a[1] * f[2]))
    add3(ws, o + 12, (a[2] * f[0], a[2] * f[1], a[2] * f[2]))
    add6(ws, o + 15, (b[0] * f[0], b[0] * f[1], b[0] * f[2], b[1] * f[1], b[1] * f[2], b[2] * f[2]))


@inline
def _sloped(ws, o, w, v):
    """K at ws[o] times a twist (w, v)."""
    J, L = load6(ws, o), load6(ws, o + 15)
    B0, B1, B2 = load3(ws, o + 6), load3(ws, o + 9), load3(ws, o + 12)
    across = (
        B0[0] * w[0] + B1[0] * w[1] + B2[0] * w[2], B0[1] * w[0] + B1[1] * w[1] + B2[1] * w[2],
        B0[2] * w[0] + B1[2] * w[1] + B2[2] * w[2],
    )  # fmt: skip
    return add(symmetric(J, w), (dot(B0, v), dot(B1, v), dot(B2, v))), add(symmetric(L, v), across)


@part
def subtract_drag_derivatives(m, Dq, Dv, ld, ws):
    """Subtract the derivatives of those forces from dtau/dq and dtau/dv of inverse dynamics, (nv, ld) lanes."""
    parent, first, zero = integers(m, TREE.parent), integers(m, TREE.first), spread(0.0)
    for i in range(m[TREE.nv]):
        for k in range(27):
            store(ws, i * RECORD + SLOPE + k, zero)
    for k in range(m[TREE.drags]):
        b, n, f, x, size, linear, quadratic = _term(m, k, ws)
        _add_slope(ws, b + SLOPE, zero - linear - 2.0 * quadratic * size, n, f)
        force = zero - (linear + quadratic * size) * x
        store3(ws, b + CARRIED, axpy(load3(ws, b + CARRIED), force, n))
        store3(ws, b + CARRIED + 3, axpy(load3(ws, b + CARRIED + 3), force, f))
    for i in range(m[TREE.nv] - 1, -1, -1):
        b, p, start = i * RECORD, load(parent, i), load(first, i)
        if p >= 0:
            for k in range(27):
                o = p * RECORD + SLOPE + k
                store(ws, o, load(ws, o) + load(ws, b + SLOPE + k))
        sw, sv = load3(ws, b + SCREW_AXIS), load3(ws, b + SCREW_AXIS + 3)
        n, f = load3(ws, b + CARRIED), load3(ws, b + CARRIED + 3)
        vw, vv = _sloped(ws, b + SLOPE, sw, sv)
        qw, qv = _sloped(ws, b + SLOPE, load3(ws, b + Y), load3(ws, b + Y + 3))
        cw, cv = add(cross(sw, n), cross(sv, f)), cross(sw, f)
        j = i
        while j >= 0:
            t, ij, ji = j * RECORD, i * ld + j, j * ld + i
            rw, rv = load3(ws, t + SCREW_AXIS), load3(ws, t + SCREW_AXIS + 3)
            by_rate, by_place = dot(rw, vw) + dot(rv, vv), dot(rw, qw) + dot(rv, qv)
            if j < start:  # the axes of a ball turn together
                by_place += dot(rw, cw) + dot(rv, cv)
            store(Dv, ji, load(Dv, ji) - by_rate)
            store(Dq, ji, load(Dq, ji) - by_place)
            if j < i:
                store(Dv, ij, load(Dv, ij) - by_rate)
                store(Dq, ij, load(Dq, ij) - dot(vw, load3(ws, t + Y)) - dot(vv, load3(ws, t + Y + 3)))
            j = load(parent, j)


# as in planner.model.passive_forces; here too, because the cache's key covers the kernels' sources alone
LARGEST = 700.0


@inline
def _torque(m, k, q):
    """The torque of curve k."""
    start, dof, slope = integers(m, TREE.curve_start), integers(m, TREE.curve_slope_dof), floats(m, TREE.curve_slope)
    value, address = floats(m, TREE.curve_value), integers(m, TREE.q_address)
    exponent = spread(0.0) + load(value, 2 * k + 1)
    for t in range(load(start, k), load(start, k + 1)):
        exponent += load(slope, t) * load(q, load(address, load(dof, t)))
    return load(value, 2 * k) * exp(minimum(maximum(exponent, -LARGEST), LARGEST))


@part
def add_curves(m, q, tau):
    """The torques of the curves onto tau (nv lanes)."""
    for k in range(m[TREE.curves]):
        i = load(integers(m, TREE.curve_dof), k)
        store(tau, i, load(tau, i) + _torque(m, k, q))


@inline
def subtract_curve_derivatives(m, q, Dq, ld):
    """Subtract the derivatives of the curves' torques from dtau/dq of inverse dynamics, (nv, ld) lanes."""
    start, dof, slope = integers(m, TREE.curve_start), integers(m, TREE.curve_slope_dof), floats(m, TREE.curve_slope)
    for k in range(m[TREE.curves]):
        row, torque = load(integers(m, TREE.curve_dof), k) * ld, _torque(m, k, q)
        for t in range(load(start, k), load(start, k + 1)):
            o = row + load(dof, t)
            store(Dq, o, load(Dq, o) - load(slope, t) * torque)


STIFFNESS, LOW, HIGH, DAMPING = range(TENDON_SIZE)  # offsets in a tendon's numbers


@inline
def _length(m, k, q):
    """The length of tendon k."""
    start, dof, factor = integers(m, TREE.tendon_start), integers(m, TREE.tendon_dof), floats(m, TREE.tendon_factor)
    address, length = integers(m, TREE.q_address), spread(0.0)
    for t in range(load(start, k), load(start, k + 1)):
        length += load(factor, t) * load(q, load(address, load(dof, t)))
    return length


@part
def add_tendons(m, q, v, tau):
    """The forces of the tendons onto tau (nv lanes)."""
    start, dof, factor = integers(m, TREE.tendon_start), integers(m, TREE.tendon_dof), floats(m, TREE.tendon_factor)
    value = floats(m, TREE.tendon_value)
    for k in range(m[TREE.tendons]):
        o, length, rate = TENDON_SIZE * k, _length(m, k, q), spread(0.0)
        for t in range(load(start, k), load(start, k + 1)):
            rate += load(factor, t) * load(v, load(dof, t))
        pull = maximum(load(value, o + LOW) - length, 0.0) - maximum(length - load(value, o + HIGH), 0.0)
        force = load(value, o + STIFFNESS) * pull - load(value, o + DAMPING) * rate
        for t in range(load(start, k), load(start, k + 1)):
            i = load(dof, t)
            store(tau, i, load(tau, i) + load(factor, t) * force)


@part
def add_tendon_derivatives(m, q, Dq, Dv, ld):
    """Add the derivatives of the tendons' forces to dtau/dq and dtau/dv of inverse dynamics, (nv, ld) lanes."""
    start, dof, factor = integers(m, TREE.tendon_start), integers(m, TREE.tendon_dof), floats(m, TREE.tendon_factor)
    value = floats(m, TREE.tendon_value)
    for k in range(m[TREE.tendons]):
        o, length = TENDON_SIZE * k, _length(m, k, q)
        slack = select(load(value, o + LOW), length, 1.0, 0.0) * select(length, load(value, o + HIGH), 1.0, 0.0)
        stiffness, damping = load(value, o + STIFFNESS) * (1.0 - slack), load(value, o + DAMPING)
        for s in range(load(start, k), load(start, k + 1)):
            for t in range(load(start, k), load(start, k + 1)):
                e, product = load(dof, s) * ld + load(dof, t), load(factor, s) * load(factor, t)
                store(Dq, e, load(Dq, e) + product * stiffness)
                store(Dv, e, load(Dv, e) + product * damping)


MOMENT = 81  # offset in a link's record, beyond those of kernels.tree.recursion and of sensitivity


@inline
def _gather_moments(m, ws):
    """The first moment of each link and all beyond it, into the links' records; their poses are known."""
    gravcomp, parent = floats(m, TREE.gravcomp_value), integers(m, TREE.parent)
    for i in range(m[TREE.nv]):
        o, b = LIFTED_SIZE * i, i * RECORD
        R = (
            load(ws, b), load(ws, b + 1), load(ws, b + 2), load(ws, b + 3), load(ws, b + 4), load(ws, b + 5),
            load(ws, b + 6), load(ws, b + 7), load(ws, b + 8),
        )  # fmt: skip
        own = rotated(R, (load(gravcomp, o + 1), load(gravcomp, o + 2), load(gravcomp, o + 3)))
        store3(ws, b + MOMENT, axpy(own, load(gravcomp, o), load3(ws, b + PLACE)))
    for i in range(m[TREE.nv] - 1, -1, -1):
        p = load(parent, i)
        if p >= 0:
            add3(ws, p * RECORD + MOMENT, load3(ws, i * RECORD + MOMENT))


@inline
def _base_acceleration(m):
    g, zero = floats(m, TREE.base_acceleration), spread(0.0)
    return zero + load(g, 0), zero + load(g, 1), zero + load(g, 2)


@part
def add_compensation(m, ws, tau):
    """The force on the joints, of links whose poses and screws are known, onto tau (nv lanes)."""
    g, mass = _base_acceleration(m), floats(m, TREE.gravcomp_mass)
    _gather_moments(m, ws)
    for i in range(m[TREE.nv]):
        b = i * RECORD
        sw, sv = load3(ws, b + SCREW_AXIS), load3(ws, b + SCREW_AXIS + 3)
        moment = cross(load3(ws, b + MOMENT), g)
        store(tau, i, load(tau, i) + dot(sw, moment) + load(mass, i) * dot(sv, g))


@part
def subtract_compensation_derivatives(m, Dq, ld, ws):
    """Subtract the derivatives of that force from dtau/dq of inverse dynamics, (nv, ld) lanes."""
    g, mass = _base_acceleration(m), floats(m, TREE.gravcomp_mass)
    parent, first = integers(m, TREE.parent), integers(m, TREE.first)
    _gather_moments(m, ws)
    for i in range(m[TREE.nv]):
        b = i * RECORD
        sw, sv, h = load3(ws, b + SCREW_AXIS), load3(ws, b + SCREW_AXIS + 3), load3(ws, b + MOMENT)
        own, start = cross(g, sw), load(first, i)
        moment, force = cross(h, own), scaled(load(mass, i), own)
        lifts = cross(axpy(cross(sw, h), load(mass, i), sv), g)
        j = i
        while j >= 0:
            t, ij, ji = j * RECORD + SCREW_AXIS, i * ld + j, j * ld + i
            rw, rv = load3(ws, t), load3(ws, t + 3)
            z = cross(g, rw)
            if j >= start:  # the axes of a ball turn together
                store(Dq, ji, load(Dq, ji) - dot(rw, moment) - dot(rv, force))
            else:
                store(Dq, ji, load(Dq, ji) - dot(rw, lifts))
            if j < i:
                store(Dq, ij, load(Dq, ij) - dot(sw, cross(h, z)) - load(mass, i) * dot(sv, z))
            j = load(parent, j)
