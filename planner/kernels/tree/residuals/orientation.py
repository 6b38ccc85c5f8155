"""How a frame stands against one that it should be: the rotation vector between them (three rows), or all six of SE(3).

    orientation    phi = log(R_ref' R),                       d phi = Jr^-1(phi) R'w_i
    pose           (rho, phi) = log(T_ref^-1 T),  rho = Jl^-1(phi) t,  t = R_ref'(p - p_ref)
                   d rho = Jr^-1(phi) R'(v_i + w_i x p) + d(Jl^-1(phi) t) along d phi

    Jr^-1(phi) = 1 + hat(phi)/2 + f hat(phi)^2,    Jl^-1 = 1 - hat(phi)/2 + f hat(phi)^2,
    f = (1 - (a/2) cot(a/2)) / a^2,   a = |phi|      (Barfoot, State Estimation for Robotics, section 7.1)

for the screws (w_i, v_i) of the dofs that move the frame. The twin is in problem.costs.residual_functions.
"""

from __future__ import annotations

from planner.kernels.algebra.spatial import add, axpy, cross, dot, load3, load9, row_times, store3, sub
from planner.kernels.numba.jit import inline, part
from planner.kernels.numba.lane_math import quarter_angle, sqrt
from planner.kernels.numba.lanes import integers, lanes, load, select, spread, store
from planner.kernels.tree.mechanism_table import TREE
from planner.kernels.tree.recursion import RECORD, SCREW_AXIS
from planner.kernels.tree.residuals.frames import link_of
from planner.kernels.tree.residuals.layout import MAX_ROWS, PLACE_SIZE, RESIDUALS, TINY
from planner.kernels.tree.residuals.points import constants_of, point_of, reference3

ORIENTATION, POSE = 7, 8  # numbers of kinds
# Offsets in KEPT: the frame's rotation in the world (9), phi (3), f and its derivative by a^2, t (3).
_R, _PHI, _F, _SLOPE, _T = 0, 9, 12, 13, 14
_SERIES_THRESHOLD = 0.04  # rad^2, below it a series: its next term is below rounding


@inline
def _quaternion_of(a, b, c):
    """A quaternion, not of length one, of the rotation with rows a, b, c: of 4 q q' that with the largest diagonal."""
    w, x = 1.0 + a[0] + b[1] + c[2], 1.0 + a[0] - b[1] - c[2]
    y, z = 1.0 - a[0] + b[1] - c[2], 1.0 - a[0] - b[1] + c[2]
    wx, wy, wz = c[1] - b[2], a[2] - c[0], b[0] - a[1]
    xy, xz, yz = a[1] + b[0], a[2] + c[0], b[2] + c[1]
    first, q0, q1, q2, q3 = w, w, wx, wy, wz
    q0, q1, q2, q3 = (
        select(first, x, wx, q0), select(first, x, x, q1), select(first, x, xy, q2), select(first, x, xz, q3),
    )  # fmt: skip
    first = select(first, x, x, first)
    q0, q1, q2, q3 = (
        select(first, y, wy, q0), select(first, y, xy, q1), select(first, y, y, q2), select(first, y, yz, q3),
    )  # fmt: skip
    first = select(first, y, y, first)
    q0, q1, q2, q3 = (
        select(first, z, wz, q0), select(first, z, xz, q1), select(first, z, yz, q2), select(first, z, z, q3),
    )  # fmt: skip
    return q0, q1, q2, q3


@inline
def _log(a, b, c):
    """The rotation vector of the rotation with rows a, b, c, with f and its derivative by the squared angle."""
    w, x, y, z = _quaternion_of(a, b, c)
    side = select(w, 0.0, -1.0, 1.0)
    w = side * w
    sine = sqrt(x * x + y * y + z * z + TINY)
    half = quarter_angle(sine, w)
    scale = side * (2.0 * half / sine)
    square, cot = 4.0 * half * half, w / sine
    f = (1.0 - half * cot) / square
    slope = ((half * (1.0 + cot * cot) - cot) / (8.0 * half) - f) / square
    s = square
    near = 1.0 / 12.0 + s * (1.0 / 720.0 + s * (1.0 / 30240.0 + s * (1.0 / 1209600.0 + s * (1.0 / 47900160.0))))
    near_slope = 1.0 / 720.0 + s * (1.0 / 15120.0 + s * (1.0 / 403200.0 + s * (1.0 / 11975040.0)))
    f, slope = select(square, _SERIES_THRESHOLD, near, f), select(square, _SERIES_THRESHOLD, near_slope, slope)
    return (scale * x, scale * y, scale * z), f, slope


@part
def orientation_value(p, ws, t, kind, n, knots):
    """The rotation vector of an orientation, or the logarithm of a pose; what the derivative needs goes to KEPT."""
    own, link, zero, kept = constants_of(p, t), link_of(p, t), spread(0.0), lanes(p, RESIDUALS.kept)
    h0, h1, h2 = load3(own, 0), load3(own, 3), load3(own, 6)
    none = (zero, zero, zero)
    R0, R1, R2 = add(none, h0), add(none, h1), add(none, h2)
    if link >= 0:
        b = link * RECORD
        R0, R1, R2 = (
            row_times(load3(ws, b), h0, h1, h2), row_times(load3(ws, b + 3), h0, h1, h2),
            row_times(load3(ws, b + 6), h0, h1, h2),
        )  # fmt: skip
    u0, u1, u2 = (
        reference3(p, t, 0, n, knots), reference3(p, t, 3, n, knots), reference3(p, t, 6, n, knots),
    )  # fmt: skip
    phi, f, slope = _log(
        row_times((u0[0], u1[0], u2[0]), R0, R1, R2), row_times((u0[1], u1[1], u2[1]), R0, R1, R2),
        row_times((u0[2], u1[2], u2[2]), R0, R1, R2),
    )  # fmt: skip
    store3(kept, _R, R0)
    store3(kept, _R + 3, R1)
    store3(kept, _R + 6, R2)
    store3(kept, _PHI, phi)
    store(kept, _F, f)
    store(kept, _SLOPE, slope)
    value, first = lanes(p, RESIDUALS.value), 0
    if kind == POSE:
        d = sub(load3(lanes(p, RESIDUALS.places), PLACE_SIZE * point_of(p, t, 0) + 3), reference3(p, t, 9, n, knots))
        shift = row_times(d, u0, u1, u2)
        store3(kept, _T, shift)
        turned = cross(phi, shift)
        store3(value, 0, axpy(axpy(shift, -0.5, turned), f, cross(phi, turned)))
        first = 3
    store3(value, first, phi)


@part
def orientation_rows(m, p, ws, t, kind):
    """The derivative of an orientation or pose, after its value."""
    parent, row, kept, j = integers(m, TREE.parent), lanes(p, RESIDUALS.row), lanes(p, RESIDUALS.kept), link_of(p, t)
    R, phi, f, slope, shift = load9(kept, _R), load3(kept, _PHI), load(kept, _F), load(kept, _SLOPE), load3(kept, _T)
    c, first = load3(lanes(p, RESIDUALS.places), PLACE_SIZE * point_of(p, t, 0)), 3 if kind == POSE else 0
    while j >= 0:
        b = j * RECORD + SCREW_AXIS
        sw = load3(ws, b)
        turn = _own_turn(R, phi, f, sw)
        store3(row, MAX_ROWS * j + first, turn)
        if kind == POSE:
            moved = _own_turn(R, phi, f, add(load3(ws, b + 3), cross(sw, c)))
            across, crossed = cross(phi, shift), cross(turn, shift)
            moved = axpy(axpy(moved, -0.5, crossed), f, add(cross(turn, across), cross(phi, crossed)))
            store3(row, MAX_ROWS * j, axpy(moved, 2.0 * slope * dot(phi, turn), cross(phi, across)))
        j = load(parent, j)


@inline
def _own_turn(R, phi, f, w):
    """Jr^-1(phi) R'w."""
    v = (
        R[0] * w[0] + R[3] * w[1] + R[6] * w[2], R[1] * w[0] + R[4] * w[1] + R[7] * w[2],
        R[2] * w[0] + R[5] * w[1] + R[8] * w[2],
    )  # fmt: skip
    turned = cross(phi, v)
    return axpy(axpy(v, 0.5, turned), f, cross(phi, turned))
