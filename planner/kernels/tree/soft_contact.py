"""Soft contacts of spheres with planes on lanes: MuJoCo's law, which has the acceleration in it, with its derivatives.

The law is model.contact.laws's with `lead`: a force f(e, x), e the penetration and x = v + lead (J qdd) the velocity
that the contact has `lead` later. It is the gradient of a convex function of x, so C = -df/dx is symmetric and at least
zero, and the accelerations are the minimum of a convex function. Newton's method takes f for

    f_k - C_k (x - x_k),

a force and, of the link, an inertia C_k lead at the contact, for which the recursion finds the next accelerations: see
kernels.tree.rounds. J qdd has neither Jdot qd nor gravity, as in MuJoCo.

J qdd is the velocity of a twist, that of the links if their rates were qdd. So x is the velocity of V + lead times that
twist, and its derivatives are those of a velocity (kernels.tree.contact).
"""

from __future__ import annotations

from planner.kernels.algebra.ramp import clamp, ramp
from planner.kernels.algebra.spatial import (  # fmt: skip
    add,
    add3,
    add6,
    axpy,
    cross,
    dot,
    load3,
    load6,
    load9,
    rotated,
    scaled,
    store3,
    store6,
    sub,
    symmetric,
)
from planner.kernels.numba.jit import inline, part
from planner.kernels.numba.lane_math import sqrt
from planner.kernels.numba.lanes import any_less, floats, integers, load, maximum, select, spread, store
from planner.kernels.tree.contact_tables import LEAD_LAW_SIZE, SOFT_SIZE
from planner.kernels.tree.lead_law import DAMPING, FORCE, LEAD, PER_FORCE, STIFFNESS, pressing
from planner.kernels.tree.mechanism_table import TREE
from planner.kernels.tree.recursion import ARTICULATED, BIAS, CORIOLIS, PLACE, RECORD, SCREW_AXIS, TWIST
from planner.kernels.tree.sensitivity import Y

# Offsets in a soft contact's numbers, as contact_tables lays them out
CENTRE, NORMAL, LEVEL, ARM, SURFACE, FIRST, SECOND, LAW = 0, 3, 6, 7, 8, 11, 14, 17
FRICTION, ROOT, WINDOW, ELLIPTIC, EDGE, ALONG_NORMAL = range(LEAD_LAW_SIZE, LEAD_LAW_SIZE + 6)  # behind the law's
# In its memory: of the last linearization its force, C and x; the force that the accelerations ask for; the next x
AT, SLOPES, WHERE, ASKED, NEXT, SOFT_MEMORY = 0, 3, 9, 12, 15, 18
SOFT_SHARE = 0.01  # of an error: a contact's force may be a hundred times as far from its law as that of friction
RATES, REST = 81, 71  # of a link's record: its twist if the joints' rates were qdd, and the rest of its acceleration
_MIN_SQUARE = 1e-40  # added to squares before their root, so that none is zero
_MIN_FORCE = 1e-30  # N, of what forces are divided by


@inline
def _plus(C, s, d):
    """C and s times d d'."""
    a = scaled(s, d)
    return (
        C[0] + a[0] * d[0], C[1] + a[0] * d[1], C[2] + a[0] * d[2],
        C[3] + a[1] * d[1], C[4] + a[1] * d[2], C[5] + a[2] * d[2],
    )  # fmt: skip


@inline
def _edge(value, o, d, share, pressed, pressed_e, s, ds, x):
    """The force of an edge d of the pyramid that has a share of all, its derivative by e, and C along d."""
    along, damping = dot(x, d), share * load(value, o + DAMPING)
    y, y_e = share * pressed - damping * (s * along), share * pressed_e - damping * (ds * along)
    force, slope = ramp(y, load(value, o + FORCE), load(value, o + PER_FORCE))
    return force, slope * y_e, damping * (slope * s)


@inline
def _pyramid(value, o, n, first, second, pressed, pressed_e, s, ds, x):
    """Force, its derivative by e and C of a pyramidal cone: four edges n +- mu t that push, and perhaps n itself."""
    mu, zero, share = load(value, o + FRICTION), spread(0.0), load(value, o + EDGE)
    f, f_e, C = (zero, zero, zero), (zero, zero, zero), (zero, zero, zero, zero, zero, zero)
    for axis in range(2):
        t = first if axis == 0 else second
        for side in range(2):
            d = axpy(n, mu if side == 0 else -mu, t)
            force, by_e, slope = _edge(value, o, d, share, pressed, pressed_e, s, ds, x)
            f, f_e, C = axpy(f, force, d), axpy(f_e, by_e, d), _plus(C, slope, d)
    share = load(value, o + ALONG_NORMAL)
    if share > 0.0:
        force, by_e, slope = _edge(value, o, n, share, pressed, pressed_e, s, ds, x)
        f, f_e, C = axpy(f, force, n), axpy(f_e, by_e, n), _plus(C, slope, n)
    return f, f_e, C


@inline
def _cone(value, o, n, pressed, pressed_e, s, ds, x):
    """The same of an elliptic cone: y projected onto it, smoothed where it begins to slip.

    Along the edge c of the cone next to y and across it, a = y'c and b = y'c_: the potential is a^2 (1/2 + psi(b/a)),
    with psi(t) = t^2/2 for t > w, where the contact sticks, constant for t < -w, where it slips, and cubic between.
    """
    mu, root, w = load(value, o + FRICTION), load(value, o + ROOT), load(value, o + WINDOW)
    B = load(value, o + DAMPING)
    opening = dot(x, n)
    xt = axpy(x, spread(0.0) - opening, n)
    yn, yn_e = pressed - B * (s * opening), pressed_e - B * (ds * opening)
    size = sqrt(dot(xt, xt) + _MIN_SQUARE)
    u = scaled(-1.0 / size, xt)  # y_t's direction
    yt, yt_e = B * root * (s * size), B * root * (ds * size)
    cone = mu / root
    per = 1.0 / sqrt(spread(1.0 + cone * cone))
    a, b = per * (yn + cone * yt), per * (cone * yn - yt)
    whole = select(0.0, a, 1.0, 0.0)
    t = b / maximum(a, _MIN_FORCE)
    z = clamp((t + w) / (2.0 * w))
    beyond = maximum(t - w, 0.0)
    psi = w * w * (0.6666666666666667 * z * z * z - 0.16666666666666666) + beyond * (w + 0.5 * beyond)
    psi_1, psi_2 = w * z * z + beyond, z
    g_a, g_b = whole * a * (1.0 + 2.0 * psi - t * psi_1), whole * a * psi_1
    h_aa, h_ab, h_bb = (
        whole * (1.0 + 2.0 * psi - 2.0 * t * psi_1 + t * t * psi_2), whole * (psi_1 - t * psi_2), whole * psi_2,
    )  # fmt: skip
    gn, gs = per * (g_a + cone * g_b), per * (cone * g_a - g_b)
    h_nn = per * per * (h_aa + 2.0 * cone * h_ab + cone * cone * h_bb)
    h_ns = per * per * (cone * h_aa + (cone * cone - 1.0) * h_ab - cone * h_bb)
    h_ss = per * per * (cone * cone * h_aa - 2.0 * cone * h_ab + h_bb)
    turning = select(t, w, gs / maximum(yt, _MIN_FORCE), whole)  # g_t / y_t, one where it sticks
    f = axpy(scaled(gn, n), (0.0 - root) * B * root * (s * turning), xt)
    f_e = axpy(scaled(h_nn * yn_e + h_ns * yt_e, n), root * (h_ns * yn_e + h_ss * yt_e), u)
    scale = s * B
    zero = spread(0.0)
    C = _plus((zero, zero, zero, zero, zero, zero), scale * (h_nn - root * root * turning - root * h_ns), n)
    C = _plus(C, scale * (root * root * (h_ss - turning) - root * h_ns), u)
    C = _plus(C, scale * root * h_ns, add(n, u))
    along = scale * (root * root * turning)
    return f, f_e, (C[0] + along, C[1], C[2], C[3] + along, C[4], C[5] + along)


@inline
def soft_force(value, k, e, x):
    """Force of soft contact k at penetrations and velocities ahead, its derivative by e, and C."""
    b = k * SOFT_SIZE
    o, n = b + LAW, load3(value, b + NORMAL)
    pressed, pressed_e, s, ds = pressing(value, o, e)
    if load(value, o + ELLIPTIC) > 0.0:
        return _cone(value, o, n, pressed, pressed_e, s, ds, x)
    return _pyramid(value, o, n, load3(value, b + FIRST), load3(value, b + SECOND), pressed, pressed_e, s, ds, x)


@inline
def _met(m, k, q, ws):
    """Soft contact k's link, penetration, sphere's centre, place and normal."""
    link, address = load(integers(m, TREE.soft_link), k), load(integers(m, TREE.soft_address), k)
    value, o, b = floats(m, TREE.soft_value), k * SOFT_SIZE, link * RECORD
    n = load3(value, o + NORMAL)
    c = add(load3(ws, b + PLACE), rotated(load9(ws, b), load3(value, o + CENTRE)))
    e = load(value, o + LEVEL) - dot(c, n)
    if address >= 0:  # a floating tree is described about where it is
        e -= dot(load3(q, address), n)
    return link, e, c, axpy(c, 0.5 * e - load(value, o + ARM), n), n


@inline
def _ahead(m, k, link, p, ws):
    """The velocity ahead x of the link at p, relative to the surface."""
    value, o, b = floats(m, TREE.soft_value), k * SOFT_SIZE, link * RECORD
    lead = load(value, o + LAW + LEAD)
    w = axpy(load3(ws, b + TWIST), lead, load3(ws, b + RATES))
    u = axpy(load3(ws, b + TWIST + 3), lead, load3(ws, b + RATES + 3))
    return sub(add(u, cross(w, p)), load3(value, o + SURFACE))


@part
def set_rates(m, a, ws):
    """Each link's twist if the joints' rates were a (nv lanes)."""
    parent = integers(m, TREE.parent)
    for i in range(m[TREE.nv]):
        b, p, rate = i * RECORD, load(parent, i), load(a, i)
        w, u = scaled(rate, load3(ws, b + SCREW_AXIS)), scaled(rate, load3(ws, b + SCREW_AXIS + 3))
        if p >= 0:
            w, u = add(w, load3(ws, p * RECORD + RATES)), add(u, load3(ws, p * RECORD + RATES + 3))
        store3(ws, b + RATES, w)
        store3(ws, b + RATES + 3, u)


@part
def any_soft_contact(m, q, ws, near):
    """Whether a sphere is in its plane in any lane, of links that move_links has seen; `near`: how many, and which."""
    count = 0
    for k in range(m[TREE.softs]):
        _, e, _, _, _ = _met(m, k, q, ws)
        if any_less(0.0, e):
            count += 1
            store(near, count, float(k))
    store(near, 0, float(count))
    return count > 0


@part
def add_soft_contacts(m, q, a, ws, near, memory):
    """Linearize the soft contacts at accelerations a and add their forces and inertias to the links."""
    value, parent, g = floats(m, TREE.soft_value), integers(m, TREE.parent), floats(m, TREE.base_acceleration)
    zero = spread(0.0)
    set_rates(m, a, ws)
    for i in range(m[TREE.nv]):  # what is not J qdd of the links' accelerations
        b, p = i * RECORD, load(parent, i)
        w, u = (zero, zero, zero), (zero + load(g, 0), zero + load(g, 1), zero + load(g, 2))
        if p >= 0:
            pb = p * RECORD + REST
            w, u = add(load3(ws, pb), load3(ws, b + CORIOLIS)), add(load3(ws, pb + 3), load3(ws, b + CORIOLIS + 3))
        store3(ws, b + REST, w)
        store3(ws, b + REST + 3, u)
    for j in range(int(load(near, 0))):
        k = int(load(near, 1 + j))
        link, e, _, p, _ = _met(m, k, q, ws)
        o, b = k * SOFT_MEMORY, link * RECORD
        x = _ahead(m, k, link, p, ws)
        store3(memory, o + WHERE, x)
        f, _, C = soft_force(value, k, e, x)
        store3(memory, o + AT, f)
        store6(memory, o + SLOPES, C)
        lead = load(value, k * SOFT_SIZE + LAW + LEAD)
        aw = add(load3(ws, b + RATES), load3(ws, b + REST))
        av = add(load3(ws, b + RATES + 3), load3(ws, b + REST + 3))
        f = axpy(f, lead, symmetric(C, add(av, cross(aw, p))))
        add3(ws, b + BIAS, scaled(-1.0, cross(p, f)))
        add3(ws, b + BIAS + 3, scaled(-1.0, f))
        _add_point_inertia(ws, b + ARTICULATED, p, (
            lead * C[0], lead * C[1], lead * C[2], lead * C[3], lead * C[4], lead * C[5],
        ))  # fmt: skip


@inline
def _add_point_inertia(ws, k, p, C):
    """An inertia C (xx, xy, xz, yy, yz, zz) of the point p onto the one at k: J (6) | H (9) | the linear block (6).

    With P = hat(p) and W = P C, the wrench of a twist (w, v) is (W v - W P w, C v - C P w).
    """
    c0, c1, c2 = (C[0], C[1], C[2]), (C[1], C[3], C[4]), (C[2], C[4], C[5])
    w0, w1, w2 = cross(p, c0), cross(p, c1), cross(p, c2)  # columns of W
    r0, r1, r2 = (w0[0], w1[0], w2[0]), (w0[1], w1[1], w2[1]), (w0[2], w1[2], w2[2])  # its rows
    j0, j1, j2 = cross(p, r0), cross(p, r1), cross(p, r2)  # rows of -W P: r x p negated
    add6(ws, k, (j0[0], j0[1], j0[2], j1[1], j1[2], j2[2]))
    add3(ws, k + 6, r0)
    add3(ws, k + 9, r1)
    add3(ws, k + 12, r2)
    add6(ws, k + 15, C)


@inline
def _asked(memory, o):
    """The force that the new accelerations ask of the contact whose memory begins at o."""
    moved = sub(load3(memory, o + NEXT), load3(memory, o + WHERE))
    return sub(load3(memory, o + AT), symmetric(load6(memory, o + SLOPES), moved))


@inline
def _off(value, k, e, x, asked):
    """How far a force is from the law's, relative to it or to what rounding leaves."""
    f, _, _ = soft_force(value, k, e, x)
    off, o = sub(asked, f), k * SOFT_SIZE + LAW
    root = load(value, o + ROOT)
    size = load(value, o + STIFFNESS) * maximum(e, 0.0) + load(value, o + DAMPING) * root * root * sqrt(dot(x, x))
    return SOFT_SHARE * sqrt(dot(off, off)) / (size + sqrt(dot(f, f)) + _MIN_FORCE)


@part
def soft_moves(m, q, a, ws, near, memory):
    """Keep the velocities ahead of new accelerations a."""
    set_rates(m, a, ws)
    for j in range(int(load(near, 0))):
        k = int(load(near, 1 + j))
        link, _, _, p, _ = _met(m, k, q, ws)
        store3(memory, k * SOFT_MEMORY + NEXT, _ahead(m, k, link, p, ws))


@part
def first_soft_error(m, q, ws, near, memory):
    """The largest error (lanes) of the first round, and what it asks for is kept."""
    error, value = spread(0.0), floats(m, TREE.soft_value)
    for j in range(int(load(near, 0))):
        k = int(load(near, 1 + j))
        _, e, _, _, _ = _met(m, k, q, ws)
        o = k * SOFT_MEMORY
        asked = _asked(memory, o)
        store3(memory, o + ASKED, asked)
        error = maximum(error, _off(value, k, e, load3(memory, o + NEXT), asked))
    return error


@part
def soft_uphill(m, q, ws, near, memory, part_of_way):
    """The slope of the convex function along the way to the new accelerations, a part of it gone."""
    slope, value = spread(0.0), floats(m, TREE.soft_value)
    for j in range(int(load(near, 0))):
        k = int(load(near, 1 + j))
        _, e, _, _, _ = _met(m, k, q, ws)
        o = k * SOFT_MEMORY
        x, before = load3(memory, o + WHERE), load3(memory, o + ASKED)
        step = sub(load3(memory, o + NEXT), x)
        f, _, _ = soft_force(value, k, e, axpy(x, part_of_way, step))
        now = axpy(before, part_of_way, sub(_asked(memory, o), before))
        slope += dot(step, sub(now, f)) / load(value, k * SOFT_SIZE + LAW + LEAD)
    return slope


@part
def soft_error(m, q, ws, near, memory, gone):
    """The largest error (lanes) after a part of the way, where what is asked for there is kept."""
    error, value = spread(0.0), floats(m, TREE.soft_value)
    for j in range(int(load(near, 0))):
        k = int(load(near, 1 + j))
        _, e, _, _, _ = _met(m, k, q, ws)
        o = k * SOFT_MEMORY
        x, before = load3(memory, o + WHERE), load3(memory, o + ASKED)
        asked = axpy(before, gone, sub(_asked(memory, o), before))
        store3(memory, o + ASKED, asked)
        error = maximum(error, _off(value, k, e, axpy(x, gone, sub(load3(memory, o + NEXT), x)), asked))
    return error


@inline
def subtract_soft_derivatives(m, q, a, M, Dq, Dv, ld, ws):
    """Subtract the derivatives of soft contacts from those by a (M), q and v; ws as inverse dynamics left it."""
    value, parent, first = floats(m, TREE.soft_value), integers(m, TREE.parent), integers(m, TREE.first)
    base, zero = integers(m, TREE.base), spread(0.0)
    set_rates(m, a, ws)
    for k in range(m[TREE.softs]):
        link, e, c, p, n = _met(m, k, q, ws)
        if not any_less(0.0, e):
            continue
        lead, lb = load(value, k * SOFT_SIZE + LAW + LEAD), link * RECORD
        f, f_e, C = soft_force(value, k, e, _ahead(m, k, link, p, ws))
        w = axpy(load3(ws, lb + TWIST), lead, load3(ws, lb + RATES))
        V = add(axpy(load3(ws, lb + TWIST + 3), lead, load3(ws, lb + RATES + 3)), cross(w, p))
        i = link
        while i >= 0:
            b = i * RECORD
            sw, sv = load3(ws, b + SCREW_AXIS), load3(ws, b + SCREW_AXIS + 3)
            yw, yv = load3(ws, b + Y), load3(ws, b + Y + 3)
            o = load(base, i) * RECORD + RATES
            if load(base, i) >= 0:
                rw, rv = load3(ws, o), load3(ws, o + 3)
                yw = axpy(yw, lead, cross(rw, sw))
                yv = axpy(yv, lead, add(cross(rw, sv), cross(rv, sw)))
            Ji, dc = add(sv, cross(sw, p)), add(sv, cross(sw, c))
            rise = dot(dc, n)
            dp = axpy(dc, -0.5 * rise, n)
            dV = add(sub(add(add(yv, cross(yw, p)), cross(sw, V)), cross(w, Ji)), cross(w, dp))
            df = sub(scaled(zero - rise, f_e), symmetric(C, dV))
            moment = add(cross(p, df), cross(dp, f))
            turning = cross(f, sw)
            carried_force = add(df, turning)
            carried_moment = add(moment, sub(cross(p, turning), cross(Ji, f)))
            dh = symmetric(C, Ji)
            damping_moment = cross(p, dh)
            start = load(first, i)
            j = link
            while j >= 0:
                t = j * RECORD
                rw, rv = load3(ws, t + SCREW_AXIS), load3(ws, t + SCREW_AXIS + 3)
                ji = j * ld + i
                if j >= start:
                    store(Dq, ji, load(Dq, ji) - dot(rw, carried_moment) - dot(rv, carried_force))
                else:
                    store(Dq, ji, load(Dq, ji) - dot(rw, moment) - dot(rv, df))
                damped = dot(rw, damping_moment) + dot(rv, dh)
                store(Dv, ji, load(Dv, ji) + damped)
                store(M, ji, load(M, ji) + lead * damped)
                j = load(parent, j)
            i = load(parent, i)
