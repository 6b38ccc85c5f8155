"""Where the links, points and frames of a solve's residuals are, on four candidates or four knots."""

from __future__ import annotations

from planner.kernels.algebra.spatial import add, axpy, cross, load3, load9, rotated, scaled, store3
from planner.kernels.numba.jit import inline, part
from planner.kernels.numba.lanes import at, floats, integers, lanes, load, load4, spread
from planner.kernels.tree.mechanism_table import TREE
from planner.kernels.tree.recursion import PLACE, RECORD, TWIST, place, placement, turn
from planner.kernels.tree.residuals.layout import PLACE_SIZE, POINT_SIZE, RESIDUALS


@inline
def stage_value(values, k, knots):
    """Entry k of what varies over stages, the same for four candidates, or those from k on for four knots."""
    return load4(values, k) if knots else spread(load(values, k))


@part
def place_links(m, p, x, ws):
    """Poses and screws of the links that carry points into their records, with twists where terms need them."""
    q, v, fast = x, at(x, m[TREE.nq]), p[RESIDUALS.fast]
    tree, parent, moved = placement(m), integers(m, TREE.parent), integers(p, RESIDUALS.links)
    for k in range(p[RESIDUALS.moved]):
        i = load(moved, k)
        turn(tree, i, q, ws)
        _, _, sw, sv = place(tree, i, q, ws)
        if fast > 0:
            w, u, b = scaled(load(v, i), sw), scaled(load(v, i), sv), load(parent, i) * RECORD + TWIST
            if load(parent, i) >= 0:
                w, u = add(w, load3(ws, b)), add(u, load3(ws, b + 3))
            store3(ws, i * RECORD + TWIST, w)
            store3(ws, i * RECORD + TWIST + 3, u)


@inline
def place_points(p, q, ws, n, knots):
    """Places of all points at stage n (or four from there on), and how their links move them; links are placed."""
    fast, link, address = p[RESIDUALS.fast], integers(p, RESIDUALS.point_link), integers(p, RESIDUALS.point_address)
    value = floats(p, RESIDUALS.point_value)
    world, places, stride = floats(p, RESIDUALS.world), lanes(p, RESIDUALS.places), p[RESIDUALS.stride]
    for i in range(p[RESIDUALS.points]):
        o, k = 3 * i * stride + n, load(link, i)
        seen = (
            stage_value(world, o, knots), stage_value(world, o + stride, knots),
            stage_value(world, o + 2 * stride, knots),
        )  # fmt: skip
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
def point_of(p, t, k):
    """Number of point k of term t."""
    return load(integers(p, RESIDUALS.ends), 4 * t + k)


@inline
def constants_of(p, t):
    """The constants of term t."""
    return at(floats(p, RESIDUALS.constant), p[RESIDUALS.constants] * t)


@inline
def reference(p, t, k, n, knots):
    """Number k of what term t refers to at stage n, or at four from there on."""
    row = load(integers(p, RESIDUALS.first_reference), t) + k
    return stage_value(floats(p, RESIDUALS.reference), row * p[RESIDUALS.stride] + n, knots)


@inline
def reference3(p, t, k, n, knots):
    """Three of them."""
    return reference(p, t, k, n, knots), reference(p, t, k + 1, n, knots), reference(p, t, k + 2, n, knots)
