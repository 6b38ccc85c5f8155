"""Contact of two bodies on lanes: spheres and capsules, their forces and exact derivatives.

model.contact.body_contact has the geometry and model.contact.laws the law. Each body is about the origin of its own
tree, so p is too. Only degrees of freedom that move one of the two bodies and not the other matter: what carries
both feels nothing and changes nothing. With J_i = v_i + w_i x p for dof i of one of them ("own", the upper sign if
it is the first) and the other one at rest,

    dg_own = +-(w_i x a_own)'D + a_own'X,   dg_other = -a_other'X,   X = v_i + w_i x x_own,   ds = -G^-1 dg
    dD     = +-(X + a_own ds_own - a_other ds_other),   dp = (X + a_own ds_own + a_other ds_other)/2 - (r_1 - r_2) dn/2
    dv     = +-(Y_i(p) + w_i x V_own(p) - w_own x J_i) + (w_1 - w_2) x dp
    df     = w x f + f_e de + f_v (dv - w x v),   w = n x dn    (the law is the same in all directions)

and J_j'f changes as in kernels.tree.contact.
"""

from __future__ import annotations

from planner.kernels.algebra.spatial import add, axpy, cross, dot, load3, rotated, scaled, store3, sub
from planner.kernels.numba.jit import inline, part
from planner.kernels.numba.lane_math import sqrt
from planner.kernels.numba.lanes import any_less, floats, integers, load, maximum, minimum, select, spread, store
from planner.kernels.tree.contact import by_velocity, contact_force, differentiated
from planner.kernels.tree.contact_tables import PAIR_LINKS_SIZE, PAIR_SIZE
from planner.kernels.tree.mechanism_table import TREE
from planner.kernels.tree.recursion import BIAS, PLACE, RECORD, SCREW_AXIS, TWIST
from planner.kernels.tree.sensitivity import Y

# Offsets in a pair's numbers, as `model` lays them out: of each part, then of both; and in its links
MIDDLE, AXIS, HALF, PART = 0, 3, 6, 7
BETWEEN, REACH, SHIFT, BLUNT, PARALLEL, LAW = 14, 17, 18, 19, 20, 21
COMMON, ADDRESS = 2, 3
_MIN_SQUARED_DISTANCE = 1e-24  # m^2, so that centres in one place have no direction rather than a wrong one


@inline
def _part(link, value, o, ws):
    """Middle and axis of a part, spin and velocity of what carries it, about its tree's origin."""
    zero = spread(0.0)
    none = (zero, zero, zero)
    m, a, w, u = load3(value, o + MIDDLE), load3(value, o + AXIS), none, none
    if link < 0:
        middle, axis = add(none, m), add(none, a)
    else:
        b = link * RECORD
        R = (
            load(ws, b), load(ws, b + 1), load(ws, b + 2), load(ws, b + 3), load(ws, b + 4), load(ws, b + 5),
            load(ws, b + 6), load(ws, b + 7), load(ws, b + 8),
        )  # fmt: skip
        middle, axis = add(load3(ws, b + PLACE), rotated(R, m)), rotated(R, a)
        w, u = load3(ws, b + TWIST), load3(ws, b + TWIST + 3)
    return middle, axis, w, u


@inline
def _within(s, half):
    return minimum(maximum(s, -half), half)


@inline
def _closest(value, o, D, a1, a2):
    """Positions along the axes for middles that are D apart, before the ends cut them off and after; determinant."""
    half1, half2, b = load(value, o + HALF), load(value, o + PART + HALF), load(value, o + BLUNT)
    c, g1, g2, x = dot(a1, a2), dot(a1, D), dot(a2, D), cross(a1, a2)
    determinant, per = load(value, o + PARALLEL) + dot(x, x), 1.0 / (1.0 + b)
    s1 = _within((c * g2 - (1.0 + b) * g1) / determinant, half1)
    free2 = (c * s1 + g2) * per  # then each in turn: of a quadratic within a box this finds the least
    s2 = _within(free2, half2)
    free1 = (c * s2 - g1) * per
    return _within(free1, half1), s2, free1, free2, determinant


@inline
def _met(m, k, q, ws):
    """Pair k's links and law; penetration, distance and normal; axes, points, p and motion of both; their freedom."""
    links, value, o = integers(m, TREE.pair_links), floats(m, TREE.pair_value), k * PAIR_SIZE
    t = k * PAIR_LINKS_SIZE
    link1, link2, q1, q2 = load(links, t), load(links, t + 1), load(links, t + ADDRESS), load(links, t + ADDRESS + 1)
    m1, a1, w1, u1 = _part(link1, value, o, ws)
    m2, a2, w2, u2 = _part(link2, value, o + PART, ws)
    D = add(sub(m1, m2), load3(value, o + BETWEEN))
    if q1 >= 0:  # a floating tree is described about where it is
        D = add(D, load3(q, q1))
    if q2 >= 0:
        D = sub(D, load3(q, q2))
    s1, s2, free1, free2, determinant = _closest(value, o, D, a1, a2)
    D = axpy(axpy(D, s1, a1), spread(0.0) - s2, a2)
    distance = sqrt(dot(D, D) + _MIN_SQUARED_DISTANCE)
    n = scaled(1.0 / distance, D)
    e, shift = load(value, o + REACH) - distance, load(value, o + SHIFT)
    x1, x2 = axpy(m1, s1, a1), axpy(m2, s2, a2)
    p1 = axpy(x1, spread(0.0) - 0.5 * distance - shift, n)
    p2 = axpy(x2, 0.5 * distance - shift, n)
    V1, V2 = add(u1, cross(w1, p1)), add(u2, cross(w2, p2))
    freedom = (free1, free2, determinant)
    return link1, link2, e, distance, n, D, a1, a2, x1, x2, p1, p2, w1, w2, V1, V2, freedom


@part
def add_pair_wrenches(m, q, ws):
    """Take the wrenches of contacts of two bodies from the bias forces of links whose poses and twists are known."""
    value = floats(m, TREE.pair_value)
    for k in range(m[TREE.pairs]):
        link1, link2, e, _, n, _, _, _, _, _, p1, p2, _, _, V1, V2, _ = _met(m, k, q, ws)
        if not any_less(0.0, e):
            continue
        f = contact_force(value, k * PAIR_SIZE + LAW, e, sub(V1, V2), n)
        if link1 >= 0:
            b = link1 * RECORD + BIAS
            store3(ws, b, sub(load3(ws, b), cross(p1, f)))
            store3(ws, b + 3, sub(load3(ws, b + 3), f))
        if link2 >= 0:
            b = link2 * RECORD + BIAS
            store3(ws, b, add(load3(ws, b), cross(p2, f)))
            store3(ws, b + 3, add(load3(ws, b + 3), f))


@inline
def _inverse(value, o, freedom, a1, a2):
    """The inverse of dg/ds: for the first, for the second, and between; zero for what is at an end."""
    free1, free2, determinant = freedom
    d = 1.0 + load(value, o + BLUNT)
    one, none = spread(1.0), spread(0.0)
    moves1 = select(maximum(free1, none - free1), load(value, o + HALF), one, none)
    moves2 = select(maximum(free2, none - free2), load(value, o + PART + HALF), one, none)
    alone, together = 1.0 / d, d / determinant
    k1 = moves1 * (moves2 * together + (1.0 - moves2) * alone)
    k2 = moves2 * (moves1 * together + (1.0 - moves1) * alone)
    return k1, k2, moves1 * moves2 * dot(a1, a2) / determinant


@inline
def subtract_pair_derivatives(m, q, Dq, Dv, ld, ws):
    """Subtract the derivatives of the contacts of two bodies from dtau/dq and dtau/dv of inverse dynamics."""
    value, parent, first = floats(m, TREE.pair_value), integers(m, TREE.parent), integers(m, TREE.first)
    for k in range(m[TREE.pairs]):
        own, other, e, distance, n, D, a, a_other, x, x_other, p, p_other, w1, w2, V, V_other, freedom = _met(
            m, k, q, ws
        )
        if not any_less(0.0, e):
            continue
        o, common = k * PAIR_SIZE, load(integers(m, TREE.pair_links), k * PAIR_LINKS_SIZE + COMMON)
        shift, per = load(value, o + SHIFT), 1.0 / distance
        k_own, k_other, between = _inverse(value, o, freedom, a, a_other)
        v, spin, w, w_other, sign = sub(V, V_other), sub(w1, w2), w1, w2, spread(1.0)
        f, f_e, vt, fn_n, fn_t, a_n, a_t, viscosity = differentiated(value, o + LAW, e, v, n)
        for _ in range(2):
            i = own
            while i != common:
                b = i * RECORD
                sw, sv = load3(ws, b + SCREW_AXIS), load3(ws, b + SCREW_AXIS + 3)
                yw, yv = load3(ws, b + Y), load3(ws, b + Y + 3)
                Ji, X = add(sv, cross(sw, p)), add(sv, cross(sw, x))
                dg_own = sign * dot(cross(sw, a), D) + dot(a, X)
                dg_other = spread(0.0) - dot(a_other, X)
                ds_own = spread(0.0) - (k_own * dg_own + between * dg_other)
                ds_other = spread(0.0) - (between * dg_own + k_other * dg_other)
                moved, followed = axpy(X, ds_own, a), scaled(ds_other, a_other)
                dD = scaled(sign, sub(moved, followed))
                ddistance = dot(n, dD)
                dn = scaled(per, axpy(dD, spread(0.0) - ddistance, n))
                dp = axpy(scaled(0.5, add(moved, followed)), spread(0.0) - shift, dn)
                dV = sub(add(add(yv, cross(yw, p)), cross(sw, V)), cross(w, Ji))
                turn = cross(n, dn)
                dv = sub(add(scaled(sign, dV), cross(spin, dp)), cross(turn, v))
                df = by_velocity(n, vt, fn_n, fn_t, a_n, a_t, viscosity, dv)
                df = add(axpy(df, spread(0.0) - ddistance, f_e), cross(turn, f))
                moment, opposite = add(cross(p, df), cross(dp, f)), add(cross(p_other, df), cross(dp, f))
                turning = cross(f, sw)
                carried_force = add(df, turning)
                carried_moment = add(moment, sub(cross(p, turning), cross(Ji, f)))
                dh = scaled(sign, by_velocity(n, vt, fn_n, fn_t, a_n, a_t, viscosity, Ji))
                start, damping_moment, damping_opposite = load(first, i), cross(p, dh), cross(p_other, dh)
                j = own
                while j != common:
                    t, ji = j * RECORD, j * ld + i
                    rw, rv = load3(ws, t + SCREW_AXIS), load3(ws, t + SCREW_AXIS + 3)
                    if j >= start:
                        store(Dq, ji, load(Dq, ji) - sign * (dot(rw, carried_moment) + dot(rv, carried_force)))
                    else:
                        store(Dq, ji, load(Dq, ji) - sign * (dot(rw, moment) + dot(rv, df)))
                    store(Dv, ji, load(Dv, ji) - sign * (dot(rw, damping_moment) + dot(rv, dh)))
                    j = load(parent, j)
                j = other
                while j != common:
                    t, ji = j * RECORD, j * ld + i
                    rw, rv = load3(ws, t + SCREW_AXIS), load3(ws, t + SCREW_AXIS + 3)
                    store(Dq, ji, load(Dq, ji) + sign * (dot(rw, opposite) + dot(rv, df)))
                    store(Dv, ji, load(Dv, ji) + sign * (dot(rw, damping_opposite) + dot(rv, dh)))
                    j = load(parent, j)
                i = load(parent, i)
            own, other, a, a_other, x, x_other, p, p_other = other, own, a_other, a, x_other, x, p_other, p
            w, w_other, V, V_other, k_own, k_other = w_other, w, V_other, V, k_other, k_own
            sign = spread(0.0) - sign
