"""Accelerations of a tree with couplings, four knots at a time: see planner.model.couplings.

    qdd = W (tau - h),   W = G (G' M G)^-1 G',   G: the dependent coordinates follow the independent ones

with M by composite inertias and h by Fig. 2's recursion, both in the frame of the tree's origin. `condense` makes
G' M G in place, in the rows and columns of the independent coordinates, and `expand` makes W of its inverse: the
derivatives of accelerations have W where those of a tree have M^-1. What constrains a tree otherwise (closed chains)
acts on M and h too.
"""

from __future__ import annotations

from planner.kernels.algebra.spatial import add, add3, add6, axpy, dot, load3, load6, scaled, store3, symmetric
from planner.kernels.numba.jit import inline, part
from planner.kernels.numba.lanes import at, floats, integers, lanes, load, spread, store
from planner.kernels.tree.mechanism_table import TREE
from planner.kernels.tree.memory import MEMORY
from planner.kernels.tree.recursion import ACCELERATION, ARTICULATED, BIAS, CORIOLIS, RECORD, SCREW_AXIS
from planner.kernels.tree.sensitivity import invert


@inline
def _times(ws, k, w, v):
    """An inertia's product with a twist; it lies at k as J (6) | H (9) | the linear block (6)."""
    J, L = load6(ws, k), load6(ws, k + 15)
    H0, H1, H2 = load3(ws, k + 6), load3(ws, k + 9), load3(ws, k + 12)
    moment = add(symmetric(J, w), (dot(H0, v), dot(H1, v), dot(H2, v)))
    return moment, add(symmetric(L, v), axpy(axpy(scaled(w[0], H0), w[1], H1), w[2], H2))


@part
def mass_and_rest(m, tau, a, ws, armature, M, ld):
    """The mass matrix M (nv, ld), and tau (nv) less h, of links that move_links has seen.

    h has what prescribed accelerations (entries of a) take.
    """
    n = m[TREE.nv]
    parent, g = integers(m, TREE.parent), floats(m, TREE.base_acceleration)
    prescribed = integers(m, TREE.prescribed)
    zero = spread(0.0)
    for k in range(n * ld):
        store(M, k, zero)
    for i in range(n):
        b = i * RECORD
        p = load(parent, i)
        if p >= 0:
            pb = p * RECORD + ACCELERATION
            aw, av = add(load3(ws, pb), load3(ws, b + CORIOLIS)), add(load3(ws, pb + 3), load3(ws, b + CORIOLIS + 3))
        else:  # gravity, as an acceleration of the base
            aw, av = (zero, zero, zero), (zero + load(g, 0), zero + load(g, 1), zero + load(g, 2))
        if load(prescribed, i) >= 0:
            aw = axpy(aw, load(a, i), load3(ws, b + SCREW_AXIS))
            av = axpy(av, load(a, i), load3(ws, b + SCREW_AXIS + 3))
        store3(ws, b + ACCELERATION, aw)
        store3(ws, b + ACCELERATION + 3, av)
        Fn, Ff = _times(ws, b + ARTICULATED, aw, av)
        add3(ws, b + BIAS, Fn)
        add3(ws, b + BIAS + 3, Ff)
    for i in range(n - 1, -1, -1):
        b = i * RECORD
        p = load(parent, i)
        sw, sv = load3(ws, b + SCREW_AXIS), load3(ws, b + SCREW_AXIS + 3)
        Fn, Ff = load3(ws, b + BIAS), load3(ws, b + BIAS + 3)
        store(tau, i, load(tau, i) - dot(sw, Fn) - dot(sv, Ff))
        Iw, Iv = _times(ws, b + ARTICULATED, sw, sv)
        store(M, i * ld + i, dot(sw, Iw) + dot(sv, Iv) + load(armature, i))
        j = p
        while j >= 0:
            jb = j * RECORD + SCREW_AXIS
            x = dot(load3(ws, jb), Iw) + dot(load3(ws, jb + 3), Iv)
            store(M, j * ld + i, x)
            store(M, i * ld + j, x)
            j = load(parent, j)
        if p >= 0:
            pb, k = p * RECORD, b + ARTICULATED
            add3(ws, pb + BIAS, Fn)
            add3(ws, pb + BIAS + 3, Ff)
            pb += ARTICULATED
            add6(ws, pb, load6(ws, k))
            add3(ws, pb + 6, load3(ws, k + 6))
            add3(ws, pb + 9, load3(ws, k + 9))
            add3(ws, pb + 12, load3(ws, k + 12))
            add6(ws, pb + 15, load6(ws, k + 15))


@inline
def condense(m, M, ld):
    """M (nv, ld) becomes G' M G, and the identity in rows and columns of dependent coordinates."""
    n = m[TREE.nv]
    dof, start = integers(m, TREE.dependent_dof), integers(m, TREE.dependent_start)
    column, value = integers(m, TREE.dependent_column), floats(m, TREE.dependent_value)
    for c in range(m[TREE.dependents]):
        d = load(dof, c)
        for t in range(load(start, c), load(start, c + 1)):
            i, x = load(column, t), load(value, t)
            for j in range(n):
                store(M, i * ld + j, load(M, i * ld + j) + x * load(M, d * ld + j))
            for j in range(n):
                store(M, j * ld + i, load(M, j * ld + i) + x * load(M, j * ld + d))
        for j in range(n):
            store(M, d * ld + j, spread(0.0))
            store(M, j * ld + d, spread(0.0))
        store(M, d * ld + d, spread(1.0))


@inline
def expand(m, M, ld):
    """The inverse of what `condense` made becomes W."""
    n = m[TREE.nv]
    dof, start = integers(m, TREE.dependent_dof), integers(m, TREE.dependent_start)
    column, value = integers(m, TREE.dependent_column), floats(m, TREE.dependent_value)
    for c in range(m[TREE.dependents]):
        d = load(dof, c)
        store(M, d * ld + d, spread(0.0))
        for t in range(load(start, c), load(start, c + 1)):
            i, x = load(column, t), load(value, t)
            for j in range(n):
                store(M, d * ld + j, load(M, d * ld + j) + x * load(M, i * ld + j))
            for j in range(n):
                store(M, j * ld + d, load(M, j * ld + d) + x * load(M, j * ld + i))


@inline
def invert_coupled(m, M, ld):
    """M (nv, ld) becomes W, the inverse where nothing is coupled."""
    stop, i = integers(m, TREE.block_stop), 0
    condense(m, M, ld)
    while i < m[TREE.nv]:  # block by block
        invert(at(M, i * ld + i), load(stop, i) - i, ld)
        i = load(stop, i)
    expand(m, M, ld)


@inline
def hold_prescribed(m, M, ld):
    """Rows and columns of prescribed coordinates become those of the identity."""
    n, prescribed, zero = m[TREE.nv], integers(m, TREE.prescribed), spread(0.0)
    for p in range(n):
        if load(prescribed, p) >= 0:
            for i in range(n):
                store(M, i * ld + p, zero)
                store(M, p * ld + i, zero)
            store(M, p * ld + p, zero + 1.0)


@part
def accelerate_coupled(m, r, forces, a, ws, armature):
    """Accelerations a (nv) under forces (nv), of links that move_links has seen; armature (nv) is floats or lanes."""
    n, prescribed = m[TREE.nv], integers(m, TREE.prescribed)
    tau, M, ld = lanes(r, MEMORY.rest), lanes(r, MEMORY.M), r[MEMORY.ld]
    for i in range(n):
        store(tau, i, load(forces, i))
    mass_and_rest(m, tau, a, ws, armature, M, ld)
    zero = spread(0.0)
    hold_prescribed(m, M, ld)
    invert_coupled(m, M, ld)
    for i in range(n):
        if load(prescribed, i) < 0:
            total = zero
            for j in range(n):
                if load(prescribed, j) < 0:
                    total += load(M, i * ld + j) * load(tau, j)
            store(a, i, total)
