"""Slip of a sphere near a plane: three rows, in the world's axes.

With n the plane's normal, h the height of the sphere over it, p = c - r n its lowest point, V_p the velocity of the
link there, and d the clearance of a foot,

    s(h) (V_p - n n'V_p),   s = t^2 (3 - 2 t) of t = 1 - h/d clipped to 0..1:

all of the slip of a foot that stands, none of one that is lifted by d. The arm a = -r n stays vertical, so that

    d V_p / dq_i = Y_i(c) + w_i x V + (W_base x w_i + w_i x W) x a,    d V_p / dqd_i = v_i + w_i x p,
    d h / dq_i   = n'(v_i + w_i x c),                                  Y_i = V_base x S_i    (see frames).

The twin is in problem.costs.residual_functions.
"""

from __future__ import annotations

from planner.kernels.algebra.ramp import clamp
from planner.kernels.algebra.spatial import add, axpy, cross, dot, load3, scaled, store3
from planner.kernels.numba.jit import inline, part
from planner.kernels.numba.lanes import integers, lanes, load, spread, store
from planner.kernels.tree.mechanism_table import TREE
from planner.kernels.tree.recursion import RECORD, TWIST
from planner.kernels.tree.residuals.frames import screw_rates
from planner.kernels.tree.residuals.layout import MAX_ROWS, PLACE_SIZE, RESIDUALS
from planner.kernels.tree.residuals.points import constants_of, point_of

SLIP = 11  # number of its kind
LEVEL, RADIUS, PER_CLEARANCE = 3, 4, 5  # offsets in a term's constants, after the normal


@inline
def _tangential(v, n):
    return axpy(v, spread(0.0) - dot(n, v), n)


@part
def slip_value(p, ws, t):
    """The rows of term t; the share s, its slope by h and the tangential velocity go to KEPT."""
    term, places, o = constants_of(p, t), lanes(p, RESIDUALS.places), PLACE_SIZE * point_of(p, t, 0)
    link, kept = load(integers(p, RESIDUALS.point_link), point_of(p, t, 0)), lanes(p, RESIDUALS.kept)
    n, per = load3(term, 0), load(term, PER_CLEARANCE)
    u = clamp(spread(1.0) - per * (dot(load3(places, o + 3), n) - load(term, LEVEL)))
    arm = scaled(spread(0.0) - load(term, RADIUS), n)
    vt = _tangential(add(load3(places, o + 6), cross(load3(ws, link * RECORD + TWIST), arm)), n)
    share = u * u * (3.0 - 2.0 * u)
    store(kept, 0, share)
    store(kept, 1, -6.0 * per * u * (1.0 - u))
    store3(kept, 2, vt)
    store3(lanes(p, RESIDUALS.value), 0, scaled(share, vt))


@part
def slip_rows(m, p, ws, t):
    """The derivatives by positions and by velocities, after the value."""
    parent, nv = integers(m, TREE.parent), m[TREE.nv]
    row, kept, term, zero = lanes(p, RESIDUALS.row), lanes(p, RESIDUALS.kept), constants_of(p, t), spread(0.0)
    places, o = lanes(p, RESIDUALS.places), PLACE_SIZE * point_of(p, t, 0)
    j = load(integers(p, RESIDUALS.point_link), point_of(p, t, 0))
    c, V, W = load3(places, o), load3(places, o + 6), load3(ws, j * RECORD + TWIST)
    share, slope, vt, n = load(kept, 0), load(kept, 1), load3(kept, 2), load3(term, 0)
    arm = scaled(zero - load(term, RADIUS), n)
    while j >= 0:
        sw, sv, Yw, Yv = screw_rates(m, ws, j)
        dV = add(add(Yv, cross(Yw, c)), cross(sw, V))
        by_q = _tangential(add(dV, cross(add(Yw, cross(sw, W)), arm)), n)
        at_centre = add(sv, cross(sw, c))
        store3(row, MAX_ROWS * j, axpy(scaled(share, by_q), slope * dot(n, at_centre), vt))
        store3(row, MAX_ROWS * (nv + j), scaled(share, _tangential(add(at_centre, cross(sw, arm)), n)))
        j = load(parent, j)
