"""The LQ problem with bounds of controls and penalties of states: the active sets are found by Newton's method.

A box in each stage (see box) knows no deviation of the state: where bounds hold many stages, later ones would leave
theirs in what the sweep expects, and steps are short. So do penalties of ranges that the motion has yet to reach.
Here a
sweep has a chosen set of controls at active bounds and of active penalties, and its linear motion tells the next set:

    a free control that would leave its bounds is held at the one it crosses,
    an active one whose multiplier points inwards is freed,
    a hinge is a parabola where the deviation will be outside of its range, and zero where it will be inside.

A set that tells itself is the solution (primal-dual active sets; Hintermueller, Ito and Kunisch 2002). It mostly takes
one sweep where the last iteration's set still holds, and few where it does not. It may also cycle: then each stage has
its box, and penalties are active where they are now.
"""

from __future__ import annotations

from planner.kernels.lq.quadratic import penalties_of
from planner.kernels.lq.riccati import advance
from planner.kernels.lq.state_dependent_bounds import moved
from planner.kernels.lq.workspace import W
from planner.kernels.numba.jit import inline, jit
from planner.kernels.numba.lanes import at, floats, integers, load, pointer, store

ROUNDING = 1e-9  # of a control: how far one may be beyond its bound
MULTIPLIER_ROUNDING = 1e-12  # of a multiplier's parts: what is rounding


@inline
def active_set_minimum(w, mu, n):
    """As box_minimum for the chosen set: k and what is clamped, in W.box; the value of these constants.

    Rows of the Hessian of controls at active bounds are kept for their multipliers.
    """
    nu, width = w[W.nu], w[W.width]
    M, h, k, o = floats(w, W.H), floats(w, W.h), floats(w, W.box), n * nu
    us, lower, upper = floats(w, W.us), floats(w, W.lower), floats(w, W.upper)
    value = 0.0
    for c in range(nu):
        side, kc = load(floats(w, W.active_bounds), o + c), 0.0
        if side != 0.0:
            kc = (load(lower, o + c) if side < 0.0 else load(upper, o + c)) - load(us, o + c)
        store(k, c, kc)
        store(k, nu + c, abs(side))
    for c in range(nu):
        if load(k, nu + c) > 0.0:
            row, kc = at(floats(w, W.active_row), (o + c) * width), load(k, c)
            for j in range(c):
                store(row, j, load(M, j * width + c))
            for j in range(c, width):
                store(row, j, load(M, c * width + j))
            store(row, c, load(row, c) + mu)
            store(floats(w, W.active_gradient), o + c, load(h, c))
            value += load(h, c) * kc
            for a in range(nu):
                value += 0.5 * kc * load(row, a) * load(k, a)
    return value


@inline
def _multiplier(w, i, du, dx):
    """The slope of the LQ problem's cost by held control i of all, but for rounding."""
    nu, ndx, width = w[W.nu], w[W.ndx], w[W.width]
    row, total = at(floats(w, W.active_row), i * width), load(floats(w, W.active_gradient), i)
    size = abs(total)
    for a in range(nu):
        part = load(row, a) * load(du, a)
        total += part
        size += abs(part)
    for j in range(ndx):
        part = load(row, w[W.first] + j) * load(dx, j)
        total += part
        size += abs(part)
    return total if abs(total) > MULTIPLIER_ROUNDING * size else 0.0


@inline
def _chosen(w, i, side, du, dx, floor, ceiling):
    """Where control i of all, with the stage's du and dx, is to be held: -1, 0 or 1."""
    u = load(floats(w, W.us), i)
    if side == 0.0:
        step = load(du, i % w[W.nu])
        after, slack = u + step, ROUNDING * (1.0 + abs(step))
        if after < load(floats(w, W.lower), i) + floor - slack:
            return -1.0
        return 1.0 if after > load(floats(w, W.upper), i) + ceiling + slack else 0.0
    return 0.0 if side * _multiplier(w, i, du, dx) > 0.0 else side


@inline
def _choose_held(w, n, du, dx):
    """The next set of controls at active bounds of stage n; by how many it differs."""
    nu, held, servo, changes = w[W.nu], at(floats(w, W.active_bounds), n * w[W.nu]), 0, 0
    for a in range(nu):
        floor, ceiling = 0.0, 0.0
        if servo < w[W.servos] and load(integers(w, W.servo_control), servo) == a:
            floor = moved(w, n, servo, floats(w, W.lower_share), dx)
            ceiling = moved(w, n, servo, floats(w, W.upper_share), dx)
            servo += 1
        side = load(held, a)
        now = _chosen(w, n * nu + a, side, du, dx, floor, ceiling)
        if now != side:
            changes += 1
            store(held, a, now)
    return changes


@inline
def _side(e, low, high, slack):
    """At which side of its range a deviation e is."""
    return 1.0 if e > high + slack else -1.0 if e < low - slack else 0.0


@inline
def _choose_penalties(w, n, dx):
    """The next set of penalties of knot n that pull: by how many it differs; how far its cost and slope are off.

    Its parabolas stand for penalties that are still within their ranges, and what these cost now is none of the
    model's.
    """
    o, changes, cost, slope = n * w[W.penalties], 0, 0.0, 0.0
    for t in range(penalties_of(w, n)):
        i, k = load(integers(w, W.penalty_dx), t), o + t
        low, high = load(floats(w, W.penalty_lower), k), load(floats(w, W.penalty_upper), k)
        if low == high or load(integers(w, W.ball), i) >= 0:  # it is always active; or is a rotation's
            continue
        e, weight, side = (
            load(floats(w, W.penalty_e), k),
            load(floats(w, W.penalty_weight), k),
            load(floats(w, W.penalty_side), k),
        )
        d = load(dx, i)
        slack = ROUNDING * (1.0 + abs(e))
        now = _side(e + d, low, high, slack if side == 0.0 else -slack)
        real = 1.0 if e >= high else -1.0 if e < low else 0.0
        gradient = weight * (e - (high if side > 0.0 else low)) if side != 0.0 else 0.0
        if now != side:
            changes += 1
            next_gradient = weight * (e - (high if now > 0.0 else low)) if now != 0.0 else 0.0
            l = at(floats(w, W.l), n * w[W.width] + w[W.first])
            store(l, i, load(l, i) + next_gradient - gradient)
            store(floats(w, W.penalty_active), k, weight if now != 0.0 else 0.0)
            store(floats(w, W.penalty_side), k, now)
        if side != real:
            really = weight * (e - (high if real > 0.0 else low)) if real != 0.0 else 0.0
            slope += (really - gradient) * d
            cost += 0.5 * (gradient * gradient - really * really) / weight
    return changes, cost, slope


@jit
def update_active_set(w, dt, none):
    """The next set of active bounds and active penalties, from the linear motion of the last sweep.

    With `none` there is no motion: the active penalties stay.

    Returns:
        By how many the set differs from that of the sweep; by how much more than the cost the model costs where it
        begins; and by how much the slope of the cost along the motion is above the model's.
    """
    w = pointer(w)
    ndx, nu, width, first = w[W.ndx], w[W.nu], w[W.width], w[W.first]
    K, k = floats(w, W.K), floats(w, W.k)
    dus, dx = floats(w, W.dus), floats(w, W.dx)
    changes, cost, slope = 0, 0.0, 0.0
    for i in range(ndx):
        store(dx, i, 0.0)
    for n in range(w[W.N] + 1):
        more, c, s = _choose_penalties(w, n, dx)
        changes, cost, slope = changes + more, cost + c, slope + s
        if n == w[W.N] or none:
            continue
        du = at(dus, n * nu)
        for a in range(nu):
            i = n * nu + a
            total = load(k, i)
            for j in range(ndx):
                total += load(K, i * width + first + j) * load(dx, j)
            store(du, a, total)
        if w[W.bounded] > 0:
            changes += _choose_held(w, n, du, dx)
        advance(w, n, dt, du, dx, at(dx, ndx))
        for i in range(ndx):
            store(dx, i, load(dx, ndx + i))
    return changes, cost, slope
