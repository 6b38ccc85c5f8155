"""Second derivatives of signed distances: what a Hessian of Gauss and Newton leaves out.

The derivative of a distance by dof k is side_k S_k'f, with the screw S_k = (w, v), the wrench f = (p x n, n) of the
direction n at the place p, and side 1 or -1 for dofs that move the first or the second shape alone. A dof l turns n
and moves p. With k before l in the chain, S_k does not move with l, so the second derivative is

    side_k S_k'(p' x n + p x n', n'),

n' and p' by l. (In a ball, whose axes move with it, the mean of both orders: that of its exponential map.)

n is across what the nearest points may slide along: a face's plane or an edge's line of either shape. Across a face n
turns with its body, as do its components along an edge. Along what is left, u, it follows the points: n'u = u'dV / D,
dV the velocity of the first point by that of the second and D the distance of the cores. p is where a corner is, or
where two edges pass each other. Faces or edges that lie parallel count once: there a distance has a kink.
"""

from __future__ import annotations

from planner.kernels.algebra.spatial import add, axpy, cross, dot, load3, scaled, store3, sub
from planner.kernels.numba.jit import inline, part
from planner.kernels.numba.lane_math import sqrt
from planner.kernels.numba.lanes import floats, integers, lanes, load, maximum, select, spread, store
from planner.kernels.tree.mechanism_table import TREE
from planner.kernels.tree.recursion import RECORD, SCREW_AXIS
from planner.kernels.tree.residuals.layout import PLACE_SIZE, RATE_SIZE, RESIDUALS, TINY
from planner.kernels.tree.residuals.points import constants_of, point_of
from planner.kernels.tree.residuals.scalars import DISTANCE, LEVEL
from planner.kernels.tree.residuals.solids import (
    FIRST_AXES,
    FIRST_HALF,
    OVER_PLANE,
    SECOND_AXES,
    SECOND_HALF,
    TAKEN_OFF,
    TOUCHING,
    axes_of,
)

FREE = 1e-7  # of a direction's components, below which the nearest points may slide
PARALLEL_EDGES = 1e-4  # sine between two edges, below which they count as one


@inline
def _size(x):
    return maximum(x, 0.0 - x)


@inline
def _free(n, axis, half):
    """1 where a point may slide along an axis with this half length."""
    return select(_size(dot(n, axis)), FREE, 1.0, spread(0.0)) if half > 0.0 else spread(0.0)


@inline
def _slides(n, axes, half):
    """The edge along which a box's nearest point may slide, or zero; and whether (0 or 1) it is on a face."""
    f0, f1, f2 = _free(n, axes[0], half[0]), _free(n, axes[1], half[1]), _free(n, axes[2], half[2])
    face = select(1.5, f0 + f1 + f2, 1.0, spread(0.0))
    edge = axpy(axpy(scaled(f0, axes[0]), f1, axes[1]), f2, axes[2])
    return scaled(1.0 - face, edge), face


@inline
def _line(n, start, end):
    """As _slides, of a line between two points."""
    v = sub(end, start)
    length = sqrt(dot(v, v) + TINY)
    axis = scaled(1.0 / length, v)
    one = select(_size(dot(n, axis)), FREE, 1.0, spread(0.0)) * select(TOUCHING, length, 1.0, spread(0.0))
    return scaled(one, axis)


@inline
def _about(places, i, p):
    """A place p of the world about the origin of the tree of point i."""
    return add(sub(p, load3(places, PLACE_SIZE * i + 3)), load3(places, PLACE_SIZE * i))


@inline
def _nearest(p, ws, t, kind, n):
    """The core's distance, both nearest points, the edges along which they may slide, whether they are on faces."""
    places, kept, term = lanes(p, RESIDUALS.places), lanes(p, RESIDUALS.kept), constants_of(p, t)
    value, zero = load(lanes(p, RESIDUALS.value), 0), spread(0.0)
    face_a, face_b = zero, zero
    if kind == DISTANCE:
        i, j = PLACE_SIZE * point_of(p, t, 0) + 3, PLACE_SIZE * point_of(p, t, 1) + 3
        k, l = PLACE_SIZE * point_of(p, t, 2) + 3, PLACE_SIZE * point_of(p, t, 3) + 3
        a0, a1, b0, b1 = load3(places, i), load3(places, j), load3(places, k), load3(places, l)
        D = value + load(term, LEVEL)
        at_a, at_b = axpy(a0, load(kept, 3), sub(a1, a0)), axpy(b0, load(kept, 4), sub(b1, b0))
        a, b = _line(n, a0, a1), _line(n, b0, b1)
    else:
        D, there = value + load(term, TAKEN_OFF), load3(kept, 3)
        ax, ay, az = axes_of(p, ws, t, 0, FIRST_AXES)
        a, face_a = _slides(n, (ax, ay, az), load3(term, FIRST_HALF))
        if kind == OVER_PLANE:
            at_a, at_b, b, face_b = there, there, (zero, zero, zero), zero + 1.0
        else:
            bx, by, bz = axes_of(p, ws, t, 1, SECOND_AXES)
            h = load3(term, SECOND_HALF)
            b, face_b = _slides(n, (bx, by, bz), h)
            reach = _size(dot(n, bx)) * h[0] + _size(dot(n, by)) * h[1] + _size(dot(n, bz)) * h[2]
            over = dot(n, sub(there, load3(places, PLACE_SIZE * point_of(p, t, 1) + 3))) - reach  # 0 or D
            at_b = axpy(there, 0.0 - over, n)
            at_a = axpy(at_b, D, n)
    face_a = face_a * (1.0 - face_b)
    on_edge = 1.0 - face_a - face_b
    a, b = scaled(on_edge, a), scaled(on_edge, b)
    m = cross(n, b)
    apart = select(_size(dot(a, m)), PARALLEL_EDGES, 1.0 - dot(b, b), spread(1.0))
    return D, at_a, at_b, scaled(apart, a), b, face_a, face_b


@part
def add_distance_curvature(m, p, ws, t, factor):
    """Add `factor` times the second derivatives of the distance of term t to RESIDUALS.bend, after its value."""
    kind, places = load(integers(p, RESIDUALS.kind), t), lanes(p, RESIDUALS.places)
    n, base = load3(lanes(p, RESIDUALS.kept), 0), integers(m, TREE.base)
    D, at_a, at_b, a, b, face_a, face_b = _nearest(p, ws, t, kind, n)
    i, j = point_of(p, t, 0), point_of(p, t, 2) if kind == DISTANCE else point_of(p, t, 1)
    about_a, about_b = _about(places, i, at_a), _about(places, j, at_b)
    has_a, has_b = dot(a, a), dot(b, b)  # 0 or 1
    both = has_a * has_b
    across = cross(n, b)
    passing = both / (dot(a, across) + 1.0 - both)
    along_a = axpy(scaled(1.0 - both, a), passing, across)
    along_b = axpy(scaled(1.0 - both, b), 0.0 - passing, cross(n, a))
    rest = (1.0 - both) * (1.0 - face_a - face_b) / maximum(D, TOUCHING)
    second = maximum(face_a, has_a * (1.0 - has_b))  # 1 where the place is that of the second's corner
    there = axpy(at_a, second, sub(at_b, at_a))
    start, end = load(integers(p, RESIDUALS.start), t), load(integers(p, RESIDUALS.start), t + 1)
    dof, side, rates = integers(p, RESIDUALS.dof), floats(p, RESIDUALS.side), lanes(p, RESIDUALS.rates)
    H, ld = lanes(p, RESIDUALS.bend), p[RESIDUALS.ld]
    for l in range(start, end):
        s = load(side, l)
        if s == 0.0:
            continue
        o = load(dof, l) * RECORD + SCREW_AXIS
        w, v = load3(ws, o), load3(ws, o + 3)
        of_a, of_b = (1.0, 0.0) if s > 0.0 else (0.0, 1.0)
        moves = add(v, cross(w, about_a if s > 0.0 else about_b))
        dV, turned = scaled(s, moves), cross(w, n)
        left = axpy(axpy(axpy(dV, 0.0 - dot(n, dV), n), 0.0 - dot(a, dV), a), 0.0 - dot(b, dV), b)
        dn = axpy(scaled(of_a * face_a + of_b * face_b, turned), rest, left)
        dn = axpy(axpy(dn, of_a * dot(a, turned), along_a), of_b * dot(b, turned), along_b)
        slid = passing * (D * dot(across, dn) - dot(across, dV))
        dp = axpy(scaled(of_a * (1.0 - second) + of_b * second, moves), slid, a)
        lever, k = cross(dp, n), RATE_SIZE * (l - start)
        store3(rates, k, dn)
        store3(rates, k + 3, add(lever, cross(_about(places, i, there), dn)))
        store3(rates, k + 6, add(lever, cross(_about(places, j, there), dn)))
    for l in range(start, end):
        for k in range(start, l + 1):
            s = load(side, k)
            if s == 0.0 or load(side, l) == 0.0:
                continue
            total = s * _along(ws, load(dof, k), rates, RATE_SIZE * (l - start), s)
            if k < l and s == load(side, l) and load(base, load(dof, k)) == load(base, load(dof, l)):
                total = 0.5 * (total + s * _along(ws, load(dof, l), rates, RATE_SIZE * (k - start), s))
            o = load(dof, k) * ld + load(dof, l)
            store(H, o, load(H, o) + factor * total)


@inline
def _along(ws, i, rates, k, s):
    """The screw of dof i of side s on the rate k of a wrench."""
    o, moment = i * RECORD + SCREW_AXIS, load3(rates, k + 3) if s > 0.0 else load3(rates, k + 6)
    return dot(load3(ws, o), moment) + dot(load3(ws, o + 3), load3(rates, k))
