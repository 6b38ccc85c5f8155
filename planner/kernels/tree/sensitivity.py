"""Exact derivatives of inverse dynamics on a tree, with the mass matrix, in one backward recursion.

The recursive sensitivities of Fig. 2 in closed form (Singh, Russell & Wensing, RA-L 2022, who allow joints of several
degrees of freedom): with I, F the composite inertia and force of the links beyond i and B their Coriolis matrix, all
in the frame of the tree's origin,

    Y_i = V_base x S_i,   Z_i = A_base x S_i + V_base x Y_i,   Sdot_i = V_body x S_i,

and for a dof i at or beyond dof j

    M_ji        = S_j' I S_i
    dtau_j/dv_i = S_j' (2 B S_i + I (Y_i + Sdot_i))          dtau_i/dv_j = S_i' (2 B S_j + I (Y_j + Sdot_j))
    dtau_j/dq_i = S_j' (2 B Y_i + I Z_i + F x* S_i)          dtau_i/dq_j = S_i' (2 B Y_j + I Z_j)

where the force term F x* S_i falls away between the axes of one ball. A pair costs two inner products.
"""

from __future__ import annotations

from planner.kernels.algebra.spatial import (  # fmt: skip
    add,
    add3,
    add6,
    axpy,
    cross,
    dot,
    load3,
    load6,
    scaled,
    store3,
    store6,
    sub,
    symmetric,
)
from planner.kernels.numba.jit import inline
from planner.kernels.numba.lanes import floats, integers, load, spread, store
from planner.kernels.tree.mechanism_table import BALL, BALL_NEXT, INERTIA_SIZE, TREE
from planner.kernels.tree.recursion import (
    ACCELERATION,
    RECORD,
    SCREW_AXIS,
    TWIST,
    moved_inertia,
    place,
    placement,
    turn,
)

# Offsets in a link's record, beside those of kernels.tree
Y, Z, YS, FIRST_MOMENT, SECOND_MOMENT, B_SYMMETRIC, MOMENTUM, FORCE = 30, 36, 42, 48, 51, 57, 63, 69
JOINT_TWIST = 75  # of a whole ball, on its first link


@inline
def _crossed(bw, bv, sw, sv):
    """Lie bracket of two twists."""
    return cross(bw, sw), add(cross(bw, sv), cross(bv, sw))


@inline
def inverse_dynamics_derivatives(m, q, v, a, ws, tau, D, ld):
    """Forces tau and their derivatives D = (dtau/da, dtau/dq, dtau/dv) at (q, v, a), without springs and damping.

    Each of D is lanes, (nv, ld) row by row; entries of unrelated links are not written and must be zero.
    """
    M, Dq, Dv = D
    n = m[TREE.nv]
    tree, kind, firsts = placement(m), integers(m, TREE.kind), integers(m, TREE.first)
    parent, base, inertia = integers(m, TREE.parent), integers(m, TREE.base), floats(m, TREE.inertia)
    armature, g = floats(m, TREE.armature), floats(m, TREE.base_acceleration)
    subtree = floats(m, TREE.subtree_mass)
    zero = spread(0.0)
    none = (zero, zero, zero)
    for i in range(n):
        turn(tree, i, q, ws)
    for i in range(n):
        R, P, sw, sv = place(tree, i, q, ws)
        b = i * RECORD
        p = load(parent, i)
        rate, acceleration = load(v, i), load(a, i)
        yw, yv, zw = none, none, none
        zv = cross((zero + load(g, 0), zero + load(g, 1), zero + load(g, 2)), sw)
        o = load(base, i) * RECORD
        if o >= 0:
            bw, bv = load3(ws, o + TWIST), load3(ws, o + TWIST + 3)
            aw, av = load3(ws, o + ACCELERATION), load3(ws, o + ACCELERATION + 3)
            yw, yv = _crossed(bw, bv, sw, sv)
            zw, zv = _crossed(aw, av, sw, sv)
            xw, xv = _crossed(bw, bv, yw, yv)
            zw, zv = add(zw, xw), add(zv, xv)
        store3(ws, b + Y, yw)
        store3(ws, b + Y + 3, yv)
        store3(ws, b + Z, zw)
        store3(ws, b + Z + 3, zv)
        if load(kind, i) == BALL:  # what all three axes do together
            x, y, z = (R[0], R[3], R[6]), (R[1], R[4], R[7]), (R[2], R[5], R[8])
            jw = axpy(axpy(scaled(rate, x), load(v, i + 1), y), load(v, i + 2), z)
            store3(ws, b + JOINT_TWIST, jw)
            store3(ws, b + JOINT_TWIST + 3, cross(P, jw))
        y2w, y2v = scaled(2.0, yw), scaled(2.0, yv)
        if load(kind, i) == BALL or load(kind, i) == BALL_NEXT:
            f = load(firsts, i) * RECORD + JOINT_TWIST
            xw, xv = _crossed(load3(ws, f), load3(ws, f + 3), sw, sv)
            y2w, y2v = add(y2w, xw), add(y2v, xv)
        store3(ws, b + YS, y2w)
        store3(ws, b + YS + 3, y2v)
        w, u = scaled(rate, sw), scaled(rate, sv)
        aw, av = axpy(scaled(acceleration, sw), rate, yw), axpy(scaled(acceleration, sv), rate, yv)
        if p >= 0:
            pb = p * RECORD
            w, u = add(w, load3(ws, pb + TWIST)), add(u, load3(ws, pb + TWIST + 3))
            aw, av = add(aw, load3(ws, pb + ACCELERATION)), add(av, load3(ws, pb + ACCELERATION + 3))
        else:
            av = (av[0] + load(g, 0), av[1] + load(g, 1), av[2] + load(g, 2))
        store3(ws, b + TWIST, w)
        store3(ws, b + TWIST + 3, u)
        store3(ws, b + ACCELERATION, aw)
        store3(ws, b + ACCELERATION + 3, av)
        mass = load(inertia, INERTIA_SIZE * i)
        if mass > 0.0:
            h, J = moved_inertia(inertia, i, R, P)
            store3(ws, b + FIRST_MOMENT, h)
            store6(ws, b + SECOND_MOMENT, J)
            f, l = axpy(cross(w, h), mass, u), add(symmetric(J, w), cross(h, u))
            store3(ws, b + MOMENTUM, l)
            store3(ws, b + MOMENTUM + 3, f)
            store3(ws, b + FORCE, add(add(symmetric(J, aw), cross(h, av)), add(cross(w, l), cross(u, f))))
            store3(ws, b + FORCE + 3, add(axpy(cross(aw, h), mass, av), cross(w, f)))
            uh = 2.0 * dot(u, h)  # the symmetric part of 2 B: w J - J w - (u h' + h u') + 2 u.h
            x0, x1, x2 = cross(w, (J[0], J[1], J[2])), cross(w, (J[1], J[3], J[4])), cross(w, (J[2], J[4], J[5]))
            store6(ws, b + B_SYMMETRIC, (
                2.0 * x0[0] - 2.0 * u[0] * h[0] + uh, x1[0] + x0[1] - u[0] * h[1] - u[1] * h[0],
                x2[0] + x0[2] - u[0] * h[2] - u[2] * h[0], 2.0 * x1[1] - 2.0 * u[1] * h[1] + uh,
                x2[1] + x1[2] - u[1] * h[2] - u[2] * h[1], 2.0 * x2[2] - 2.0 * u[2] * h[2] + uh,
            ))  # fmt: skip
        else:
            for k in range(b + FIRST_MOMENT, b + JOINT_TWIST):
                store(ws, k, zero)
    for i in range(n - 1, -1, -1):
        b = i * RECORD
        p = load(parent, i)
        h, J, B = load3(ws, b + FIRST_MOMENT), load6(ws, b + SECOND_MOMENT), load6(ws, b + B_SYMMETRIC)
        l, f = load3(ws, b + MOMENTUM), load3(ws, b + MOMENTUM + 3)
        Fn, Ff, mass = load3(ws, b + FORCE), load3(ws, b + FORCE + 3), load(subtree, i)
        if p >= 0:
            pb = p * RECORD
            add3(ws, pb + FIRST_MOMENT, h)
            add6(ws, pb + SECOND_MOMENT, J)
            add6(ws, pb + B_SYMMETRIC, B)
            add3(ws, pb + MOMENTUM, l)
            add3(ws, pb + MOMENTUM + 3, f)
            add3(ws, pb + FORCE, Fn)
            add3(ws, pb + FORCE + 3, Ff)
        sw, sv = load3(ws, b + SCREW_AXIS), load3(ws, b + SCREW_AXIS + 3)
        yw, yv = load3(ws, b + Y), load3(ws, b + Y + 3)
        zw, zv = load3(ws, b + Z), load3(ws, b + Z + 3)
        tw, tv = load3(ws, b + YS), load3(ws, b + YS + 3)
        Iw, Iv = add(symmetric(J, sw), cross(h, sv)), axpy(cross(sw, h), mass, sv)
        gw, gv = add(symmetric(J, tw), cross(h, tv)), axpy(cross(tw, h), mass, tv)
        vw = add(sub(symmetric(B, sw), cross(l, sw)), gw)
        vv = add(gv, scaled(2.0, cross(sw, f)))
        qw = add(sub(symmetric(B, yw), cross(l, yw)), add(symmetric(J, zw), cross(h, zv)))
        qv = axpy(axpy(cross(zw, h), mass, zv), 2.0, cross(yw, f))
        ow = axpy(add(symmetric(B, sw), cross(l, sw)), 2.0, cross(f, sv))  # 2 B' S_i
        store(tau, i, dot(sw, Fn) + dot(sv, Ff) + load(armature, i) * load(a, i))
        diagonal = i * ld + i
        store(M, diagonal, dot(sw, Iw) + dot(sv, Iv) + load(armature, i))
        store(Dv, diagonal, dot(sw, vw) + dot(sv, vv))
        store(Dq, diagonal, dot(sw, qw) + dot(sv, qv))
        first = load(firsts, i)
        turned = first == i  # whether the force term counts for dof j: not within a ball
        if turned:
            qw, qv = add(qw, add(cross(sw, Fn), cross(sv, Ff))), add(qv, cross(sw, Ff))
        j = p
        while j >= 0:
            if not turned and j < first:
                qw, qv = add(qw, add(cross(sw, Fn), cross(sv, Ff))), add(qv, cross(sw, Ff))
                turned = True
            jb = j * RECORD
            rw, rv = load3(ws, jb + SCREW_AXIS), load3(ws, jb + SCREW_AXIS + 3)
            ji, ij = j * ld + i, i * ld + j
            Mji = dot(rw, Iw) + dot(rv, Iv)
            store(M, ji, Mji)
            store(M, ij, Mji)
            store(Dv, ji, dot(rw, vw) + dot(rv, vv))
            store(Dq, ji, dot(rw, qw) + dot(rv, qv))
            tw, tv = load3(ws, jb + YS), load3(ws, jb + YS + 3)
            yw, zw, zv = load3(ws, jb + Y), load3(ws, jb + Z), load3(ws, jb + Z + 3)
            store(Dv, ij, dot(ow, rw) + (dot(Iw, tw) + dot(Iv, tv)))
            store(Dq, ij, dot(ow, yw) + (dot(Iw, zw) + dot(Iv, zv)))
            j = load(parent, j)


@inline
def invert(M, n, ld):
    """A symmetric positive definite M (n, ld) of lanes becomes its inverse, by n unpivoted sweeps of one triangle."""
    for k in range(n):
        d = 1.0 / load(M, k * ld + k)
        store(M, k * ld + k, -1.0 * d)
        for i in range(n):
            if i != k:
                factor = (load(M, i * ld + k) if i > k else load(M, k * ld + i)) * d
                for j in range(min(i + 1, k)):
                    store(M, i * ld + j, load(M, i * ld + j) - factor * load(M, k * ld + j))
                for j in range(k + 1, i + 1):
                    store(M, i * ld + j, load(M, i * ld + j) - factor * load(M, j * ld + k))
        for i in range(k):
            store(M, k * ld + i, load(M, k * ld + i) * d)
        for i in range(k + 1, n):
            store(M, i * ld + k, load(M, i * ld + k) * d)
    for i in range(n):
        for j in range(i + 1):
            x = -1.0 * load(M, i * ld + j)
            store(M, i * ld + j, x)
            store(M, j * ld + i, x)
