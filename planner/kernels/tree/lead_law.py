"""A law with a lead (planner.model.contact.laws) of contacts and stops, as a function of the penetration, on lanes."""

from __future__ import annotations

from planner.kernels.algebra.ramp import clamp, ramp
from planner.kernels.numba.jit import inline
from planner.kernels.numba.lanes import load, select

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
