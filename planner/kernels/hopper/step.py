"""The paper's hopper (section 2.4) on lanes: height y, its rate v, piston p; control u = dp/dt.

    dy/dt = v,   dv/dt = F(p - y) / m - g,   dp/dt = u

with the C1 spring F of section 2.4. Every function works on floats and on V4 alike. One stage is one step of one
of three integrators; `step` also returns the spring's slope at each of its evaluations, from which `push` carries
any first-order change of (y, v, p, u) through the same step: four pushes give A and B exactly, one push along a
search direction gives the slope of the cost.
"""

from __future__ import annotations

from planner.kernels.algebra.ramp import ramp
from planner.kernels.algebra.spatial import load3, store3, sub
from planner.kernels.integrators import EULER, SEMI_IMPLICIT_EULER
from planner.kernels.lq.line_search import WOLFE, batches, choose, first_step_lengths, refine
from planner.kernels.lq.workspace import ALPHA, BRACKET, COSTS, GIVEN, SLOPES, W, accept
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


@inline
def spring(compression, stiffness, smoothing):
    """Force per mass F(e) / m of section 2.4 and its slope: the one-sided law of every contact, without damping."""
    force, slope = ramp(compression, smoothing, 1.0 / smoothing)
    return stiffness * force, stiffness * slope


@inline
def step(integrator, x, u, dt, parameters):
    """One stage from x = (y, v, p). Returns x at its end and the spring's four slopes (equal where there is one)."""
    y, v, p = x
    stiffness, smoothing, gravity = parameters
    f1, s1 = spring(p - y, stiffness, smoothing)
    a1 = f1 - gravity
    p1 = p + dt * u
    if integrator == EULER:
        return (y + dt * v, v + dt * a1, p1), (s1, s1, s1, s1)
    if integrator == SEMI_IMPLICIT_EULER:
        v1 = v + dt * a1
        return (y + dt * v1, v1, p1), (s1, s1, s1, s1)
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
    return (y1, v1, p1), (s1, s2, s3, s4)


@inline
def push(integrator, x, u, slopes, dt):
    """The first-order change of a stage's end for changes x = (y, v, p) of its start and u of its control."""
    y, v, p = x
    s1, s2, s3, s4 = slopes
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
    constants = (parameters[0], parameters[1], parameters[2])
    for i in range(xs.shape[0]):
        (y, v, p), _ = step(integrator, (xs[i, 0], xs[i, 1], xs[i, 2]), us[i, 0], dt[i], constants)
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
def linearize(integrator, dt, parameters, trajectory, rows, knots):
    """F[n, i, :] = (B | A) row i of stage n, four stages at a time.

    trajectory is (xs, us, N), rows (F, their width, the column of x), knots seven lanes of scratch; all by pointers.
    """
    xs, us, N = trajectory
    F, width, first = rows
    constants = (parameters[0], parameters[1], parameters[2])
    flat = as_floats(knots)
    for n0 in range(0, N, WIDTH):
        for lane in range(WIDTH):
            n = min(n0 + lane, N - 1)
            store(flat, lane, load(us, n))
            for i in range(3):
                store(flat, (1 + i) * WIDTH + lane, load(xs, 3 * n + i))
        _, slopes = step(integrator, load3(knots, 1), load(knots, 0), dt, constants)
        for column in range(4):  # the unit changes of u, y, v, p
            du = spread(1.0 if column == 0 else 0.0)
            dy = spread(1.0 if column == 1 else 0.0)
            dv = spread(1.0 if column == 2 else 0.0)
            dp = spread(1.0 if column == 3 else 0.0)
            store3(knots, 4, push(integrator, (dy, dv, dp), du, slopes, dt))
            for lane in range(min(WIDTH, N - n0)):
                at_row = (n0 + lane) * 3 * width + (0 if column == 0 else first + column - 1)
                store(F, at_row, load(flat, 4 * WIDTH + lane))
                store(F, at_row + width, load(flat, 5 * WIDTH + lane))
                store(F, at_row + 2 * width, load(flat, 6 * WIDTH + lane))


@jit
def linearize_arrays(integrator, dt, parameters, xs, us, F, knots):
    """The same on arrays xs (N+1, 3), us (N, 1), F (N, 3, width), knots (7, 4)."""
    trajectory, rows = (doubles(xs), doubles(us), us.shape[0]), (doubles(F), F.shape[2], 1)
    linearize(integrator, dt, parameters, trajectory, rows, pointer(knots))


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
    """Four step lengths at once: states trial_x, controls trial_u, costs and, if asked, their slopes.

    The control is us + alpha k + K (x - xs) with feedback, us + alpha dus without (Eq. 36).
    """
    constants = (parameters[0], parameters[1], parameters[2])
    stages, width = w[W.N], w[W.width]
    xs, us, K, k = floats(w, W.xs), floats(w, W.us), floats(w, W.K), floats(w, W.k)
    dus, x_ref, u_ref = floats(w, W.dus), floats(w, W.x_ref), floats(w, W.u_ref)
    lower, upper = floats(w, W.lower), floats(w, W.upper)
    stage_row, stage_column = integers(w, W.stage_row), integers(w, W.stage_column)
    R, terms = floats(w, W.control_value), w[W.stage_terms]
    X_, U_, e = lanes(w, W.trial_x), lanes(w, W.trial_u), lanes(w, W.deviations)
    d = at(e, 3)
    alpha = load(pointer(search), ALPHA)
    y, v, p = spread(load(xs, 0)), spread(load(xs, 1)), spread(load(xs, 2))
    zero = spread(0.0)
    dy, dv, dp = zero, zero, zero
    J, S = zero, zero
    for n in range(stages + 1):
        store3(X_, 3 * n, (y, v, p))
        store3(e, 0, sub((y, v, p), load3(x_ref, 3 * n)))
        store3(d, 0, (dy, dv, dp))
        if n == stages:
            row, column, last = integers(w, W.final_row), integers(w, W.final_column), w[W.final_terms]
            dJ, dS = _tracking(e, d, row, column, floats(w, W.final_value), last, slopes)
            J += dJ
            S += dS
            break
        dJ, dS = _tracking(e, d, stage_row, stage_column, at(floats(w, W.stage_value), n * terms), terms, slopes)
        J += dJ
        S += dS
        if feedback:
            du = load(k, n)
            u = load(us, n) + alpha * du
            o = n * width + w[W.first]
            Ky, Kv, Kp = load(K, o), load(K, o + 1), load(K, o + 2)
            u += Ky * (y - load(xs, 3 * n)) + Kv * (v - load(xs, 3 * n + 1)) + Kp * (p - load(xs, 3 * n + 2))
            du_dalpha = du + (Ky * dy + Kv * dv + Kp * dp)
        else:
            du = load(dus, n)
            u = load(us, n) + alpha * du  # Eq. 36
            du_dalpha = spread(du)
        if w[W.bounded] > 0:
            u = minimum(maximum(u, load(lower, n)), load(upper, n))
        store(U_, n, u)
        gu = load(R, n) * (u - load(u_ref, n))
        J += 0.5 * gu * (u - load(u_ref, n))
        if slopes:
            S += gu * du_dalpha
        (y, v, p), spring_slopes = step(integrator, (y, v, p), u, dt, constants)
        if slopes:
            dy, dv, dp = push(integrator, (dy, dv, dp), du_dalpha, spring_slopes, dt)
    store(pointer(search), COSTS, J)
    store(pointer(search), SLOPES, S)


@jit
def linearize_nominal(integrator, dt, parameters, w):
    """A and B along the nominal trajectory."""
    w = pointer(w)
    trajectory, rows = (floats(w, W.xs), floats(w, W.us), w[W.N]), (floats(w, W.F), w[W.width], w[W.first])
    linearize(integrator, dt, parameters, trajectory, rows, lanes(w, W.deviations))


@jit
def search_step(integrator, dt, parameters, w, search, rule, feedback):
    """Search along the direction and take a step, or with rule START only roll the controls out; (step, cost after).

    The step is 0 when there is none.
    """
    w = pointer(w)
    alpha, costs, slopes, bracket = search[ALPHA], search[COSTS], search[SLOPES], search[BRACKET]
    cost, slope = search[GIVEN, 0], search[GIVEN, 1]
    first_step_lengths(rule, alpha, bracket)
    for _ in range(batches(rule)):
        rollout(integrator, dt, parameters, w, search, feedback, rule == WOLFE)
        lane = choose(rule, alpha, costs, slopes, cost, slope, bracket)
        if lane >= 0:
            accept(w, lane)
            return alpha[lane], costs[lane]
        refine(rule, alpha, bracket)
    return 0.0, cost
