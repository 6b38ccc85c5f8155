"""Derivatives of the accelerations of a tree with closed chains (kernels.tree.rounds).

For r1 = M qdd + h - tau - J'f and r2 = J qdd + Jdot qd + 2 rate phidot + rate^2 phi, with W and N as there,

    d qdd = -(W - W J'N J W) dr1 - W J'N dr2

With S_i = (w_i, v_i) the screw of dof i at the tree's origin, V and A the twist and acceleration of the link that
carries a point p, and Y_i, Z_i, YS_i as in kernels.tree.sensitivity, the point moves by

    dp = v_i + w_i x p,   dV = S_i x V + Y_i,   dA = S_i x A + Y_i x V + Z_i    along q_i
    dV = S_i,             dA = S_i x V + YS_i                                   along v_i
"""

from __future__ import annotations

from planner.kernels.algebra.spatial import add, axpy, cross, dot, load3, scaled
from planner.kernels.numba.jit import inline, part
from planner.kernels.numba.lanes import WIDTH, floats, integers, lanes, load, spread, store
from planner.kernels.tree.loop_algebra import invert_independent, subtract, times_inverse
from planner.kernels.tree.loop_rows import LEADER, cam_polynomial, constraint_rows, frame_axis, joined_frame, projected
from planner.kernels.tree.mechanism_table import TREE
from planner.kernels.tree.memory import MEMORY
from planner.kernels.tree.recursion import ACCELERATION, RECORD, SCREW_AXIS, TWIST
from planner.kernels.tree.sensitivity import YS, Y, Z


@inline
def _along(m, r, e, side, row, rigid, link, p, q, ws):
    """Add what frame e of a loop has in dr2 by positions and by velocities, (rows, 2 nv) lanes."""
    parent, nv, D = integers(m, TREE.parent), m[TREE.nv], lanes(r, MEMORY.loop_D)
    rate, sign, width = load(floats(m, TREE.loop_rate), 0), 1.0 - 2.0 * side, r[MEMORY.loop_width]
    zero = spread(0.0)
    b = link * RECORD
    w, u = load3(ws, b + TWIST), load3(ws, b + TWIST + 3)
    aw, av = load3(ws, b + ACCELERATION), load3(ws, b + ACCELERATION + 3)
    moves, other = add(u, cross(w, p)), load(integers(m, TREE.joined_link), e + 1 - 2 * side)
    i = link
    while i >= 0:
        o = i * RECORD
        sw, sv = load3(ws, o + SCREW_AXIS), load3(ws, o + SCREW_AXIS + 3)
        yw, yv = load3(ws, o + Y), load3(ws, o + Y + 3)
        zw, zv, tw, tv = load3(ws, o + Z), load3(ws, o + Z + 3), load3(ws, o + YS), load3(ws, o + YS + 3)
        dp = add(sv, cross(sw, p))
        dw, du = add(cross(sw, w), yw), add(add(cross(sw, u), cross(sv, w)), yv)
        dmoves = add(add(du, cross(dw, p)), cross(w, dp))
        daw = add(add(cross(sw, aw), cross(yw, w)), zw)
        dav = add(add(add(cross(sw, av), cross(sv, aw)), add(cross(yw, u), cross(yv, w))), zv)
        da = add(add(add(dav, cross(daw, p)), cross(aw, dp)), add(cross(dw, moves), cross(w, dmoves)))
        by_q = axpy(axpy(da, 2.0 * rate, dmoves), rate * rate, dp)
        saw, sav = add(cross(sw, w), tw), add(add(cross(sw, u), cross(sv, w)), tv)
        by_v = add(add(sav, cross(saw, p)), add(cross(sw, moves), cross(w, dp)))
        by_v = axpy(by_v, 2.0 * rate, dp)
        add_column(D, row, width, i, sign, by_q)
        add_column(D, row, width, nv + i, sign, by_v)
        if rigid > 0:
            add_column(D, row + 3, width, i, sign, axpy(daw, 2.0 * rate, dw))
            add_column(D, row + 3, width, nv + i, sign, axpy(saw, 2.0 * rate, sw))
            turn = (zero, zero, zero)
            for c in range(3):
                own, its = frame_axis(m, e, link, c, ws), frame_axis(m, e + 1 - 2 * side, other, c, ws)
                turn = add(turn, cross(its, cross(sw, own)))  # of the first frame: d(b x a) = b x da; else da x b
            add_column(D, row + 3, width, i, 0.5 * rate * rate * sign, turn)
        i = load(parent, i)


@inline
def add_column(D, row, width, column, factor, x):
    """Add factor times a vector in three rows of a column of D."""
    for c in range(3):
        o = (row + c) * width + column
        y = x[0] if c == 0 else x[1] if c == 1 else x[2]
        store(D, o, load(D, o) + factor * y)


@inline
def turn_forces(m, Dq, ld, link, p, force, moment, ws):
    """Subtract d(J'f)/dq of a force at p and a moment, both constant in the world, from dtau/dq."""
    parent, first = integers(m, TREE.parent), integers(m, TREE.first)
    i = link
    while i >= 0:
        b = i * RECORD + SCREW_AXIS
        sw, sv = load3(ws, b), load3(ws, b + 3)
        turning = cross(force, sw)
        outer = add(cross(p, turning), cross(moment, sw))
        inner = cross(add(sv, cross(sw, p)), force)
        start, j = load(first, i), link
        while j >= 0:
            t, ji = j * RECORD + SCREW_AXIS, j * ld + i
            rw, rv = load3(ws, t), load3(ws, t + 3)
            if j >= start:
                store(Dq, ji, load(Dq, ji) - dot(rw, outer) - dot(rv, turning))
            else:
                store(Dq, ji, load(Dq, ji) - dot(rw, inner))
            j = load(parent, j)
        i = load(parent, i)


@part
def close_derivatives(m, r, q, v, a, f, Dq, ld, ws):
    """Subtract d(J'f)/dq from dtau/dq, and leave dr2 in MEMORY.loop_D and J in loop_J; ws is inverse dynamics'."""
    nv, rigid, row, width = m[TREE.nv], integers(m, TREE.loop_rigid), 0, r[MEMORY.loop_width]
    D, zero, rate = lanes(r, MEMORY.loop_D), spread(0.0), load(floats(m, TREE.loop_rate), 0)
    for k in range(m[TREE.loop_rows] * width):
        store(D, k, zero)
    for k in range(m[TREE.loops]):
        stiff = load(rigid, k)
        for side in range(2):
            e = 2 * k + side
            link, p, _, _, _ = joined_frame(m, e, q, ws)
            if link >= 0:
                sign = 1.0 - 2.0 * side
                _along(m, r, e, side, row, stiff, link, p, q, ws)
                moment = (zero, zero, zero)
                if stiff > 0:
                    moment = scaled(sign, load3(f, row + 3))
                turn_forces(m, Dq, ld, link, p, scaled(sign, load3(f, row)), moment, ws)
        row += 6 if stiff > 0 else 3
    dof = integers(m, TREE.coupling_dof)
    for k in range(m[TREE.polynomial_couplings]):
        i, j, o = load(dof, 2 * k), load(dof, 2 * k + LEADER), row * width
        _, slope, curvature, third = cam_polynomial(m, k, q)
        speed = load(v, j)
        store(D, o + i, zero + rate * rate)
        store(D, o + nv + i, zero + 2.0 * rate)
        by_q = curvature * load(a, j) + third * (speed * speed)
        by_q += (2.0 * rate) * (curvature * speed) + (rate * rate) * slope
        store(D, o + j, zero - by_q)
        store(D, o + nv + j, zero - 2.0 * (curvature * speed) - (2.0 * rate) * slope)
        store(Dq, j * ld + j, load(Dq, j * ld + j) + curvature * load(f, row))
        row += 3


@part
def close(m, r, q, W, ld, ws):
    """W becomes W - W J'N J W, and MEMORY.loop_Y = W J'N (rows, ld); for the derivatives of accelerations."""
    J, WJ, Y_ = lanes(r, MEMORY.loop_J), lanes(r, MEMORY.loop_WJ), lanes(r, MEMORY.loop_Y)
    constraint_rows(m, q, ws, J, ld)
    projected(m, r, J, W, ld)
    invert_independent(m, r)
    times_inverse(m, r, WJ, ld, Y_, ld)
    subtract(m, (integers(m, TREE.reach_start), integers(m, TREE.reach_dof)), WJ, Y_, ld, W, (ld, 0), True)
    for i in range(m[TREE.nv]):
        for j in range(i):
            store(W, j * ld + i, load(W, i * ld + j))


@inline
def less_bound(m, r, tile, i0, i1, j0, half):
    """A tile of derivatives, rows i0 and i1 in four columns from j0 on, less that of W J'N dr2."""
    start, rows = integers(m, TREE.bound_start), integers(m, TREE.bound_rows)
    ld, width = r[MEMORY.ld], r[MEMORY.loop_width]
    Y_, D = lanes(r, MEMORY.loop_Y), lanes(r, MEMORY.loop_D)
    (a0, a1, a2, a3), (b0, b1, b2, b3) = tile
    for t in range(load(start, j0 // WIDTH), load(start, j0 // WIDTH + 1)):
        k = load(rows, t)
        y0, y1, o = load(Y_, k * ld + i0), load(Y_, k * ld + i1), k * width + half * m[TREE.nv] + j0
        d0, d1, d2, d3 = load(D, o), load(D, o + 1), load(D, o + 2), load(D, o + 3)
        a0 -= y0 * d0
        b0 -= y1 * d0
        a1 -= y0 * d1
        b1 -= y1 * d1
        a2 -= y0 * d2
        b2 -= y1 * d2
        a3 -= y0 * d3
        b3 -= y1 * d3
    return (a0, a1, a2, a3), (b0, b1, b2, b3)
