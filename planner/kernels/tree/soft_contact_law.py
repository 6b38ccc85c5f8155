"""The force and torque of a contact with a lead (model.contact.laws) on lanes, with their derivatives.

The law is a function of the penetration e and of two velocities that the contact has a lead later: x of its point,
relative to the surface, and w of the link, which spinning and rolling friction resist. It is the gradient of a convex
function of (x, w), so minus its derivative by them is symmetric and at least zero. What is between the force and w is
a product of two vectors in every cone:

    df = -(C x + a (b'w)),   dt = -(b (a'x) + D w),   C and D symmetric.

C (6), a (3), b (3) and D (6) are called slopes below.
"""

from __future__ import annotations

from planner.kernels.algebra.ramp import clamp, ramp
from planner.kernels.algebra.spatial import add, axpy, dot, load3, scaled, symmetric
from planner.kernels.numba.jit import inline
from planner.kernels.numba.lane_math import sqrt
from planner.kernels.numba.lanes import load, maximum, select, spread
from planner.kernels.tree.contact_tables import LEAD_LAW_SIZE, SOFT_SIZE

# Offsets in a law's numbers, as contact_tables lays them out
STIFFNESS, DAMPING, RAMP, PER_RAMP, FORCE, PER_FORCE, LEAD = range(7)
FIRST_IMPEDANCE, LAST_IMPEDANCE, PER_WIDTH, MIDPOINT = range(7, 11)


@inline
def _impedance(value, o, r):
    """MuJoCo's impedance d at a depth r and d / (1 - d) over its last value, each with its derivative by r."""
    first, last = load(value, o + FIRST_IMPEDANCE), load(value, o + LAST_IMPEDANCE)
    midpoint, per_width = load(value, o + MIDPOINT), load(value, o + PER_WIDTH)
    x = clamp(per_width * r)
    left = 1.0 - x
    rise = select(midpoint, x, 1.0 - left * left / (1.0 - midpoint), x * x / midpoint)
    slope = 2.0 * per_width * select(midpoint, x, left / (1.0 - midpoint), x / midpoint)
    d, d_r = first + (last - first) * rise, (last - first) * slope
    per, scale = 1.0 / (1.0 - d), (1.0 - last) / last
    return d, d_r, scale * (d * per), scale * (per * per * d_r)


@inline
def pressing(value, o, e):
    """The spring's force at a penetration, and the share of the damping that acts there, with their derivatives.

    The four numbers are K w d depth / d_1, its derivative, w s and its derivative.
    """
    a, per_a, K = load(value, o + RAMP), load(value, o + PER_RAMP), load(value, o + STIFFNESS)
    depth, t = ramp(e, a, per_a)
    h = clamp(2.0 * per_a * e)
    early, early_e = h * h * (3.0 - 2.0 * h), 12.0 * h * (1.0 - h) * per_a
    d, d_e, gain, gain_e = _impedance(value, o, e - 0.5 * a)
    s, ds = early * gain, early_e * gain + early * gain_e
    K = K / load(value, o + LAST_IMPEDANCE)
    pressed = K * (d * s * depth)
    pressed_e = K * (d_e * s * depth + d * ds * depth + d * s * t)
    return pressed, pressed_e, s, ds


# Offsets in a soft contact's numbers, as contact_tables lays them out
CENTRE, NORMAL, LEVEL, ARM, SURFACE, FIRST, SECOND, LAW = 0, 3, 6, 7, 8, 11, 14, 17
FRICTION, ROOT, WINDOW, ELLIPTIC, EDGE, SPIN, ROLL, PER_LENGTH = range(LEAD_LAW_SIZE, LEAD_LAW_SIZE + 8)  # behind it
_MIN_SQUARE = 1e-40  # added to squares before their root, so that none is zero
MIN_FORCE = 1e-30  # N, of what forces are divided by


@inline
def slopes_times(slopes, x, w):
    """Minus the changes of force and torque by changes x and w."""
    C, a, b, D = slopes
    return axpy(symmetric(C, x), dot(b, w), a), axpy(symmetric(D, w), dot(a, x), b)


@inline
def plus_square(C, s, d):
    """C and s times d d'."""
    a = scaled(s, d)
    return (
        C[0] + a[0] * d[0], C[1] + a[0] * d[1], C[2] + a[0] * d[2],
        C[3] + a[1] * d[1], C[4] + a[1] * d[2], C[5] + a[2] * d[2],
    )  # fmt: skip


@inline
def _nothing():
    zero = spread(0.0)
    return zero, zero, zero


@inline
def _no_matrix():
    zero = spread(0.0)
    return zero, zero, zero, zero, zero, zero


@inline
def _edge(value, o, along, pressed, pressed_e, s, ds):
    """The force of an edge of the pyramid with a velocity along it, its derivative by e, and minus that by `along`."""
    share = load(value, o + EDGE)
    damping = share * load(value, o + DAMPING)
    y, y_e = share * pressed - damping * (s * along), share * pressed_e - damping * (ds * along)
    force, slope = ramp(y, load(value, o + FORCE), load(value, o + PER_FORCE))
    return force, slope * y_e, damping * (slope * s)


@inline
def _pyramid(value, o, n, first, second, pressed, pressed_e, s, ds, x, w):
    """Force and torque, their derivatives by e and slopes of a pyramidal cone.

    Four edges n +- mu t push, with condim 4 also two that turn about n, with condim 6 also four about the t.
    """
    mu, spin, roll = load(value, o + FRICTION), load(value, o + SPIN), load(value, o + ROLL)
    f, f_e, torque, torque_e, b = _nothing(), _nothing(), _nothing(), _nothing(), _nothing()
    C, D = _no_matrix(), _no_matrix()
    for axis in range(2):
        t = first if axis == 0 else second
        for side in range(2):
            d = axpy(n, mu if side == 0 else -mu, t)
            force, by_e, slope = _edge(value, o, dot(x, d), pressed, pressed_e, s, ds)
            f, f_e, C = axpy(f, force, d), axpy(f_e, by_e, d), plus_square(C, slope, d)
    for axis in range(3):
        arm = spin if axis == 0 else roll
        if arm > 0.0:
            t = n if axis == 0 else first if axis == 1 else second
            for side in range(2):
                d = scaled(arm if side == 0 else -arm, t)
                force, by_e, slope = _edge(value, o, dot(x, n) + dot(w, d), pressed, pressed_e, s, ds)
                f, f_e, C = axpy(f, force, n), axpy(f_e, by_e, n), plus_square(C, slope, n)
                torque, torque_e, D = axpy(torque, force, d), axpy(torque_e, by_e, d), plus_square(D, slope, d)
                b = axpy(b, slope, d)
    return f, torque, f_e, torque_e, (C, add(_nothing(), n), b, D)


@inline
def _turned(spin, roll, n, w):
    """An angular velocity w with its part about n times spin, and the rest times roll."""
    return axpy(scaled(roll, w), (spin - roll) * dot(w, n), n)


@inline
def _cone(value, o, n, pressed, pressed_e, s, ds, x, w):
    """The same of an elliptic cone: y projected onto it, smoothed where it begins to slip.

    Along the edge c of the cone next to y and across it, a = y'c and b = y'c_: the potential is a^2 (1/2 + psi(b/a)),
    with psi(t) = t^2/2 for t > w, where the contact sticks, constant for t < -w, where it slips, and cubic between.
    Rotations count as velocities at arms of spinning and rolling.
    """
    mu, root, window = load(value, o + FRICTION), load(value, o + ROOT), load(value, o + WINDOW)
    spin, roll, B = load(value, o + SPIN), load(value, o + ROLL), load(value, o + DAMPING)
    opening = dot(x, n)
    xt, wt = axpy(x, spread(0.0) - opening, n), _turned(spin, roll, n, w)
    yn, yn_e = pressed - B * (s * opening), pressed_e - B * (ds * opening)
    size = sqrt(dot(xt, xt) + dot(wt, wt) + _MIN_SQUARE)
    u, uw = scaled(-1.0 / size, xt), _turned(spin, roll, n, scaled(-1.0 / size, wt))  # y_t's direction
    yt, yt_e = B * root * (s * size), B * root * (ds * size)
    cone = mu / root
    per = 1.0 / sqrt(spread(1.0 + cone * cone))
    a, b = per * (yn + cone * yt), per * (cone * yn - yt)
    whole = select(0.0, a, 1.0, 0.0)
    t = b / maximum(a, MIN_FORCE)
    z = clamp((t + window) / (2.0 * window))
    beyond = maximum(t - window, 0.0)
    psi = window * window * (0.6666666666666667 * z * z * z - 0.16666666666666666) + beyond * (window + 0.5 * beyond)
    psi_1, psi_2 = window * z * z + beyond, z
    g_a, g_b = whole * a * (1.0 + 2.0 * psi - t * psi_1), whole * a * psi_1
    h_aa, h_ab, h_bb = (
        whole * (1.0 + 2.0 * psi - 2.0 * t * psi_1 + t * t * psi_2), whole * (psi_1 - t * psi_2), whole * psi_2,
    )  # fmt: skip
    gn, gs = per * (g_a + cone * g_b), per * (cone * g_a - g_b)
    h_nn = per * per * (h_aa + 2.0 * cone * h_ab + cone * cone * h_bb)
    h_ns = per * per * (cone * h_aa + (cone * cone - 1.0) * h_ab - cone * h_bb)
    h_ss = per * per * (cone * cone * h_aa - 2.0 * cone * h_ab + h_bb)
    turning = select(t, window, gs / maximum(yt, MIN_FORCE), whole)  # g_t / y_t, one where it sticks
    scale = s * B
    along, across = scale * (root * root * turning), scale * (root * root * (h_ss - turning))
    f = axpy(scaled(gn, n), spread(0.0) - along, xt)
    torque = scaled(spread(0.0) - along, _turned(spin, roll, n, wt))
    by_e = root * (h_ns * yn_e + h_ss * yt_e)
    f_e, torque_e = axpy(scaled(h_nn * yn_e + h_ns * yt_e, n), by_e, u), scaled(by_e, uw)
    C = plus_square(_no_matrix(), scale * (h_nn - root * root * turning - root * h_ns), n)
    C = plus_square(C, across - scale * (root * h_ns), u)
    C = plus_square(C, scale * root * h_ns, add(n, u))
    C = (C[0] + along, C[1], C[2], C[3] + along, C[4], C[5] + along)
    D = plus_square(_no_matrix(), along * (spin * spin - roll * roll), n)
    D = plus_square(D, across, uw)
    rolling = along * (roll * roll)
    D = (D[0] + rolling, D[1], D[2], D[3] + rolling, D[4], D[5] + rolling)
    return f, torque, f_e, torque_e, (C, axpy(scaled(scale * root * h_ns, n), across, u), uw, D)


@inline
def soft_law(value, k, e, x, w):
    """Force and torque of soft contact k, their derivatives by e, and slopes."""
    b = k * SOFT_SIZE
    o, n = b + LAW, load3(value, b + NORMAL)
    pressed, pressed_e, s, ds = pressing(value, o, e)
    if load(value, o + ELLIPTIC) > 0.0:
        return _cone(value, o, n, pressed, pressed_e, s, ds, x, w)
    first, second = load3(value, b + FIRST), load3(value, b + SECOND)
    return _pyramid(value, o, n, first, second, pressed, pressed_e, s, ds, x, w)
