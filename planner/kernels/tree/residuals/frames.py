"""Where a frame is, where an axis of it points, how fast it moves and turns: three rows each. Its tilt: one row.

All are in the world's axes.

With the screw (w_i, v_i) of a dof that moves the frame, its origin p, moving at V and turning at W:

    position       d p / dq_i = v_i + w_i x p
    pointing       d b / dq_i = w_i x b, b the axis; a target d for it leaves |b - d| = 2 sin(angle / 2)
    linear         d V / dq_i = Y_i(p) + w_i x V,              d V / dqd_i = v_i + w_i x p,    Y_i = V_base x S_i
    tilt           theta = atan2(|b x d|, b'd),    d theta / dq_i = -w_i'(b x d) / |b x d| = -w_i'n
    angular        d W / dq_i = W_base x w_i + w_i x W,        d W / dqd_i = w_i

A tilt has a second row, which has no value: how far the axis moves across the arc from b to d, w_i'(b x n). Along it
theta has the second derivative 1 / tan(theta), which is large where theta is small (the axis is on a narrow cone).

The twin is in problem.costs.residual_functions.
"""

from __future__ import annotations

import math

from planner.kernels.algebra.spatial import add, cross, dot, load3, load9, rotated, scaled, store3
from planner.kernels.numba.jit import inline, part
from planner.kernels.numba.lane_math import quarter_angle, sqrt
from planner.kernels.numba.lanes import integers, lanes, load, select, spread, store
from planner.kernels.tree.mechanism_table import TREE
from planner.kernels.tree.recursion import RECORD, SCREW_AXIS, TWIST
from planner.kernels.tree.residuals.layout import MAX_ROWS, PLACE_SIZE, RESIDUALS, TINY
from planner.kernels.tree.residuals.points import constants_of, point_of

POSITION, POINTING, LINEAR, ANGULAR = range(3, 7)  # numbers of kinds
TILT = 10
TILT_BEND = 6  # of KEPT, where a tilt leaves its second derivative across
BLUNT = 1e-6  # rad^2, added to squares of sines: at the kink of a tilt of zero the second derivative would be infinite


@inline
def link_of(p, t):
    """The link that carries the frame of term t, or -1."""
    return load(integers(p, RESIDUALS.point_link), point_of(p, t, 0))


@part
def frame_value(p, ws, t, kind):
    """The position of a frame, an axis of it, or its linear or angular velocity."""
    o, zero, link = PLACE_SIZE * point_of(p, t, 0), spread(0.0), link_of(p, t)
    value = load3(lanes(p, RESIDUALS.places), o + 3)
    if kind == POINTING:
        own = load3(constants_of(p, t), 0)
        value = rotated(load9(ws, link * RECORD), own) if link >= 0 else add((zero, zero, zero), own)
    elif kind >= LINEAR:
        value = (zero, zero, zero)
        if link >= 0:
            value = load3(ws, link * RECORD + TWIST) if kind == ANGULAR else load3(lanes(p, RESIDUALS.places), o + 6)
    store3(lanes(p, RESIDUALS.value), 0, value)


@part
def tilt_value(p, ws, t):
    """The angle between an axis of a frame and a direction; n, b x n and 1 / tan(angle) go to KEPT."""
    own, link, zero = constants_of(p, t), link_of(p, t), spread(0.0)
    b, d = load3(own, 0), load3(own, 3)
    b = rotated(load9(ws, link * RECORD), b) if link >= 0 else add((zero, zero, zero), b)
    about, cosine = cross(b, d), dot(b, d)
    sine = sqrt(dot(about, about) + TINY)
    angle = quarter_angle(sine, select(cosine, 0.0, -1.0 * cosine, cosine))
    normal, kept = scaled(1.0 / sine, about), lanes(p, RESIDUALS.kept)
    store3(kept, 0, normal)
    store3(kept, 3, cross(b, normal))
    store(kept, TILT_BEND, cosine * sine / (sine * sine + BLUNT))
    store(lanes(p, RESIDUALS.value), 0, select(cosine, 0.0, math.pi - angle, angle))


@part
def tilt_row(m, p, ws, t):
    """The derivative of a tilt and the row across, after its value."""
    parent, row, j = integers(m, TREE.parent), lanes(p, RESIDUALS.row), link_of(p, t)
    normal, across = load3(lanes(p, RESIDUALS.kept), 0), load3(lanes(p, RESIDUALS.kept), 3)
    while j >= 0:
        sw = load3(ws, j * RECORD + SCREW_AXIS)
        store(row, MAX_ROWS * j, -1.0 * dot(sw, normal))
        store(row, MAX_ROWS * j + 1, dot(sw, across))
        j = load(parent, j)


@part
def place_rows(m, p, ws, t, kind):
    """The derivative of a position, or of an axis after its value."""
    parent, row, j = integers(m, TREE.parent), lanes(p, RESIDUALS.row), link_of(p, t)
    c, axis = load3(lanes(p, RESIDUALS.places), PLACE_SIZE * point_of(p, t, 0)), load3(lanes(p, RESIDUALS.value), 0)
    while j >= 0:
        b = j * RECORD + SCREW_AXIS
        sw = load3(ws, b)
        turned = cross(sw, axis) if kind == POINTING else add(load3(ws, b + 3), cross(sw, c))
        store3(row, MAX_ROWS * j, turned)
        j = load(parent, j)


@inline
def screw_rates(m, ws, j):
    """The screw (w, v) of dof j, and its rate by its base's twist, Y = V_base x S."""
    b, base, zero = j * RECORD + SCREW_AXIS, load(integers(m, TREE.base), j), spread(0.0)
    sw, sv = load3(ws, b), load3(ws, b + 3)
    bw, bv = (zero, zero, zero), (zero, zero, zero)
    if base >= 0:
        bw, bv = load3(ws, base * RECORD + TWIST), load3(ws, base * RECORD + TWIST + 3)
    return sw, sv, cross(bw, sw), add(cross(bw, sv), cross(bv, sw))


@part
def speed_rows(m, p, ws, t, kind):
    """The derivatives of a linear or angular velocity, by positions and by velocities."""
    parent, nv = integers(m, TREE.parent), m[TREE.nv]
    row, link, o = lanes(p, RESIDUALS.row), link_of(p, t), PLACE_SIZE * point_of(p, t, 0)
    c, V, j = load3(lanes(p, RESIDUALS.places), o), load3(lanes(p, RESIDUALS.places), o + 6), link
    while j >= 0:
        sw, sv, Yw, Yv = screw_rates(m, ws, j)
        if kind == ANGULAR:
            by_q, by_v = add(Yw, cross(sw, load3(ws, link * RECORD + TWIST))), sw
        else:
            by_q, by_v = add(add(Yv, cross(Yw, c)), cross(sw, V)), add(sv, cross(sw, c))
        store3(row, MAX_ROWS * j, by_q)
        store3(row, MAX_ROWS * (nv + j), by_v)
        j = load(parent, j)
