"""The end of a stage of RK4 goes back onto the closed chains: what integration has opened them by is taken away.

By one step of Newton's, the smallest that closes the chains to first order, then for the velocities, with J at either,

    q+ = q + delta,   delta = -J'N phi,       v+ = v - J'N J v,       N = (J J')^-1

Rows are left out of N as in kernels.tree.loop_algebra, but sooner: near a singular pose such steps would be long.
Columns of prescribed coordinates count as zero, and coupled ones move with those that they follow: J is J G in N and
where a step is made of it, v = G times that of the independent ones. With d(J'f)/dq = H of a constant f, d(J w)/dq = D
of a constant w, and (f, w) = (N phi, delta) and (N J v, v+),

    d delta = -G (G'H + G'J'N (dphi/dq + D - J G G'H)) dq,
    dv+     = (1 - G G'J'N J) dv - G (G'H + G'J'N (D - J G G'H)) dq+
"""

from __future__ import annotations

from planner.kernels.algebra.spatial import add, add3, cross, load3, scaled, store3
from planner.kernels.numba.jit import inline, part
from planner.kernels.numba.lanes import floats, integers, lanes, load, spread, store
from planner.kernels.tree.loop_algebra import gram, invert_independent, solve, subtract, times_inverse
from planner.kernels.tree.loop_derivatives import add_column, turn_forces
from planner.kernels.tree.loop_rows import (
    LEADER,
    cam_polynomial,
    closure_residual,
    constraint_rows,
    frame_axis,
    joined_frame,
    times_rows,
)
from planner.kernels.tree.mechanism_table import TREE
from planner.kernels.tree.memory import MEMORY
from planner.kernels.tree.recursion import RECORD, SCREW_AXIS, TWIST, place_all
from planner.kernels.tree.sensitivity import Y

INDEPENDENT = 1e-6  # of the largest diagonal entry of J J' for positions, rotations and couplings
POSITIONS, VELOCITIES = 0, 1


@inline
def _turn_with(m, w, ws):
    """Twists and Y (kernels.tree.sensitivity) at velocities w, of links that are placed."""
    parent, base, zero = integers(m, TREE.parent), integers(m, TREE.base), spread(0.0)
    for i in range(m[TREE.nv]):
        b, p, o = i * RECORD, load(parent, i), load(base, i) * RECORD
        sw, sv = load3(ws, b + SCREW_AXIS), load3(ws, b + SCREW_AXIS + 3)
        yw, yv = (zero, zero, zero), (zero, zero, zero)
        if o >= 0:
            bw, bv = load3(ws, o + TWIST), load3(ws, o + TWIST + 3)
            yw, yv = cross(bw, sw), add(cross(bw, sv), cross(bv, sw))
        store3(ws, b + Y, yw)
        store3(ws, b + Y + 3, yv)
        store3(ws, b + TWIST, scaled(load(w, i), sw))
        store3(ws, b + TWIST + 3, scaled(load(w, i), sv))
        if p >= 0:
            add3(ws, b + TWIST, load3(ws, p * RECORD + TWIST))
            add3(ws, b + TWIST + 3, load3(ws, p * RECORD + TWIST + 3))


@inline
def _fold(m, X, count, row, column):
    """Row vectors x' of X become x'G: `count` of them, a `row` apart, with entries a `column` apart."""
    prescribed, zero = integers(m, TREE.prescribed), spread(0.0)
    dof, start = integers(m, TREE.dependent_dof), integers(m, TREE.dependent_start)
    follows, value = integers(m, TREE.dependent_column), floats(m, TREE.dependent_value)
    for i in range(m[TREE.nv]):
        if load(prescribed, i) >= 0:
            for k in range(count):
                store(X, k * row + i * column, zero)
    for c in range(m[TREE.dependents]):
        d = load(dof, c) * column
        for k in range(count):
            x = load(X, k * row + d)
            for t in range(load(start, c), load(start, c + 1)):
                o = k * row + load(follows, t) * column
                store(X, o, load(X, o) + load(value, t) * x)
            store(X, k * row + d, zero)


@inline
def _unfold(m, X, count, row, column):
    """Vectors x of independent coordinates become G x."""
    dof, start = integers(m, TREE.dependent_dof), integers(m, TREE.dependent_start)
    follows, value = integers(m, TREE.dependent_column), floats(m, TREE.dependent_value)
    for c in range(m[TREE.dependents]):
        for k in range(count):
            total = spread(0.0)
            for t in range(load(start, c), load(start, c + 1)):
                total += load(value, t) * load(X, k * row + load(follows, t) * column)
            store(X, k * row + load(dof, c) * column, total)


@inline
def _back(m, J, ld, f, step):
    """The step G J'f (nv) of a folded J."""
    first, moved = integers(m, TREE.moved_start), integers(m, TREE.moved_dof)
    for i in range(m[TREE.nv]):
        store(step, i, spread(0.0))
    for k in range(m[TREE.triples]):
        o0, o1, o2 = 3 * k * ld, (3 * k + 1) * ld, (3 * k + 2) * ld
        x, y, z = load3(f, 3 * k)
        for t in range(load(first, k), load(first, k + 1)):
            i = load(moved, t)
            store(step, i, load(step, i) + (load(J, o0 + i) * x + load(J, o1 + i) * y + load(J, o2 + i) * z))
    _unfold(m, step, 1, 0, 1)


@inline
def _open(m, r, q, v, which, whole):
    """J, folded, its N, and in loop_c what is open: phi, or J v. `whole` (rows, ld), if not None, is J as it was."""
    ws, J, ld = lanes(r, MEMORY.links), lanes(r, MEMORY.loop_J), r[MEMORY.ld]
    place_all(m, q, ws)
    constraint_rows(m, q, ws, J, ld)
    if which == POSITIONS:
        closure_residual(m, q, ws, lanes(r, MEMORY.loop_c))
    else:
        times_rows(m, J, ld, v, lanes(r, MEMORY.loop_c))
    if whole is not None:
        for k in range(m[TREE.loop_rows] * ld):
            store(whole, k, load(J, k))
    _fold(m, J, m[TREE.loop_rows], ld, 1)
    gram(m, r, J, J, ld, INDEPENDENT)


@part
def project_to_closure(m, r, q, v, which, step):
    """The step (nv) of positions, or of velocities v, that closes the chains at q."""
    f = lanes(r, MEMORY.loop_f)
    _open(m, r, q, v, which, None)
    solve(m, r, lanes(r, MEMORY.loop_c), f)
    _back(m, lanes(r, MEMORY.loop_J), r[MEMORY.ld], f, step)


@inline
def _along(m, r, e, side, row, rigid, which, q, ws):
    """Add what frame e of a loop has in D, and in dphi/dq where it is for positions."""
    parent, D, width, sign = integers(m, TREE.parent), lanes(r, MEMORY.loop_D), r[MEMORY.loop_width], 1.0 - 2.0 * side
    link, p, _, w, _ = joined_frame(m, e, q, ws)
    other, zero = load(integers(m, TREE.joined_link), e + 1 - 2 * side), spread(0.0)
    u = load3(ws, link * RECORD + TWIST + 3)
    i = link
    while i >= 0:
        o = i * RECORD
        sw, sv = load3(ws, o + SCREW_AXIS), load3(ws, o + SCREW_AXIS + 3)
        dp = add(sv, cross(sw, p))
        dw = add(cross(sw, w), load3(ws, o + Y))
        du = add(add(cross(sw, u), cross(sv, w)), load3(ws, o + Y + 3))
        moves = add(add(du, cross(dw, p)), cross(w, dp))
        add_column(D, row, width, i, sign, add(moves, dp) if which == POSITIONS else moves)
        if rigid > 0:
            add_column(D, row + 3, width, i, sign, dw)
            if which == POSITIONS:
                turn = (zero, zero, zero)
                for c in range(3):
                    own, its = frame_axis(m, e, link, c, ws), frame_axis(m, e + 1 - 2 * side, other, c, ws)
                    turn = add(turn, cross(its, cross(sw, own)))
                add_column(D, row + 3, width, i, 0.5 * sign, turn)
        i = load(parent, i)


@inline
def _rates(m, r, q, w, which, H, ld, ws):
    """D (rows, loop_width) with dphi/dq for positions, and -H (nv, ld) of f in loop_f, of links that moved with w."""
    nv, rigid, row, width = m[TREE.nv], integers(m, TREE.loop_rigid), 0, r[MEMORY.loop_width]
    D, f, zero = lanes(r, MEMORY.loop_D), lanes(r, MEMORY.loop_f), spread(0.0)
    for k in range(m[TREE.loop_rows] * width):
        store(D, k, zero)
    for k in range(nv * ld):
        store(H, k, zero)
    for k in range(m[TREE.loops]):
        stiff = load(rigid, k)
        for side in range(2):
            e, sign = 2 * k + side, 1.0 - 2.0 * side
            link, p, _, _, _ = joined_frame(m, e, q, ws)
            if link >= 0:
                _along(m, r, e, side, row, stiff, which, q, ws)
                moment = (zero, zero, zero)
                if stiff > 0:
                    moment = scaled(sign, load3(f, row + 3))
                turn_forces(m, H, ld, link, p, scaled(sign, load3(f, row)), moment, ws)
        row += 6 if stiff > 0 else 3
    dof = integers(m, TREE.coupling_dof)
    for k in range(m[TREE.polynomial_couplings]):
        i, j, o = load(dof, 2 * k), load(dof, 2 * k + LEADER), row * width
        _, slope, curvature, _ = cam_polynomial(m, k, q)
        store(D, o + j, zero - curvature * load(w, j))
        if which == POSITIONS:
            store(D, o + i, zero + 1.0)
            store(D, o + j, load(D, o + j) - slope)
        store(H, j * ld + j, load(H, j * ld + j) + curvature * load(f, row))
        row += 3


@inline
def _add_turned(m, r, H, D):
    """D (rows, loop_width) plus J H of a folded J and H (nv, ld), which is zero but within blocks."""
    first, moved = integers(m, TREE.moved_start), integers(m, TREE.moved_dof)
    begin, stop = integers(m, TREE.block_start), integers(m, TREE.block_stop)
    J, ld, width = lanes(r, MEMORY.loop_J), r[MEMORY.ld], r[MEMORY.loop_width]
    for k in range(m[TREE.triples]):
        d0, d1, d2 = 3 * k * width, (3 * k + 1) * width, (3 * k + 2) * width
        for t in range(load(first, k), load(first, k + 1)):
            i = load(moved, t)
            o = 3 * k * ld + i
            x, y, z = load(J, o), load(J, o + ld), load(J, o + 2 * ld)
            for j in range(load(begin, i), load(stop, i)):
                h = load(H, i * ld + j)
                store(D, d0 + j, load(D, d0 + j) + x * h)
                store(D, d1 + j, load(D, d1 + j) + y * h)
                store(D, d2 + j, load(D, d2 + j) + z * h)


@part
def step_derivatives(m, r, q, v, which, step, E):
    """Take the step of project_to_closure in v; write E (nv, columns), its derivatives by (u | q | v | act)."""
    nv, rows, ld, columns, at_q = m[TREE.nv], m[TREE.loop_rows], r[MEMORY.ld], r[MEMORY.columns], r[MEMORY.first]
    ws, J, N, H = lanes(r, MEMORY.links), lanes(r, MEMORY.loop_J), lanes(r, MEMORY.loop_N), lanes(r, MEMORY.Dq)
    c, f, D, width = lanes(r, MEMORY.loop_c), lanes(r, MEMORY.loop_f), lanes(r, MEMORY.loop_D), r[MEMORY.loop_width]
    whole, Y_, zero = lanes(r, MEMORY.loop_WJ), lanes(r, MEMORY.loop_Y), spread(0.0)
    lists = integers(m, TREE.moved_start), integers(m, TREE.moved_dof)
    _open(m, r, q, v, which, whole)
    invert_independent(m, r)
    for k in range(rows):
        total = zero
        for l in range(rows):
            total -= load(N, k * rows + l) * load(c, l)
        store(f, k, total)
    _back(m, J, ld, f, step)
    for k in range(rows):
        store(f, k, 0.0 - load(f, k))
    if which == POSITIONS:
        _turn_with(m, step, ws)
        _rates(m, r, q, step, which, H, ld, ws)
    else:
        for i in range(nv):
            store(v, i, load(v, i) + load(step, i))
        _turn_with(m, v, ws)
        _rates(m, r, q, v, which, H, ld, ws)
    _fold(m, H, nv, 1, ld)
    for i in range(nv):
        for j in range(columns):
            store(E, i * columns + j, zero)
        for j in range(nv):
            store(E, i * columns + at_q + j, load(H, i * ld + j))
    _add_turned(m, r, H, D)
    times_inverse(m, r, D, width, Y_, ld)
    subtract(m, lists, J, Y_, ld, E, (columns, at_q), False)
    if which == VELOCITIES:
        times_inverse(m, r, whole, ld, Y_, ld)
        subtract(m, lists, J, Y_, ld, E, (columns, at_q + nv), False)
    _unfold(m, E, columns, 1, columns)
