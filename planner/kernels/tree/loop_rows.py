"""The constraints of a tree's closed chains (planner.model.couplings): their frames, couplings, rows J and J W J'."""

from __future__ import annotations

from planner.kernels.algebra.spatial import add, cross, load3, load9, rotated, scaled, store3, sub
from planner.kernels.numba.jit import inline
from planner.kernels.numba.lanes import floats, integers, lanes, load, spread, store
from planner.kernels.tree.loop_algebra import gram
from planner.kernels.tree.loop_arrays import COUPLING_SIZE, JOINED_SIZE
from planner.kernels.tree.mechanism_table import TREE
from planner.kernels.tree.memory import MEMORY
from planner.kernels.tree.recursion import PLACE, RECORD, SCREW_AXIS, TWIST

POINT, ORIGIN, AXES = 0, 3, 6  # offsets in the numbers of one of two frames that are joined, as `model` lays them out
FOLLOWER, LEADER, POWERS = 0, 1, 2  # and of a coupling
INDEPENDENT = 1e-10  # of the largest diagonal entry of J W J' for its kind of rows; rounding leaves 1e-16


@inline
def joined_frame(m, e, q, ws):
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
def frame_axis(m, e, link, c, ws):
    """Axis c of frame e in the world."""
    value, o, zero = floats(m, TREE.joined_value), JOINED_SIZE * e + AXES + 3 * c, spread(0.0)
    axis = add((zero, zero, zero), load3(value, o))
    if link >= 0:
        axis = rotated(load9(ws, link * RECORD), load3(value, o))
    return axis


@inline
def cam_polynomial(m, k, q):
    """Of coupling k at the leader's place: the value to follow, and its first three derivatives."""
    o, value = COUPLING_SIZE * k + POWERS, floats(m, TREE.coupling_value)
    leader = load(integers(m, TREE.coupling_dof), 2 * k + LEADER)
    s = load(q, load(integers(m, TREE.q_address), leader)) - load(value, COUPLING_SIZE * k + LEADER)
    c0, c1, c2, c3, c4 = load(value, o), load(value, o + 1), load(value, o + 2), load(value, o + 3), load(value, o + 4)
    zero = spread(0.0)
    p0 = c0 + s * (c1 + s * (c2 + s * (c3 + s * c4)))
    p1 = c1 + s * (2.0 * c2 + s * (3.0 * c3 + s * (4.0 * c4)))
    p2 = 2.0 * c2 + s * (6.0 * c3 + s * (12.0 * c4))
    return (
        zero + load(value, COUPLING_SIZE * k + FOLLOWER) + p0,
        zero + p1,
        zero + p2,
        zero + (6.0 * c3 + s * (24.0 * c4)),
    )


@inline
def constraint_rows(m, q, ws, J, ld):
    """J (rows, ld) of the constraints."""
    parent, rigid = integers(m, TREE.parent), integers(m, TREE.loop_rigid)
    zero, row = spread(0.0), 0
    for k in range(m[TREE.loop_rows] * ld):
        store(J, k, zero)
    for k in range(m[TREE.loops]):
        for side in range(2):
            link, p, _, _, _ = joined_frame(m, 2 * k + side, q, ws)
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
    dof = integers(m, TREE.coupling_dof)
    for k in range(m[TREE.polynomial_couplings]):
        _, slope, _, _ = cam_polynomial(m, k, q)
        store(J, row * ld + load(dof, 2 * k), zero + 1.0)
        store(J, row * ld + load(dof, 2 * k + LEADER), zero - slope)
        row += 3


@inline
def closure_residual(m, q, ws, c):
    """Phi (rows) of links that are placed: what is to be zero."""
    rigid, zero, row = integers(m, TREE.loop_rigid), spread(0.0), 0
    for k in range(m[TREE.loops]):
        first, _, x1, _, _ = joined_frame(m, 2 * k, q, ws)
        second, _, x2, _, _ = joined_frame(m, 2 * k + 1, q, ws)
        store3(c, row, sub(x1, x2))
        row += 3
        if load(rigid, k) > 0:
            turn = (zero, zero, zero)
            for e in range(3):
                turn = add(turn, cross(frame_axis(m, 2 * k + 1, second, e, ws), frame_axis(m, 2 * k, first, e, ws)))
            store3(c, row, scaled(0.5, turn))
            row += 3
    dof, address = integers(m, TREE.coupling_dof), integers(m, TREE.q_address)
    for k in range(m[TREE.polynomial_couplings]):
        value, _, _, _ = cam_polynomial(m, k, q)
        store3(c, row, (load(q, load(address, load(dof, 2 * k))) - value, zero, zero))
        row += 3


@inline
def times_rows(m, J, ld, w, c):
    """C = J w (rows)."""
    start, dof = integers(m, TREE.moved_start), integers(m, TREE.moved_dof)
    for k in range(m[TREE.triples]):
        o0, o1, o2, x, y, z = 3 * k * ld, (3 * k + 1) * ld, (3 * k + 2) * ld, spread(0.0), spread(0.0), spread(0.0)
        for t in range(load(start, k), load(start, k + 1)):
            i = load(dof, t)
            x += load(J, o0 + i) * load(w, i)
            y += load(J, o1 + i) * load(w, i)
            z += load(J, o2 + i) * load(w, i)
        store3(c, 3 * k, (x, y, z))


@inline
def projected(m, r, J, W, ld):
    """WJ = W J' (rows, ld), N the lower half of J W J' (rows, rows); W of prescribed coordinates counts as zero."""
    prescribed, start, dof = integers(m, TREE.prescribed), integers(m, TREE.moved_start), integers(m, TREE.moved_dof)
    begin, stop = integers(m, TREE.block_start), integers(m, TREE.block_stop)
    first, reach, WJ = integers(m, TREE.reach_start), integers(m, TREE.reach_dof), lanes(r, MEMORY.loop_WJ)
    zero = spread(0.0)
    for k in range(m[TREE.loop_rows] * ld):
        store(WJ, k, zero)
    for k in range(m[TREE.triples]):
        o0, o1, o2 = 3 * k * ld, (3 * k + 1) * ld, (3 * k + 2) * ld
        for t in range(load(first, k), load(first, k + 1)):
            i, x, y, z = load(reach, t), zero, zero, zero
            if load(prescribed, i) < 0:
                for s in range(load(start, k), load(start, k + 1)):
                    j = load(dof, s)
                    if load(begin, i) <= j and j < load(stop, i):
                        w = load(W, i * ld + j)
                        x += w * load(J, o0 + j)
                        y += w * load(J, o1 + j)
                        z += w * load(J, o2 + j)
            store(WJ, o0 + i, x)
            store(WJ, o1 + i, y)
            store(WJ, o2 + i, z)
    gram(m, r, WJ, J, ld, INDEPENDENT)
