"""The Hessian and gradient in z = (u | x) of a stage of the LQ problem, before the stage's own weights.

With F = (B | A) and the value function of the next stage (P, s),

    H = F' P F,    h = l + F' s.

Semi-implicit Euler has more structure: x+ = E (x + [0; dt a(z)]) with E = [[T, dt J], [0, 1]], where T = J = 1 but
for rotations. With S = E' P E and D = dt da/dz,

    H = (0 | 1)' (S + S_xv D) + D' (S_vx + S_vv D),

which contracts over nv rows instead of 2 nv. Only the upper triangle of H is formed; P and S are whole.
"""

from __future__ import annotations

from planner.kernels import workspace as W
from planner.kernels.jit import inline
from planner.kernels.lanes import WIDTH, at, floats, integers, load, load4, spread, store, store4
from planner.kernels.tiles import four_rows, one_row


@inline
def _copied(a, b, columns):
    for j in range(0, columns, WIDTH):
        store4(b, j, load4(a, j))


@inline
def dense_stage(w, n, dt):
    """H, and h and the costate through F' (Eq. 16), for F = (B | A)."""
    ndx, width, first = w[W.NDX], w[W.WIDTH_Z], w[W.FIRST_X]
    F, M, G = at(floats(w, W.LINEAR), n * ndx * width), floats(w, W.H), floats(w, W.G)
    P, l = first * width + first, at(floats(w, W.STAGE_GRADIENT), n * width)
    for i in range(0, ndx, WIDTH):
        four_rows(G, i * width, width, M, P + i, width, F, 0, width, ndx, 1.0, width, False)
    for which in range(2):
        s = floats(w, W.h) if which == 0 else floats(w, W.COSTATE)
        _copied(l, at(s, width), width)
        one_row(s, width, s, first, 1, F, 0, width, ndx, 1.0, width)  # Eq. 16
        _copied(at(s, width), s, width)
    for i in range(0, width, WIDTH):
        four_rows(M, i * width + i, width, F, i, width, G, i, width, ndx, 1.0, width - i, False)


@inline
def _times_E(w, n, dt):
    """S = E' P E; returns the length of its rows."""
    ndx, width, first = w[W.NDX], w[W.WIDTH_Z], w[W.FIRST_X]
    nv = ndx // 2
    ld = (ndx + 2 * WIDTH - 1) // WIDTH * WIDTH
    M, S = floats(w, W.H), floats(w, W.S)
    balls, starts = w[W.QUATERNIONS], integers(w, W.QUATERNION_DX)
    E = at(floats(w, W.TRANSPORT), n * 18 * balls)
    zero = spread(0.0)
    for i in range(ndx):  # P E
        o, p = i * ld, (first + i) * width + first
        for j in range(0, nv, WIDTH):
            store4(S, o + j, load4(M, p + j))
        for j in range(0, nv, WIDTH):
            store4(S, o + nv + j, dt * load4(M, p + j) + load4(M, p + nv + j))
        store4(S, o + ndx, zero)
        for b in range(balls):
            k, e = load(starts, b), 18 * b
            x, y, z = load(M, p + k), load(M, p + k + 1), load(M, p + k + 2)
            for c in range(3):
                store(S, o + k + c, x * load(E, e + c) + y * load(E, e + 3 + c) + z * load(E, e + 6 + c))
                turned = x * load(E, e + 9 + c) + y * load(E, e + 12 + c) + z * load(E, e + 15 + c)
                store(S, o + nv + k + c, dt * turned + load(M, p + nv + k + c))
    for i in range(nv):  # E' (P E)
        o, p = i * ld, (nv + i) * ld
        for j in range(0, ndx, WIDTH):
            store4(S, p + j, dt * load4(S, o + j) + load4(S, p + j))
    for b in range(balls):
        k, e = load(starts, b), 18 * b
        for j in range(0, ndx, WIDTH):
            x, y, z = load4(S, k * ld + j), load4(S, (k + 1) * ld + j), load4(S, (k + 2) * ld + j)
            for c in range(3):
                turned = load(E, e + 9 + c) * x + load(E, e + 12 + c) * y + load(E, e + 15 + c) * z
                own = x if c == 0 else y if c == 1 else z  # what the loop above added, for J = 1
                q = (nv + k + c) * ld + j
                store4(S, q, load4(S, q) + dt * (turned - own))
            for c in range(3):
                turned = load(E, e + c) * x + load(E, e + 3 + c) * y + load(E, e + 6 + c) * z
                store4(S, (k + c) * ld + j, turned)
        for c in range(3):  # tiles read past the end of rows
            for j in range(ndx, ld):
                store(S, (k + c) * ld + j, 0.0)
                store(S, (nv + k + c) * ld + j, 0.0)
    return ld


@inline
def _times_E_vector(w, n, dt, s):
    """E' s of a value gradient s (ndx), in place."""
    nv = w[W.NDX] // 2
    starts = integers(w, W.QUATERNION_DX)
    E = at(floats(w, W.TRANSPORT), n * 18 * w[W.QUATERNIONS])
    for i in range(nv):
        store(s, nv + i, load(s, nv + i) + dt * load(s, i))
    for b in range(w[W.QUATERNIONS]):
        k, e = load(starts, b), 18 * b
        x, y, z = load(s, k), load(s, k + 1), load(s, k + 2)
        for c in range(3):
            turned = x * load(E, e + 9 + c) + y * load(E, e + 12 + c) + z * load(E, e + 15 + c)
            own = x if c == 0 else y if c == 1 else z
            store(s, nv + k + c, load(s, nv + k + c) + dt * (turned - own))
            store(s, k + c, x * load(E, e + c) + y * load(E, e + 3 + c) + z * load(E, e + 6 + c))


@inline
def structured_stage(w, n, dt):
    """H, and h and the costate, for semi-implicit Euler; F holds da/dz."""
    ndx, width, first = w[W.NDX], w[W.WIDTH_Z], w[W.FIRST_X]
    nv = ndx // 2
    F, M, Y, S = at(floats(w, W.LINEAR), n * nv * width), floats(w, W.H), floats(w, W.G), floats(w, W.S)
    l = at(floats(w, W.STAGE_GRADIENT), n * width)
    ld = _times_E(w, n, dt)
    for which in range(2):
        s = floats(w, W.h) if which == 0 else floats(w, W.COSTATE)
        _times_E_vector(w, n, dt, at(s, first))
        _copied(l, at(s, width), first)
        for j in range(first, width, WIDTH):
            store4(s, width + j, load4(l, j) + load4(s, j))
        one_row(s, width, s, first + nv, 1, F, 0, width, nv, dt, width)  # Eq. 16
        _copied(at(s, width), s, width)
    for i in range(0, ndx, WIDTH):  # Y = S (0 | 1) + S_xv D; of the position rows only what lies above
        start = 0 if i + WIDTH > nv else first + i
        for k in range(i, i + WIDTH):
            for j in range(start, first, WIDTH):
                store4(Y, k * width + j, spread(0.0))
            for j in range(max(start, first) - first, width - first, WIDTH):
                store4(Y, k * width + first + j, load4(S, k * ld + j))
        o = i * width + start
        four_rows(Y, o, width, S, nv * ld + i, ld, F, start, width, nv, dt, width - start, True)
    for i in range(0, width, WIDTH):
        o = i * width + i
        if i < first:
            four_rows(M, o, width, F, i, width, Y, nv * width + i, width, nv, dt, width - i, False)
        else:
            for k in range(WIDTH):
                _copied(at(Y, (i - first + k) * width + i), at(M, o + k * width), width - i)
            four_rows(M, o, width, F, i, width, Y, nv * width + i, width, nv, dt, width - i, True)
