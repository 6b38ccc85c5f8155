"""Accelerations of a tree with closed chains (planner.model.loops) and their derivatives, four knots at a time.

With W in place of M^-1 (kernels.tree.couplings), the accelerations a0 that the tree would have, and c = J a0 + Jdot qd
+ 2 rate phidot + rate^2 phi what they lack of the constraints,

    f = -N c,   qdd = a0 + W J'f,   N = (J W J')^-1

Equations that say the same twice, as those of a planar machine do, make J W J' singular. Its elimination leaves out a
row whose pivot falls below INDEPENDENT of the largest of its kind: its force is zero, and the others keep it too.

The derivatives have, for r1 = M qdd + h - tau - J'f and r2 = J qdd + Jdot qd + ... ,

    d qdd = -(W - W J'N J W) dr1 - W J'N dr2

With S_i = (w_i, v_i) the screw of dof i at the tree's origin, V and A the twist and acceleration of the link that
carries a point p, and Y_i, Z_i, YS_i as in kernels.tree.sensitivity, the point moves by

    dp = v_i + w_i x p,   dV = S_i x V + Y_i,   dA = S_i x A + Y_i x V + Z_i    along q_i
    dV = S_i,             dA = S_i x V + YS_i                                   along v_i
"""

from __future__ import annotations

from planner.kernels.algebra.spatial import add, axpy, cross, dot, load3, load9, rotated, scaled, store3, sub
from planner.kernels.numba.jit import inline, part
from planner.kernels.numba.lanes import WIDTH, floats, integers, lanes, load, maximum, select, spread, store
from planner.kernels.tree.couplings import invert_coupled, mass_and_rest
from planner.kernels.tree.memory import MEMORY
from planner.kernels.tree.model import CAM_SIZE, JOINED_SIZE, TREE
from planner.kernels.tree.recursion import ACCELERATION, PLACE, RECORD, SCREW_AXIS, TWIST
from planner.kernels.tree.sensitivity import YS, Y, Z

POINT, ORIGIN, AXES = 0, 3, 6  # offsets in the numbers of one of two frames that are joined, as `model` lays them out
FOLLOWER, LEADER, POWERS = 0, 1, 2  # and of a cam
INDEPENDENT = 1e-10  # of the largest diagonal entry of J W J' for places, rotations and cams; rounding leaves 1e-16


@inline
def _joined(m, e, q, ws):
    """Frame e of those that are joined: its link, its place about the tree's origin and in the world, the twist."""
    link, address = load(integers(m, TREE.joined_link), e), load(integers(m, TREE.joined_address), e)
    value, o, zero = floats(m, TREE.joined_value), JOINED_SIZE * e, spread(0.0)
    none = (zero, zero, zero)
    p, w, u = add(none, load3(value, o + POINT)), none, none
    if link >= 0:
        b = link * RECORD
        p = add(load3(ws, b + PLACE), rotated(load9(ws, b), load3(value, o + POINT)))
        w, u = load3(ws, b + TWIST), load3(ws, b + TWIST + 3)
    x = add(p, load3(value, o + ORIGIN))
    if address >= 0:  # a floating tree is described about where it is
        x = add(x, load3(q, address))
    return link, p, x, w, u


@inline
def _axis(m, e, link, c, ws):
    """Axis c of frame e in the world."""
    value, o, zero = floats(m, TREE.joined_value), JOINED_SIZE * e + AXES + 3 * c, spread(0.0)
    axis = add((zero, zero, zero), load3(value, o))
    if link >= 0:
        axis = rotated(load9(ws, link * RECORD), load3(value, o))
    return axis


@inline
def _acceleration(m, link, ws):
    """The acceleration of a link, (angular, linear) at the tree's origin, without gravity's part."""
    zero, g = spread(0.0), floats(m, TREE.base_acceleration)
    aw, av = (zero, zero, zero), (zero, zero, zero)
    if link >= 0:
        b = link * RECORD + ACCELERATION
        aw, av = load3(ws, b), sub(load3(ws, b + 3), load3(g, 0))
    return aw, av


@inline
def _polynomial(m, k, q):
    """Of cam k at the leader's place: the value to follow, and its first three derivatives."""
    o, value = CAM_SIZE * k + POWERS, floats(m, TREE.cam_value)
    leader = load(integers(m, TREE.cam_dof), 2 * k + LEADER)
    s = load(q, load(integers(m, TREE.q_address), leader)) - load(value, CAM_SIZE * k + LEADER)
    c0, c1, c2, c3, c4 = load(value, o), load(value, o + 1), load(value, o + 2), load(value, o + 3), load(value, o + 4)
    zero = spread(0.0)
    p0 = c0 + s * (c1 + s * (c2 + s * (c3 + s * c4)))
    p1 = c1 + s * (2.0 * c2 + s * (3.0 * c3 + s * (4.0 * c4)))
    p2 = 2.0 * c2 + s * (6.0 * c3 + s * (12.0 * c4))
    return zero + load(value, CAM_SIZE * k + FOLLOWER) + p0, zero + p1, zero + p2, zero + (6.0 * c3 + s * (24.0 * c4))


@inline
def _constraint_rows(m, q, ws, J, ld):
    """J (rows, ld) of the constraints."""
    parent, rigid = integers(m, TREE.parent), integers(m, TREE.loop_rigid)
    zero, row = spread(0.0), 0
    for k in range(m[TREE.loop_rows] * ld):
        store(J, k, zero)
    for k in range(m[TREE.loops]):
        for side in range(2):
            link, p, _, _, _ = _joined(m, 2 * k + side, q, ws)
            sign = 1.0 - 2.0 * side
            i = link
            while i >= 0:
                b = i * RECORD + SCREW_AXIS
                sw, sv = load3(ws, b), load3(ws, b + 3)
                moves = add(sv, cross(sw, p))
                for c in range(3):
                    o = (row + c) * ld + i
                    x = moves[0] if c == 0 else moves[1] if c == 1 else moves[2]
                    store(J, o, load(J, o) + sign * x)
                    if load(rigid, k) > 0:
                        o += 3 * ld
                        y = sw[0] if c == 0 else sw[1] if c == 1 else sw[2]
                        store(J, o, load(J, o) + sign * y)
                i = load(parent, i)
        row += 6 if load(rigid, k) > 0 else 3
    dof = integers(m, TREE.cam_dof)
    for k in range(m[TREE.cams]):
        _, slope, _, _ = _polynomial(m, k, q)
        store(J, row * ld + load(dof, 2 * k), zero + 1.0)
        store(J, row * ld + load(dof, 2 * k + LEADER), zero - slope)
        row += 1


@inline
def _lacks(m, q, v, ws, c):
    """C = Jdot qd + 2 rate phidot + rate^2 phi, and J a of prescribed coordinates, from the links' accelerations."""
    rigid, row, rate = integers(m, TREE.loop_rigid), 0, load(floats(m, TREE.loop_rate), 0)
    zero = spread(0.0)
    for k in range(m[TREE.loops]):
        total, turning, turn = (zero, zero, zero), (zero, zero, zero), (zero, zero, zero)
        links = load(integers(m, TREE.joined_link), 2 * k), load(integers(m, TREE.joined_link), 2 * k + 1)
        for side in range(2):
            link, p, x, w, u = _joined(m, 2 * k + side, q, ws)
            sign = 1.0 - 2.0 * side
            aw, av = _acceleration(m, link, ws)
            moves = add(u, cross(w, p))
            a = add(add(av, cross(aw, p)), cross(w, moves))
            total = axpy(total, sign, axpy(axpy(a, 2.0 * rate, moves), rate * rate, x))
            turning = axpy(turning, sign, axpy(aw, 2.0 * rate, w))
        store3(c, row, total)
        row += 3
        if load(rigid, k) > 0:
            for e in range(3):
                turn = add(turn, cross(_axis(m, 2 * k + 1, links[1], e, ws), _axis(m, 2 * k, links[0], e, ws)))
            store3(c, row, axpy(turning, 0.5 * rate * rate, turn))
            row += 3
    dof, address = integers(m, TREE.cam_dof), integers(m, TREE.q_address)
    for k in range(m[TREE.cams]):
        i, j = load(dof, 2 * k), load(dof, 2 * k + LEADER)
        value, slope, curvature, _ = _polynomial(m, k, q)
        speed = load(v, j)
        phi, phid = load(q, load(address, i)) - value, load(v, i) - slope * speed
        store(c, row, (2.0 * rate) * phid + (rate * rate) * phi - curvature * (speed * speed))
        row += 1


@inline
def _projected(m, r, J, W, ld):
    """WJ = W J' (rows, ld), N the lower half of J W J' (rows, rows); W of prescribed coordinates counts as zero."""
    rows, prescribed = m[TREE.loop_rows], integers(m, TREE.prescribed)
    start, dof, stop = integers(m, TREE.row_start), integers(m, TREE.row_dof), integers(m, TREE.block_stop)
    first, reach, kinds = integers(m, TREE.reach_start), integers(m, TREE.reach_dof), integers(m, TREE.row_kind)
    WJ, N, least = lanes(r, MEMORY.loop_WJ), lanes(r, MEMORY.loop_N), lanes(r, MEMORY.loop_least)
    zero = spread(0.0)
    for kind in range(3):
        store(least, kind, zero)
    for k in range(rows * ld):
        store(WJ, k, zero)
    for k in range(rows):
        for t in range(load(first, k), load(first, k + 1)):
            i, total = load(reach, t), zero
            if load(prescribed, i) < 0:
                for s in range(load(start, k), load(start, k + 1)):
                    j = load(dof, s)
                    if load(stop, j) == load(stop, i):
                        total += load(W, i * ld + j) * load(J, k * ld + j)
            store(WJ, k * ld + i, total)
        for l in range(k + 1):
            total = zero
            for s in range(load(start, l), load(start, l + 1)):
                j = load(dof, s)
                total += load(J, l * ld + j) * load(WJ, k * ld + j)
            store(N, k * rows + l, total)
        kind = load(kinds, k)
        store(least, kind, maximum(load(least, kind), INDEPENDENT * load(N, k * rows + k)))


@inline
def _solve(m, N, rows, least, c, f):
    """F = -N^-1 c by L D L', in place of the lower half of N; dependent rows have no force."""
    kinds = integers(m, TREE.row_kind)
    for k in range(rows):  # column by column: what stands right of it has all that comes before taken off
        pivot = load(N, k * rows + k)
        d = select(load(least, load(kinds, k)), pivot, 1.0 / pivot, 0.0)
        store(N, k * rows + k, d)
        total = load(c, k)
        for i in range(k + 1, rows):
            factor = load(N, i * rows + k) * d
            for j in range(k + 1, i + 1):
                store(N, i * rows + j, load(N, i * rows + j) - factor * load(N, j * rows + k))
            store(c, i, load(c, i) - factor * total)
        store(f, k, (-1.0 * d) * total)
    for k in range(rows - 1, -1, -1):  # L' f: entries below the diagonal are L D
        total, d = load(f, k), load(N, k * rows + k)
        for i in range(k + 1, rows):
            total -= (load(N, i * rows + k) * d) * load(f, i)
        store(f, k, total)


@inline
def _invert_independent(m, N, rows, least):
    """N becomes the inverse of its independent rows and columns, and zero in the others: kernels.tree.sensitivity's."""
    kinds = integers(m, TREE.row_kind)
    for k in range(rows):
        pivot = load(N, k * rows + k)
        d = select(load(least, load(kinds, k)), pivot, 1.0 / pivot, 0.0)
        store(N, k * rows + k, -1.0 * d)
        for i in range(rows):
            if i != k:
                factor = (load(N, i * rows + k) if i > k else load(N, k * rows + i)) * d
                for j in range(min(i + 1, k)):
                    store(N, i * rows + j, load(N, i * rows + j) - factor * load(N, k * rows + j))
                for j in range(k + 1, i + 1):
                    store(N, i * rows + j, load(N, i * rows + j) - factor * load(N, j * rows + k))
        for i in range(k):
            store(N, k * rows + i, load(N, k * rows + i) * d)
        for i in range(k + 1, rows):
            store(N, i * rows + k, load(N, i * rows + k) * d)
    for i in range(rows):
        for j in range(i + 1):
            x = -1.0 * load(N, i * rows + j)
            store(N, i * rows + j, x)
            store(N, j * rows + i, x)


@part
def accelerate_closed(m, r, q, v, forces, a, ws, armature, f):
    """Accelerations a (nv) under forces (nv), and the constraints' f, of links that move_links has seen.

    armature (nv) is floats or lanes.
    """
    n, prescribed, rows = m[TREE.nv], integers(m, TREE.prescribed), m[TREE.loop_rows]
    rest, M, ld = lanes(r, MEMORY.rest), lanes(r, MEMORY.M), r[MEMORY.ld]
    J, WJ, N = lanes(r, MEMORY.loop_J), lanes(r, MEMORY.loop_WJ), lanes(r, MEMORY.loop_N)
    c, zero = lanes(r, MEMORY.loop_c), spread(0.0)
    for i in range(n):
        store(rest, i, load(forces, i))
    mass_and_rest(m, rest, a, ws, armature, M, ld)
    _lacks(m, q, v, ws, c)
    for p in range(n):
        if load(prescribed, p) >= 0:
            for i in range(n):
                store(M, i * ld + p, zero)
                store(M, p * ld + i, zero)
            store(M, p * ld + p, zero + 1.0)
            store(rest, p, zero)
    invert_coupled(m, M, ld)
    _constraint_rows(m, q, ws, J, ld)
    _projected(m, r, J, M, ld)
    first, reach, stop = integers(m, TREE.reach_start), integers(m, TREE.reach_dof), integers(m, TREE.block_stop)
    for k in range(rows):
        total = load(c, k)
        for t in range(load(first, k), load(first, k + 1)):
            total += load(WJ, k * ld + load(reach, t)) * load(rest, load(reach, t))
        store(c, k, total)
    _solve(m, N, rows, lanes(r, MEMORY.loop_least), c, f)
    begin = 0
    for i in range(n):
        if i > 0 and load(stop, i) != load(stop, i - 1):
            begin = i
        if load(prescribed, i) < 0:
            total = zero
            for j in range(begin, load(stop, i)):
                total += load(M, i * ld + j) * load(rest, j)
            store(a, i, total)
    for k in range(rows):
        for t in range(load(first, k), load(first, k + 1)):
            i = load(reach, t)
            if load(prescribed, i) < 0:
                store(a, i, load(a, i) + load(WJ, k * ld + i) * load(f, k))


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
        _add_column(D, row, width, i, sign, by_q)
        _add_column(D, row, width, nv + i, sign, by_v)
        if rigid > 0:
            _add_column(D, row + 3, width, i, sign, axpy(daw, 2.0 * rate, dw))
            _add_column(D, row + 3, width, nv + i, sign, axpy(saw, 2.0 * rate, sw))
            turn = (zero, zero, zero)
            for c in range(3):
                own, its = _axis(m, e, link, c, ws), _axis(m, e + 1 - 2 * side, other, c, ws)
                turn = add(turn, cross(its, cross(sw, own)))  # of the first frame: d(b x a) = b x da; else da x b
            _add_column(D, row + 3, width, i, 0.5 * rate * rate * sign, turn)
        i = load(parent, i)


@inline
def _add_column(D, row, width, column, factor, x):
    for c in range(3):
        o = (row + c) * width + column
        y = x[0] if c == 0 else x[1] if c == 1 else x[2]
        store(D, o, load(D, o) + factor * y)


@inline
def _turn_forces(m, Dq, ld, link, p, force, moment, ws):
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
            link, p, _, _, _ = _joined(m, e, q, ws)
            if link >= 0:
                sign = 1.0 - 2.0 * side
                _along(m, r, e, side, row, stiff, link, p, q, ws)
                moment = (zero, zero, zero)
                if stiff > 0:
                    moment = scaled(sign, load3(f, row + 3))
                _turn_forces(m, Dq, ld, link, p, scaled(sign, load3(f, row)), moment, ws)
        row += 6 if stiff > 0 else 3
    dof = integers(m, TREE.cam_dof)
    for k in range(m[TREE.cams]):
        i, j, o = load(dof, 2 * k), load(dof, 2 * k + LEADER), row * width
        _, slope, curvature, third = _polynomial(m, k, q)
        speed = load(v, j)
        store(D, o + i, zero + rate * rate)
        store(D, o + nv + i, zero + 2.0 * rate)
        by_q = curvature * load(a, j) + third * (speed * speed)
        by_q += (2.0 * rate) * (curvature * speed) + (rate * rate) * slope
        store(D, o + j, zero - by_q)
        store(D, o + nv + j, zero - 2.0 * (curvature * speed) - (2.0 * rate) * slope)
        store(Dq, j * ld + j, load(Dq, j * ld + j) + curvature * load(f, row))
        row += 1


@part
def close(m, r, q, W, ld, ws):
    """W becomes W - W J'N J W, and MEMORY.loop_Y = W J'N (rows, ld); for the derivatives of accelerations."""
    n, rows = m[TREE.nv], m[TREE.loop_rows]
    J, WJ, N, Y_ = (
        lanes(r, MEMORY.loop_J), lanes(r, MEMORY.loop_WJ), lanes(r, MEMORY.loop_N), lanes(r, MEMORY.loop_Y)
    )  # fmt: skip
    first, reach = integers(m, TREE.reach_start), integers(m, TREE.reach_dof)
    _constraint_rows(m, q, ws, J, ld)
    _projected(m, r, J, W, ld)
    _invert_independent(m, N, rows, lanes(r, MEMORY.loop_least))
    for k in range(rows * ld):
        store(Y_, k, spread(0.0))
    for k in range(rows):
        for l in range(rows):
            x = load(N, k * rows + l)
            for t in range(load(first, l), load(first, l + 1)):
                o = load(reach, t)
                store(Y_, k * ld + o, load(Y_, k * ld + o) + x * load(WJ, l * ld + o))
    for k in range(rows):
        for t in range(load(first, k), load(first, k + 1)):
            j = load(reach, t)
            x = load(WJ, k * ld + j)
            for i in range(n):
                store(W, j * ld + i, load(W, j * ld + i) - x * load(Y_, k * ld + i))


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
