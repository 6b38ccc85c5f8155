"""PenaltyCosts on lanes: their value over four candidates, their gradients and Hessians over four knots.

The twin of problem.costs.penalty, whose arithmetic it repeats. With a term's value f, its direction d and the factor of
each of its points (1 - s, s, u - 1 and -u for the ends of two lines; 1 for a height), the derivative of f by dof i is

    sum over points of factor share d'(v_i + w_i x p) = sum of w_i'(p x g) + v_i'g,    g = factor share d,

a wrench on the point's link, for the links that move it: (w_i, v_i) is the screw of i, p the point, both about the
tree's origin. The velocity V of a point, along d, has by q_i and v_i the derivatives

    d'(Y_i(p) + w_i x V),   d'(v_i + w_i x p),   Y_i = V_base x S_i    (see kernels.tree.contact, where p is the link's)
"""

from __future__ import annotations

from planner.kernels.algebra.ramp import clamp, ramp
from planner.kernels.algebra.spatial import add, axpy, cross, dot, load3, load9, rotated, scaled, store3, sub
from planner.kernels.lq.workspace import W
from planner.kernels.numba.jit import inline, jit, part
from planner.kernels.numba.lane_math import sqrt
from planner.kernels.numba.lanes import (
    WIDTH,
    any_less,
    as_floats,
    at,
    floats,
    integers,
    lanes,
    load,
    load4,
    pointer,
    spread,
    store,
)
from planner.kernels.tree.linearize import scatter_row
from planner.kernels.tree.memory import MEMORY
from planner.kernels.tree.model import TREE
from planner.kernels.tree.penalty_table import (
    DISTANCE,
    HEIGHT,
    PARALLEL,
    PENALTY,
    PLACE_SIZE,
    POINT_SIZE,
    TERM_SIZE,
    TINY,
    VELOCITY,
)
from planner.kernels.tree.recursion import PLACE, RECORD, SCREW_AXIS, TWIST, place, placement
from planner.kernels.tree.step import gather

LEVEL, SIDE, RAMP, PER_RAMP = 3, 4, 5, 6  # offsets in a term's constants, after its normal


@inline
def _stage(values, k, knots):
    """Entry k of what varies over stages, the same for four candidates, or those from k on for four knots."""
    return load4(values, k) if knots else spread(load(values, k))


@inline
def _place_points(m, p, x, ws, n, knots):
    """Place all points at stage n (or four from there on), with velocities where terms need them; in PENALTY.places."""
    q, v, fast = x, at(x, m[TREE.nq]), p[PENALTY.fast]
    tree, parent, moved = placement(m), integers(m, TREE.parent), integers(p, PENALTY.links)
    for k in range(p[PENALTY.moved]):
        i = load(moved, k)
        _, _, sw, sv = place(tree, i, q, ws)
        if fast > 0:
            w, u, b = scaled(load(v, i), sw), scaled(load(v, i), sv), load(parent, i) * RECORD + TWIST
            if load(parent, i) >= 0:
                w, u = add(w, load3(ws, b)), add(u, load3(ws, b + 3))
            store3(ws, i * RECORD + TWIST, w)
            store3(ws, i * RECORD + TWIST + 3, u)
    link, address = integers(p, PENALTY.point_link), integers(p, PENALTY.point_address)
    value = floats(p, PENALTY.point_value)
    world, places, stride = floats(p, PENALTY.world), lanes(p, PENALTY.places), p[PENALTY.stride]
    for i in range(p[PENALTY.points]):
        o, k = 3 * i * stride + n, load(link, i)
        seen = (_stage(world, o, knots), _stage(world, o + stride, knots), _stage(world, o + 2 * stride, knots))
        if k >= 0:
            b, own, share = k * RECORD, POINT_SIZE * i, load(value, POINT_SIZE * i + 3)
            R = load9(ws, b)
            c = add(load3(ws, b + PLACE), rotated(R, load3(value, own)))
            store3(places, PLACE_SIZE * i, c)
            seen = axpy(seen, share, c)
            a = load(address, i)
            if a >= 0:  # a floating tree is described about where it is
                seen = axpy(seen, share, load3(q, a))
            if fast > 0:
                V = add(load3(ws, b + TWIST + 3), cross(load3(ws, b + TWIST), c))
                store3(places, PLACE_SIZE * i + 6, V)
        store3(places, PLACE_SIZE * i + 3, seen)


@inline
def _nearest(a0, a1, b0, b1):
    """From the nearest point of a line to that of another, and where they are; as problem.costs.penalty.nearest."""
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
    if load(integers(p, PENALTY.point_link), i) >= 0:
        share = load(floats(p, PENALTY.point_value), POINT_SIZE * i + 3)
        speed = share * dot(load3(lanes(p, PENALTY.places), PLACE_SIZE * i + 6), d)
    return speed


@inline
def _measured(p, t):
    """Term t's value and direction, and where along their lines its points are."""
    ends, places, term = integers(p, PENALTY.ends), lanes(p, PENALTY.places), at(floats(p, PENALTY.term), TERM_SIZE * t)
    zero, kind = spread(0.0), load(integers(p, PENALTY.kind), t)
    i = PLACE_SIZE * load(ends, 4 * t) + 3
    d = add((zero, zero, zero), load3(term, 0))
    value, s, u = dot(load3(places, i), d), zero, zero
    if kind == VELOCITY:
        value = _speed(p, load(ends, 4 * t), d) - _speed(p, load(ends, 4 * t + 1), d)
    elif kind == DISTANCE:
        j, k = PLACE_SIZE * load(ends, 4 * t + 1) + 3, PLACE_SIZE * load(ends, 4 * t + 2) + 3
        l = PLACE_SIZE * load(ends, 4 * t + 3) + 3
        d, s, u = _nearest(load3(places, i), load3(places, j), load3(places, k), load3(places, l))
        value = sqrt(dot(d, d) + TINY)
        d = scaled(1.0 / value, d)
    return value - load(term, LEVEL), d, s, u


@inline
def _ramped(p, t, value, bound):
    """The residual times the tolerance, and its derivative by the value."""
    term = at(floats(p, PENALTY.term), TERM_SIZE * t)
    side, a = load(term, SIDE), load(term, RAMP)
    if side == 0.0:
        return value - bound, spread(1.0)
    residual, slope = ramp(side * (value - bound), a, load(term, PER_RAMP))
    return residual, side * slope


@part
def penalty_cost(m, p, x, ws, n):
    """Cost of the terms for four candidates x (nx lanes) at stage n; ws (links) is overwritten."""
    J = spread(0.0)
    if load(floats(p, PENALTY.active), n) > 0.0:
        _place_points(m, p, x, ws, n, False)
        weights, bounds, stride = floats(p, PENALTY.weight), floats(p, PENALTY.bound), p[PENALTY.stride]
        for t in range(p[PENALTY.terms]):
            weight = load(weights, t * stride + n)
            if weight > 0.0:
                value, _, _, _ = _measured(p, t)
                residual, _ = _ramped(p, t, value, spread(load(bounds, t * stride + n)))
                J += 0.5 * weight * (residual * residual)
    return J


@inline
def _row(m, p, ws, t, d, s, u):
    """The derivative of term t's value, in PENALTY.row, which was zero."""
    parent, link, ends = integers(m, TREE.parent), integers(p, PENALTY.point_link), integers(p, PENALTY.ends)
    value, places, row = floats(p, PENALTY.point_value), lanes(p, PENALTY.places), lanes(p, PENALTY.row)
    for k in range(1 if load(integers(p, PENALTY.kind), t) == HEIGHT else 4):
        i = load(ends, 4 * t + k)
        j = load(link, i)
        if j >= 0:
            along = s if k < 2 else u
            factor = along if k % 2 == 1 else 1.0 - along
            g = scaled((load(value, POINT_SIZE * i + 3) if k < 2 else -load(value, POINT_SIZE * i + 3)) * factor, d)
            moment = cross(load3(places, PLACE_SIZE * i), g)
            while j >= 0:
                b = j * RECORD + SCREW_AXIS
                store(row, j, load(row, j) + dot(load3(ws, b), moment) + dot(load3(ws, b + 3), g))
                j = load(parent, j)


@inline
def _velocity_row(m, p, ws, t, d):
    """The derivative of a velocity, by positions and by velocities, in PENALTY.row."""
    parent, base, nv = integers(m, TREE.parent), integers(m, TREE.base), m[TREE.nv]
    link, ends, row = integers(p, PENALTY.point_link), integers(p, PENALTY.ends), lanes(p, PENALTY.row)
    for k in range(2):
        i = load(ends, 4 * t + k)
        o, share = PLACE_SIZE * i, load(floats(p, PENALTY.point_value), POINT_SIZE * i + 3)
        g = scaled(share if k == 0 else -share, d)
        j = load(link, i)
        if j >= 0:
            moment = cross(load3(lanes(p, PENALTY.places), o), g)
            turned = cross(load3(lanes(p, PENALTY.places), o + 6), g)
            while j >= 0:
                b = j * RECORD + SCREW_AXIS
                sw, sv = load3(ws, b), load3(ws, b + 3)
                by_q = dot(sw, turned)
                if load(base, j) >= 0:
                    twist = load(base, j) * RECORD + TWIST
                    bw, bv = load3(ws, twist), load3(ws, twist + 3)
                    by_q += dot(cross(bw, sw), moment) + dot(add(cross(bw, sv), cross(bv, sw)), g)
                store(row, j, load(row, j) + by_q)
                store(row, nv + j, load(row, nv + j) + dot(sw, moment) + dot(sv, g))
                j = load(parent, j)


@inline
def _add_term(p, t, gradient, curvature):
    """Add the row's part to gradient and Hessian, and make the row zero again."""
    start, dof, row = integers(p, PENALTY.start), integers(p, PENALTY.dof), lanes(p, PENALTY.row)
    g, H, ld, end = lanes(p, PENALTY.gradient), lanes(p, PENALTY.hessian), p[PENALTY.ld], load(start, t + 1)
    for k in range(load(start, t), end):
        i = load(dof, k)
        x = load(row, i)
        store(g, i, load(g, i) + gradient * x)
        c, o = curvature * x, i * ld
        for l in range(k, end):
            j = load(dof, l)
            store(H, o + j, load(H, o + j) + c * load(row, j))
    for k in range(load(start, t), end):
        store(row, load(dof, k), 0.0)


@inline
def _scatter(w, p, first, present):
    """Gradients of up to four stages onto W.l, Hessians into W.penalty_hessian."""
    rows, ld, width = p[PENALTY.rows], p[PENALTY.ld], w[W.width]
    l, H = at(floats(w, W.l), w[W.first]), floats(w, W.penalty_hessian)
    g = as_floats(lanes(p, PENALTY.gradient))
    for lane in range(present):
        for i in range(rows):
            k = (first + lane) * width + i
            store(l, k, load(l, k) + load(g, i * WIDTH + lane))
    for i in range(rows):
        scatter_row(lanes(p, PENALTY.hessian), i * ld, H, first * rows * ld + i * ld, present, rows * ld, ld)


@jit
def penalise(w, m, r, p):
    """Add the terms' gradients to W.l of every stage and of the end, and leave their Hessians in W.penalty_hessian."""
    w, m, r, p = pointer(w), pointer(m), pointer(r), pointer(p)
    stages, nx, x, ws = w[W.N] + 1, w[W.nx], lanes(r, MEMORY.x), lanes(r, MEMORY.links)
    weights, bounds, stride = floats(p, PENALTY.weight), floats(p, PENALTY.bound), p[PENALTY.stride]
    active = floats(p, PENALTY.active)
    kinds = integers(p, PENALTY.kind)
    for first in range(0, stages, WIDTH):
        if not any_less(0.0, load4(active, first)):
            continue  # their Hessians are zero for good
        gather(floats(w, W.xs), first, stages, nx, x)
        _place_points(m, p, x, ws, first, True)
        for i in range(p[PENALTY.rows]):
            store(lanes(p, PENALTY.gradient), i, 0.0)
            for j in range(p[PENALTY.ld]):
                store(lanes(p, PENALTY.hessian), i * p[PENALTY.ld] + j, 0.0)
        for t in range(p[PENALTY.terms]):
            weight = load4(weights, t * stride + first)
            if any_less(0.0, weight):
                value, d, s, u = _measured(p, t)
                residual, slope = _ramped(p, t, value, load4(bounds, t * stride + first))
                if any_less(0.0, slope * slope):
                    if load(kinds, t) == VELOCITY:
                        _velocity_row(m, p, ws, t, d)
                    else:
                        _row(m, p, ws, t, d, s, u)
                    _add_term(p, t, weight * slope * residual, weight * slope * slope)
        _scatter(w, p, first, min(WIDTH, stages - first))
