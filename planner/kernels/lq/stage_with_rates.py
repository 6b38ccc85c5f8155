"""The Hessian and gradient of a stage of semi-implicit Euler that remembers its accelerations, for least jerk.

Behind the machine's own x the state has the accelerations of the stage before and their rates (problem.costs.jerk),

    a+ = a(z),    r+ = (a+ - a) / dt,

of which r are outputs: they have weights W of their own, and nothing depends on them. With d = dt a(z) and D = dt da/dz
as in stage_hessian, S over (x, d) is that of P over (x, a), where a = d / dt and its diagonal has W / dt^2 added. For
the machine's own z

    H = (0 | 1)' (S_xx + S_xd D) + D' (S_dx + S_dd D),

which contracts over nv rows too; a's columns of H are rows of D times a number each.
"""

from __future__ import annotations

from planner.kernels.algebra.tiles import four_rows
from planner.kernels.lq.stage_hessian import pull_back, times_E, times_E_vector
from planner.kernels.lq.workspace import W
from planner.kernels.numba.jit import inline, part
from planner.kernels.numba.lanes import WIDTH, at, floats, load, load4, store, store4


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
