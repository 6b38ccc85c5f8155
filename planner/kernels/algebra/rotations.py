"""Quaternions and rotation vectors on lanes: exponential, logarithm and their Jacobians, as in planner.model.space."""

from __future__ import annotations

import math

from planner.kernels.algebra.spatial import axpy, cross
from planner.kernels.numba.jit import inline
from planner.kernels.numba.lane_math import sincos, sqrt
from planner.kernels.numba.lanes import WIDTH, as_floats, load, store

_MIN_SQUARED_ANGLE = 1e-40  # added to squared angles, so that no angle is zero: sin(x)/x is then 1 to the last bit


@inline
def turned(w, x, y, z, r):
    """Quaternion times the exponential of a rotation vector r, normalized (MuJoCo's mju_quatIntegrate)."""
    half = 0.5 * sqrt(r[0] * r[0] + r[1] * r[1] + r[2] * r[2] + _MIN_SQUARED_ANGLE)
    s, c = sincos(half)
    f = 0.5 * s / half
    a, b, d = f * r[0], f * r[1], f * r[2]
    n = 1.0 / sqrt(w * w + x * x + y * y + z * z)
    return (
        n * (w * c - x * a - y * b - z * d), n * (w * a + x * c + y * d - z * b),
        n * (w * b - x * d + y * c + z * a), n * (w * d + x * b - y * a + z * c),
    )  # fmt: skip


@inline
def _log_between(w0, x0, y0, z0, w, x, y, z):
    """Rotation vector from one quaternion to another, of floats; model.space.log_quaternion of their quotient."""
    a = w0 * w + x0 * x + y0 * y + z0 * z
    b = w0 * x - x0 * w - y0 * z + z0 * y
    c = w0 * y + x0 * z - y0 * w - z0 * x
    d = w0 * z - x0 * y + y0 * x - z0 * w
    if a < 0.0:
        a, b, c, d = -a, -b, -c, -d
    sine = math.sqrt(b * b + c * c + d * d)
    f = 2.0 * math.atan2(sine, a) / sine if sine > 1e-12 * a else 2.0 / a
    return f * b, f * c, f * d


@inline
def difference(q, at, reference, at_reference, r, at_r):
    """Rotation vector (three lanes of r) from one quaternion (four floats of reference) to another (lanes of q)."""
    p, out = as_floats(q), as_floats(r)
    for lane in range(WIDTH):
        k = at * WIDTH + lane
        b, c, d = _log_between(
            load(reference, at_reference), load(reference, at_reference + 1), load(reference, at_reference + 2),
            load(reference, at_reference + 3), load(p, k), load(p, k + WIDTH), load(p, k + 2 * WIDTH),
            load(p, k + 3 * WIDTH),
        )  # fmt: skip
        k = at_r * WIDTH + lane
        store(out, k, b)
        store(out, k + WIDTH, c)
        store(out, k + 2 * WIDTH, d)


@inline
def difference_of_lanes(q, reference, at, r, at_r):
    """As difference, where the quaternions from `at` on are lanes of both."""
    p, p0, out = as_floats(q), as_floats(reference), as_floats(r)
    for lane in range(WIDTH):
        k, o = at * WIDTH + lane, at_r * WIDTH + lane
        b, c, d = _log_between(
            load(p0, k), load(p0, k + WIDTH), load(p0, k + 2 * WIDTH), load(p0, k + 3 * WIDTH),
            load(p, k), load(p, k + WIDTH), load(p, k + 2 * WIDTH), load(p, k + 3 * WIDTH),
        )  # fmt: skip
        store(out, o, b)
        store(out, o + WIDTH, c)
        store(out, o + 2 * WIDTH, d)


@inline
def difference_floats(q, reference, r):
    """Rotation vector (three floats of r) from one quaternion to another."""
    b, c, d = _log_between(
        load(reference, 0), load(reference, 1), load(reference, 2), load(reference, 3),
        load(q, 0), load(q, 1), load(q, 2), load(q, 3),
    )  # fmt: skip
    store(r, 0, b)
    store(r, 1, c)
    store(r, 2, d)


@inline
def _double_cross(r, v):
    return cross(r, cross(r, v))


@inline
def right_jacobian_times(r, v):
    """Jr(r) v with exp(r + e) = exp(r) exp(Jr(r) e)."""
    square = r[0] * r[0] + r[1] * r[1] + r[2] * r[2] + _MIN_SQUARED_ANGLE
    half = 0.5 * sqrt(square)
    s, c = sincos(half)
    first = 2.0 * s * s / square
    # (t - sin t) / t^3 loses digits near 0, but r x (r x v) is as small there as they are few
    second = (2.0 * half - 2.0 * s * c) / (square * 2.0 * half)
    return axpy(axpy(v, -1.0 * first, cross(r, v)), second, _double_cross(r, v))


@inline
def carried(r, v):
    """The vector exp(-r) v: a rotation at the start of a step seen at its end."""
    square = r[0] * r[0] + r[1] * r[1] + r[2] * r[2] + _MIN_SQUARED_ANGLE
    half = 0.5 * sqrt(square)
    s, c = sincos(half)
    return axpy(axpy(v, -1.0 * (s * c / half), cross(r, v)), 2.0 * s * s / square, _double_cross(r, v))


@inline
def _inverse_right_jacobian(x, y, z):
    square = x * x + y * y + z * z + _MIN_SQUARED_ANGLE
    half = 0.5 * math.sqrt(square)
    f = (1.0 - half / math.tan(half)) / square
    if square < 1e-6:  # the series' next term is below rounding
        f = 1.0 / 12.0 + square / 720.0
    return (
        1.0 - f * (y * y + z * z), -0.5 * z + f * x * y, 0.5 * y + f * x * z,
        0.5 * z + f * x * y, 1.0 - f * (x * x + z * z), -0.5 * x + f * y * z,
        -0.5 * y + f * x * z, 0.5 * x + f * y * z, 1.0 - f * (x * x + y * y),
    )  # fmt: skip


@inline
def inverse_right_jacobian(r, at_r, J, at_J):
    """Nine lanes of J: the inverse of Jr(r), row by row; log(R exp(e)) = r + J e with log R = r."""
    p, out = as_floats(r), as_floats(J)
    for lane in range(WIDTH):
        k = at_r * WIDTH + lane
        entries = _inverse_right_jacobian(load(p, k), load(p, k + WIDTH), load(p, k + 2 * WIDTH))
        for i in range(9):
            store(out, (at_J + i) * WIDTH + lane, entries[i])


@inline
def inverse_right_jacobian_floats(r, J):
    """As inverse_right_jacobian, for one rotation vector of floats."""
    entries = _inverse_right_jacobian(load(r, 0), load(r, 1), load(r, 2))
    for i in range(9):
        store(J, i, entries[i])
