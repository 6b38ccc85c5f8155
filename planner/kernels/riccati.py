"""The backward sweep (Eq. 31-34) and the costate (Eq. 16-19) on lanes.

With z = (u | x), F = (B | A), the stage's Hessian W = diag(R, Q) and gradient l, and the value function of the next
stage (P, s), the LQ problem of a stage is the quadratic with

    H = W + F' P F,    h = l + F' s.

Eliminating u by a Cholesky factorisation of its block R + B'PB leaves the Schur complement, which is the next
(P, s): Eq. 33 and 34, with the inverse of Eq. 31 never formed.

Semi-implicit Euler has more structure: x+ = E (x + [0; dt a(z)]) with E = [[T, dt J], [0, 1]] (T = J = 1 but for
quaternions). With S = E' P E and D = dt da/dz,

    H = W + (0 | 1)' (S + S_xv D) + D' (S_vx + S_vv D),

which contracts over nv instead of 2 nv rows.
"""

from __future__ import annotations

import math

from planner.kernels.jit import inline, jit
from planner.kernels.lanes import WIDTH, at, floats, integers, load, load4, spread, store, store4
from planner.kernels.rotations import difference_floats, inverse_right_jacobian_floats
from planner.kernels.tiles import four_rows, mirror, one_row
from planner.kernels.workspace import (
    BALL_OF,
    CONTROL_COLUMN,
    CONTROL_ROW,
    CONTROL_TERMS,
    CONTROL_VALUE,
    COSTATE,
    DIRECTION,
    DX,
    ERROR,
    FEEDFORWARD,
    FINAL_COLUMN,
    FINAL_ROW,
    FINAL_TERMS,
    FINAL_VALUE,
    GAINS,
    GRADIENT,
    LINEAR,
    NDX,
    NU,
    NX,
    NZ,
    QUATERNION_DX,
    QUATERNION_X,
    QUATERNIONS,
    STAGE_COLUMN,
    STAGE_GRADIENT,
    STAGE_ROW,
    STAGE_TERMS,
    STAGE_VALUE,
    STRUCTURED,
    TRANSPORT,
    TURN,
    U_REF,
    US,
    VECTOR_DX,
    VECTOR_X,
    VECTORS,
    X_REF,
    XS,
    G,
    H,
    N,
    S,
    h,
)  # fmt: skip


@inline
def _deviation(w, x, x_ref, e, turn):
    """The deviation e (ndx) of a state from its reference, and what turns it: the inverse Jacobians of rotations."""
    vector_x, vector_dx = integers(w, VECTOR_X), integers(w, VECTOR_DX)
    for i in range(w[VECTORS]):
        a = load(vector_x, i)
        store(e, load(vector_dx, i), load(x, a) - load(x_ref, a))
    for b in range(w[QUATERNIONS]):
        a, d = load(integers(w, QUATERNION_X), b), load(integers(w, QUATERNION_DX), b)
        difference_floats(at(x, a), at(x_ref, a), at(e, d))
        inverse_right_jacobian_floats(at(e, d), at(turn, 9 * b))


@jit
def gradients(w):
    """L = (R (u - u_ref) | J' Q (x - x_ref)) of every stage and of the end (whose u part is zero)."""
    nx, ndx, nu, width = w[NX], w[NDX], w[NU], w[NZ]
    xs, us, x_ref, u_ref = floats(w, XS), floats(w, US), floats(w, X_REF), floats(w, U_REF)
    e, l, turn = floats(w, ERROR), floats(w, STAGE_GRADIENT), floats(w, TURN)
    for n in range(w[N] + 1):
        ln = n * width
        for j in range(nu + ndx):
            store(l, ln + j, 0.0)
        if n < w[N]:
            row, column, terms = integers(w, CONTROL_ROW), integers(w, CONTROL_COLUMN), w[CONTROL_TERMS]
            value = floats(w, CONTROL_VALUE)
            for t in range(terms):
                i, j, r = load(row, t), load(column, t), load(value, n * terms + t)
                store(l, ln + i, load(l, ln + i) + r * (load(us, n * nu + j) - load(u_ref, n * nu + j)))
                if i != j:
                    store(l, ln + j, load(l, ln + j) + r * (load(us, n * nu + i) - load(u_ref, n * nu + i)))
            row, column, terms = integers(w, STAGE_ROW), integers(w, STAGE_COLUMN), w[STAGE_TERMS]
            value = at(floats(w, STAGE_VALUE), n * terms)
        else:
            row, column, terms = integers(w, FINAL_ROW), integers(w, FINAL_COLUMN), w[FINAL_TERMS]
            value = at(floats(w, FINAL_VALUE), 0)
        if terms == 0:
            continue
        _deviation(w, at(xs, n * nx), at(x_ref, n * nx), e, at(turn, n * 9 * w[QUATERNIONS]))
        g = ln + nu
        for t in range(terms):
            i, j, q = load(row, t), load(column, t), load(value, t)
            store(l, g + i, load(l, g + i) + q * load(e, j))
            if i != j:
                store(l, g + j, load(l, g + j) + q * load(e, i))
        for b in range(w[QUATERNIONS]):
            k, J = g + load(integers(w, QUATERNION_DX), b), (n * w[QUATERNIONS] + b) * 9
            a0, a1, a2 = load(l, k), load(l, k + 1), load(l, k + 2)
            for c in range(3):
                store(l, k + c, a0 * load(turn, J + c) + a1 * load(turn, J + 3 + c) + a2 * load(turn, J + 6 + c))


@inline
def _add_weight(M, at_M, width, ball, turn, i, j, q):
    """Add q at (i, j) of symmetric weights to the upper and lower triangle of a Hessian, rotations through J'QJ."""
    if load(ball, i) < 0 and load(ball, j) < 0:
        store(M, at_M + i * width + j, load(M, at_M + i * width + j) + q)
        if i != j:
            store(M, at_M + j * width + i, load(M, at_M + j * width + i) + q)
        return
    i0, j0, ni, nj = i, j, 1, 1
    while ni < 3 and load(ball, i) >= 0 and i0 > 0 and load(ball, i0 - 1) == load(ball, i):
        i0 -= 1
    while nj < 3 and load(ball, j) >= 0 and j0 > 0 and load(ball, j0 - 1) == load(ball, j):
        j0 -= 1
    ni, nj = 3 if load(ball, i) >= 0 else 1, 3 if load(ball, j) >= 0 else 1
    for a in range(ni):
        fa = load(turn, 9 * load(ball, i) + 3 * (i - i0) + a) if ni == 3 else 1.0
        for b in range(nj):
            fb = load(turn, 9 * load(ball, j) + 3 * (j - j0) + b) if nj == 3 else 1.0
            k = at_M + (i0 + a) * width + j0 + b
            store(M, k, load(M, k) + q * fa * fb)
            if i != j:
                k = at_M + (j0 + b) * width + i0 + a
                store(M, k, load(M, k) + q * fa * fb)


@inline
def _add_weights(w, M, n):
    """The stage's (or the end's) weights onto H."""
    width, nu = w[NZ], w[NU]
    ball, turn = integers(w, BALL_OF), at(floats(w, TURN), n * 9 * w[QUATERNIONS])
    if n < w[N]:
        row, column, terms = integers(w, CONTROL_ROW), integers(w, CONTROL_COLUMN), w[CONTROL_TERMS]
        value = floats(w, CONTROL_VALUE)
        for t in range(terms):
            i, j, r = load(row, t), load(column, t), load(value, n * terms + t)
            store(M, i * width + j, load(M, i * width + j) + r)
            if i != j:
                store(M, j * width + i, load(M, j * width + i) + r)
        row, column, terms = integers(w, STAGE_ROW), integers(w, STAGE_COLUMN), w[STAGE_TERMS]
        value = at(floats(w, STAGE_VALUE), n * terms)
    else:
        row, column, terms = integers(w, FINAL_ROW), integers(w, FINAL_COLUMN), w[FINAL_TERMS]
        value = at(floats(w, FINAL_VALUE), 0)
    for t in range(terms):
        _add_weight(M, nu * width + nu, width, ball, turn, load(row, t), load(column, t), load(value, t))


@inline
def _form_dense(w, Fn, ln):
    """H = F'PF and h, costate = l + F' s, l + F' lambda, for a dense F."""
    ndx, nu, width = w[NDX], w[NU], w[NZ]
    F, M, GP, l = floats(w, LINEAR), floats(w, H), floats(w, G), floats(w, STAGE_GRADIENT)
    s, c = floats(w, h), floats(w, COSTATE)
    P = nu * width + nu
    for i0 in range(0, ndx, WIDTH):
        four_rows(GP, i0 * width, width, M, P + i0, width, F, Fn, width, ndx, 1.0, width, False)
    for j0 in range(0, width, WIDTH):
        store4(s, width + j0, load4(l, ln + j0))
        store4(c, width + j0, load4(l, ln + j0))
    one_row(s, width, s, nu, 1, F, Fn, width, ndx, 1.0, width)
    one_row(c, width, c, nu, 1, F, Fn, width, ndx, 1.0, width)  # Eq. 16
    for j0 in range(0, width, WIDTH):
        store4(s, j0, load4(s, width + j0))
        store4(c, j0, load4(c, width + j0))
    for i0 in range(0, width, WIDTH):
        o = i0 * width + i0
        four_rows(M, o, width, F, Fn + i0, width, GP, i0, width, ndx, 1.0, width - i0, False)


@inline
def _times_E(w, n, dt):
    """S = E' P E."""
    ndx, nu, width = w[NDX], w[NU], w[NZ]
    nv = ndx // 2
    ld = (ndx + 2 * WIDTH - 1) // WIDTH * WIDTH
    M, S_ = floats(w, H), floats(w, S)
    balls, first = w[QUATERNIONS], integers(w, QUATERNION_DX)
    E = at(floats(w, TRANSPORT), n * 18 * balls)
    zero = spread(0.0)
    for i in range(ndx):
        o, p = i * ld, (nu + i) * width + nu
        for j in range(0, nv, WIDTH):
            store4(S_, o + j, load4(M, p + j))
        for j in range(0, nv, WIDTH):
            store4(S_, o + nv + j, dt * load4(M, p + j) + load4(M, p + nv + j))
        store4(S_, o + ndx, zero)
        for b in range(balls):
            k, e = load(first, b), 18 * b
            x, y, z = load(M, p + k), load(M, p + k + 1), load(M, p + k + 2)
            for c in range(3):
                store(S_, o + k + c, x * load(E, e + c) + y * load(E, e + 3 + c) + z * load(E, e + 6 + c))
                turned = x * load(E, e + 9 + c) + y * load(E, e + 12 + c) + z * load(E, e + 15 + c)
                store(S_, o + nv + k + c, dt * turned + load(M, p + nv + k + c))
    for i in range(nv):
        o, p = i * ld, (nv + i) * ld
        for j in range(0, ndx, WIDTH):
            store4(S_, p + j, dt * load4(S_, o + j) + load4(S_, p + j))
    for b in range(balls):
        k, e = load(first, b), 18 * b
        for j in range(0, ndx, WIDTH):
            x, y, z = load4(S_, k * ld + j), load4(S_, (k + 1) * ld + j), load4(S_, (k + 2) * ld + j)
            for c in range(3):
                turned = load(E, e + 9 + c) * x + load(E, e + 12 + c) * y + load(E, e + 15 + c) * z
                own = x if c == 0 else y if c == 1 else z  # what the pass above added with J = 1
                q = (nv + k + c) * ld + j
                store4(S_, q, load4(S_, q) + dt * (turned - own))
            for c in range(3):
                store4(
                    S_, (k + c) * ld + j,
                    load(E, e + c) * x + load(E, e + 3 + c) * y + load(E, e + 6 + c) * z,
                )  # fmt: skip
        for j in range(WIDTH):  # the pad is read by tiles
            for c in range(3):
                store(S_, (k + c) * ld + ndx + j, 0.0)
                store(S_, (nv + k + c) * ld + ndx + j, 0.0)
    return ld


@inline
def _times_E_vector(w, n, dt, s):
    """E' applied to a value gradient (ndx) in place."""
    nv = w[NDX] // 2
    first = integers(w, QUATERNION_DX)
    E = at(floats(w, TRANSPORT), n * 18 * w[QUATERNIONS])
    for i in range(nv):
        store(s, nv + i, load(s, nv + i) + dt * load(s, i))
    for b in range(w[QUATERNIONS]):
        k, e = load(first, b), 18 * b
        x, y, z = load(s, k), load(s, k + 1), load(s, k + 2)
        for c in range(3):
            turned = x * load(E, e + 9 + c) + y * load(E, e + 12 + c) + z * load(E, e + 15 + c)
            own = x if c == 0 else y if c == 1 else z
            store(s, nv + k + c, load(s, nv + k + c) + dt * (turned - own))
            store(s, k + c, x * load(E, e + c) + y * load(E, e + 3 + c) + z * load(E, e + 6 + c))


@inline
def _structured_gradient(w, n, dt, s, Fn, ln):
    """L + (B | A)' s, through the accelerations; s (NZ) in place."""
    ndx, nu, width = w[NDX], w[NU], w[NZ]
    nv = ndx // 2
    F, l = floats(w, LINEAR), floats(w, STAGE_GRADIENT)
    _times_E_vector(w, n, dt, at(s, nu))
    for j0 in range(0, width, WIDTH):
        store4(s, width + j0, load4(l, ln + j0))
    one_row(s, width, s, nu + nv, 1, F, Fn, width, nv, dt, width)
    for i in range(ndx):
        store(s, width + nu + i, load(s, width + nu + i) + load(s, nu + i))
    for j0 in range(0, width, WIDTH):
        store4(s, j0, load4(s, width + j0))


@inline
def _form_structured(w, n, dt, Fn, ln):
    """H, h and costate for semi-implicit Euler."""
    ndx, nu, width = w[NDX], w[NU], w[NZ]
    nv = ndx // 2
    F, M, Y, S_ = floats(w, LINEAR), floats(w, H), floats(w, G), floats(w, S)
    ld = _times_E(w, n, dt)
    _structured_gradient(w, n, dt, floats(w, h), Fn, ln)
    _structured_gradient(w, n, dt, floats(w, COSTATE), Fn, ln)  # Eq. 16
    for i0 in range(0, ndx, WIDTH):  # Y = S (0 | 1) + dt S_xv F; of the position rows only what lies above
        start = 0 if i0 + WIDTH > nv else (nu + i0) // WIDTH * WIDTH
        o = i0 * width + start
        four_rows(Y, o, width, S_, nv * ld + i0, ld, F, Fn + start, width, nv, dt, width - start, False)
    for i in range(ndx):
        for j in range(0, ndx, WIDTH):
            k = i * width + nu + j
            store4(Y, k, load4(Y, k) + load4(S_, i * ld + j))
    zero = spread(0.0)
    for i0 in range(0, width, WIDTH):
        for i in range(i0, i0 + WIDTH):
            for j0 in range(i0, width, WIDTH):
                inside = nu <= i < nu + ndx
                store4(M, i * width + j0, load4(Y, (i - nu) * width + j0) if inside else zero)
        o = i0 * width + i0
        four_rows(M, o, width, F, Fn + i0, width, Y, nv * width + i0, width, nv, dt, width - i0, True)


@inline
def _eliminate(w, mu, n):
    """Cholesky R + B'PB + mu I = U'U carried along the columns of x; gains; the next P and s in place.

    Returns the slope's part and whether the block is positive definite.
    """
    ndx, nu, width = w[NDX], w[NU], w[NZ]
    M, s = floats(w, H), floats(w, h)
    K, k = floats(w, GAINS), floats(w, FEEDFORWARD)
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
        for j0 in range(o, width, WIDTH):
            store4(M, a * width + j0, scale * load4(M, a * width + j0))
        store(M, a * width + a, scale)  # the diagonal holds 1 / U_aa
        ha *= scale
        store(s, a, ha)
        slope -= ha * ha  # Eq. 42
    one_row(s, nu, s, 0, 1, M, nu, width, nu, -1.0, ndx)  # Eq. 34
    o = nu // WIDTH * WIDTH
    for a in range(nu - 1, -1, -1):  # U (K | k) = -(U_x | h)
        scale = -1.0 * load(M, a * width + a)
        ka = load(s, a)
        for b in range(a + 1, nu):
            ka += load(M, a * width + b) * load(k, n * nu + b)
        store(k, n * nu + a, scale * ka)
        row, below = (n * nu + a) * width + o, (n * nu + a + 1) * width + o
        for j0 in range(0, width - o, WIDTH):
            store4(K, row + j0, load4(M, a * width + o + j0))
        one_row(K, row, M, a * width + a + 1, 1, K, below, width, nu - a - 1, 1.0, width - o)
        for j0 in range(0, width - o, WIDTH):
            store4(K, row + j0, scale * load4(K, row + j0))
    columns = (ndx + WIDTH - 1) // WIDTH * WIDTH
    P = nu * width + nu
    for i0 in range(0, ndx, WIDTH):  # Eq. 33
        o, wide = P + i0 * width + i0, columns - i0
        four_rows(M, o, width, M, nu + i0, width, M, nu + i0, width, nu, -1.0, wide, True)
        mirror(M, P, width, i0, columns)
    return slope, True


@jit
def riccati(w, mu, dt):
    """Sweep backward. Fills the gains, the gradient and the value function.

    Returns:
        (gradient norm, slope, ok): the norm of Eq. 19; the slope of J along the direction, which by Eq. 42 is
        minus twice the decrease that the LQ model promises; False when R + B'PB + mu I is not positive definite.
    """
    ndx, nu, width = w[NDX], w[NU], w[NZ]
    M, s, c = floats(w, H), floats(w, h), floats(w, COSTATE)
    l, gradient = floats(w, STAGE_GRADIENT), floats(w, GRADIENT)
    states = ndx // 2 if w[STRUCTURED] else ndx
    zero = spread(0.0)
    for i in range(0, (nu + ndx) * width, WIDTH):  # Eq. 29: P(N) = Q(N), s(N) = Q(N) (x - x_ref)
        store4(M, i, zero)
    _add_weights(w, M, w[N])
    for j in range(nu + ndx):
        store(s, j, load(l, w[N] * width + j))
        store(c, j, load(l, w[N] * width + j))  # Eq. 17
    norm2, slope = 0.0, 0.0
    for n in range(w[N] - 1, -1, -1):
        Fn, ln = n * states * width, n * width
        if w[STRUCTURED]:
            _form_structured(w, n, dt, Fn, ln)
        else:
            _form_dense(w, Fn, ln)
        _add_weights(w, M, n)
        for a in range(nu):  # Eq. 18
            g = load(c, a)
            store(gradient, n * nu + a, g)
            norm2 += g * g
        part, definite = _eliminate(w, mu, n)
        if not definite:
            return math.sqrt(norm2), 0.0, False
        slope += part
    return math.sqrt(norm2), slope, True


@inline
def advance_deviation(w, F, n, dt, du, dx, dx_next):
    """The linearised stage: dx_next = A dx + B du, with F the linearisation of some trajectory."""
    ndx, nu, width = w[NDX], w[NU], w[NZ]
    states = ndx // 2 if w[STRUCTURED] else ndx
    for i in range(states):
        row = (n * states + i) * width
        total = 0.0
        for a in range(nu):
            total += load(F, row + a) * load(du, a)
        for j in range(ndx):
            total += load(F, row + nu + j) * load(dx, j)
        store(dx_next, i, total)
    if w[STRUCTURED]:
        nv = states
        for i in range(nv):
            rate = load(dx, nv + i) + dt * load(dx_next, i)
            store(dx_next, nv + i, rate)
            store(dx_next, i, load(dx, i) + dt * rate)
        for b in range(w[QUATERNIONS]):
            k = load(integers(w, QUATERNION_DX), b)
            E = at(floats(w, TRANSPORT), (n * w[QUATERNIONS] + b) * 18)
            for c in range(3):
                total = 0.0
                for j in range(3):
                    total += load(E, 3 * c + j) * load(dx, k + j)
                    total += dt * load(E, 9 + 3 * c + j) * load(dx_next, nv + k + j)
                store(dx_next, k + c, total)


@jit
def direction(w, dt):
    """The LQ problem's own forward pass: dus (N, nu) = k + K dx with dx+ = A dx + B du, dx(0) = 0 (Eq. 30)."""
    ndx, nu, width = w[NDX], w[NU], w[NZ]
    K, k, dus, dx = floats(w, GAINS), floats(w, FEEDFORWARD), floats(w, DIRECTION), floats(w, DX)
    for i in range(ndx):
        store(dx, i, 0.0)
    for n in range(w[N]):
        for a in range(nu):
            total = load(k, n * nu + a)
            for i in range(ndx):
                total += load(K, (n * nu + a) * width + nu + i) * load(dx, i)
            store(dus, n * nu + a, total)  # Eq. 25
        advance_deviation(w, floats(w, LINEAR), n, dt, at(dus, n * nu), dx, at(dx, ndx))  # Eq. 30
        for i in range(ndx):
            store(dx, i, load(dx, ndx + i))
