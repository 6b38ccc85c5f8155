"""Exact second-order terms in the sweep (differential dynamic programming): T = sum_k costate_k d2 f_k / dz2.

The Hessian of a stage of the LQ problem in z = (u | x) is that of its cost plus F' P F. With T it becomes the second
derivative of the Hamiltonian (Eq. 21), and an iteration a Newton step instead of a Gauss-Newton one. The costates are
those of the trajectory itself (Eq. 16, 17), so T is there before the sweep.
"""

from __future__ import annotations

from planner.kernels.lq.stage_hessian import times_E_vector
from planner.kernels.lq.workspace import W
from planner.kernels.numba.jit import inline, jit
from planner.kernels.numba.lanes import WIDTH, at, floats, load, load4, pointer, store, store4


@jit
def costates(w, dt):
    """Fill W.costates (Eq. 16, 17) along the trajectory, in the columns of x, from F and the stages' gradients."""
    w = pointer(w)
    ndx, width, first = w[W.ndx], w[W.width], w[W.first]
    structured, nv = w[W.structured], ndx // 2
    rows = nv if structured else ndx
    c, l, carried = floats(w, W.costates), floats(w, W.l), floats(w, W.dx)
    for j in range(width):
        store(c, w[W.N] * width + j, load(l, w[W.N] * width + j))  # Eq. 17
    for n in range(w[W.N] - 1, -1, -1):
        F, o, later = at(floats(w, W.F), n * rows * width), n * width, at(c, (n + 1) * width + first)
        for j in range(width):
            store(c, o + j, load(l, o + j))
        if structured:
            times_E_vector(w, n, dt, nv, later, carried)
            for j in range(ndx):
                store(c, o + first + j, load(c, o + first + j) + load(carried, j))
        for i in range(rows):
            factor = dt * load(carried, nv + i) if structured else load(later, i)
            for j in range(width):
                store(c, o + j, load(c, o + j) + factor * load(F, i * width + j))  # Eq. 16


@inline
def add_second(w, M, n):
    """T of stage n onto the upper triangle of its Hessian M (z, z)."""
    width = w[W.width]
    T = at(floats(w, W.T), n * width * width)
    for i in range(width):
        for j in range(i // WIDTH * WIDTH, width, WIDTH):
            o = i * width + j
            store4(M, o, load4(M, o) + load4(T, o))
