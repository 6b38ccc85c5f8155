"""The line search on a tree: four rollouts at once."""

from __future__ import annotations

import numpy as np

from planner.kernels.algebra.rotations import difference
from planner.kernels.integrators import SEMI_IMPLICIT_EULER
from planner.kernels.lq.line_search import (
    EVALUATE_ONLY,
    INITIAL_ROLLOUT,
    WOLFE,
    batches,
    choose,
    first_step_lengths,
    refine,
)
from planner.kernels.lq.quadratic import control_terms, penalties_of, state_terms
from planner.kernels.lq.workspace import ALPHA, BRACKET, COSTS, GIVEN, SLOPES, W, accept, take_lane
from planner.kernels.numba.jit import inline, jit, part
from planner.kernels.numba.lanes import (
    any_less,
    at,
    floats,
    integers,
    lanes,
    load,
    maximum,
    minimum,
    pointer,
    select,
    spread,
    store,
)
from planner.kernels.tree.mechanism_table import TREE
from planner.kernels.tree.memory import MEMORY
from planner.kernels.tree.residuals.evaluate import residual_cost
from planner.kernels.tree.residuals.layout import RESIDUALS
from planner.kernels.tree.residuals.motor_work import work_cost
from planner.kernels.tree.step import stage


@inline
def _deviations(w, X, reference, e):
    """Deviations e (ndx lanes) of the candidates' states X (nx lanes) from one reference (nx floats)."""
    vector_x, vector_dx = integers(w, W.vector_x), integers(w, W.vector_dx)
    for i in range(w[W.vectors]):
        k = load(vector_x, i)
        store(e, load(vector_dx, i), load(X, k) - load(reference, k))
    for b in range(w[W.quaternions]):
        k = load(integers(w, W.quaternion_x), b)
        difference(X, k, reference, k, e, load(integers(w, W.quaternion_dx), b))


@inline
def _quadratic(row, column, value, terms, e):
    """1/2 e'Qe."""
    J = spread(0.0)
    for t in range(terms):
        i, j = load(row, t), load(column, t)
        factor = 0.5 * load(value, t) if i == j else load(value, t)
        J += factor * (load(e, i) * load(e, j))
    return J


@inline
def _state_cost(w, X, n, e):
    """1/2 |x - x_ref|^2 of stage n or, for n = N, of the end; and its penalties."""
    row, column, value, terms, _ = state_terms(w, n)
    if terms == 0 and penalties_of(w, n) == 0:
        return spread(0.0)
    _deviations(w, X, at(floats(w, W.x_ref), n * w[W.nx]), e)
    J = _quadratic(row, column, value, terms, e)
    if penalties_of(w, n) > 0:
        J += _penalties(w, n, e)
    return J


@inline
def _penalties(w, n, e):
    """1/2 w (max(0, e - upper)^2 + max(0, lower - e)^2)."""
    o, component, J = n * w[W.penalties], integers(w, W.penalty_dx), spread(0.0)
    lower, upper = at(floats(w, W.penalty_lower), o), at(floats(w, W.penalty_upper), o)
    weight = at(floats(w, W.penalty_weight), o)
    for t in range(penalties_of(w, n)):
        d = load(e, load(component, t))
        above, below = maximum(d - load(upper, t), 0.0), maximum(load(lower, t) - d, 0.0)
        J += 0.5 * load(weight, t) * (above * above + below * below)
    return J


@inline
def _clip(w, n, U):
    """Controls of stage n put back within their bounds."""
    nu = w[W.nu]
    lower, upper = at(floats(w, W.lower), n * nu), at(floats(w, W.upper), n * nu)
    for a in range(nu):
        store(U, a, minimum(maximum(load(U, a), load(lower, a)), load(upper, a)))


@inline
def _clip_servos(w, n, X, U):
    """The same where bounds of servos are lines of the state (see planner.problem.control_bounds)."""
    nu, entry = w[W.nu], integers(w, W.servo_x)
    lower, upper = at(floats(w, W.range_lower), n * nu), at(floats(w, W.range_upper), n * nu)
    control, start = integers(w, W.servo_control), integers(w, W.servo_start)
    now, late = floats(w, W.servo_at_start), floats(w, W.servo_at_end)
    least, most = floats(w, W.servo_low), floats(w, W.servo_high)
    servo = 0
    for a in range(nu):
        low, high = spread(load(lower, a)), spread(load(upper, a))
        if servo < w[W.servos] and load(control, servo) == a:
            first, last = spread(0.0), spread(0.0)
            for t in range(load(start, servo), load(start, servo + 1)):
                y = load(X, load(entry, t))
                first += load(now, t) * y
                last += load(late, t) * y
            l = maximum(load(least, servo) - first, load(least, servo) - last)
            h = minimum(load(most, servo) - first, load(most, servo) - last)
            middle = 0.5 * (l + h)
            low, high = (
                minimum(maximum(minimum(l, middle), low), high), minimum(maximum(maximum(h, middle), low), high)
            )  # fmt: skip
            servo += 1
        store(U, a, minimum(maximum(load(U, a), low), high))


@inline
def _control_cost(w, U, n, e):
    """1/2 |u - u_ref|^2 of stage n."""
    nu, u_ref = w[W.nu], at(floats(w, W.u_ref), n * w[W.nu])
    for i in range(nu):
        store(e, i, load(U, i) - load(u_ref, i))
    row, column, value, terms = control_terms(w, n)
    return _quadratic(row, column, value, terms, e)


@inline
def _controls(w, n, alpha, feedback, dx, U):
    """U = us + alpha k + K dx with feedback, us + alpha dus without (Eq. 36)."""
    nu, ndx, width = w[W.nu], w[W.ndx], w[W.width]
    us = at(floats(w, W.us), n * nu)
    step = at(floats(w, W.k), n * nu) if feedback else at(floats(w, W.dus), n * nu)
    for a in range(nu):
        store(U, a, load(us, a) + alpha * load(step, a))
    if not feedback:
        return
    K = at(floats(w, W.K), n * nu * width + w[W.first])
    zero = spread(0.0)
    for a in range(0, nu - 3, 4):
        k0, k1, k2, k3 = at(K, a * width), at(K, (a + 1) * width), at(K, (a + 2) * width), at(K, (a + 3) * width)
        s0, s1, s2, s3 = zero, zero, zero, zero
        for j in range(ndx):
            d = load(dx, j)
            s0 += load(k0, j) * d
            s1 += load(k1, j) * d
            s2 += load(k2, j) * d
            s3 += load(k3, j) * d
        store(U, a, load(U, a) + s0)
        store(U, a + 1, load(U, a + 1) + s1)
        store(U, a + 2, load(U, a + 2) + s2)
        store(U, a + 3, load(U, a + 3) + s3)
    for a in range(nu // 4 * 4, nu):
        k0 = at(K, a * width)
        s0, s1 = zero, zero
        half = ndx // 2
        for j in range(half):
            s0 += load(k0, j) * load(dx, j)
            s1 += load(k0, half + j) * load(dx, half + j)
        if 2 * half < ndx:
            s0 += load(k0, ndx - 1) * load(dx, ndx - 1)
        store(U, a, load(U, a) + (s0 + s1))


@inline
def _append_accelerations(m, x, x_next, dt):
    """After a stage from x to x_next: its mean acceleration, and the change of that by dt (problem.costs.jerk)."""
    nv, v = m[TREE.nv], m[TREE.nq]
    a = v + nv + m[TREE.na]
    for k in range(nv):
        mean = (load(x_next, v + k) - load(x, v + k)) / dt
        store(x_next, a + k, mean)
        store(x_next, a + nv + k, (mean - load(x, a + k)) / dt)


@part
def rollout(w, m, r, search, dt, limit, feedback, external, p, solids):
    """Four step lengths at once: states trial_x, controls trial_u, accelerations trial_a and costs.

    No term of the cost is negative by more than rounding, so a candidate whose sum is not below the limit is lost: it
    costs infinity, and goes on in the nominal states, where a machine that has fallen does not keep the others waiting.
    The rollout ends where all are lost.

    p is the table of residuals or, where there are none, None: then nothing of them is compiled.
    """
    nx, nu, ndx, kept = w[W.nx], w[W.nu], w[W.ndx], r[MEMORY.kept]
    with_accelerations = nx > m[TREE.nq] + m[TREE.nv] + m[TREE.na]
    X_, U_, A_, e = lanes(w, W.trial_x), lanes(w, W.trial_u), lanes(r, MEMORY.trial_a), lanes(w, W.deviations)
    xs = floats(w, W.xs)
    dx, lengths = at(e, ndx), at(e, 2 * ndx)
    alpha, length = load(search, ALPHA), spread(dt)
    for i in range(nx):
        store(X_, i, spread(load(xs, i)))
    J = spread(0.0)
    for n in range(w[W.N]):
        X, U = at(X_, n * nx), at(U_, n * nu)
        J += _state_cost(w, X, n, e)
        if feedback:
            _deviations(w, X, at(xs, n * nx), dx)
        _controls(w, n, alpha, feedback, dx, U)
        if w[W.servos] > 0:
            _clip_servos(w, n, X, U)
        elif w[W.bounded] > 0:
            _clip(w, n, U)
        control = _control_cost(w, U, n, lengths)
        stage(m, r, X, U, at(A_, n * kept), length, at(X_, (n + 1) * nx), external)
        if with_accelerations:
            _append_accelerations(m, X, at(X_, (n + 1) * nx), length)
        if p is not None:
            if pointer(p)[RESIDUALS.works] > 0:
                J += work_cost(m, pointer(p), X, U, at(X_, (n + 1) * nx))
            # a stage of an Euler method has left the links where X has them
            placed = r[MEMORY.integrator] <= SEMI_IMPLICIT_EULER
            J += residual_cost(m, pointer(p), X, lanes(r, MEMORY.links), n, placed, solids)
        J += control
        if limit < np.inf:
            J = select(J, limit, J, np.inf)
            if not any_less(J, limit):
                store(search, COSTS, J)
                return
            X, nominal = at(X_, (n + 1) * nx), at(xs, (n + 1) * nx)
            for i in range(nx):
                store(X, i, select(J, limit, load(X, i), load(nominal, i)))
    J += _state_cost(w, at(X_, w[W.N] * nx), w[W.N], e)
    if p is not None:
        J += residual_cost(m, pointer(p), at(X_, w[W.N] * nx), lanes(r, MEMORY.links), w[W.N], False, solids)
    store(search, COSTS, J)


@inline
def _take(w, m, r, lane):
    """Make candidate `lane` the nominal trajectory, its accelerations with it."""
    accept(w, lane)
    take_lane(floats(r, MEMORY.accelerations), floats(r, MEMORY.trial_a), w[W.N] * r[MEMORY.kept], lane)


@jit
def search_step(w, m, r, search, rule, feedback, external, p, solids):
    """Search along the direction and take a step, or with rule START only roll the controls out; (step, cost after).

    The step is 0 when there is none. p is the table of residuals or None, solids whether some are of two solids (True
    or None), external as in Model: what is None is not compiled.
    """
    w, m, r = pointer(w), pointer(m), pointer(r)
    alpha, costs, slopes, bracket = search[ALPHA], search[COSTS], search[SLOPES], search[BRACKET]
    cost, slope, dt = search[GIVEN, 0], search[GIVEN, 1], search[GIVEN, 2]
    limit = np.inf if rule in (INITIAL_ROLLOUT, EVALUATE_ONLY, WOLFE) else cost
    first_step_lengths(rule, alpha, bracket)
    for _ in range(batches(rule)):
        rollout(w, m, r, pointer(search), dt, limit, feedback, external, p, solids)
        lane = choose(rule, alpha, costs, slopes, cost, slope, bracket)
        if lane >= 0:
            _take(w, m, r, lane)
            return alpha[lane], costs[lane]
        refine(rule, alpha, bracket)
    return 0.0, cost
