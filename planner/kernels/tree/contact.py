"""Contact of spheres with planes, and stops of joints, on lanes: forces and their exact derivatives.

The law is model.contact.laws's. It has no cases: t = clamp(e/a, 0, 1), ramp(e; a) = t (e - a t/2), its slope is t and
s(e; a) = t^2 (3 - 2 t); a ramp of no length has 1/a so large that t is 0 or 1. A contact acts at

    p = c - (r + d/2 - e/2) n,   e = r + d + offset - n'c,

halfway between the two surfaces, c the sphere's centre and r its radius. With J_i = v_i + w_i x p the velocity of p per
rate of dof i (its screw (w_i, v_i) at the tree's origin), Y_i = V_base x S_i and V the twist of the link,

    de   = -n'dc,   dp = dc + n de / 2,   dc = v_i + w_i x c
    d(J v)     = Y_i(p) + w_i x V(p) - w x J_i + w x dp          (p as a point that contact moves over the link)
    d(J_j' f)  = J_j'(df + f x w_i) + w_j'((dp - J_i) x f)      for j moved by i, else J_j'df + w_j'(dp x f)
"""

from __future__ import annotations

from planner.kernels.algebra.ramp import clamp, ramp
from planner.kernels.algebra.spatial import add, axpy, cross, dot, load3, rotated, scaled, store3, sub
from planner.kernels.numba.jit import inline, part
from planner.kernels.numba.lane_math import sqrt
from planner.kernels.numba.lanes import any_less, floats, integers, load, maximum, select, spread, store
from planner.kernels.tree.contact_tables import CONTACT_SIZE, STOP_SIZE
from planner.kernels.tree.mechanism_table import TREE
from planner.kernels.tree.recursion import BIAS, PLACE, RECORD, SCREW_AXIS, TWIST
from planner.kernels.tree.sensitivity import Y

# Offsets in a contact's and a stop's numbers, as `model` lays them out
CENTRE, NORMAL, LEVEL, ARM, SURFACE, SLIDE, LAW = 0, 3, 6, 7, 8, 11, 14
STIFFNESS, DAMPING, RAMP, PER_RAMP, FORCE, PER_FORCE, SLIP, FRICTION, RAISE, SHARE, BEND = range(11)
SIDE, END, STOP_LAW = 0, 1, 2
_MIN_SQUARE = 1e-40  # added to squares before their root, so that none is zero


@inline
def _normal(law, o, e, opening):
    """The force before its own ramp, and its derivatives by e and by the opening speed; the slope of s; t."""
    K, B, a, per_a = load(law, o), load(law, o + DAMPING), load(law, o + RAMP), load(law, o + PER_RAMP)
    depth, t = ramp(e, a, per_a)
    s, ds = t * t * (3.0 - 2.0 * t), 6.0 * t * (1.0 - t) * per_a
    g = K * depth - B * (s * opening)
    return g, K * t - B * (ds * opening), spread(0.0) - B * s, s, ds


@inline
def _ramped(law, o, h):
    """The second ramp and its slope."""
    return ramp(h, load(law, o + FORCE), load(law, o + PER_FORCE))


@inline
def _bent(law, o, slip, fn):
    """Slopes of friction by the slip force and the cone's limit, whose sum times these it is; the limit."""
    limit, bend = load(law, o + FRICTION) * fn, load(law, o + BEND)
    t = clamp((slip - (1.0 - bend) * limit) / (2.0 * bend * limit + _MIN_SQUARE))
    return 1.0 - t, t * (1.0 - bend + bend * t), limit


@inline
def _touched(m, k, q, ws):
    """Contact k's penetration, place, the velocity of the link there and relative to the surface, normal and link."""
    link, address = load(integers(m, TREE.contact_link), k), load(integers(m, TREE.contact_address), k)
    value, o, b = floats(m, TREE.contact_value), k * CONTACT_SIZE, link * RECORD
    n = load3(value, o + NORMAL)
    R = (
        load(ws, b), load(ws, b + 1), load(ws, b + 2), load(ws, b + 3), load(ws, b + 4), load(ws, b + 5),
        load(ws, b + 6), load(ws, b + 7), load(ws, b + 8),
    )  # fmt: skip
    c = add(load3(ws, b + PLACE), rotated(R, load3(value, o + CENTRE)))
    e = load(value, o + LEVEL) - dot(c, n)
    if address >= 0:  # a floating tree is described about where it is
        e -= dot(load3(q, address), n)
    p = axpy(c, 0.5 * e - load(value, o + ARM), n)
    w, u = load3(ws, b + TWIST), load3(ws, b + TWIST + 3)
    V = add(u, cross(w, p))
    v = sub(V, load3(value, o + SURFACE))
    slide = load(integers(m, TREE.contact_slide), k)
    if slide >= 0:
        v = sub(v, load3(ws, slide * RECORD + TWIST + 3))
    return e, c, p, w, V, v, n, link, slide


@inline
def contact_force(value, o, e, v, n):
    """The force of the law at o, by penetration, relative velocity and normal."""
    opening = dot(v, n)
    vt = axpy(v, spread(0.0) - opening, n)
    g, _, _, s, _ = _normal(value, o, e, opening)
    c = load(value, o + SLIP) * s
    speed = sqrt(dot(vt, vt) + _MIN_SQUARE)
    slip = c * speed
    raised = load(value, o + SHARE) * (g + load(value, o + RAISE) * slip)
    fn, _ = _ramped(value, o, maximum(g, raised))
    by_slip, by_limit, limit = _bent(value, o, slip, fn)
    return sub(scaled(fn, n), scaled(by_slip * c + by_limit * limit / speed, vt))


@part
def add_contact_wrenches(m, q, ws):
    """Take the contacts' wrenches from the bias forces of links whose poses and twists are known."""
    value = floats(m, TREE.contact_value)
    for k in range(m[TREE.contacts]):
        e, _, p, _, _, v, n, link, slide = _touched(m, k, q, ws)
        if not any_less(0.0, e):
            continue
        f = contact_force(value, k * CONTACT_SIZE + LAW, e, v, n)
        b = link * RECORD + BIAS
        store3(ws, b, sub(load3(ws, b), cross(p, f)))
        store3(ws, b + 3, sub(load3(ws, b + 3), f))
        if slide >= 0:
            b = slide * RECORD + BIAS
            store3(ws, b, add(load3(ws, b), cross(p, f)))
            store3(ws, b + 3, add(load3(ws, b + 3), f))


@inline
def differentiated(value, o, e, v, n):
    """The force f, its derivative by e, and the numbers that `by_velocity` takes."""
    opening = dot(v, n)
    vt = axpy(v, spread(0.0) - opening, n)
    g, g_e, g_n, s, ds = _normal(value, o, e, opening)
    speed = sqrt(dot(vt, vt) + _MIN_SQUARE)
    ct = load(value, o + SLIP)
    c, c_e = ct * s, ct * ds
    slip, slip_e = c * speed, c_e * speed
    slip_t = c / speed  # times v_t'dv_t
    share, raise_ = load(value, o + SHARE), load(value, o + RAISE)
    raised = share * (g + raise_ * slip)
    by_g, by_slip = select(g, raised, share, 1.0), select(g, raised, share * raise_, 0.0)
    fn, slope = _ramped(value, o, maximum(g, raised))
    fn_e, fn_n, fn_t = slope * (by_g * g_e + by_slip * slip_e), slope * by_g * g_n, slope * by_slip * slip_t
    by_slip, by_limit, limit = _bent(value, o, slip, fn)
    coulomb, per = by_limit * limit / speed, load(value, o + FRICTION) * by_limit / speed
    viscosity = by_slip * c + coulomb
    a_e, a_n, a_t = by_slip * c_e + per * fn_e, per * fn_n, per * fn_t - coulomb / (speed * speed)
    f, f_e = sub(scaled(fn, n), scaled(viscosity, vt)), sub(scaled(fn_e, n), scaled(a_e, vt))
    return f, f_e, vt, fn_n, fn_t, a_n, a_t, viscosity


@inline
def by_velocity(n, vt, fn_n, fn_t, a_n, a_t, viscosity, dv):
    """The derivative of the force along dv."""
    along, across = dot(dv, n), dot(vt, dv)
    x = fn_n * along + fn_t * across + viscosity * along
    y = a_n * along + a_t * across
    return sub(axpy(scaled(x, n), spread(0.0) - y, vt), scaled(viscosity, dv))


@inline
def subtract_contact_derivatives(m, q, Dq, Dv, ld, ws):
    """Subtract the derivatives of contacts from dtau/dq and dtau/dv, (nv, ld) lanes; ws as inverse dynamics left it."""
    value, parent, first = floats(m, TREE.contact_value), integers(m, TREE.parent), integers(m, TREE.first)
    zero = spread(0.0)
    for k in range(m[TREE.contacts]):
        e, c, p, w, V, v, n, link, slide = _touched(m, k, q, ws)
        if not any_less(0.0, e):
            continue
        o = k * CONTACT_SIZE + LAW
        f, f_e, vt, fn_n, fn_t, a_n, a_t, viscosity = differentiated(value, o, e, v, n)
        d = load3(value, k * CONTACT_SIZE + SLIDE)
        if slide >= 0:  # a rate of the slide is one of the link, backwards
            dh = by_velocity(n, vt, fn_n, fn_t, a_n, a_t, viscosity, (zero + d[0], zero + d[1], zero + d[2]))
            j, own = link, slide * ld + slide
            while j >= 0:
                t, js = j * RECORD + SCREW_AXIS, j * ld + slide
                store(Dv, js, load(Dv, js) + dot(load3(ws, t), cross(p, dh)) + dot(load3(ws, t + 3), dh))
                j = load(parent, j)
            store(Dv, own, load(Dv, own) - dot(dh, d))
        i = link
        while i >= 0:
            b = i * RECORD
            sw, sv = load3(ws, b + SCREW_AXIS), load3(ws, b + SCREW_AXIS + 3)
            yw, yv = load3(ws, b + Y), load3(ws, b + Y + 3)
            Ji, dc = add(sv, cross(sw, p)), add(sv, cross(sw, c))
            rise = dot(dc, n)
            dp = axpy(dc, -0.5 * rise, n)
            dV = add(sub(add(add(yv, cross(yw, p)), cross(sw, V)), cross(w, Ji)), cross(w, dp))
            df = axpy(by_velocity(n, vt, fn_n, fn_t, a_n, a_t, viscosity, dV), spread(0.0) - rise, f_e)
            moment = add(cross(p, df), cross(dp, f))
            turning = cross(f, sw)
            carried_force = add(df, turning)
            carried_moment = add(moment, sub(cross(p, turning), cross(Ji, f)))
            dh = by_velocity(n, vt, fn_n, fn_t, a_n, a_t, viscosity, Ji)
            damping_moment = cross(p, dh)
            if slide >= 0:
                si = slide * ld + i
                store(Dq, si, load(Dq, si) + dot(df, d))
                store(Dv, si, load(Dv, si) + dot(dh, d))
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
                store(Dv, ji, load(Dv, ji) - dot(rw, damping_moment) - dot(rv, dh))
                j = load(parent, j)
            i = load(parent, i)


@inline
def _stopped(m, k, q, v):
    """Stop k's degree of freedom, its side, and the force with its derivatives by the penetration and its opening."""
    i = load(integers(m, TREE.stop_dof), k)
    value, o = floats(m, TREE.stop_value), k * STOP_SIZE
    side = load(value, o + SIDE)
    e = side * (load(q, load(integers(m, TREE.q_address), i)) - load(value, o + END))
    g, g_e, g_n, _, _ = _normal(value, o + STOP_LAW, e, -side * load(v, i))
    force, slope = _ramped(value, o + STOP_LAW, g)
    return i, side, force, slope * g_e, slope * g_n


@part
def add_stops(m, q, v, tau):
    """The forces of the joints' stops onto tau (nv lanes)."""
    for k in range(m[TREE.stops]):
        i, side, force, _, _ = _stopped(m, k, q, v)
        store(tau, i, load(tau, i) - side * force)


@inline
def add_stop_derivatives(m, q, v, Dq, Dv, ld):
    """Add the derivatives of the stops' forces to dtau/dq and dtau/dv of inverse dynamics."""
    for k in range(m[TREE.stops]):
        i, _, _, by_depth, by_opening = _stopped(m, k, q, v)
        d = i * ld + i  # the side counts twice
        store(Dq, d, load(Dq, d) + by_depth)
        store(Dv, d, load(Dv, d) - by_opening)
