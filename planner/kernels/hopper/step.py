"""The paper's hopper (section 2.4) on lanes: height y, its rate v, piston p; control u = dp/dt.

    dy/dt = v,   dv/dt = F(p - y) / m - g,   dp/dt = u

with the C1 spring F of section 2.4. Every function works on floats and on V4 alike. One stage is one step of one
of three integrators; `step` also returns the spring's slope at each of its evaluations, from which `push` carries
any first-order change of (y, v, p, u) through the same step: four pushes give A and B exactly, one push along a
search direction gives the slope of the cost.
"""

from __future__ import annotations

from planner.kernels.algebra.ramp import ramp
from planner.kernels.lq.search import WOLFE, batches, choose, ladder, refine
from planner.kernels.lq.workspace import (  # fmt: skip
    ALPHA,
    BOUNDED,
    BRACKET,
    CONTROL_VALUE,
    COSTS,
    DEVIATIONS,
    DIRECTION,
    FEEDFORWARD,
    FINAL_COLUMN,
    FINAL_ROW,
    FINAL_TERMS,
    FINAL_VALUE,
    FIRST_X,
    GAINS,
    LINEAR,
    LOWER,
    SLOPES,
    STAGE_COLUMN,
    STAGE_ROW,
    STAGE_TERMS,
    STAGE_VALUE,
    TRIAL_U,
    TRIAL_X,
    U_REF,
    UPPER,
    US,
    WIDTH_Z,
    X_REF,
    XS,
    N,
    accept,
)
from planner.kernels.numba.jit import inline, jit, part
from planner.kernels.numba.lanes import (
    WIDTH,
    as_floats,
    at,
    doubles,
    floats,
    integers,
    lanes,
    load,
    maximum,
    minimum,
    pointer,
    spread,
    store,
)

EULER, SEMI_IMPLICIT_EULER, RK4 = 0, 1, 2


@inline
def spring(compression, stiffness, smoothing):
    """Force per mass F(e) / m of section 2.4 and its slope: the one-sided law of every contact, without damping."""
    force, slope = ramp(compression, smoothing, 1.0 / smoothing)
    return stiffness * force, stiffness * slope


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


@part
def linearize(integrator, dt, parameters, xs, us, N, F, width, first, knots):
    """F[n, i, :] = (B | A) row i of stage n, four stages at a time; all pointers, knots seven lanes of scratch."""
    stiffness, smoothing, gravity = parameters[0], parameters[1], parameters[2]
    flat = as_floats(knots)
    for n0 in range(0, N, WIDTH):
        for lane in range(WIDTH):
            n = min(n0 + lane, N - 1)
            store(flat, lane, load(us, n))
            for i in range(3):
                store(flat, (1 + i) * WIDTH + lane, load(xs, 3 * n + i))
        u, y, v, p = load(knots, 0), load(knots, 1), load(knots, 2), load(knots, 3)
        _, _, _, s1, s2, s3, s4 = step(integrator, y, v, p, u, dt, stiffness, smoothing, gravity)
        for column in range(4):  # the unit changes of u, y, v, p
            du = spread(1.0 if column == 0 else 0.0)
            dy = spread(1.0 if column == 1 else 0.0)
            dv = spread(1.0 if column == 2 else 0.0)
            dp = spread(1.0 if column == 3 else 0.0)
            dy, dv, dp = push(integrator, dy, dv, dp, du, s1, s2, s3, s4, dt)
            store(knots, 4, dy)
            store(knots, 5, dv)
            store(knots, 6, dp)
            for lane in range(min(WIDTH, N - n0)):
                at_row = (n0 + lane) * 3 * width + (0 if column == 0 else first + column - 1)
                store(F, at_row, load(flat, 4 * WIDTH + lane))
                store(F, at_row + width, load(flat, 5 * WIDTH + lane))
                store(F, at_row + 2 * width, load(flat, 6 * WIDTH + lane))


@jit
def linearize_arrays(integrator, dt, parameters, xs, us, F, knots):
    """The same on arrays xs (N+1, 3), us (N, 1), F (N, 3, width), knots (7, 4)."""
    linearize(
        integrator, dt, parameters, doubles(xs), doubles(us), us.shape[0],
        doubles(F), F.shape[2], 1, pointer(knots),
    )  # fmt: skip


@inline
def _tracking(e, d, row, column, value, terms, slopes):
    """1/2 e'Qe and, if asked, its slope along d, from the terms of Q."""
    J, S = spread(0.0), spread(0.0)
    for t in range(terms):
        i, j, q = load(row, t), load(column, t), load(value, t)
        factor = 0.5 * q if i == j else q
        J += factor * (load(e, i) * load(e, j))
        if slopes:
            S += factor * (load(e, i) * load(d, j) + load(e, j) * load(d, i))
    return J, S


@part
def rollout(integrator, dt, parameters, w, search, feedback, slopes):
    """Four step lengths at once: states TRIAL_X, controls TRIAL_U, costs and, if asked, their slopes.

    The control is us + alpha k + K (x - xs) with feedback, us + alpha dus without (Eq. 36).
    """
    stiffness, smoothing, gravity = parameters[0], parameters[1], parameters[2]
    stages, width = w[N], w[WIDTH_Z]
    xs, us, K, k = floats(w, XS), floats(w, US), floats(w, GAINS), floats(w, FEEDFORWARD)
    dus, x_ref, u_ref = floats(w, DIRECTION), floats(w, X_REF), floats(w, U_REF)
    lower, upper = floats(w, LOWER), floats(w, UPPER)
    stage_row, stage_column = integers(w, STAGE_ROW), integers(w, STAGE_COLUMN)
    R, terms = floats(w, CONTROL_VALUE), w[STAGE_TERMS]
    X_, U_, e = lanes(w, TRIAL_X), lanes(w, TRIAL_U), lanes(w, DEVIATIONS)
    d = at(e, 3)
    alpha = load(pointer(search), ALPHA)
    y, v, p = spread(load(xs, 0)), spread(load(xs, 1)), spread(load(xs, 2))
    zero = spread(0.0)
    dy, dv, dp = zero, zero, zero
    J, S = zero, zero
    for n in range(stages + 1):
        store(X_, 3 * n, y)
        store(X_, 3 * n + 1, v)
        store(X_, 3 * n + 2, p)
        store(e, 0, y - load(x_ref, 3 * n))
        store(e, 1, v - load(x_ref, 3 * n + 1))
        store(e, 2, p - load(x_ref, 3 * n + 2))
        store(d, 0, dy)
        store(d, 1, dv)
        store(d, 2, dp)
        if n == stages:
            row, column, last = integers(w, FINAL_ROW), integers(w, FINAL_COLUMN), w[FINAL_TERMS]
            dJ, dS = _tracking(e, d, row, column, floats(w, FINAL_VALUE), last, slopes)
            J += dJ
            S += dS
            break
        dJ, dS = _tracking(e, d, stage_row, stage_column, at(floats(w, STAGE_VALUE), n * terms), terms, slopes)
        J += dJ
        S += dS
        if feedback:
            du = load(k, n)
            u = load(us, n) + alpha * du
            o = n * width + w[FIRST_X]
            Ky, Kv, Kp = load(K, o), load(K, o + 1), load(K, o + 2)
            u += Ky * (y - load(xs, 3 * n)) + Kv * (v - load(xs, 3 * n + 1)) + Kp * (p - load(xs, 3 * n + 2))
            du_dalpha = du + (Ky * dy + Kv * dv + Kp * dp)
        else:
            du = load(dus, n)
            u = load(us, n) + alpha * du  # Eq. 36
            du_dalpha = spread(du)
        if w[BOUNDED] > 0:
            u = minimum(maximum(u, load(lower, n)), load(upper, n))
        store(U_, n, u)
        gu = load(R, n) * (u - load(u_ref, n))
        J += 0.5 * gu * (u - load(u_ref, n))
        if slopes:
            S += gu * du_dalpha
        y, v, p, s1, s2, s3, s4 = step(integrator, y, v, p, u, dt, stiffness, smoothing, gravity)
        if slopes:
            dy, dv, dp = push(integrator, dy, dv, dp, du_dalpha, s1, s2, s3, s4, dt)
    store(pointer(search), COSTS, J)
    store(pointer(search), SLOPES, S)


@jit
def linearize_nominal(integrator, dt, parameters, w):
    """A and B along the nominal trajectory."""
    w = pointer(w)
    linearize(
        integrator, dt, parameters, floats(w, XS), floats(w, US), w[N], floats(w, LINEAR), w[WIDTH_Z],
        w[FIRST_X], lanes(w, DEVIATIONS),
    )  # fmt: skip


@jit
def search_step(integrator, dt, parameters, w, search, rule, feedback, cost, slope):
    """Search along the direction and take a step, or with rule START roll out US as it is; (step, cost after).

    The step is 0 when there is none.
    """
    w = pointer(w)
    alpha, costs, slopes, bracket = search[ALPHA], search[COSTS], search[SLOPES], search[BRACKET]
    ladder(rule, alpha, bracket)
    for _ in range(batches(rule)):
        rollout(integrator, dt, parameters, w, search, feedback, rule == WOLFE)
        lane = choose(rule, alpha, costs, slopes, cost, slope, bracket)
        if lane >= 0:
            accept(w, lane)
            return alpha[lane], costs[lane]
        refine(rule, alpha, bracket)
    return 0.0, cost
