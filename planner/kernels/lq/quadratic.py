"""The tracking cost along a trajectory: gradients and Hessians of its stages, rotations by Gauss and Newton.

With dx = x (-) x_ref and J = d dx / dx, the gradient is J' Q dx and the Hessian J' Q J; J is the identity but for the
rotation vectors of quaternions. Weights are lists of their upper entries that are not zero, plain ones first, then
those that touch a rotation.

Ranges of the states come in as penalties, 1/2 w (max(0, e - upper)^2 + max(0, lower - e)^2) on single components of the
deviation e (see planner.solvers.augmented_lagrangian); where both bounds are the same, that is 1/2 w (e - bound)^2.
"""

from __future__ import annotations

from planner.kernels.algebra.rotations import inverse_right_jacobian_floats
from planner.kernels.algebra.tiles import four_rows
from planner.kernels.lq.deviation import deviation
from planner.kernels.lq.workspace import W
from planner.kernels.numba.jit import inline, jit
from planner.kernels.numba.lanes import WIDTH, at, floats, integers, load, load4, pointer, store, store4


@inline
def _turns(w, e, turn):
    """The J (9) of the rotation vector of each quaternion in a deviation e."""
    for b in range(w[W.quaternions]):
        inverse_right_jacobian_floats(at(e, load(integers(w, W.quaternion_dx), b)), at(turn, 9 * b))


@inline
def _add_gradient(row, column, value, terms, e, l):
    """Add Q e to l."""
    for t in range(terms):
        i, j, q = load(row, t), load(column, t), load(value, t)
        store(l, i, load(l, i) + q * load(e, j))
        if i != j:
            store(l, j, load(l, j) + q * load(e, i))


@inline
def state_terms(w, n):
    """Rows, columns, values, and numbers of terms and of plain terms of the state weights of stage n, or of the end."""
    if n < w[W.N]:
        return (
            integers(w, W.stage_row), integers(w, W.stage_column), at(floats(w, W.stage_value), n * w[W.stage_terms]),
            w[W.stage_terms], w[W.stage_plain],
        )  # fmt: skip
    return (
        integers(w, W.final_row), integers(w, W.final_column), at(floats(w, W.final_value), 0), w[W.final_terms],
        w[W.final_plain],
    )  # fmt: skip


@inline
def control_terms(w, n):
    """Rows, columns, values and number of terms of the control weights of stage n."""
    terms = w[W.control_terms]
    return integers(w, W.control_row), integers(w, W.control_column), at(floats(w, W.control_value), n * terms), terms


@inline
def penalties_of(w, n):
    """How many components have a range at stage n, or at the end."""
    return w[W.stage_penalties] if n < w[W.N] else w[W.penalties]


@inline
def _add_penalties(w, n, count, e, l):
    """Add the slopes of the penalties of stage n to l, and keep their second derivatives for add_weights."""
    o, component = n * w[W.penalties], integers(w, W.penalty_dx)
    lower, upper = at(floats(w, W.penalty_lower), o), at(floats(w, W.penalty_upper), o)
    weight, active = at(floats(w, W.penalty_weight), o), at(floats(w, W.penalty_active), o)
    for t in range(count):
        i = load(component, t)
        d, low, high, factor = load(e, i), load(lower, t), load(upper, t), load(weight, t)
        store(floats(w, W.penalty_e), o + t, d)
        store(floats(w, W.penalty_side), o + t, 1.0 if d >= high else -1.0 if d < low else 0.0)
        slope, curvature = 0.0, 0.0
        if d >= high:
            slope, curvature = factor * (d - high), factor
        if d < low:
            slope, curvature = slope + factor * (d - low), curvature + factor
        store(l, i, load(l, i) + slope)
        store(active, t, curvature)


@jit
def gradients(w):
    """L = (R (u - u_ref) | J' Q (x - x_ref)) of every stage and of the end (whose u part is zero)."""
    w = pointer(w)
    nx, nu, width, first = w[W.nx], w[W.nu], w[W.width], w[W.first]
    us, u_ref = floats(w, W.us), floats(w, W.u_ref)
    e, turn, balls = floats(w, W.error), floats(w, W.turn), w[W.quaternions]
    for n in range(w[W.N] + 1):
        l = at(floats(w, W.l), n * width)
        for j in range(width):
            store(l, j, 0.0)
        if n < w[W.N]:
            for i in range(nu):
                store(e, i, load(us, n * nu + i) - load(u_ref, n * nu + i))
            row, column, value, terms = control_terms(w, n)
            _add_gradient(row, column, value, terms, e, l)
        row, column, value, terms, _ = state_terms(w, n)
        count = penalties_of(w, n)
        if terms == 0 and count == 0:
            continue
        J = at(turn, n * 9 * balls)
        deviation(w, at(floats(w, W.xs), n * nx), at(floats(w, W.x_ref), n * nx), e)
        _turns(w, e, J)
        g = at(l, first)
        _add_gradient(row, column, value, terms, e, g)
        if count > 0:
            _add_penalties(w, n, count, e, g)
        for b in range(balls):
            k = load(integers(w, W.quaternion_dx), b)
            a0, a1, a2 = load(g, k), load(g, k + 1), load(g, k + 2)
            for c in range(3):
                o = 9 * b + c
                store(g, k + c, a0 * load(J, o) + a1 * load(J, o + 3) + a2 * load(J, o + 6))


@inline
def _add_turned(w, M, width, turn, i, j, q):
    """Add J' (q at (i, j) and (j, i)) J to a Hessian, where i or j belongs to a rotation."""
    ball, first = integers(w, W.ball), integers(w, W.quaternion_dx)
    bi, bj = load(ball, i), load(ball, j)
    i0, ni = (load(first, bi), 3) if bi >= 0 else (i, 1)
    j0, nj = (load(first, bj), 3) if bj >= 0 else (j, 1)
    for a in range(ni):
        fa = load(turn, 9 * bi + 3 * (i - i0) + a) if ni == 3 else 1.0
        for b in range(nj):
            fb = load(turn, 9 * bj + 3 * (j - j0) + b) if nj == 3 else 1.0
            k = (i0 + a) * width + j0 + b
            store(M, k, load(M, k) + q * fa * fb)
            if i != j:
                k = (j0 + b) * width + i0 + a
                store(M, k, load(M, k) + q * fa * fb)


@inline
def _add_residuals(w, M, n):
    """The Hessian of the residuals of stage n, or of the end, onto the upper triangle of M (x, x)."""
    columns, width = w[W.residual_columns], w[W.width]
    ld = (columns + WIDTH - 1) // WIDTH * WIDTH
    P = at(floats(w, W.residual_hessian), n * columns * ld)
    for i in range(columns):
        for j in range(i // WIDTH * WIDTH, ld, WIDTH):
            o = i * width + j
            store4(M, o, load4(M, o) + load4(P, i * ld + j))


@inline
def add_weights(w, M, n):
    """The weights of stage n, or of the end, onto the upper triangle of its Hessian M (z, z)."""
    width, first, rows = w[W.width], w[W.first], w[W.hessian_rows]
    if n < w[W.N]:
        for i in range(0, width if rows > 0 else 0, WIDTH):
            C, A = (M, i * width + i, width), (floats(w, W.rows), n * rows * width + i, width)
            four_rows(C, (A[0], A[1], width, 1), A, rows, 1.0, width - i, C, True)
        row, column, value, terms = control_terms(w, n)
        for t in range(terms):
            k = load(row, t) * width + load(column, t)
            store(M, k, load(M, k) + load(value, t))
    row, column, value, terms, plain = state_terms(w, n)
    M = at(M, first * width + first)
    for t in range(plain):
        k = load(row, t) * width + load(column, t)
        store(M, k, load(M, k) + load(value, t))
    turn = at(floats(w, W.turn), n * 9 * w[W.quaternions])
    for t in range(plain, terms):
        _add_turned(w, M, width, turn, load(row, t), load(column, t), load(value, t))
    count = penalties_of(w, n)
    if count > 0:
        component, active = integers(w, W.penalty_dx), at(floats(w, W.penalty_active), n * w[W.penalties])
        for t in range(count):
            q, i = load(active, t), load(component, t)
            if q > 0.0:
                if load(integers(w, W.ball), i) >= 0:
                    _add_turned(w, M, width, turn, i, i, q)
                else:
                    store(M, i * width + i, load(M, i * width + i) + q)
    if w[W.residual_columns] > 0 and load(floats(w, W.residual_active), n) > 0.0:
        _add_residuals(w, M, n)
