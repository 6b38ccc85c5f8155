"""Soft contacts of spheres with planes on lanes: MuJoCo's law, which has the acceleration in it, with its derivatives.

The law is model.contact.laws's with `lead`: a force and torque f(e, x), e the penetration and x = v + lead (J qdd) the
velocity and the angular velocity that the contact has `lead` later (kernels.tree.soft_contact_law). It is the gradient
of a convex function of x, so C = -df/dx is symmetric and at least zero, and the accelerations are the minimum of a
convex function. Newton's method takes f for

    f_k - C_k (x - x_k),

a wrench and, of the link, an inertia C_k lead at the contact, for which the recursion finds the next accelerations: see
kernels.tree.rounds. J qdd has neither Jdot qd nor gravity, as in MuJoCo.

J qdd is the velocity of a twist, that of the links if their rates were qdd. So x is the velocity of V + lead times that
twist, and its derivatives are those of a velocity (kernels.tree.contact).
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
    load9,
    rotated,
    scaled,
    store3,
    store6,
    sub,
)
from planner.kernels.numba.jit import inline, part
from planner.kernels.numba.lane_math import sqrt
from planner.kernels.numba.lanes import any_less, floats, integers, load, maximum, spread, store
from planner.kernels.tree.contact_tables import SOFT_SIZE
from planner.kernels.tree.mechanism_table import TREE
from planner.kernels.tree.recursion import ARTICULATED, BIAS, CORIOLIS, PLACE, RECORD, SCREW_AXIS, TWIST
from planner.kernels.tree.sensitivity import Y
from planner.kernels.tree.soft_contact_law import (
    ARM,
    CENTRE,
    DAMPING,
    LAW,
    LEAD,
    LEVEL,
    MIN_FORCE,
    NORMAL,
    PER_LENGTH,
    ROOT,
    STIFFNESS,
    SURFACE,
    slopes_times,
    soft_law,
)

# In its memory: of the last linearization its force, torque, slopes (18), x and w; the force and torque that the
# accelerations ask for; the next x and w
AT, SLOPES, WHERE, ASKED, NEXT, SOFT_MEMORY = 0, 6, 24, 30, 36, 42
SOFT_SHARE = 0.01  # of an error: a contact's force may be a hundred times as far from its law as that of friction
RATES, REST = 81, 71  # of a link's record: its twist if the joints' rates were qdd, and the rest of its acceleration


@inline
def _store_both(memory, o, x, w):
    """Keep a pair of vectors."""
    store3(memory, o, x)
    store3(memory, o + 3, w)


@inline
def _load_both(memory, o):
    """A pair of vectors."""
    return load3(memory, o), load3(memory, o + 3)


@inline
def _store_slopes(memory, o, slopes):
    """Keep C, a, b and D."""
    C, a, b, D = slopes
    store6(memory, o, C)
    store3(memory, o + 6, a)
    store3(memory, o + 9, b)
    store6(memory, o + 12, D)


@inline
def _load_slopes(memory, o):
    """C, a, b and D."""
    return load6(memory, o), load3(memory, o + 6), load3(memory, o + 9), load6(memory, o + 12)


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
    """The velocity ahead of the link at p, relative to the surface, and its angular velocity ahead."""
    value, o, b = floats(m, TREE.soft_value), k * SOFT_SIZE, link * RECORD
    lead = load(value, o + LAW + LEAD)
    w = axpy(load3(ws, b + TWIST), lead, load3(ws, b + RATES))
    u = axpy(load3(ws, b + TWIST + 3), lead, load3(ws, b + RATES + 3))
    return sub(add(u, cross(w, p)), load3(value, o + SURFACE)), w


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
        x, w = _ahead(m, k, link, p, ws)
        _store_both(memory, o + WHERE, x, w)
        f, torque, _, _, slopes = soft_law(value, k, e, x, w)
        _store_both(memory, o + AT, f, torque)
        _store_slopes(memory, o + SLOPES, slopes)
        lead = load(value, k * SOFT_SIZE + LAW + LEAD)
        aw = add(load3(ws, b + RATES), load3(ws, b + REST))
        av = add(load3(ws, b + RATES + 3), load3(ws, b + REST + 3))
        df, dt = slopes_times(slopes, add(av, cross(aw, p)), aw)
        f, torque = axpy(f, lead, df), axpy(torque, lead, dt)
        add3(ws, b + BIAS, scaled(-1.0, add(torque, cross(p, f))))
        add3(ws, b + BIAS + 3, scaled(-1.0, f))
        _add_inertia(ws, b + ARTICULATED, p, lead, slopes)


@inline
def _add_inertia(ws, k, p, lead, slopes):
    """Add the slopes of the point p, times lead, to the inertia at k: J (6) | H (9) | the linear block (6).

    With P = hat(p), W = P C and c = P a, the wrench of a twist (w, v) has the moment J w + H v and the force H'w + C v,
    J = D - W P + b c' + c b' and H = W + b a'.
    """
    C, a, b, D = slopes
    (xx, xy, xz), (yy, yz, zz) = scaled(lead, (C[0], C[1], C[2])), scaled(lead, (C[3], C[4], C[5]))
    a = scaled(lead, a)
    w0, w1, w2 = cross(p, (xx, xy, xz)), cross(p, (xy, yy, yz)), cross(p, (xz, yz, zz))  # columns of W
    r0, r1, r2 = (w0[0], w1[0], w2[0]), (w0[1], w1[1], w2[1]), (w0[2], w1[2], w2[2])  # its rows
    j0, j1, j2 = cross(p, r0), cross(p, r1), cross(p, r2)  # rows of -W P: r x p negated
    c = cross(p, a)
    add6(ws, k, (
        j0[0] + lead * D[0] + 2.0 * b[0] * c[0], j0[1] + lead * D[1] + b[0] * c[1] + b[1] * c[0],
        j0[2] + lead * D[2] + b[0] * c[2] + b[2] * c[0], j1[1] + lead * D[3] + 2.0 * b[1] * c[1],
        j1[2] + lead * D[4] + b[1] * c[2] + b[2] * c[1], j2[2] + lead * D[5] + 2.0 * b[2] * c[2],
    ))  # fmt: skip
    add3(ws, k + 6, axpy(r0, b[0], a))
    add3(ws, k + 9, axpy(r1, b[1], a))
    add3(ws, k + 12, axpy(r2, b[2], a))
    add6(ws, k + 15, (xx, xy, xz, yy, yz, zz))


@inline
def _asked(memory, o):
    """The force and torque that the new accelerations ask of the contact whose memory begins at o."""
    (x, w), (next_x, next_w) = _load_both(memory, o + WHERE), _load_both(memory, o + NEXT)
    df, dt = slopes_times(_load_slopes(memory, o + SLOPES), sub(next_x, x), sub(next_w, w))
    return sub(load3(memory, o + AT), df), sub(load3(memory, o + AT + 3), dt)


@inline
def _part_of_way(memory, o, gone):
    """Velocities x and w a part of the way to the new accelerations, and the force and torque asked for there."""
    (x, w), (next_x, next_w) = _load_both(memory, o + WHERE), _load_both(memory, o + NEXT)
    (f, torque), (next_f, next_torque) = _load_both(memory, o + ASKED), _asked(memory, o)
    x, w = axpy(x, gone, sub(next_x, x)), axpy(w, gone, sub(next_w, w))
    return x, w, axpy(f, gone, sub(next_f, f)), axpy(torque, gone, sub(next_torque, torque))


@inline
def _off(value, k, e, x, w, asked, asked_torque):
    """How far a force and torque are from the law's, relative to it or to what rounding leaves."""
    f, torque, _, _, _ = soft_law(value, k, e, x, w)
    o = k * SOFT_SIZE + LAW
    root, per_length = load(value, o + ROOT), load(value, o + PER_LENGTH)
    off, off_torque = sub(asked, f), scaled(per_length, sub(asked_torque, torque))
    torque = scaled(per_length, torque)
    speed = dot(x, x)
    if per_length > 0.0:
        speed += dot(w, w) / (per_length * per_length)
    size = load(value, o + STIFFNESS) * maximum(e, 0.0) + load(value, o + DAMPING) * root * root * sqrt(speed)
    far = sqrt(dot(off, off) + dot(off_torque, off_torque))
    return SOFT_SHARE * far / (size + sqrt(dot(f, f) + dot(torque, torque)) + MIN_FORCE)


@part
def soft_moves(m, q, a, ws, near, memory):
    """Keep the velocities ahead of new accelerations a."""
    set_rates(m, a, ws)
    for j in range(int(load(near, 0))):
        k = int(load(near, 1 + j))
        link, _, _, p, _ = _met(m, k, q, ws)
        x, w = _ahead(m, k, link, p, ws)
        _store_both(memory, k * SOFT_MEMORY + NEXT, x, w)


@part
def first_soft_error(m, q, ws, near, memory):
    """The largest error (lanes) of the first round, and what it asks for is kept."""
    error, value = spread(0.0), floats(m, TREE.soft_value)
    for j in range(int(load(near, 0))):
        k = int(load(near, 1 + j))
        _, e, _, _, _ = _met(m, k, q, ws)
        o = k * SOFT_MEMORY
        (f, torque), (x, w) = _asked(memory, o), _load_both(memory, o + NEXT)
        _store_both(memory, o + ASKED, f, torque)
        error = maximum(error, _off(value, k, e, x, w, f, torque))
    return error


@part
def soft_uphill(m, q, ws, near, memory, part_of_way):
    """The slope of the convex function along the way to the new accelerations, a part of it gone."""
    slope, value = spread(0.0), floats(m, TREE.soft_value)
    for j in range(int(load(near, 0))):
        k = int(load(near, 1 + j))
        _, e, _, _, _ = _met(m, k, q, ws)
        o = k * SOFT_MEMORY
        x, w, asked, asked_torque = _part_of_way(memory, o, part_of_way)
        f, torque, _, _, _ = soft_law(value, k, e, x, w)
        (x, w), (next_x, next_w) = _load_both(memory, o + WHERE), _load_both(memory, o + NEXT)
        power = dot(sub(next_x, x), sub(asked, f)) + dot(sub(next_w, w), sub(asked_torque, torque))
        slope += power / load(value, k * SOFT_SIZE + LAW + LEAD)
    return slope


@part
def soft_error(m, q, ws, near, memory, gone):
    """The largest error (lanes) after a part of the way, where what is asked for there is kept."""
    error, value = spread(0.0), floats(m, TREE.soft_value)
    for j in range(int(load(near, 0))):
        k = int(load(near, 1 + j))
        _, e, _, _, _ = _met(m, k, q, ws)
        o = k * SOFT_MEMORY
        x, w, f, torque = _part_of_way(memory, o, gone)
        _store_both(memory, o + ASKED, f, torque)
        error = maximum(error, _off(value, k, e, x, w, f, torque))
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
        x, w = _ahead(m, k, link, p, ws)
        f, torque, f_e, torque_e, slopes = soft_law(value, k, e, x, w)
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
            damped, damped_torque = slopes_times(slopes, dV, add(yw, cross(sw, w)))
            df, dt = sub(scaled(zero - rise, f_e), damped), sub(scaled(zero - rise, torque_e), damped_torque)
            moment = add(dt, add(cross(p, df), cross(dp, f)))
            turning = cross(f, sw)
            carried_force = add(df, turning)
            carried_moment = add(moment, add(cross(torque, sw), sub(cross(p, turning), cross(Ji, f))))
            dh, dh_torque = slopes_times(slopes, Ji, sw)
            damping_moment = add(dh_torque, cross(p, dh))
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
                by_rate = dot(rw, damping_moment) + dot(rv, dh)
                store(Dv, ji, load(Dv, ji) + by_rate)
                store(M, ji, load(M, ji) + lead * by_rate)
                j = load(parent, j)
            i = load(parent, i)
