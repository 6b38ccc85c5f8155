"""Drag of a fluid (planner.model.passive_forces) on the joints of a tree, and its derivatives, on lanes.

With g a term's direction moved to the tree's origin and x = g' V, the term's wrench and its slope by the twist are

    W = -(linear + quadratic |x|) x g,   K = dW/dV = -(linear + 2 quadratic |x|) g g',

and with both summed over the links beyond i, Y_i = V_base x S_i as in kernels.tree.sensitivity, for dof i at or beyond
dof j

    dtau_j/dv_i = S_j' K S_i                         dtau_i/dv_j = S_i' K S_j
    dtau_j/dq_i = S_j' (K Y_i + S_i x* W)            dtau_i/dq_j = S_i' K Y_j

where the term with W falls away between the axes of one ball.
"""

from __future__ import annotations

from planner.kernels.algebra.spatial import add, add3, add6, axpy, cross, dot, load3, load6, rotated, store3, symmetric
from planner.kernels.numba.jit import inline, part
from planner.kernels.numba.lanes import floats, integers, load, maximum, spread, store
from planner.kernels.tree.mechanism_table import TREE
from planner.kernels.tree.passive_force_arrays import DRAG_SIZE
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
