"""The backward sweep (Eq. 31-34) and the costate (Eq. 16-19) on lanes, for any dense A, B.

With z = (u | x), F = (B | A), the stage's Hessian W = diag(R, Q) and gradient l, and the value function of the next
stage (P, s), the LQ problem of a stage is the quadratic with

    H = W + F' P F,    h = l + F' s.

Eliminating u by a Cholesky factorisation of its block R + B'PB leaves the Schur complement, which is the next
(P, s): Eq. 33 and 34, with the inverse of Eq. 31 never formed. Rows are padded to whole lanes, so a row operation
is a few vector instructions.
"""

from __future__ import annotations

import numpy as np

from planner.kernels.jit import jit
from planner.kernels.lanes import WIDTH, load, load8, pointer, spread, store, store8


@jit
def gradients(w):
    """L = (R (u - u_ref) | Q (x - x_ref)) of every stage and of the end (whose u part is zero)."""
    N, nu, nx = w.us.shape[0], w.us.shape[1], w.xs.shape[1]
    for n in range(N + 1):
        for i in range(nx):
            total = 0.0
            for j in range(nx):
                total += w.Q[n, i, j] * (w.xs[n, j] - w.x_ref[n, j])
            w.l[n, nu + i] = total
        if n < N:
            for i in range(nu):
                total = 0.0
                for j in range(nu):
                    total += w.R[n, i, j] * (w.us[n, j] - w.u_ref[n, j])
                w.l[n, i] = total


@jit
def riccati(w, mu):
    """Sweep backward. Fills w.K, w.k, w.gradient.

    Returns:
        (gradient norm, slope, ok): the norm of Eq. 19; the slope of J along the direction, which by Eq. 42 is
        minus twice the decrease that the LQ model promises; False when R + B'PB + mu I is not positive definite.
    """
    N, nu, nx = w.us.shape[0], w.us.shape[1], w.xs.shape[1]
    nz = nu + nx
    NZ = w.F.shape[2]
    F, W, l = pointer(w.F.reshape(-1)), pointer(w.W.reshape(-1)), pointer(w.l.reshape(-1))
    K, k, gradient = pointer(w.K.reshape(-1)), pointer(w.k.reshape(-1)), pointer(w.gradient.reshape(-1))
    H, H_next, G = pointer(w.H[0].reshape(-1)), pointer(w.H[1].reshape(-1)), pointer(w.G.reshape(-1))
    h, costate = pointer(w.h), pointer(w.costate)
    zero = spread(0.0)
    for i in range(nz * NZ):  # Eq. 29: P(N) = Q(N), s(N) = Q(N) (x - x_ref)
        store(H_next, i, load(W, N * nz * NZ + i))
    for j in range(nz):
        store(h, j, load(l, N * NZ + j))
        store(costate, j, load(l, N * NZ + j))  # Eq. 17
    norm2 = 0.0
    slope = 0.0
    for n in range(N - 1, -1, -1):
        Fn, Wn, ln = n * nx * NZ, n * nz * NZ, n * NZ
        for j0 in range(0, NZ, WIDTH):
            for i in range(nx):  # G = P F, reading the upper triangle of P
                g = zero
                for m in range(nx):
                    a, b = (i, m) if i < m else (m, i)
                    g += load(H_next, (nu + a) * NZ + nu + b) * load8(F, Fn + m * NZ + j0)
                store8(G, i * NZ + j0, g)
            hj, cj = load8(l, ln + j0), load8(l, ln + j0)
            for i in range(nx):
                row = load8(F, Fn + i * NZ + j0)
                hj += load(h, nu + i) * row
                cj += load(costate, nu + i) * row
            store8(h, NZ + j0, hj)
            store8(costate, NZ + j0, cj)
        for j0 in range(0, NZ, WIDTH):
            store8(h, j0, load8(h, NZ + j0))
            store8(costate, j0, load8(costate, NZ + j0))  # Eq. 16
            for a in range(nz):  # H = W + F' G
                row = load8(W, Wn + a * NZ + j0)
                for i in range(nx):
                    row += load(F, Fn + i * NZ + a) * load8(G, i * NZ + j0)
                store8(H, a * NZ + j0, row)
        for a in range(nu):  # Eq. 18
            g = load(costate, a)
            store(gradient, n * nu + a, g)
            norm2 += g * g
        for a in range(nu):  # Cholesky R + B'PB = U'U, carried along the columns of x and h
            pivot = load(H, a * NZ + a) + mu
            if not pivot > 0.0:
                return np.sqrt(norm2), 0.0, False
            scale = 1.0 / np.sqrt(pivot)
            for j0 in range(0, NZ, WIDTH):
                store8(H, a * NZ + j0, scale * load8(H, a * NZ + j0))
            store(H, a * NZ + a, np.sqrt(pivot))
            ha = scale * load(h, a)
            store(h, a, ha)
            slope -= ha * ha  # Eq. 42
            for b in range(a + 1, nz):  # Eq. 33, 34
                factor = load(H, a * NZ + b)
                for j0 in range(0, NZ, WIDTH):
                    store8(H, b * NZ + j0, load8(H, b * NZ + j0) - factor * load8(H, a * NZ + j0))
                store(h, b, load(h, b) - factor * ha)
        for a in range(nu - 1, -1, -1):  # U (K | k) = -(U_x | h)
            scale = -1.0 / load(H, a * NZ + a)
            ka = load(h, a)
            for b in range(a + 1, nu):
                ka += load(H, a * NZ + b) * load(k, n * nu + b)
            store(k, n * nu + a, scale * ka)
            for j0 in range(0, NZ, WIDTH):
                row = load8(H, a * NZ + j0)
                for b in range(a + 1, nu):
                    row += load(H, a * NZ + b) * load8(K, (n * nu + b) * NZ + j0)
                store8(K, (n * nu + a) * NZ + j0, scale * row)
        H, H_next = H_next, H
    return np.sqrt(norm2), slope, True


@jit
def direction(w):
    """The LQ problem's own forward pass: w.dus (N, nu) = k + K dx with dx+ = A dx + B du, dx(0) = 0 (Eq. 30)."""
    N, nu, nx = w.us.shape[0], w.us.shape[1], w.xs.shape[1]
    dx, dx_next = w.dx[0], w.dx[1]
    dx[:] = 0.0
    for n in range(N):
        for a in range(nu):
            total = w.k[n, a]
            for i in range(nx):
                total += w.K[n, a, nu + i] * dx[i]
            w.dus[n, a] = total  # Eq. 25
        for i in range(nx):
            total = 0.0
            for a in range(nu):
                total += w.F[n, i, a] * w.dus[n, a]
            for j in range(nx):
                total += w.F[n, i, nu + j] * dx[j]
            dx_next[i] = total  # Eq. 30
        for i in range(nx):
            dx[i] = dx_next[i]
