"""The backward sweep with bounds on the controls (Tassa, Mansard and Todorov 2014), and its direction.

In each stage the control is the minimum of the quadratic over the box (see box). A clamped control c enters what is
left as a constant, h += H_c k_c, and leaves it: its row and column become those of the identity. Then the plain
sweep's own steps go on (see riccati), and give a clamped control no gains: feedback does not ask for more than there
is. Of the others the gains are those of the plain sweep.

Or the set of clamped controls is chosen, for all stages together (see active_set).

A servo that is clamped by a bound of its own follows it, u = k + K dx (see along_bounds).

Compiled apart from the plain sweep, so that a problem without bounds pays nothing.

The minimum of a quadratic over a box, for the few controls of one stage: projected Newton (Bertsekas 1982).

    minimize 1/2 k'(H + mu I) k + h'k   over   lower - u <= k <= upper - u

A control at a bound that its gradient pushes against is clamped; Newton's step is taken in the others and the result
put back into the box. With the right set clamped one full step is the minimum, so bounds are met exactly and most
stages take one or two factorizations. It starts from k = 0, which lies in the box.
"""

from __future__ import annotations

import math

from planner.kernels.lq.active_set import active_set_minimum
from planner.kernels.lq.defects import add_defect
from planner.kernels.lq.quadratic import add_weights
from planner.kernels.lq.riccati import advance, begin, factorize, gains, next_value
from planner.kernels.lq.second_order import add_second
from planner.kernels.lq.stage_hessian import dense_stage, stage_with_rates, structured_stage
from planner.kernels.lq.state_dependent_bounds import (
    add_bound_costate,
    along_bounds,
    at_lower,
    at_upper,
    gains_along,
    substitute_bound_control,
)
from planner.kernels.lq.workspace import W
from planner.kernels.numba.jit import inline, jit
from planner.kernels.numba.lanes import at, floats, integers, load, pointer, store

MAX_STEPS = 100  # of Newton; the clamped sets seldom change more than a few times
SHORTEST = 1e-10  # step length at which the line search gives up
ARMIJO_SHARE = 0.1  # of the expected reduction


@inline
def _symmetric(M, width, i, j):
    """Entry (i, j) of a matrix of which the upper triangle is there."""
    return load(M, i * width + j) if i <= j else load(M, j * width + i)


@inline
def _newton(M, width, mu, nu, clamped, C, g, d):
    """Newton's step d in the controls that are not clamped, by C C' = H + mu I there; False if not definite."""
    for i in range(nu):
        for j in range(i + 1):
            total = 0.0 if load(clamped, i) + load(clamped, j) > 0.0 else load(M, j * width + i)
            if i == j:
                total = 1.0 if load(clamped, i) > 0.0 else total + mu
            for k in range(j):
                total -= load(C, i * nu + k) * load(C, j * nu + k)
            if i == j:
                if not total > 0.0:  # also when it is NaN
                    return False
                store(C, i * nu + i, total**0.5)
            else:
                store(C, i * nu + j, total / load(C, j * nu + j))
    for i in range(nu):
        total = 0.0 if load(clamped, i) > 0.0 else -load(g, i)
        for k in range(i):
            total -= load(C, i * nu + k) * load(d, k)
        store(d, i, total / load(C, i * nu + i))
    for i in range(nu - 1, -1, -1):
        total = load(d, i)
        for k in range(i + 1, nu):
            total -= load(C, k * nu + i) * load(d, k)
        store(d, i, total / load(C, i * nu + i))
    return True


@inline
def _multiply(M, width, mu, nu, x, y):
    """Y = (H + mu I) x."""
    for i in range(nu):
        total = mu * load(x, i)
        for j in range(nu):
            total += _symmetric(M, width, i, j) * load(x, j)
        store(y, i, total)


@inline
def solve_box_qp(w, mu, n):
    """The minimum k of stage n from its H and h, and which of its controls are clamped (1 or 0).

    All in W.box: k, then clamped, then the remaining gradient, nu numbers each. Returns the value
    1/2 k'(H + mu I) k + h'k, and whether H is definite.
    """
    nu, width, M, h = w[W.nu], w[W.width], floats(w, W.H), floats(w, W.h)
    k = floats(w, W.box)
    clamped, g, d, moved, product = at(k, nu), at(k, 2 * nu), at(k, 3 * nu), at(k, 4 * nu), at(k, 5 * nu)
    C = at(k, 6 * nu)
    u, lower, upper = at(floats(w, W.us), n * nu), at(floats(w, W.lower), n * nu), at(floats(w, W.upper), n * nu)
    for i in range(nu):
        store(k, i, 0.0)
        store(g, i, load(h, i))
        store(clamped, i, -1.0)
    full = False
    for _ in range(MAX_STEPS):
        changed = False
        for i in range(nu):
            at_lower = load(k, i) <= load(lower, i) - load(u, i) and load(g, i) > 0.0
            at_upper = load(k, i) >= load(upper, i) - load(u, i) and load(g, i) < 0.0
            now = 1.0 if at_lower or at_upper else 0.0
            changed = changed or now != load(clamped, i)
            store(clamped, i, now)
        if full and not changed:
            break
        if not _newton(M, width, mu, nu, clamped, C, g, d):
            return 0.0, False
        step = 1.0
        while True:
            full, slope = step == 1.0, 0.0
            for i in range(nu):
                wanted = load(k, i) + step * load(d, i)
                low, high = load(lower, i) - load(u, i), load(upper, i) - load(u, i)
                into = low if wanted < low else high if wanted > high else wanted
                full = full and into == wanted
                store(moved, i, into - load(k, i))
                slope += load(g, i) * (into - load(k, i))
            _multiply(M, width, mu, nu, moved, product)
            change = slope
            for i in range(nu):
                change += 0.5 * load(moved, i) * load(product, i)
            if full or change <= ARMIJO_SHARE * slope or step < SHORTEST:
                break
            step *= 0.5
        if step < SHORTEST:  # nothing left to gain but rounding
            break
        for i in range(nu):
            wanted = load(k, i) + step * load(d, i)
            low, high = load(lower, i) - load(u, i), load(upper, i) - load(u, i)
            store(k, i, low if wanted < low else high if wanted > high else wanted)
        _multiply(M, width, mu, nu, k, product)
        for i in range(nu):
            store(g, i, load(h, i) + load(product, i))
    value = 0.0
    for i in range(nu):
        value += 0.5 * (load(h, i) + load(g, i)) * load(k, i)
    return value, True


@inline
def _projected(w, n):
    """Gradient of stage n (Eq. 18), kept, and the square of the part that does not push against a bound."""
    nu, c, gradient = w[W.nu], floats(w, W.costate), floats(w, W.gradient)
    us, lower, upper = floats(w, W.us), floats(w, W.lower), floats(w, W.upper)
    norm2 = 0.0
    for a in range(nu):
        i, g = n * nu + a, load(c, a)
        store(gradient, i, g)
        pushes = (at_lower(us, lower, i) and g > 0.0) or (at_upper(us, upper, i) and g < 0.0)
        if not pushes:
            norm2 += g * g
    if w[W.servos] > 0:
        add_bound_costate(w, n)
    return norm2


@inline
def _clamp(w, mu, n):
    """Take the clamped controls out of the quadratic of a stage."""
    nu, width, servo = w[W.nu], w[W.width], 0
    M, s, k = floats(w, W.H), floats(w, W.h), floats(w, W.box)
    clamped = at(k, nu)
    for c in range(nu):
        if servo < w[W.servos] and load(integers(w, W.servo_control), servo) == c:
            if load(clamped, c) > 0.0:
                substitute_bound_control(w, mu, n, servo)
            servo += 1
        if load(clamped, c) > 0.0:
            kc = load(k, c)
            for a in range(c):
                store(s, a, load(s, a) + load(M, a * width + c) * kc)
                store(M, a * width + c, 0.0)
            for j in range(c + 1, width):
                store(s, j, load(s, j) + load(M, c * width + j) * kc)
                store(M, c * width + j, 0.0)
            store(M, c * width + c, 1.0)
    for c in range(nu):  # after all have been counted into the others
        if load(clamped, c) > 0.0:
            store(s, c, 0.0)


@inline
def _keep_clamped(w, n):
    """Which controls of stage n are clamped, and where: the first set to choose from."""
    nu, k, held = w[W.nu], floats(w, W.box), at(floats(w, W.active_bounds), n * w[W.nu])
    for a in range(nu):
        low = load(k, a) <= load(floats(w, W.lower), n * nu + a) - load(floats(w, W.us), n * nu + a)
        store(held, a, 0.0 if load(k, nu + a) == 0.0 else -1.0 if low else 1.0)


@inline
def _finish_bounded(w, mu, n, chosen):
    """As riccati's, with the controls of stage n in their box; the model's value in place of the slope."""
    nu = w[W.nu]
    add_weights(w, floats(w, W.H), n)
    if w[W.exact]:
        add_second(w, floats(w, W.H), n)
    norm2 = _projected(w, n)
    if chosen:
        value, definite = active_set_minimum(w, mu, n), True
    else:
        value, definite = solve_box_qp(w, mu, n)
        _keep_clamped(w, n)
    if definite:
        _clamp(w, mu, n)
        part, definite = factorize(w, mu)
        value += 0.5 * part if chosen else 0.0
    if definite:
        next_value(w)
        gains(w, n)
        k, box = at(floats(w, W.k), n * nu), floats(w, W.box)
        for a in range(nu):
            if not chosen or load(box, nu + a) > 0.0:
                store(k, a, load(box, a))
        if w[W.servos] > 0:
            gains_along(w, n)
    return norm2, value, definite


@jit
def riccati_dense_bounded(w, mu, dt, chosen):
    """Sweep backward with F = (B | A) and bounds. Fills the gains, the gradient and the value function.

    With `chosen` the controls in W.active_bounds are held at their bounds and the others free, else each stage has its
    box.

    Returns:
        (norm of the projected gradient, value of the LQ model at its minimum, minus the expected reduction;
        False when R + B'PB + mu I is not positive definite where controls are free).
    """
    w = pointer(w)
    begin(w)
    total, value = 0.0, 0.0
    for n in range(w[W.N] - 1, -1, -1):
        if w[W.has_defects]:
            add_defect(w, n)
        dense_stage(w, n, dt)
        norm2, part, definite = _finish_bounded(w, mu, n, chosen)
        total += norm2
        if not definite:
            return math.sqrt(total), 0.0, False
        value += part
    return math.sqrt(total), value, True


@jit
def riccati_structured_bounded(w, mu, dt, chosen):
    """The same for semi-implicit Euler, whose F holds accelerations only."""
    w = pointer(w)
    begin(w)
    total, value = 0.0, 0.0
    for n in range(w[W.N] - 1, -1, -1):
        if w[W.has_defects]:
            add_defect(w, n)
        if w[W.outputs] > 0:
            stage_with_rates(w, n, dt)
        else:
            structured_stage(w, n, dt)
        norm2, part, definite = _finish_bounded(w, mu, n, chosen)
        total += norm2
        if not definite:
            return math.sqrt(total), 0.0, False
        value += part
    return math.sqrt(total), value, True


@jit
def bounded_direction(w, dt):
    """The direction dus (N, nu) in which the clipped controls set out, and the slope of J along it.

    du = k + K dx, but along the bound that the control is at where it leads out of it.
    """
    w = pointer(w)
    ndx, nu, width, first = w[W.ndx], w[W.nu], w[W.width], w[W.first]
    K, k, gradient = floats(w, W.K), floats(w, W.k), floats(w, W.gradient)
    us, lower, upper = floats(w, W.us), floats(w, W.lower), floats(w, W.upper)
    dus, dx = floats(w, W.dus), floats(w, W.dx)
    slope = 0.0
    for i in range(ndx):
        store(dx, i, 0.0)
    for n in range(w[W.N]):
        for a in range(nu):
            i = n * nu + a
            du = load(k, i)
            for j in range(ndx):
                du += load(K, i * width + first + j) * load(dx, j)
            if (at_lower(us, lower, i) and du < 0.0) or (at_upper(us, upper, i) and du > 0.0):
                du = 0.0
            store(dus, i, du)
            slope += load(gradient, i) * du
        if w[W.servos] > 0:
            slope += along_bounds(w, n, dx)
        advance(w, n, dt, at(dus, n * nu), dx, at(dx, ndx))
        for i in range(ndx):
            store(dx, i, load(dx, ndx + i))
    return slope
