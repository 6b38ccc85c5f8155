"""The first guess of a controller's next plan: the plan before, moved on by whole stages, from a measured state.

    xs(n), us(n), K(n) <- those of stage n + m, beyond the end the last;   k <- 0
    us(0) <- us(0) + K(0) (x0 (-) xs(0)),   xs(0) <- x0

What follows is a rollout with these gains (kernels.lq.line_search). NumPy's way to do the same is
solvers.engine.warm_start_shift, by a
dozen calls of some microseconds each while the caches are full of other things.
"""

from __future__ import annotations

from planner.kernels.lq.deviation import deviation
from planner.kernels.lq.workspace import W
from planner.kernels.numba.jit import inline, jit
from planner.kernels.numba.lanes import at, floats, load, pointer, store
from planner.kernels.numba.layout import Layout

# A plan that is followed: the stages by which it moves; the measured state (nx,), xs (N+1, nx), us (N, nu), and
# K (2 N, nu, width), whose second half is room for what is beyond the end.
FOLLOWED = Layout("stages", "x0 xs us K")


@inline
def _moved(to, values, rows, size, stages, last):
    """Write `rows` rows of a size, those from row `stages` on; beyond row `last` that repeats."""
    whole = min(rows, last + 1 - stages)
    for i in range(whole * size):
        store(to, i, load(values, stages * size + i))
    for n in range(whole, rows):
        for i in range(size):
            store(to, n * size + i, load(values, last * size + i))


@jit
def load_tracked(w, f):
    """Write the first guess into the memory of a solve w, from a plan f (FOLLOWED)."""
    w, f = pointer(w), pointer(f)
    N, nx, nu, first, m = w[W.N], w[W.nx], w[W.nu], w[W.first], f[FOLLOWED.stages]
    xs, us, x0, K, row = floats(w, W.xs), floats(w, W.us), floats(f, FOLLOWED.x0), floats(f, FOLLOWED.K), w[W.width]
    _moved(xs, floats(f, FOLLOWED.xs), N + 1, nx, m, N)
    _moved(us, floats(f, FOLLOWED.us), N, nu, m, N - 1)
    if m > 0:
        _moved(at(K, N * nu * row), K, m, nu * row, N, N - 1)
    k, e = floats(w, W.k), floats(w, W.error)
    for i in range(N * nu):
        store(k, i, 0.0)
    deviation(w, x0, xs, e)
    for i in range(nu):
        u = load(us, i)
        for j in range(w[W.ndx]):
            u += load(K, (m * nu + i) * row + first + j) * load(e, j)
        store(us, i, u)
    for i in range(nx):
        store(xs, i, load(x0, i))


@jit
def store_tracked(w, f):
    """Copy the trajectory of a solve w into a plan f; the square of the norm of its last state."""
    w, f = pointer(w), pointer(f)
    N, nx, nu = w[W.N], w[W.nx], w[W.nu]
    _moved(floats(f, FOLLOWED.xs), floats(w, W.xs), N + 1, nx, 0, N)
    _moved(floats(f, FOLLOWED.us), floats(w, W.us), N, nu, 0, N - 1)
    end, square = at(floats(w, W.xs), N * nx), 0.0
    for i in range(nx):
        square += load(end, i) * load(end, i)
    return square
