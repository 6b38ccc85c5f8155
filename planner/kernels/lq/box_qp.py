"""The minimum of a quadratic over a box, for the few controls of one stage: projected Newton (Bertsekas 1982).

    minimize 1/2 k'(H + mu I) k + h'k   over   lower - u <= k <= upper - u

A control at a bound that its gradient pushes against is clamped; Newton's step is taken in the others and the result
put back into the box. With the right set clamped one full step is the minimum, so bounds are met exactly and most
stages take one or two factorizations. It starts from k = 0, which lies in the box.
"""

from __future__ import annotations

from planner.kernels.lq.workspace import W
from planner.kernels.numba.jit import inline
from planner.kernels.numba.lanes import at, floats, load, store

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
