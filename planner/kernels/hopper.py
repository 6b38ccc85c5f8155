"""The paper's hopper (section 2.4) on lanes: height y, its rate v, piston p; control u = dp/dt.

    dy/dt = v,   dv/dt = F(p - y) / m - g,   dp/dt = u

with the C1 spring F of section 2.4. Every function works on floats and on V8 alike. One stage is one step of one
of three integrators; `step` also returns the spring's slope at each of its evaluations, from which `push` carries
any first-order change of (y, v, p, u) through the same step: four pushes give A and B exactly, one push along a
search direction gives the slope of the cost.
"""

from __future__ import annotations

from planner.kernels.jit import inline, jit
from planner.kernels.lanes import WIDTH, load, maximum, minimum, pointer, spread, store
from planner.kernels.riccati import direction, gradients, riccati
from planner.kernels.search import WOLFE, batches, choose, ladder, refine
from planner.kernels.workspace import ACCEPTED, CONVERGED, INDEFINITE, NO_STEP, accept

EULER, SEMI_IMPLICIT_EULER, RK4 = 0, 1, 2


@inline
def spring(compression, stiffness, smoothing):
    """Force per mass F(e) / m of section 2.4 and its slope."""
    pushed = maximum(compression, 0.0)
    soft = minimum(pushed, smoothing)  # the part of the compression on the parabola
    force = stiffness * (soft * soft * (0.5 / smoothing) + (pushed - soft))
    return force, stiffness * soft * (1.0 / smoothing)


@inline
def step(integrator, y, v, p, u, dt, stiffness, smoothing, gravity):
    """One stage. Returns (y, v, p) at its end and the spring's slopes s1..s4 (equal where there is one)."""
    f1, s1 = spring(p - y, stiffness, smoothing)
    a1 = f1 - gravity
    p1 = p + dt * u
    if integrator == EULER:
        return y + dt * v, v + dt * a1, p1, s1, s1, s1, s1
    if integrator == SEMI_IMPLICIT_EULER:
        v1 = v + dt * a1
        return y + dt * v1, v1, p1, s1, s1, s1, s1
    h = 0.5 * dt
    pm = p + h * u
    v2 = v + h * a1
    f2, s2 = spring(pm - (y + h * v), stiffness, smoothing)
    a2 = f2 - gravity
    v3 = v + h * a2
    f3, s3 = spring(pm - (y + h * v2), stiffness, smoothing)
    a3 = f3 - gravity
    v4 = v + dt * a3
    f4, s4 = spring(p1 - (y + dt * v3), stiffness, smoothing)
    a4 = f4 - gravity
    w = dt / 6.0
    y1 = y + w * (v + 2.0 * v2 + 2.0 * v3 + v4)
    v1 = v + w * (a1 + 2.0 * a2 + 2.0 * a3 + a4)
    return y1, v1, p1, s1, s2, s3, s4


@inline
def push(integrator, y, v, p, u, s1, s2, s3, s4, dt):
    """The first-order change of a stage's end for a change (y, v, p, u) at its start."""
    a1 = s1 * (p - y)
    p1 = p + dt * u
    if integrator == EULER:
        return y + dt * v, v + dt * a1, p1
    if integrator == SEMI_IMPLICIT_EULER:
        v1 = v + dt * a1
        return y + dt * v1, v1, p1
    h = 0.5 * dt
    pm = p + h * u
    v2 = v + h * a1
    a2 = s2 * (pm - (y + h * v))
    v3 = v + h * a2
    a3 = s3 * (pm - (y + h * v2))
    v4 = v + dt * a3
    a4 = s4 * (p1 - (y + dt * v3))
    w = dt / 6.0
    return y + w * (v + 2.0 * v2 + 2.0 * v3 + v4), v + w * (a1 + 2.0 * a2 + 2.0 * a3 + a4), p1


@jit
def steps(integrator, parameters, xs, us, dt, xs_next):
    """xs_next[i] = the end of a stage of length dt[i] from xs[i] (K, 3) with us[i] (K, 1)."""
    stiffness, smoothing, gravity = parameters[0], parameters[1], parameters[2]
    for i in range(xs.shape[0]):
        y, v, p, _, _, _, _ = step(
            integrator, xs[i, 0], xs[i, 1], xs[i, 2], us[i, 0], dt[i], stiffness, smoothing, gravity
        )
        xs_next[i, 0] = y
        xs_next[i, 1] = v
        xs_next[i, 2] = p


@jit
def rates(parameters, xs, us, rates):
    """rates[i] = dx/dt at xs[i] (K, 3) with us[i] (K, 1)."""
    for i in range(xs.shape[0]):
        force, _ = spring(xs[i, 2] - xs[i, 0], parameters[0], parameters[1])
        rates[i, 0] = xs[i, 1]
        rates[i, 1] = force - parameters[2]
        rates[i, 2] = us[i, 0]


@jit
def linearize(integrator, dt, parameters, xs, us, knots, F):
    """F[n, i, :] = (B | A) row i of stage n, eight stages at a time; knots (7, 8) is workspace."""
    stiffness, smoothing, gravity = parameters[0], parameters[1], parameters[2]
    N = us.shape[0]
    lanes = pointer(knots)
    flat = F.reshape(-1)
    for n0 in range(0, N, WIDTH):
        for lane in range(WIDTH):
            n = min(n0 + lane, N - 1)
            knots[0, lane] = us[n, 0]
            for i in range(3):
                knots[1 + i, lane] = xs[n, i]
        u, y, v, p = load(lanes, 0), load(lanes, 1), load(lanes, 2), load(lanes, 3)
        _, _, _, s1, s2, s3, s4 = step(integrator, y, v, p, u, dt, stiffness, smoothing, gravity)
        for column in range(4):  # the unit changes of u, y, v, p
            du = spread(1.0 if column == 0 else 0.0)
            dy = spread(1.0 if column == 1 else 0.0)
            dv = spread(1.0 if column == 2 else 0.0)
            dp = spread(1.0 if column == 3 else 0.0)
            dy, dv, dp = push(integrator, dy, dv, dp, du, s1, s2, s3, s4, dt)
            store(lanes, 4, dy)
            store(lanes, 5, dv)
            store(lanes, 6, dp)
            for lane in range(min(WIDTH, N - n0)):
                at = (n0 + lane) * 3 * WIDTH + column
                flat[at] = knots[4, lane]
                flat[at + WIDTH] = knots[5, lane]
                flat[at + 2 * WIDTH] = knots[6, lane]


@jit
def rollout(integrator, dt, parameters, w, feedback, slopes):
    """Eight step lengths w.alpha at once: states w.X8, controls w.U8, costs w.J8 and, if asked, their slopes w.S8.

    The control is us + alpha k + K (x - xs) with feedback, us + alpha dus without (Eq. 36).
    """
    stiffness, smoothing, gravity = parameters[0], parameters[1], parameters[2]
    N = w.us.shape[0]
    xs, us = pointer(w.xs.reshape(-1)), pointer(w.us.reshape(-1))
    K, k = pointer(w.K.reshape(-1)), pointer(w.k.reshape(-1))
    dus = pointer(w.dus.reshape(-1))
    Q, R = pointer(w.Q.reshape(-1)), pointer(w.R.reshape(-1))
    x_ref, u_ref = pointer(w.x_ref.reshape(-1)), pointer(w.u_ref.reshape(-1))
    X8, U8 = pointer(w.X8), pointer(w.U8)
    alpha = load(pointer(w.alpha), 0)
    y, v, p = spread(w.xs[0, 0]), spread(w.xs[0, 1]), spread(w.xs[0, 2])
    zero = spread(0.0)
    dy, dv, dp = zero, zero, zero
    J, S = zero, zero
    for n in range(N + 1):
        store(X8, 3 * n, y)
        store(X8, 3 * n + 1, v)
        store(X8, 3 * n + 2, p)
        ey, ev, ep = y - load(x_ref, 3 * n), v - load(x_ref, 3 * n + 1), p - load(x_ref, 3 * n + 2)
        q = 9 * n
        gy = load(Q, q) * ey + load(Q, q + 1) * ev + load(Q, q + 2) * ep
        gv = load(Q, q + 3) * ey + load(Q, q + 4) * ev + load(Q, q + 5) * ep
        gp = load(Q, q + 6) * ey + load(Q, q + 7) * ev + load(Q, q + 8) * ep
        J += 0.5 * (ey * gy + ev * gv + ep * gp)
        if slopes:
            S += gy * dy + gv * dv + gp * dp
        if n == N:
            break
        if feedback:
            du = load(k, n)
            u = load(us, n) + alpha * du
            at = n * WIDTH + 1  # a row of K is kept behind its columns of u, as in F
            Ky, Kv, Kp = load(K, at), load(K, at + 1), load(K, at + 2)
            u += Ky * (y - load(xs, 3 * n)) + Kv * (v - load(xs, 3 * n + 1)) + Kp * (p - load(xs, 3 * n + 2))
            du_dalpha = du + (Ky * dy + Kv * dv + Kp * dp)
        else:
            du = load(dus, n)
            u = load(us, n) + alpha * du  # Eq. 36
            du_dalpha = spread(du)
        store(U8, n, u)
        gu = load(R, n) * (u - load(u_ref, n))
        J += 0.5 * gu * (u - load(u_ref, n))
        if slopes:
            S += gu * du_dalpha
        y, v, p, s1, s2, s3, s4 = step(integrator, y, v, p, u, dt, stiffness, smoothing, gravity)
        if slopes:
            dy, dv, dp = push(integrator, dy, dv, dp, du_dalpha, s1, s2, s3, s4, dt)
    store(pointer(w.J8), 0, J)
    store(pointer(w.S8), 0, S)


@jit
def start(integrator, dt, parameters, w):
    """Roll out the controls in w.us from w.xs[0]; returns the cost."""
    w.alpha[:] = 0.0
    w.dus[:] = 0.0
    rollout(integrator, dt, parameters, w, False, False)
    accept(w, 0)
    return w.J8[0, 0]


@jit
def iterate(integrator, dt, parameters, w, rule, feedback, mu, fresh, cost, gradient_tolerance, decrease_tolerance):
    """One SLQ iteration: linearise (if `fresh`), sweep, search, accept. Returns an outcome (see kernels.workspace).

    Fills w.out = (gradient norm, slope, step, expected decrease, cost after).
    """
    if fresh:
        linearize(integrator, dt, parameters, w.xs, w.us, w.knots, w.F)
        gradients(w)
    norm, slope, definite = riccati(w, mu)
    out = w.out
    out[0], out[1], out[2], out[3], out[4] = norm, slope, 0.0, -0.5 * slope, cost
    if not definite:
        return INDEFINITE
    if norm <= gradient_tolerance or -0.5 * slope <= decrease_tolerance:
        return CONVERGED
    if not feedback:
        direction(w)
    alpha, J8, S8 = w.alpha[0], w.J8[0], w.S8[0]
    ladder(rule, alpha, w.bracket)
    for _ in range(batches(rule)):
        rollout(integrator, dt, parameters, w, feedback, rule == WOLFE)
        lane = choose(rule, alpha, J8, S8, cost, slope, w.bracket)
        if lane >= 0:
            accept(w, lane)
            step = alpha[lane]
            out[2], out[3], out[4] = step, -slope * step * (1.0 - 0.5 * step), J8[lane]
            return ACCEPTED
        refine(rule, alpha, w.bracket)
    return NO_STEP
