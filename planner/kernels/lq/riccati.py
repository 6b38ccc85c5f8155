"""The backward sweep (Eq. 31-34) and the costate (Eq. 16-19), for one problem at a time.

Each stage of the LQ problem is a quadratic in z = (u | x) with Hessian H and gradient h (see stage_hessian).
Eliminating u by a Cholesky factorization of its block R + B'PB leaves the Schur complement, which is the next
(P, s): Eq. 33 and 34, with the inverse of Eq. 31 never formed. P and s lie where x lies in H and h.
"""

from __future__ import annotations

import math

from planner.kernels.algebra.tiles import four_rows, mirror, weighted_rows
from planner.kernels.lq.defects import add_defect, step_with_defect
from planner.kernels.lq.quadratic import add_weights
from planner.kernels.lq.second_order import add_second
from planner.kernels.lq.stage_hessian import dense_stage, stage_with_rates, structured_stage
from planner.kernels.lq.workspace import W
from planner.kernels.numba.jit import inline, jit
from planner.kernels.numba.lanes import WIDTH, at, floats, integers, load, load4, pointer, spread, store, store4


@inline
def factorize(w, mu):
    """Cholesky R + B'PB + mu I = U'U carried along the columns of x and h; the slope's part, and whether it exists.

    Four rows at a time, whose pivots are found as L D L': a square root has no place in a chain of them.
    """
    nu, width = w[W.nu], w[W.width]
    M, s = floats(w, W.H), floats(w, W.h)
    slope = 0.0
    for a in range(0, nu, WIDTH):
        o = a * width + a
        if a > 0:
            C = (M, o, width)
            four_rows(C, (M, a, width, 1), (M, a, width), a, -1.0, width - a, C, True)
            for c in range(a):
                store4(s, a, load4(s, a) - load(s, c) * load4(M, c * width + a))
        u01, u02, u03 = load(M, o + 1), load(M, o + 2), load(M, o + 3)
        u12, u13, u23 = load(M, o + width + 2), load(M, o + width + 3), load(M, o + 2 * width + 3)
        h0, h1, h2, h3 = load(s, a), load(s, a + 1), load(s, a + 2), load(s, a + 3)
        # rows past the last control are zero and stay zero
        d0, d1, d2, d3 = load(M, o) + mu, 1.0, 1.0, 1.0
        e0, e1, e2, e3 = 1.0 / d0, 0.0, 0.0, 0.0
        l10, l20, l30, l21, l31, l32 = u01 * e0, u02 * e0, u03 * e0, 0.0, 0.0, 0.0
        slope -= e0 * h0 * h0  # Eq. 42
        if a + 1 < nu:
            d1 = load(M, o + width + 1) + mu - l10 * u01
            e1 = 1.0 / d1
            u12 -= l10 * u02
            u13 -= l10 * u03
            l21, l31 = u12 * e1, u13 * e1
            h1 -= l10 * h0
            slope -= e1 * h1 * h1
        if a + 2 < nu:
            d2 = load(M, o + 2 * width + 2) + mu - l20 * u02 - l21 * u12
            e2 = 1.0 / d2
            u23 -= l20 * u03 + l21 * u13
            l32 = u23 * e2
            h2 -= l20 * h0 + l21 * h1
            slope -= e2 * h2 * h2
        if a + 3 < nu:
            d3 = load(M, o + 3 * width + 3) + mu - l30 * u03 - l31 * u13 - l32 * u23
            e3 = 1.0 / d3
            h3 -= l30 * h0 + l31 * h1 + l32 * h2
            slope -= e3 * h3 * h3
        if not (d0 > 0.0 and d1 > 0.0 and d2 > 0.0 and d3 > 0.0):
            return 0.0, False
        e0 = math.sqrt(e0)
        store(s, a, e0 * h0)
        if a + 1 < nu:
            e1, e2, e3 = math.sqrt(e1), math.sqrt(e2), math.sqrt(e3)
            store(s, a + 1, e1 * h1)
            store(s, a + 2, e2 * h2)
            store(s, a + 3, e3 * h3)
        for k in range(o, (a + 1) * width, WIDTH):
            r0 = load4(M, k)
            store4(M, k, e0 * r0)
            if a + 1 < nu:
                r1 = load4(M, k + width) - l10 * r0
                r2 = load4(M, k + 2 * width) - l20 * r0 - l21 * r1
                r3 = load4(M, k + 3 * width) - l30 * r0 - l31 * r1 - l32 * r2
                store4(M, k + width, e1 * r1)
                store4(M, k + 2 * width, e2 * r2)
                store4(M, k + 3 * width, e3 * r3)
        store(M, o, e0)  # the diagonal holds 1 / U_aa
        if a + 1 < nu:
            store(M, o + width + 1, e1)
            store(M, o + 2 * width + 2, e2)
            store(M, o + 3 * width + 3, e3)
    return slope, True


@inline
def next_value(w):
    """P and s of this stage, by the Schur complement."""
    nu, width, first = w[W.nu], w[W.width], w[W.first]
    M, s, columns = floats(w, W.H), floats(w, W.h), width - first
    P = first * width + first
    for i in range(0, columns, WIDTH):  # Eq. 33
        C = (M, P + i * width + i, width)
        four_rows(C, (M, first + i, width, 1), (M, first + i, width), nu, -1.0, columns - i, C, True)
        mirror(M, P, width, i, columns)
    weighted_rows(at(s, first), at(s, first), s, (M, first, width), nu, -1.0, columns)  # Eq. 34


@inline
def _substituted(r, e, v):
    """Back substitution of four rows r, with e = 1/U_aa and v = (e0 U_01, U_02, U_03; e1 U_12, U_13; e2 U_23)."""
    v01, v02, v03, v12, v13, v23 = v
    k3 = -1.0 * e[3] * r[3]
    k2 = -1.0 * e[2] * r[2] - v23 * k3
    k1 = -1.0 * e[1] * r[1] - v13 * k3 - v12 * k2
    k0 = -1.0 * e[0] * r[0] - v03 * k3 - v02 * k2 - v01 * k1
    return k0, k1, k2, k3


@inline
def gains(w, n):
    """U (K | k) = -(U_x | h), four rows at a time."""
    nu, width, first = w[W.nu], w[W.width], w[W.first]
    M, s = floats(w, W.H), floats(w, W.h)
    K, k = at(floats(w, W.K), n * nu * width + first), at(floats(w, W.k), n * nu)
    for a in range((nu - 1) // WIDTH * WIDTH, -1, -WIDTH):
        o, p, columns = a * width + a, a * width, width - first
        q, source = a * width + first, M
        h0, h1, h2, h3 = load(s, a), load(s, a + 1), load(s, a + 2), load(s, a + 3)
        if a + WIDTH < nu:
            A, B = (M, o + WIDTH, 1, width), (K, p + WIDTH * width, width)
            four_rows((K, p, width), A, B, nu - a - WIDTH, 1.0, columns, (M, q, width), True)
            q, source = p, K
            for b in range(a + WIDTH, nu):
                kb, c = load(k, b), p + b
                h0 += load(M, c) * kb
                h1 += load(M, c + width) * kb
                h2 += load(M, c + 2 * width) * kb
                h3 += load(M, c + 3 * width) * kb
        rows = min(WIDTH, nu - a)
        if rows == 1:
            f = -1.0 * load(M, o)
            store(k, a, f * h0)
            for j in range(0, columns, WIDTH):
                store4(K, p + j, f * load4(M, q + j))
            continue
        e0, e1 = load(M, o), load(M, o + width + 1)
        e2, e3 = load(M, o + 2 * width + 2), load(M, o + 3 * width + 3)
        e = (e0, e1, e2, e3)
        v = (
            e0 * load(M, o + 1), e0 * load(M, o + 2), e0 * load(M, o + 3),
            e1 * load(M, o + width + 2), e1 * load(M, o + width + 3), e2 * load(M, o + 2 * width + 3),
        )  # fmt: skip
        h0, h1, h2, h3 = _substituted((h0, h1, h2, h3), e, v)
        store(k, a, h0)
        store(k, a + 1, h1)
        if rows > 2:
            store(k, a + 2, h2)
        if rows > 3:
            store(k, a + 3, h3)
        for j in range(0, columns, WIDTH):
            c = q + j
            r0, r1 = load4(source, c), load4(source, c + width)
            r2, r3 = load4(source, c + 2 * width), load4(source, c + 3 * width)
            r0, r1, r2, r3 = _substituted((r0, r1, r2, r3), e, v)
            c = p + j
            store4(K, c, r0)
            store4(K, c + width, r1)
            if rows > 2:
                store4(K, c + 2 * width, r2)
            if rows > 3:
                store4(K, c + 3 * width, r3)


@inline
def begin(w):
    """P(N) = Q(N), s(N) = Q(N) (x - x_ref) (Eq. 29), and the costate (Eq. 17)."""
    width = w[W.width]
    M, s, c, l = floats(w, W.H), floats(w, W.h), floats(w, W.costate), floats(w, W.l)
    zero = spread(0.0)
    for i in range(0, width * width, WIDTH):
        store4(M, i, zero)
    add_weights(w, M, w[W.N])
    if w[W.exact]:
        add_second(w, M, w[W.N])
    first = w[W.first]
    for i in range(0, width - first, WIDTH):
        mirror(M, first * width + first, width, i, width - first)
    for j in range(0, width, WIDTH):
        store4(s, j, load4(l, w[W.N] * width + j))
        store4(c, j, load4(l, w[W.N] * width + j))


@inline
def _finish(w, mu, n):
    """Weights, gradient (Eq. 18), gains and value of stage n; the gradient's square, the slope's part, definite."""
    nu, c, gradient = w[W.nu], floats(w, W.costate), floats(w, W.gradient)
    add_weights(w, floats(w, W.H), n)
    if w[W.exact]:
        add_second(w, floats(w, W.H), n)
    norm2 = 0.0
    for a in range(nu):
        g = load(c, a)
        store(gradient, n * nu + a, g)
        norm2 += g * g
    part, definite = factorize(w, mu)
    if definite:
        next_value(w)
        gains(w, n)
    return norm2, part, definite


@jit
def riccati_dense(w, mu, dt):
    """Sweep backward with F = (B | A). Fills the gains, the gradient and the value function.

    Returns:
        (gradient norm, slope, ok): the norm of Eq. 19; the slope of J along the direction, which by Eq. 42 is
        minus twice the expected reduction; False when R + B'PB + mu I is not positive definite.
    """
    w = pointer(w)
    begin(w)
    total, slope = 0.0, 0.0
    for n in range(w[W.N] - 1, -1, -1):
        if w[W.has_defects]:
            add_defect(w, n)
        dense_stage(w, n, dt)
        norm2, part, definite = _finish(w, mu, n)
        total += norm2
        if not definite:
            return math.sqrt(total), 0.0, False
        slope += part
    return math.sqrt(total), slope, True


@jit
def riccati_structured(w, mu, dt):
    """The same for semi-implicit Euler, whose F holds accelerations only."""
    w = pointer(w)
    begin(w)
    total, slope = 0.0, 0.0
    for n in range(w[W.N] - 1, -1, -1):
        if w[W.has_defects]:
            add_defect(w, n)
        if w[W.outputs] > 0:
            stage_with_rates(w, n, dt)
        else:
            structured_stage(w, n, dt)
        norm2, part, definite = _finish(w, mu, n)
        total += norm2
        if not definite:
            return math.sqrt(total), 0.0, False
        slope += part
    return math.sqrt(total), slope, True


@inline
def advance(w, n, dt, du, dx, dx_next):
    """The linearized stage: dx_next = A dx + B du (Eq. 30)."""
    ndx, nu, width, first = w[W.ndx], w[W.nu], w[W.width], w[W.first]
    nv = ndx // 2 - w[W.outputs]
    rows = nv if w[W.structured] else ndx
    F = at(floats(w, W.F), n * rows * width)
    for i in range(rows):
        total = 0.0
        for a in range(nu):
            total += load(F, i * width + a) * load(du, a)
        for j in range(ndx):
            total += load(F, i * width + first + j) * load(dx, j)
        store(dx_next, i, total)
    if w[W.structured]:
        for i in range(w[W.outputs]):
            a = 2 * nv + i
            store(dx_next, a, load(dx_next, i))
            store(dx_next, nv + a, (load(dx_next, i) - load(dx, a)) / dt)
        for i in range(nv):
            rate = load(dx, nv + i) + dt * load(dx_next, i)
            store(dx_next, nv + i, rate)
            store(dx_next, i, load(dx, i) + dt * rate)
        for b in range(w[W.quaternions]):
            k = load(integers(w, W.quaternion_dx), b)
            E = at(floats(w, W.transport), (n * w[W.quaternions] + b) * 18)
            for c in range(3):
                total = 0.0
                for j in range(3):
                    total += load(E, 3 * c + j) * load(dx, k + j)
                    total += dt * load(E, 9 + 3 * c + j) * load(dx_next, nv + k + j)
                store(dx_next, k + c, total)


@jit
def direction(w, dt):
    """The LQ problem's own forward pass: dus (N, nu) = k + K dx with dx+ = A dx + B du + defect, dx(0) = 0."""
    w = pointer(w)
    ndx, nu, width, first = w[W.ndx], w[W.nu], w[W.width], w[W.first]
    K, k = floats(w, W.K), floats(w, W.k)
    dus, dx = floats(w, W.dus), floats(w, W.dx)
    for i in range(ndx):
        store(dx, i, 0.0)
    for n in range(w[W.N]):
        for a in range(nu):
            total = load(k, n * nu + a)
            for i in range(ndx):
                total += load(K, (n * nu + a) * width + first + i) * load(dx, i)
            store(dus, n * nu + a, total)  # Eq. 25
        advance(w, n, dt, at(dus, n * nu), dx, at(dx, ndx))
        if w[W.has_defects]:
            step_with_defect(w, n, at(dx, ndx))
        for i in range(ndx):
            store(dx, i, load(dx, ndx + i))
