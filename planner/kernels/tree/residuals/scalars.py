"""Heights, distances and velocities of points: one row each, with a direction d and a factor of each point.

With the factor of each of a term's points (1 - s, s, u - 1 and -u for the ends of two lines; 1 for a height), the
derivative by dof i is

    sum over points of factor share d'(v_i + w_i x p) = sum of w_i'(p x g) + v_i'g,    g = factor share d,

a wrench on the point's link, for the links that move it: (w_i, v_i) is the screw of i, p the point, both about the
tree's origin. The velocity V of a point, along d, has by q_i and v_i the derivatives

    d'(Y_i(p) + w_i x V),   d'(v_i + w_i x p),   Y_i = V_base x S_i    (see kernels.tree.contact, where p is the link's)

The twin is in problem.costs.residual_functions.
"""

from __future__ import annotations

from planner.kernels.algebra.ramp import clamp
from planner.kernels.algebra.spatial import add, axpy, cross, dot, load3, scaled, store3, sub
from planner.kernels.numba.jit import inline, part
from planner.kernels.numba.lane_math import sqrt
from planner.kernels.numba.lanes import floats, integers, lanes, load, spread, store
from planner.kernels.tree.mechanism_table import TREE
from planner.kernels.tree.recursion import RECORD, SCREW_AXIS, TWIST
from planner.kernels.tree.residuals.layout import MAX_ROWS, PARALLEL, PLACE_SIZE, POINT_SIZE, RESIDUALS, TINY
from planner.kernels.tree.residuals.points import constants_of, point_of

HEIGHT, DISTANCE, VELOCITY = range(3)  # numbers of kinds
LEVEL = 3  # offset in a term's constants, after its direction


@inline
def _nearest(a0, a1, b0, b1):
    """From the nearest point of a line to that of another, and where they are; as the twin's nearest."""
    v, w, r = sub(a1, a0), sub(b1, b0), sub(a0, b0)
    vv, ww, vw, vr, wr = dot(v, v), dot(w, w), dot(v, w), dot(v, r), dot(w, r)
    pull = PARALLEL * vv * ww
    s = clamp((vw * wr - vr * ww + 0.5 * pull) / (vv * ww - vw * vw + pull + TINY))
    u = clamp((vw * s + wr) / (ww + TINY))
    s = clamp((vw * u - vr) / (vv + TINY))
    return axpy(axpy(r, s, v), spread(0.0) - u, w), s, u


@inline
def _speed(p, i, d):
    """Velocity of point i along d; the world's is zero."""
    speed = spread(0.0)
    if load(integers(p, RESIDUALS.point_link), i) >= 0:
        share = load(floats(p, RESIDUALS.point_value), POINT_SIZE * i + 3)
        speed = share * dot(load3(lanes(p, RESIDUALS.places), PLACE_SIZE * i + 6), d)
    return speed


@part
def scalar_value(p, t, kind):
    """The value of term t; its direction and where along their lines its points are go to KEPT."""
    places, term, kept = lanes(p, RESIDUALS.places), constants_of(p, t), lanes(p, RESIDUALS.kept)
    zero = spread(0.0)
    i = PLACE_SIZE * point_of(p, t, 0) + 3
    d = add((zero, zero, zero), load3(term, 0))
    value, s, u = dot(load3(places, i), d), zero, zero
    if kind == VELOCITY:
        value = _speed(p, point_of(p, t, 0), d) - _speed(p, point_of(p, t, 1), d)
    elif kind == DISTANCE:
        j, k = PLACE_SIZE * point_of(p, t, 1) + 3, PLACE_SIZE * point_of(p, t, 2) + 3
        l = PLACE_SIZE * point_of(p, t, 3) + 3
        d, s, u = _nearest(load3(places, i), load3(places, j), load3(places, k), load3(places, l))
        value = sqrt(dot(d, d) + TINY)
        d = scaled(1.0 / value, d)
    store3(kept, 0, d)
    store(kept, 3, s)
    store(kept, 4, u)
    store(lanes(p, RESIDUALS.value), 0, value - load(term, LEVEL))


@part
def scalar_row(m, p, ws, t, kind):
    """The derivative of a height or distance, after its value."""
    parent, link = integers(m, TREE.parent), integers(p, RESIDUALS.point_link)
    value, places, row = floats(p, RESIDUALS.point_value), lanes(p, RESIDUALS.places), lanes(p, RESIDUALS.row)
    kept = lanes(p, RESIDUALS.kept)
    d, s, u = load3(kept, 0), load(kept, 3), load(kept, 4)
    for k in range(1 if kind == HEIGHT else 4):
        i = point_of(p, t, k)
        j = load(link, i)
        if j >= 0:
            along = s if k < 2 else u
            factor = along if k % 2 == 1 else 1.0 - along
            g = scaled((load(value, POINT_SIZE * i + 3) if k < 2 else -load(value, POINT_SIZE * i + 3)) * factor, d)
            moment = cross(load3(places, PLACE_SIZE * i), g)
            while j >= 0:
                b, o = j * RECORD + SCREW_AXIS, MAX_ROWS * j
                store(row, o, load(row, o) + dot(load3(ws, b), moment) + dot(load3(ws, b + 3), g))
                j = load(parent, j)


@part
def velocity_row(m, p, ws, t):
    """The derivative of a velocity, by positions and by velocities, after its value."""
    parent, base, nv = integers(m, TREE.parent), integers(m, TREE.base), m[TREE.nv]
    link, row, d = integers(p, RESIDUALS.point_link), lanes(p, RESIDUALS.row), load3(lanes(p, RESIDUALS.kept), 0)
    for k in range(2):
        i = point_of(p, t, k)
        o, share = PLACE_SIZE * i, load(floats(p, RESIDUALS.point_value), POINT_SIZE * i + 3)
        g = scaled(share if k == 0 else -share, d)
        j = load(link, i)
        if j >= 0:
            moment = cross(load3(lanes(p, RESIDUALS.places), o), g)
            turned = cross(load3(lanes(p, RESIDUALS.places), o + 6), g)
            while j >= 0:
                b, e, f = j * RECORD + SCREW_AXIS, MAX_ROWS * j, MAX_ROWS * (nv + j)
                sw, sv = load3(ws, b), load3(ws, b + 3)
                by_q = dot(sw, turned)
                if load(base, j) >= 0:
                    twist = load(base, j) * RECORD + TWIST
                    bw, bv = load3(ws, twist), load3(ws, twist + 3)
                    by_q += dot(cross(bw, sw), moment) + dot(add(cross(bw, sv), cross(bv, sw)), g)
                store(row, e, load(row, e) + by_q)
                store(row, f, load(row, f) + dot(sw, moment) + dot(sv, g))
                j = load(parent, j)
