"""The ramp that every one-sided force and cost is made of, on floats and on lanes alike: model.contact.laws's."""

from __future__ import annotations

from planner.kernels.numba.jit import inline
from planner.kernels.numba.lanes import maximum, minimum


@inline
def clamp(x):
    """X within 0 and 1."""
    return minimum(maximum(x, 0.0), 1.0)


@inline
def ramp(e, a, per_a):
    """0, e^2 / 2a, e - a/2 for e < 0, 0..a, > a, and its slope; where a is 0, per_a is so large that this is 0 or 1."""
    slope = clamp(e * per_a)
    return slope * (e - 0.5 * a * slope), slope
