"""Accelerations of a tree with closed chains (planner.model.couplings), four knots at a time.

With W in place of M^-1 (kernels.tree.couplings), the accelerations a0 that the tree would have, and c = J a0 + Jdot qd
+ 2 rate phidot + rate^2 phi what they lack of the constraints,

    f = -N c,   qdd = a0 + W J'f,   N = (J W J')^-1
"""

from __future__ import annotations

from planner.kernels.algebra.spatial import add, axpy, cross, load3, store3, sub
from planner.kernels.numba.jit import inline, part
from planner.kernels.numba.lanes import floats, integers, lanes, load, spread, store
from planner.kernels.tree.couplings import hold_prescribed, invert_coupled, mass_and_rest
from planner.kernels.tree.loop_algebra import solve
from planner.kernels.tree.loop_rows import LEADER, cam_polynomial, constraint_rows, frame_axis, joined_frame, projected
from planner.kernels.tree.mechanism_table import TREE
from planner.kernels.tree.memory import MEMORY
from planner.kernels.tree.recursion import ACCELERATION, RECORD


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
def _lacks(m, q, v, ws, c):
    """C = Jdot qd + 2 rate phidot + rate^2 phi, and J a of prescribed coordinates, from the links' accelerations."""
    rigid, row, rate = integers(m, TREE.loop_rigid), 0, load(floats(m, TREE.loop_rate), 0)
    zero = spread(0.0)
    for k in range(m[TREE.loops]):
        total, turning, turn = (zero, zero, zero), (zero, zero, zero), (zero, zero, zero)
        links = load(integers(m, TREE.joined_link), 2 * k), load(integers(m, TREE.joined_link), 2 * k + 1)
        for side in range(2):
            link, p, x, w, u = joined_frame(m, 2 * k + side, q, ws)
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
                turn = add(
                    turn, cross(frame_axis(m, 2 * k + 1, links[1], e, ws), frame_axis(m, 2 * k, links[0], e, ws))
                )
            store3(c, row, axpy(turning, 0.5 * rate * rate, turn))
            row += 3
    dof, address = integers(m, TREE.coupling_dof), integers(m, TREE.q_address)
    for k in range(m[TREE.polynomial_couplings]):
        i, j = load(dof, 2 * k), load(dof, 2 * k + LEADER)
        value, slope, curvature, _ = cam_polynomial(m, k, q)
        speed = load(v, j)
        phi, phid = load(q, load(address, i)) - value, load(v, i) - slope * speed
        lacks = (2.0 * rate) * phid + (rate * rate) * phi - curvature * (speed * speed)
        store3(c, row, (lacks, zero, zero))
        row += 3


@part
def accelerate_closed(m, r, q, v, forces, a, ws, armature, f):
    """Accelerations a (nv) under forces (nv), and the constraints' f, of links that move_links has seen.

    armature (nv) is floats or lanes.
    """
    n, prescribed, c, zero = m[TREE.nv], integers(m, TREE.prescribed), lanes(r, MEMORY.loop_c), spread(0.0)
    rest, M, ld = lanes(r, MEMORY.rest), lanes(r, MEMORY.M), r[MEMORY.ld]
    J, WJ, start = lanes(r, MEMORY.loop_J), lanes(r, MEMORY.loop_WJ), integers(m, TREE.block_start)
    first, reach, stop = integers(m, TREE.reach_start), integers(m, TREE.reach_dof), integers(m, TREE.block_stop)
    for i in range(n):
        store(rest, i, load(forces, i))
    mass_and_rest(m, rest, a, ws, armature, M, ld)
    _lacks(m, q, v, ws, c)
    for p in range(n):
        if load(prescribed, p) >= 0:
            store(rest, p, zero)
    hold_prescribed(m, M, ld)
    invert_coupled(m, M, ld)
    constraint_rows(m, q, ws, J, ld)
    projected(m, r, J, M, ld)
    for k in range(m[TREE.triples]):
        o0, o1, o2 = 3 * k * ld, (3 * k + 1) * ld, (3 * k + 2) * ld
        x, y, z = load3(c, 3 * k)
        for t in range(load(first, k), load(first, k + 1)):
            i = load(reach, t)
            x += load(WJ, o0 + i) * load(rest, i)
            y += load(WJ, o1 + i) * load(rest, i)
            z += load(WJ, o2 + i) * load(rest, i)
        store3(c, 3 * k, (x, y, z))
    solve(m, r, c, f)
    for i in range(n):
        if load(prescribed, i) < 0:
            total = zero
            for j in range(load(start, i), load(stop, i)):
                total += load(M, i * ld + j) * load(rest, j)
            store(a, i, total)
    for k in range(m[TREE.triples]):  # columns of prescribed coordinates are zero
        o0, o1, o2 = 3 * k * ld, (3 * k + 1) * ld, (3 * k + 2) * ld
        x, y, z = load3(f, 3 * k)
        for t in range(load(first, k), load(first, k + 1)):
            i = load(reach, t)
            store(a, i, load(a, i) + (load(WJ, o0 + i) * x + load(WJ, o1 + i) * y + load(WJ, o2 + i) * z))
