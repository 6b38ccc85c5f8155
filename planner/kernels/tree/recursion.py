"""Where the links of a tree are, and how they accelerate: Fig. 2's recursions in the frame of the tree's origin.

Expressed in one fixed frame, composite inertias and forces are plain sums and no 6x6 transformation is needed: the
work is linear in the number of links (forward dynamics: Featherstone's articulated bodies, the paper's [21]). Twists,
screws and wrenches are (angular, linear) at the origin. All entries are V4: four knots or candidates at once.

Every link has a record of RECORD entries in the scratch memory `ws`.
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
    rotated,
    row_times,
    scaled,
    store3,
    store6,
    symmetric,
)
from planner.kernels.numba.jit import inline, part
from planner.kernels.numba.lane_math import sincos
from planner.kernels.numba.lanes import floats, integers, load, spread, store
from planner.kernels.tree.mechanism_table import BALL, BALL_NEXT, HOME_SIZE, INERTIA_SIZE, TREE

RECORD = 88
# Offsets in a record; the second group is the forward dynamics' own.
ROTATION, PLACE, SCREW_AXIS, TWIST, ACCELERATION = 0, 9, 12, 18, 24
CORIOLIS, ARTICULATED, BIAS, U_SCREW, PIVOT, REST_FORCE = 30, 36, 57, 63, 69, 70


@inline
def quaternion_rows(w, x, y, z):
    """The rows of the rotation of a quaternion, which need not be normalized."""
    s = 2.0 / (w * w + x * x + y * y + z * z)
    return (
        (1.0 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)),
        (s * (x * y + w * z), 1.0 - s * (x * x + z * z), s * (y * z - w * x)),
        (s * (x * z - w * y), s * (y * z + w * x), 1.0 - s * (x * x + y * y)),
    )


@inline
def placement(m):
    """The arrays that `place` reads."""
    integer = integers(m, TREE.parent), integers(m, TREE.kind), integers(m, TREE.first), integers(m, TREE.q_address)
    return integer, floats(m, TREE.home)


@inline
def turn(tree, i, q, ws):
    """Sine and cosine of joint i to where `place` reads them: all joints first, as these wait for no other link."""
    (_, kind, _, q_address), home = tree
    if load(kind, i) != BALL and load(kind, i) != BALL_NEXT:
        s, c = sincos(load(home, i * HOME_SIZE + 12) * load(q, load(q_address, i)))
        store(ws, i * RECORD + ROTATION, s)
        store(ws, i * RECORD + ROTATION + 1, c)


@inline
def place(tree, i, q, ws):
    """Pose and screw of link i of a tree's `placement`, stored; returns rotation, position and the screw's halves.

    It reads what `turn` has left in the link's record, and its parent's pose.
    """
    (parent, kind, first, q_address), home = tree
    b, p, k, own = i * RECORD, load(parent, i), load(kind, i), i * HOME_SIZE
    pb = p * RECORD
    if k == BALL_NEXT:
        R0, R1, R2, P = load3(ws, pb), load3(ws, pb + 3), load3(ws, pb + 6), load3(ws, pb + PLACE)
        sw = (R0[1], R1[1], R2[1]) if i - load(first, i) == 1 else (R0[2], R1[2], R2[2])
        sv = cross(P, sw)
    else:
        h0, h1, h2, t = load3(home, own), load3(home, own + 3), load3(home, own + 6), load3(home, own + 9)
        if p >= 0:
            r0, r1, r2, pp = load3(ws, pb), load3(ws, pb + 3), load3(ws, pb + 6), load3(ws, pb + PLACE)
            H0, H1, H2 = row_times(r0, h0, h1, h2), row_times(r1, h0, h1, h2), row_times(r2, h0, h1, h2)
            P = (pp[0] + dot(r0, t), pp[1] + dot(r1, t), pp[2] + dot(r2, t))
        else:
            zero = spread(0.0)
            H0, H1, H2 = add((zero, zero, zero), h0), add((zero, zero, zero), h1), add((zero, zero, zero), h2)
            P = add((zero, zero, zero), t)
        a = load(q_address, i)
        if k == BALL:
            r0, r1, r2 = quaternion_rows(load(q, a), load(q, a + 1), load(q, a + 2), load(q, a + 3))
            R0, R1, R2 = row_times(H0, r0, r1, r2), row_times(H1, r0, r1, r2), row_times(H2, r0, r1, r2)
            sw = (R0[0], R1[0], R2[0])
            sv = cross(P, sw)
        else:
            x, z = load(q, a), (H0[2], H1[2], H2[2])
            turned, shift = load(home, own + 12), load(home, own + 13)
            s, c = load(ws, b + ROTATION), load(ws, b + ROTATION + 1)
            R0 = (c * H0[0] + s * H0[1], c * H0[1] - s * H0[0], z[0])
            R1 = (c * H1[0] + s * H1[1], c * H1[1] - s * H1[0], z[1])
            R2 = (c * H2[0] + s * H2[1], c * H2[1] - s * H2[0], z[2])
            P = axpy(P, load(home, own + 14) * x, z)
            sw = scaled(turned, z)
            sv = axpy(cross(P, sw), shift, z)
    store3(ws, b, R0)
    store3(ws, b + 3, R1)
    store3(ws, b + 6, R2)
    store3(ws, b + PLACE, P)
    store3(ws, b + SCREW_AXIS, sw)
    store3(ws, b + SCREW_AXIS + 3, sv)
    return (R0[0], R0[1], R0[2], R1[0], R1[1], R1[2], R2[0], R2[1], R2[2]), P, sw, sv


@inline
def moved_inertia(inertia, i, R, P):
    """First moment and second moment of link i about the origin."""
    o = INERTIA_SIZE * i
    m, largest = load(inertia, o), load(inertia, o + 4)
    c = add(P, rotated(R, (load(inertia, o + 1), load(inertia, o + 2), load(inertia, o + 3))))
    a = rotated(R, (load(inertia, o + 5), load(inertia, o + 6), load(inertia, o + 7)))
    b = rotated(R, (load(inertia, o + 8), load(inertia, o + 9), load(inertia, o + 10)))
    h = scaled(m, c)
    t = dot(h, c) + largest
    return h, (
        t - h[0] * c[0] - a[0] * a[0] - b[0] * b[0], spread(0.0) - h[0] * c[1] - a[0] * a[1] - b[0] * b[1],
        spread(0.0) - h[0] * c[2] - a[0] * a[2] - b[0] * b[2], t - h[1] * c[1] - a[1] * a[1] - b[1] * b[1],
        spread(0.0) - h[1] * c[2] - a[1] * a[2] - b[1] * b[2], t - h[2] * c[2] - a[2] * a[2] - b[2] * b[2],
    )  # fmt: skip


@part
def place_all(m, q, ws):
    """Poses and screws of all links."""
    tree = placement(m)
    for i in range(m[TREE.nv]):
        turn(tree, i, q, ws)
    for i in range(m[TREE.nv]):
        place(tree, i, q, ws)


@part
def move_links(m, q, v, ws):
    """Forward dynamics' way out: poses, twists, and each link's own inertia and bias force."""
    n = m[TREE.nv]
    tree, inertia = placement(m), floats(m, TREE.inertia)
    parent, base = integers(m, TREE.parent), integers(m, TREE.base)
    zero = spread(0.0)
    none = (zero, zero, zero)
    for i in range(n):
        turn(tree, i, q, ws)
    for i in range(n):
        R, P, sw, sv = place(tree, i, q, ws)
        b = i * RECORD
        p = load(parent, i)
        rate = load(v, i)
        w, u = scaled(rate, sw), scaled(rate, sv)
        if p >= 0:
            o = load(base, i) * RECORD + TWIST  # V_base x S qd: the screw is carried by what it moves on
            cw, cv = none, none
            if load(base, i) >= 0:
                bw, bv = load3(ws, o), load3(ws, o + 3)
                cw, cv = cross(bw, w), add(cross(bw, u), cross(bv, w))
            store3(ws, b + CORIOLIS, cw)
            store3(ws, b + CORIOLIS + 3, cv)
            w, u = add(w, load3(ws, p * RECORD + TWIST)), add(u, load3(ws, p * RECORD + TWIST + 3))
        store3(ws, b + TWIST, w)
        store3(ws, b + TWIST + 3, u)
        mass = load(inertia, INERTIA_SIZE * i)
        if mass > 0.0:
            h, J = moved_inertia(inertia, i, R, P)
            f = axpy(cross(w, h), mass, u)
            moment = add(symmetric(J, w), cross(h, u))
            store3(ws, b + BIAS, add(cross(w, moment), cross(u, f)))
            store3(ws, b + BIAS + 3, cross(w, f))
            k = b + ARTICULATED  # J (6) | H = hat(h) (9) | the linear block (6)
            store6(ws, k, J)
            store3(ws, k + 6, (zero, -1.0 * h[2], h[1]))
            store3(ws, k + 9, (h[2], zero, -1.0 * h[0]))
            store3(ws, k + 12, (-1.0 * h[1], h[0], zero))
            store6(ws, k + 15, (zero + mass, zero, zero, zero + mass, zero, zero + mass))
        else:
            for k in range(b + ARTICULATED, b + BIAS + 6):
                store(ws, k, zero)


@part
def accelerate(m, tau, a, ws, armature, reaction):
    """Accelerations from forces (Fig. 2, right; the paper's Case 3 where accelerations are prescribed).

    The way back and out again, of links that move_links has seen. tau (nv) and a (nv) are lanes, armature (nv) may be.
    tau is the whole applied force, a prescribed joint's entry of a is read and, with `reaction`, its entry of tau
    becomes the force that it takes.
    """
    n = m[TREE.nv]
    parent, g = integers(m, TREE.parent), floats(m, TREE.base_acceleration)
    prescribed = integers(m, TREE.prescribed)
    zero = spread(0.0)
    none = (zero, zero, zero)
    for i in range(n - 1, -1, -1):
        b = i * RECORD
        p = load(parent, i)
        k = b + ARTICULATED
        sw, sv = load3(ws, b + SCREW_AXIS), load3(ws, b + SCREW_AXIS + 3)
        J, L = load6(ws, k), load6(ws, k + 15)
        H0, H1, H2 = load3(ws, k + 6), load3(ws, k + 9), load3(ws, k + 12)
        bw, bv = load3(ws, b + BIAS), load3(ws, b + BIAS + 3)
        Uw = add(symmetric(J, sw), (dot(H0, sv), dot(H1, sv), dot(H2, sv)))
        Uv = add(symmetric(L, sv), axpy(axpy(scaled(sw[0], H0), sw[1], H1), sw[2], H2))
        store3(ws, b + U_SCREW, Uw)
        store3(ws, b + U_SCREW + 3, Uv)
        moves = load(prescribed, i) < 0
        D = zero
        u = zero
        if moves:
            D = 1.0 / (dot(sw, Uw) + dot(sv, Uv) + load(armature, i))
            u = load(tau, i) - dot(sw, bw) - dot(sv, bv)
        store(ws, b + PIVOT, D)
        store(ws, b + REST_FORCE, u)
        if p >= 0:
            pb = p * RECORD
            cw, cv = load3(ws, b + CORIOLIS), load3(ws, b + CORIOLIS + 3)
            Icw = add(symmetric(J, cw), (dot(H0, cv), dot(H1, cv), dot(H2, cv)))
            Icv = add(symmetric(L, cv), axpy(axpy(scaled(cw[0], H0), cw[1], H1), cw[2], H2))
            t = D * (u - dot(Uw, cw) - dot(Uv, cv)) if moves else load(a, i)
            add3(ws, pb + BIAS, axpy(add(bw, Icw), t, Uw))
            add3(ws, pb + BIAS + 3, axpy(add(bv, Icv), t, Uv))
            Ew, Ev = scaled(-1.0 * D, Uw), scaled(-1.0 * D, Uv)
            k = pb + ARTICULATED
            add6(ws, k, (
                J[0] + Ew[0] * Uw[0], J[1] + Ew[0] * Uw[1], J[2] + Ew[0] * Uw[2],
                J[3] + Ew[1] * Uw[1], J[4] + Ew[1] * Uw[2], J[5] + Ew[2] * Uw[2],
            ))  # fmt: skip
            add3(ws, k + 6, axpy(H0, Ew[0], Uv))
            add3(ws, k + 9, axpy(H1, Ew[1], Uv))
            add3(ws, k + 12, axpy(H2, Ew[2], Uv))
            add6(ws, k + 15, (
                L[0] + Ev[0] * Uv[0], L[1] + Ev[0] * Uv[1], L[2] + Ev[0] * Uv[2],
                L[3] + Ev[1] * Uv[1], L[4] + Ev[1] * Uv[2], L[5] + Ev[2] * Uv[2],
            ))  # fmt: skip
    for i in range(n):
        b = i * RECORD
        p = load(parent, i)
        sw, sv = load3(ws, b + SCREW_AXIS), load3(ws, b + SCREW_AXIS + 3)
        if p >= 0:
            pb = p * RECORD + ACCELERATION
            aw, av = add(load3(ws, pb), load3(ws, b + CORIOLIS)), add(load3(ws, pb + 3), load3(ws, b + CORIOLIS + 3))
        else:  # gravity, as an acceleration of the base
            aw, av = none, (zero + load(g, 0), zero + load(g, 1), zero + load(g, 2))
        Uw, Uv = load3(ws, b + U_SCREW), load3(ws, b + U_SCREW + 3)
        if load(prescribed, i) < 0:
            acceleration = load(ws, b + PIVOT) * (load(ws, b + REST_FORCE) - dot(Uw, aw) - dot(Uv, av))
            store(a, i, acceleration)
        else:
            acceleration = load(a, i)
            if reaction:
                bw, bv = load3(ws, b + BIAS), load3(ws, b + BIAS + 3)
                force = dot(Uw, aw) + dot(Uv, av) + dot(sw, bw) + dot(sv, bv)
                inner = dot(sw, Uw) + dot(sv, Uv) + load(armature, i)
                store(tau, i, force + inner * acceleration)
        store3(ws, b + ACCELERATION, axpy(aw, acceleration, sw))
        store3(ws, b + ACCELERATION + 3, axpy(av, acceleration, sv))


@part
def inverse_dynamics(m, q, v, a, tau, ws):
    """Forces from accelerations (Fig. 2, left): tau (nv lanes) without springs and damping, with armature."""
    n = m[TREE.nv]
    tree, inertia = placement(m), floats(m, TREE.inertia)
    parent, base = integers(m, TREE.parent), integers(m, TREE.base)
    armature, g = floats(m, TREE.armature), floats(m, TREE.base_acceleration)
    for i in range(n):
        turn(tree, i, q, ws)
    for i in range(n):
        R, P, sw, sv = place(tree, i, q, ws)
        b = i * RECORD
        p = load(parent, i)
        rate, acceleration = load(v, i), load(a, i)
        w, u = scaled(rate, sw), scaled(rate, sv)
        aw, av = scaled(acceleration, sw), scaled(acceleration, sv)
        if load(base, i) >= 0:
            o = load(base, i) * RECORD + TWIST
            bw, bv = load3(ws, o), load3(ws, o + 3)
            aw, av = add(aw, cross(bw, w)), add(av, add(cross(bw, u), cross(bv, w)))
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
        h, J = moved_inertia(inertia, i, R, P)
        f = axpy(cross(w, h), mass, u)
        moment = add(symmetric(J, w), cross(h, u))
        store3(ws, b + BIAS, add(add(symmetric(J, aw), cross(h, av)), add(cross(w, moment), cross(u, f))))
        store3(ws, b + BIAS + 3, add(axpy(cross(aw, h), mass, av), cross(w, f)))
    for i in range(n - 1, -1, -1):
        b = i * RECORD
        p = load(parent, i)
        Fn, Ff = load3(ws, b + BIAS), load3(ws, b + BIAS + 3)
        force = dot(load3(ws, b + SCREW_AXIS), Fn) + dot(load3(ws, b + SCREW_AXIS + 3), Ff)
        store(tau, i, force + load(armature, i) * load(a, i))
        if p >= 0:
            add3(ws, p * RECORD + BIAS, Fn)
            add3(ws, p * RECORD + BIAS + 3, Ff)
