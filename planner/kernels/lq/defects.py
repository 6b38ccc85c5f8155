"""Gaps of multiple shooting in the sweep: stage n ends at f(x(n), u(n)) = x(n+1) + g(n), and g is to vanish.

The LQ problem's deviations then obey dx(n+1) = A(n) dx(n) + B(n) du(n) + g(n), so that the value gradient that stage n
sees behind its defect is s(n+1) + P(n+1) g(n); P does not change (Mastalli et al. 2020, FDDP; Giftthaler et al. 2018).
Multipliers of the defects are P dx + s along the direction, so both are kept.
"""

from __future__ import annotations

from planner.kernels.lq.workspace import W
from planner.kernels.numba.jit import inline
from planner.kernels.numba.lanes import at, floats, load, store


@inline
def add_defect(w, n):
    """Keep the value function (P | s) of the end of stage n, and take its gradient s across the defect."""
    ndx, width, first = w[W.ndx], w[W.width], w[W.first]
    P, s = at(floats(w, W.H), first * width + first), at(floats(w, W.h), first)
    g, kept = at(floats(w, W.defects), n * ndx), at(floats(w, W.values), n * ndx * (ndx + 1))
    for i in range(ndx):
        for j in range(ndx):
            store(kept, i * (ndx + 1) + j, load(P, i * width + j))
        store(kept, i * (ndx + 1) + ndx, load(s, i))
    for i in range(ndx):
        total = load(s, i)
        for j in range(ndx):
            total += load(P, i * width + j) * load(g, j)
        store(s, i, total)


@inline
def step_with_defect(w, n, dx):
    """Add the defect after stage n to the deviation dx (ndx) of its end, and keep it."""
    ndx = w[W.ndx]
    g, dxs = at(floats(w, W.defects), n * ndx), at(floats(w, W.dxs), (n + 1) * ndx)
    for i in range(ndx):
        d = load(dx, i) + load(g, i)
        store(dx, i, d)
        store(dxs, i, d)
