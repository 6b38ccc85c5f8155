"""The Hessian and gradient in z = (u | x) of a stage of the LQ problem, before the stage's own weights.

With F = (B | A) and the value function of the next stage (P, s),

    H = F' P F,    h = l + F' s.

Semi-implicit Euler has more structure: x+ = E (x + [0; dt a(z)]) with E = [[T, dt J], [0, 1]], where T = J = 1 but
for rotations. With S = E' P E and D = dt da/dz,

    H = (0 | 1)' (S + S_xv D) + D' (S_vx + S_vv D),

which contracts over nv rows instead of 2 nv (stage_with_rates has more states). Only the upper triangle of H is formed;
P and S are whole.

The Hessian and gradient of a stage of semi-implicit Euler that remembers its accelerations, for least jerk.

Behind the machine's own x the state has the accelerations of the stage before and their rates (problem.costs.jerk),

    a+ = a(z),    r+ = (a+ - a) / dt,

of which r are outputs: they have weights W of their own, and nothing depends on them. With d = dt a(z) and D = dt da/dz
as in stage_hessian, S over (x, d) is that of P over (x, a), where a = d / dt and its diagonal has W / dt^2 added. For
the machine's own z

    H = (0 | 1)' (S_xx + S_xd D) + D' (S_dx + S_dd D),

which contracts over nv rows too; a's columns of H are rows of D times a number each.
"""

from __future__ import annotations

from planner.kernels.algebra.tiles import four_rows, two_sums
from planner.kernels.lq.workspace import W
from planner.kernels.numba.jit import inline, part
from planner.kernels.numba.lanes import WIDTH, at, floats, integers, load, load4, spread, store, store4


@inline
def pull_back(w, n, F, rows, scale, first_row, stays):
    """Gradient h and the costate, l + (s, if it stays) + scale F' s (Eq. 16), from s in their arrays' second rows."""
    width = w[W.width]
    h, c, l = floats(w, W.h), floats(w, W.costate), at(floats(w, W.l), n * width)
    for j in range(0, width, WIDTH):
        x, y = two_sums(at(h, width + first_row), at(c, width + first_row), F, width, rows, j)
        p = load4(l, j)
        if stays:
            store4(h, j, p + load4(h, width + j) + scale * x)
            store4(c, j, p + load4(c, width + j) + scale * y)
        else:
            store4(h, j, p + x)
            store4(c, j, p + y)


@inline
def dense_stage(w, n, dt):
    """H, and h and the costate through F' (Eq. 16), for F = (B | A)."""
    ndx, width, first = w[W.ndx], w[W.width], w[W.first]
    F, M, G = at(floats(w, W.F), n * ndx * width), floats(w, W.H), floats(w, W.G)
    h, c, P = floats(w, W.h), floats(w, W.costate), first * width + first
    if w[W.outputs] > 0:
        _times_P_with_outputs(w, F)
    else:
        for i in range(0, ndx, WIDTH):
            C = (G, i * width, width)
            four_rows(C, (M, P + i, width, 1), (F, 0, width), ndx, 1.0, width, C, False)
    for j in range(first, width, WIDTH):
        store4(h, width + j, load4(h, j))
        store4(c, width + j, load4(c, j))
    pull_back(w, n, F, ndx, 1.0, first, False)
    end = width if w[W.outputs] == 0 else first + ndx - w[W.outputs]  # the columns of outputs are zero
    for i in range(0, end, WIDTH):
        C = (M, i * width + i, width)
        four_rows(C, (F, i, width, 1), (G, i, width), ndx, 1.0, end - i, C, False)


@inline
def _times_P_with_outputs(w, F):
    """G = P F, where outputs have weights of their own and nothing else in P; then these are zero in P."""
    ndx, width, first, carried = w[W.ndx], w[W.width], w[W.first], w[W.ndx] - w[W.outputs]
    M, G, P = floats(w, W.H), floats(w, W.G), first * width + first
    for i in range(0, carried, WIDTH):
        C = (G, i * width, width)
        four_rows(C, (M, P + i, width, 1), (F, 0, width), carried, 1.0, width, C, False)
    for i in range(carried, ndx):
        weight, o = load(M, P + i * width + i), i * width
        store(M, P + i * width + i, 0.0)
        for j in range(0, width, WIDTH):
            store4(G, o + j, weight * load4(F, o + j))


@inline
def _times_E_plain(M, p, ldp, S, o, ld, nv, dt):
    """E' P E without rotations, in one pass over the quarters of P."""
    zero = spread(0.0)
    for i in range(nv):
        pq, pv, oq, ov = p + i * ldp, p + (nv + i) * ldp, o + i * ld, o + (nv + i) * ld
        for j in range(0, nv, WIDTH):
            qq = load4(M, pq + j)
            store4(S, oq + j, qq)
            store4(S, ov + j, dt * qq + load4(M, pv + j))
        for j in range(0, nv, WIDTH):  # over what the rows above left past their ends
            qq = load4(M, pq + j)
            qv = dt * qq + load4(M, pq + nv + j)
            store4(S, oq + nv + j, qv)
            store4(S, ov + nv + j, dt * (qv + load4(M, pv + j)) + load4(M, pv + nv + j))
        store4(S, oq + 2 * nv, zero)
        store4(S, ov + 2 * nv, zero)


@inline
def times_E(w, n, dt, nv):
    """S = (0 | E' P E), columns in the order of z; returns the length of its rows."""
    ndx, width, first = 2 * nv, w[W.width], w[W.first]
    ld = first + (ndx + 2 * WIDTH - 1) // WIDTH * WIDTH
    M, S = floats(w, W.H), at(floats(w, W.S), first)  # the first columns stay zero
    balls, starts = w[W.quaternions], integers(w, W.quaternion_dx)
    if balls == 0:
        _times_E_plain(M, first * width + first, width, S, 0, ld, nv, dt)
        return ld
    E = at(floats(w, W.transport), n * 18 * balls)
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
            for j in range(ndx, ld - first):
                store(S, (k + c) * ld + j, 0.0)
                store(S, (nv + k + c) * ld + j, 0.0)
    return ld


@inline
def times_E_vector(w, n, dt, nv, s, t):
    """E' s of a value gradient s (2 nv), into t."""
    ndx = 2 * nv
    for j in range(0, nv, WIDTH):
        store4(t, j, load4(s, j))
    for j in range(0, nv, WIDTH):
        store4(t, nv + j, load4(s, nv + j) + dt * load4(s, j))
    store4(t, ndx, spread(0.0))
    starts = integers(w, W.quaternion_dx)
    E = at(floats(w, W.transport), n * 18 * w[W.quaternions])
    for b in range(w[W.quaternions]):
        k, e = load(starts, b), 18 * b
        x, y, z = load(s, k), load(s, k + 1), load(s, k + 2)
        for c in range(3):
            turned = x * load(E, e + 9 + c) + y * load(E, e + 12 + c) + z * load(E, e + 15 + c)
            store(t, nv + k + c, load(s, nv + k + c) + dt * turned)
            store(t, k + c, x * load(E, e + c) + y * load(E, e + 3 + c) + z * load(E, e + 6 + c))


@inline
def structured_stage(w, n, dt):
    """H, and h and the costate, for semi-implicit Euler; F holds da/dz."""
    ndx, width, first = w[W.ndx], w[W.width], w[W.first]
    nv = ndx // 2
    F, M, Y, S = at(floats(w, W.F), n * nv * width), floats(w, W.H), floats(w, W.G), floats(w, W.S)
    h, c = floats(w, W.h), floats(w, W.costate)
    ld = times_E(w, n, dt, nv)
    times_E_vector(w, n, dt, nv, at(h, first), at(h, width + first))
    times_E_vector(w, n, dt, nv, at(c, first), at(c, width + first))
    pull_back(w, n, F, nv, dt, first + nv, True)
    for i in range(0, ndx, WIDTH):  # Y = S (0 | 1) + S_xv D; of the position rows only what lies above
        j = 0 if i + WIDTH > nv else first + i
        A, base = (S, nv * ld + first + i, ld, 1), (S, i * ld + j, ld)
        four_rows((Y, i * width + j, width), A, (F, j, width), nv, dt, width - j, base, True)
    for i in range(0, width, WIDTH):
        C, A, B = (M, i * width + i, width), (F, i, width, 1), (Y, nv * width + i, width)
        if i < first:
            four_rows(C, A, B, nv, dt, width - i, C, False)
        else:
            four_rows(C, A, B, nv, dt, width - i, (Y, (i - first) * width + i, width), True)


@inline
def _padded(n):
    return (n + WIDTH - 1) // WIDTH * WIDTH


@inline
def _pull_back_rates(w, dt, s):
    """E' s in the second row of s (h or the costate) goes on with what a gives; the third gets what d gives."""
    width, first, nv = w[W.width], w[W.first], w[W.outputs]
    t, d, a = at(s, width + first), at(s, 2 * width), first + 2 * nv
    for k in range(nv):
        rate = load(s, a + nv + k) / dt
        store(d, k, load(t, nv + k) + (load(s, a + k) + rate) / dt)
        store(t, 2 * nv + k, -1.0 * rate)
        store(t, 3 * nv + k, 0.0)


@inline
def _add_rates(w, n, dt, ld):
    """Rows of d behind those of x in S: S_dx, and behind them S_dd. P has the weights of r no longer."""
    width, first, nv = w[W.width], w[W.first], w[W.outputs]
    M, S, T, P, weights = floats(w, W.H), floats(w, W.S), floats(w, W.G), first * width + first, _weights_of_rates(w)
    a, r, per = 2 * nv, 3 * nv, 1.0 / dt
    for k in range(nv):
        t, v, d, p = k * width, (nv + k) * ld + first, (a + k) * ld + first, P + (r + k) * (width + 1)
        times_E_vector(w, n, dt, nv, at(M, P + (a + k) * width), at(T, t))
        for j in range(0, a, WIDTH):
            store4(S, d + j, load4(S, v + j) + per * load4(T, t + j))
        store(weights, k, per * per * load(M, p))
        store(M, p, 0.0)
    for k in range(nv):
        d, p = r * ld + k * _padded(nv), P + (a + k) * width + a
        for l in range(nv):
            p_kl = load(M, p + l) + (load(weights, k) if l == k else 0.0)
            x_l = load(S, (a + k) * ld + first + nv + l)
            store(S, d + l, x_l + per * (load(T, l * width + nv + k) + per * p_kl))


@inline
def _weights_of_rates(w):
    """Where the weights of r over dt^2 (nv) are kept during a stage."""
    return at(floats(w, W.h), 2 * w[W.width] + w[W.outputs])


@inline
def _rates_of_hessian(w, F):
    """The columns of a in H: a+ = F z changes by r dt from it."""
    width, nv, M, weights = w[W.width], w[W.outputs], floats(w, W.H), _weights_of_rates(w)
    a = w[W.first] + 2 * nv
    for i in range(a):
        for k in range(nv):
            store(M, i * width + a + k, -1.0 * load(weights, k) * load(F, k * width + i))
    for i in range(2 * nv):  # r's are zero
        for k in range(i, 2 * nv):
            store(M, (a + i) * width + a + k, load(weights, k) if k == i and k < nv else 0.0)


@part
def stage_with_rates(w, n, dt):
    """H, and h and the costate, of such a stage; F holds da/dz for the machine's own z."""
    width, first, nv = w[W.width], w[W.first], w[W.outputs]
    F, M, Y, S = at(floats(w, W.F), n * nv * width), floats(w, W.H), floats(w, W.G), floats(w, W.S)
    h, c, ndx = floats(w, W.h), floats(w, W.costate), 2 * nv
    end = first + _padded(ndx)  # F is zero from here on
    ld = times_E(w, n, dt, nv)
    for s in (h, c):
        times_E_vector(w, n, dt, nv, at(s, first), at(s, width + first))
        _pull_back_rates(w, dt, s)
    _add_rates(w, n, dt, ld)
    pull_back(w, n, F, nv, dt, width, True)
    for i in range(0, ndx, WIDTH):  # Y = S (0 | 1) + S_xd D, of what lies above
        j = first + i
        A, base = (S, ndx * ld + j, ld, 1), (S, i * ld + j, ld)
        four_rows((Y, i * width + j, width), A, (F, j, width), nv, dt, end - j, base, True)
    for i in range(0, nv, WIDTH):
        A, o = (S, (ndx + nv) * ld + i, _padded(nv), 1), ndx + i
        four_rows((Y, o * width, width), A, (F, 0, width), nv, dt, end, (S, o * ld, ld), True)
    for i in range(0, end, WIDTH):
        C, A, B = (M, i * width + i, width), (F, i, width, 1), (Y, ndx * width + i, width)
        if i < first:
            four_rows(C, A, B, nv, dt, end - i, C, False)
        else:
            four_rows(C, A, B, nv, dt, end - i, (Y, (i - first) * width + i, width), True)
    _rates_of_hessian(w, F)
