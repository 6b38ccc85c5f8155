"""Second-order terms T = sum_k costate_k d2 f_k / dz2 of the hopper, in closed form.

Only the spring is not linear. Stage i of the integrator compresses it by e_i, which changes by g_i' dz with
z = (u | y, v, p); with mu_i the derivative of costate' x(n+1) by the acceleration of that stage,

    T = sum_i mu_i F''(e_i)/m g_i g_i',      F''/m = stiffness / smoothing on the parabola, 0 elsewhere.

mu goes backward as in kernels.tree.tree_second_order, where da/dy = -s, the spring's slope, and da/dv = 0.
"""

from __future__ import annotations

from planner.kernels.hopper.step import step
from planner.kernels.integrators import EULER, RUNGE_KUTTA
from planner.kernels.numba.jit import inline, jit


@inline
def _add(T, n, mu, slope, g, first, spring):
    """Mu F''/m g g' onto the upper triangle of T, g = (u, y, v, p)."""
    stiffness, smoothing, _ = spring
    if not 0.0 < slope < stiffness:  # off the parabola
        return
    factor = mu * stiffness / smoothing
    for i in range(4):
        row = 0 if i == 0 else first + i - 1
        for j in range(i, 4):
            T[n, row, 0 if j == 0 else first + j - 1] += factor * g[i] * g[j]


@inline
def _minus(g, factor, other):
    return g[0] - factor * other[0], g[1] - factor * other[1], g[2] - factor * other[2], g[3] - factor * other[3]


@jit
def second_order(integrator, dt, parameters, xs, us, costates, T):
    """Upper triangles T (N, width, width) along xs (N+1, 3), us (N, 1), for the costates (N+1, width)."""
    spring = (parameters[0], parameters[1], parameters[2])
    first, h, w = T.shape[1] // 2, 0.5 * dt, dt / 6.0  # z is padded to two groups of lanes
    for n in range(us.shape[0]):
        T[n] = 0.0
        ly, lv = costates[n + 1, first], costates[n + 1, first + 1]
        _, slopes = step(integrator, (xs[n, 0], xs[n, 1], xs[n, 2]), us[n, 0], dt, spring)
        s0, s1, s2, s3 = slopes
        g0 = (0.0, -1.0, 0.0, 1.0)
        if integrator != RUNGE_KUTTA:
            mu = dt * lv + (0.0 if integrator == EULER else dt * dt * ly)
            _add(T, n, mu, s0, g0, first, spring)
            continue
        mu3 = w * lv
        mu2 = 2.0 * w * lv + dt * w * ly
        mu1 = 2.0 * w * lv + h * (2.0 * w * ly - dt * s3 * mu3)
        mu0 = w * lv + h * (2.0 * w * ly - h * s2 * mu2)
        # e = p - y of the states that the step goes through
        g1 = (h, -1.0, -h, 1.0)
        g2 = _minus(g1, h * h * s0, g0)
        g3 = _minus((dt, -1.0, -dt, 1.0), dt * h * s1, g1)
        _add(T, n, mu0, s0, g0, first, spring)
        _add(T, n, mu1, s1, g1, first, spring)
        _add(T, n, mu2, s2, g2, first, spring)
        _add(T, n, mu3, s3, g3, first, spring)
