"""Servos at bounds that are lines of the state: they follow these, u = k + K dx with K = d bound/dx.

In the backward sweep that is put into the quadratic in the place of u. The costate then is that of the motion along the
bounds: it gains K' g of every servo whose gradient g pushes against its bound.

Only problems with such bounds run any of this (planner.problem.control_bounds has them). Lower and upper bounds are
those at the nominal states.
"""

from __future__ import annotations

from planner.kernels.lq.workspace import W
from planner.kernels.numba.jit import inline
from planner.kernels.numba.lanes import at, floats, integers, load, store

AT_BOUND = 1e-11  # a step can end a few roundings inside a bound


@inline
def at_lower(us, lower, i):
    """Whether a control is at its lower bound, but for rounding."""
    return load(us, i) - load(lower, i) <= AT_BOUND


@inline
def at_upper(us, upper, i):
    """Whether a control is at its upper bound, but for rounding."""
    return load(upper, i) - load(us, i) <= AT_BOUND


@inline
def _slope(w, n, servo, share, t):
    """Entry t of d bound/dx of a servo's control at stage n, whose bound has these parts of both lines."""
    i = 2 * (n * w[W.nu] + load(integers(w, W.servo_control), servo))
    return -(
        load(share, i) * load(floats(w, W.servo_at_start), t) + load(share, i + 1) * load(floats(w, W.servo_at_end), t)
    )


@inline
def moved(w, n, servo, share, dx):
    """By how much a deviation dx (ndx) moves a servo's bound at stage n."""
    start, entry, total = integers(w, W.servo_start), integers(w, W.servo_dx), 0.0
    for t in range(load(start, servo), load(start, servo + 1)):
        total += _slope(w, n, servo, share, t) * load(dx, load(entry, t))
    return total


@inline
def add_bound_costate(w, n):
    """The costate gains what a gradient that pushes against the bound of a servo does as this moves with the state."""
    nu, first, c = w[W.nu], w[W.first], floats(w, W.costate)
    us, lower, upper = floats(w, W.us), floats(w, W.lower), floats(w, W.upper)
    start, entry = integers(w, W.servo_start), integers(w, W.servo_dx)
    for servo in range(w[W.servos]):
        a = load(integers(w, W.servo_control), servo)
        i, g = n * nu + a, load(c, a)
        low, high = at_lower(us, lower, i) and g > 0.0, at_upper(us, upper, i) and g < 0.0
        if low or high:
            share = floats(w, W.lower_share) if low else floats(w, W.upper_share)
            for t in range(load(start, servo), load(start, servo + 1)):
                j = first + load(entry, t)
                store(c, j, load(c, j) + g * _slope(w, n, servo, share, t))


@inline
def _clamped_share(w, n, a):
    """The parts of the lines of the bound that box_minimum has put control a at."""
    i, k = n * w[W.nu] + a, load(floats(w, W.box), a)
    at_low = k <= load(floats(w, W.lower), i) - load(floats(w, W.us), i)
    return floats(w, W.lower_share) if at_low else floats(w, W.upper_share)


@inline
def substitute_bound_control(w, mu, n, servo):
    """Put u_c = k_c + K_c dx of a clamped servo into what is left of the quadratic; k_c is put in by _clamp."""
    nu, width, first, ndx = w[W.nu], w[W.width], w[W.first], w[W.ndx]
    M, s, c = floats(w, W.H), floats(w, W.h), load(integers(w, W.servo_control), servo)
    share, start, entry = _clamped_share(w, n, c), integers(w, W.servo_start), integers(w, W.servo_dx)
    own = load(M, c * width + c) + mu
    push = load(s, c) + own * load(floats(w, W.box), c)
    for t in range(load(start, servo), load(start, servo + 1)):
        j, K = first + load(entry, t), _slope(w, n, servo, share, t)
        store(s, j, load(s, j) + K * push)
        for a in range(nu):
            if a != c:
                store(M, a * width + j, load(M, a * width + j) + K * load(M, min(a, c) * width + max(a, c)))
        for i in range(first, first + ndx):
            o = min(i, j) * width + max(i, j)
            both = K * load(M, c * width + i)
            store(M, o, load(M, o) + (2.0 * both if i == j else both))
        for u in range(load(start, servo), load(start, servo + 1)):
            i = first + load(entry, u)
            if i <= j:
                o = i * width + j
                store(M, o, load(M, o) + K * _slope(w, n, servo, share, u) * own)


@inline
def gains_along(w, n):
    """The gains of clamped servos: those that follow their bounds."""
    nu, width, clamped = w[W.nu], w[W.width], at(floats(w, W.box), w[W.nu])
    start, entry = integers(w, W.servo_start), integers(w, W.servo_dx)
    for servo in range(w[W.servos]):
        a = load(integers(w, W.servo_control), servo)
        if load(clamped, a) > 0.0:
            share, K = _clamped_share(w, n, a), at(floats(w, W.K), (n * nu + a) * width + w[W.first])
            for t in range(load(start, servo), load(start, servo + 1)):
                store(K, load(entry, t), _slope(w, n, servo, share, t))


@inline
def along_bounds(w, n, dx):
    """Have servos at their bounds follow these in a direction; what that changes of its slope."""
    nu, gradient, dus, k = w[W.nu], floats(w, W.gradient), floats(w, W.dus), floats(w, W.k)
    us, lower, upper = floats(w, W.us), floats(w, W.lower), floats(w, W.upper)
    K, slope = at(floats(w, W.K), w[W.first]), 0.0
    for servo in range(w[W.servos]):
        i = n * nu + load(integers(w, W.servo_control), servo)
        du, g = load(k, i), load(gradient, i)
        for j in range(w[W.ndx]):
            du += load(K, i * w[W.width] + j) * load(dx, j)
        low, high = at_lower(us, lower, i), at_upper(us, upper, i)
        floor = moved(w, n, servo, floats(w, W.lower_share), dx)
        ceiling = moved(w, n, servo, floats(w, W.upper_share), dx)
        if low and du < floor:
            du = floor
        if high and du > ceiling:
            du = ceiling
        slope += g * (du - load(dus, i))
        if low and g > 0.0:  # the costate has it already
            slope -= g * floor
        if high and g < 0.0:
            slope -= g * ceiling
        store(dus, i, du)
    return slope
