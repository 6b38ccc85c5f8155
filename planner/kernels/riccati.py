"""The backward sweep (Eq. 31-34) and the costate (Eq. 16-19), for one problem at a time.

Each stage of the LQ problem is a quadratic in z = (u | x) with Hessian H and gradient h (see stage_hessian).
Eliminating u by a Cholesky factorisation of its block R + B'PB leaves the Schur complement, which is the next
(P, s): Eq. 33 and 34, with the inverse of Eq. 31 never formed. P and s lie where x lies in H and h.
"""

from __future__ import annotations

import math

from planner.kernels import workspace as W
from planner.kernels.jit import inline, jit
from planner.kernels.lanes import WIDTH, at, floats, integers, load, load4, spread, store, store4
from planner.kernels.quadratic import add_weights
from planner.kernels.stage_hessian import dense_stage, structured_stage
from planner.kernels.tiles import four_rows, mirror, one_row


@inline
def _factorize(w, mu):
    """Cholesky R + B'PB + mu I = U'U carried along the columns of x and h; the slope's part, and whether it exists."""
    nu, width = w[W.NU], w[W.WIDTH_Z]
    M, s = floats(w, W.H), floats(w, W.h)
    slope = 0.0
    for a in range(nu):
        o = a // WIDTH * WIDTH
        one_row(M, a * width + o, M, a, width, M, o, width, a, -1.0, width - o)
        pivot = load(M, a * width + a) + mu
        if not pivot > 0.0:
            return 0.0, False
        scale = 1.0 / math.sqrt(pivot)
        ha = load(s, a)
        for c in range(a):
            ha -= load(M, c * width + a) * load(s, c)
        for j in range(o, width, WIDTH):
            store4(M, a * width + j, scale * load4(M, a * width + j))
        store(M, a * width + a, scale)  # the diagonal holds 1 / U_aa
        ha *= scale
        store(s, a, ha)
        slope -= ha * ha  # Eq. 42
    return slope, True


@inline
def _next_value(w):
    """P and s of this stage, by the Schur complement."""
    nu, width, first = w[W.NU], w[W.WIDTH_Z], w[W.FIRST_X]
    M, s, columns = floats(w, W.H), floats(w, W.h), width - first
    P = first * width + first
    for i in range(0, columns, WIDTH):  # Eq. 33
        four_rows(M, P + i * width + i, width, M, first + i, width, M, first + i, width, nu, -1.0, columns - i, True)
        mirror(M, P, width, i, columns)
    one_row(s, first, s, 0, 1, M, first, width, nu, -1.0, columns)  # Eq. 34


@inline
def _gains(w, n):
    """U (K | k) = -(U_x | h)."""
    nu, width, first = w[W.NU], w[W.WIDTH_Z], w[W.FIRST_X]
    M, s, K, k = floats(w, W.H), floats(w, W.h), floats(w, W.GAINS), floats(w, W.FEEDFORWARD)
    for a in range(nu - 1, -1, -1):
        scale = -1.0 * load(M, a * width + a)
        ka = load(s, a)
        for b in range(a + 1, nu):
            ka += load(M, a * width + b) * load(k, n * nu + b)
        store(k, n * nu + a, scale * ka)
        row = (n * nu + a) * width + first
        for j in range(0, width - first, WIDTH):
            store4(K, row + j, load4(M, a * width + first + j))
        one_row(K, row, M, a * width + a + 1, 1, K, row + width, width, nu - a - 1, 1.0, width - first)
        for j in range(0, width - first, WIDTH):
            store4(K, row + j, scale * load4(K, row + j))


@jit
def riccati(w, mu, dt):
    """Sweep backward. Fills the gains, the gradient and the value function.

    Returns:
        (gradient norm, slope, ok): the norm of Eq. 19; the slope of J along the direction, which by Eq. 42 is
        minus twice the decrease that the LQ model promises; False when R + B'PB + mu I is not positive definite.
    """
    nu, width = w[W.NU], w[W.WIDTH_Z]
    M, s, c = floats(w, W.H), floats(w, W.h), floats(w, W.COSTATE)
    l, gradient = floats(w, W.STAGE_GRADIENT), floats(w, W.GRADIENT)
    zero = spread(0.0)
    for i in range(0, width * width, WIDTH):  # Eq. 29: P(N) = Q(N), s(N) = Q(N) (x - x_ref)
        store4(M, i, zero)
    add_weights(w, M, w[W.N])
    for i in range(w[W.FIRST_X], width, WIDTH):
        mirror(M, 0, width, i, width)
    for j in range(0, width, WIDTH):
        store4(s, j, load4(l, w[W.N] * width + j))
        store4(c, j, load4(l, w[W.N] * width + j))  # Eq. 17
    norm2, slope = 0.0, 0.0
    for n in range(w[W.N] - 1, -1, -1):
        if w[W.STRUCTURED]:
            structured_stage(w, n, dt)
        else:
            dense_stage(w, n, dt)
        add_weights(w, M, n)
        for a in range(nu):  # Eq. 18
            g = load(c, a)
            store(gradient, n * nu + a, g)
            norm2 += g * g
        part, definite = _factorize(w, mu)
        if not definite:
            return math.sqrt(norm2), 0.0, False
        slope += part
        _next_value(w)
        _gains(w, n)
    return math.sqrt(norm2), slope, True


@inline
def _advance(w, n, dt, du, dx, dx_next):
    """The linearised stage: dx_next = A dx + B du (Eq. 30)."""
    ndx, nu, width, first = w[W.NDX], w[W.NU], w[W.WIDTH_Z], w[W.FIRST_X]
    nv = ndx // 2
    rows = nv if w[W.STRUCTURED] else ndx
    F = at(floats(w, W.LINEAR), n * rows * width)
    for i in range(rows):
        total = 0.0
        for a in range(nu):
            total += load(F, i * width + a) * load(du, a)
        for j in range(ndx):
            total += load(F, i * width + first + j) * load(dx, j)
        store(dx_next, i, total)
    if w[W.STRUCTURED]:
        for i in range(nv):
            rate = load(dx, nv + i) + dt * load(dx_next, i)
            store(dx_next, nv + i, rate)
            store(dx_next, i, load(dx, i) + dt * rate)
        for b in range(w[W.QUATERNIONS]):
            k = load(integers(w, W.QUATERNION_DX), b)
            E = at(floats(w, W.TRANSPORT), (n * w[W.QUATERNIONS] + b) * 18)
            for c in range(3):
                total = 0.0
                for j in range(3):
                    total += load(E, 3 * c + j) * load(dx, k + j)
                    total += dt * load(E, 9 + 3 * c + j) * load(dx_next, nv + k + j)
                store(dx_next, k + c, total)


@jit
def direction(w, dt):
    """The LQ problem's own forward pass: dus (N, nu) = k + K dx with dx+ = A dx + B du, dx(0) = 0."""
    ndx, nu, width, first = w[W.NDX], w[W.NU], w[W.WIDTH_Z], w[W.FIRST_X]
    K, k = floats(w, W.GAINS), floats(w, W.FEEDFORWARD)
    dus, dx = floats(w, W.DIRECTION), floats(w, W.DX)
    for i in range(ndx):
        store(dx, i, 0.0)
    for n in range(w[W.N]):
        for a in range(nu):
            total = load(k, n * nu + a)
            for i in range(ndx):
                total += load(K, (n * nu + a) * width + first + i) * load(dx, i)
            store(dus, n * nu + a, total)  # Eq. 25
        _advance(w, n, dt, at(dus, n * nu), dx, at(dx, ndx))
        for i in range(ndx):
            store(dx, i, load(dx, ndx + i))
