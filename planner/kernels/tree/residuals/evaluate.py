"""Residuals on lanes: their cost over four candidates, their gradients and Hessians over four knots.

The twin is problem.costs.least_squares. With the value e of a row, its bound b and its weight w, the cost is

    1/2 w r^2,    r = e - b for a target, ramp(e - b) for at most b, ramp(b - e) for at least b,

the gradient w r r' J and the Hessian of Gauss and Newton w r'^2 J'J, J the derivative of e and r' the slope of r by e.
Distances whose curvature a solve uses have that, w r r' times their second derivatives, apart in RESIDUALS.bends (see
curvature).
A tilt adds w r r' times its own second derivative across (see frames) where that is positive, as a row without a value.
"""

from __future__ import annotations

from planner.kernels.algebra.ramp import ramp
from planner.kernels.lq.workspace import W
from planner.kernels.numba.jit import inline, jit, part
from planner.kernels.numba.lanes import (
    WIDTH,
    any_less,
    as_floats,
    at,
    floats,
    integers,
    lanes,
    load,
    load4,
    pointer,
    select,
    spread,
    store,
)
from planner.kernels.tree.linearize import scatter_row
from planner.kernels.tree.memory import MEMORY
from planner.kernels.tree.residuals.curvature import add_distance_curvature
from planner.kernels.tree.residuals.frames import TILT, TILT_BEND
from planner.kernels.tree.residuals.kinds import differentiate, measure
from planner.kernels.tree.residuals.layout import LAW_SIZE, MAX_ROWS, RESIDUALS
from planner.kernels.tree.residuals.motor_work import quadratize_work
from planner.kernels.tree.residuals.points import place_links, place_points
from planner.kernels.tree.step import gather


@inline
def _ramped(p, row, value, bound):
    """The residual of a row, and its derivative by the value."""
    law = at(floats(p, RESIDUALS.law), LAW_SIZE * row)
    side, a = load(law, 0), load(law, 1)
    if side == 0.0:
        return value - bound, spread(1.0)
    residual, slope = ramp(side * (value - bound), a, load(law, 2))
    return residual, side * slope


@part
def residual_cost(m, p, x, ws, n, placed, solids):
    """Cost of the terms for four candidates x (nx lanes) at stage n; with `placed` ws has the links where they are.

    solids is True or, where no term is of two solids, None: then nothing of them is compiled.
    """
    J = spread(0.0)
    if load(floats(p, RESIDUALS.active), n) > 0.0:
        if not placed:
            place_links(m, p, x, ws)
        place_points(p, x, ws, n, False)
        weights, bounds, stride = floats(p, RESIDUALS.weight), floats(p, RESIDUALS.bound), p[RESIDUALS.stride]
        first, value, on = integers(p, RESIDUALS.first_row), lanes(p, RESIDUALS.value), floats(p, RESIDUALS.on)
        for t in range(p[RESIDUALS.terms]):
            if load(on, t * stride + n) > 0.0:
                measure(m, p, x, ws, t, n, False, solids)
                start = load(first, t)
                for row in range(start, load(first, t + 1)):
                    weight = load(weights, row * stride + n)
                    if weight > 0.0:
                        bound = spread(load(bounds, row * stride + n))
                        residual, _ = _ramped(p, row, load(value, row - start), bound)
                        J += 0.5 * weight * (residual * residual)
    return J


@inline
def _add_term(p, t, rows):
    """Add to the Hessian what the rows' derivatives and curvatures make, and make the derivatives zero again."""
    start, dof, row = integers(p, RESIDUALS.start), integers(p, RESIDUALS.dof), lanes(p, RESIDUALS.row)
    scaled, factor, curvature = lanes(p, RESIDUALS.scaled), lanes(p, RESIDUALS.factor), lanes(p, RESIDUALS.curvature)
    g, H, ld, end = lanes(p, RESIDUALS.gradient), lanes(p, RESIDUALS.hessian), p[RESIDUALS.ld], load(start, t + 1)
    for k in range(load(start, t), end):
        i = load(dof, k)
        u = at(row, MAX_ROWS * i)
        total = load(g, i)
        for r in range(rows):
            x = load(u, r)
            total += load(factor, r) * x
            store(scaled, r, load(curvature, r) * x)
        store(g, i, total)
        o = i * ld
        for l in range(k, end):
            j = load(dof, l)
            v, total = at(row, MAX_ROWS * j), load(H, o + j)
            for r in range(rows):
                total += load(scaled, r) * load(v, r)
            store(H, o + j, total)
    for k in range(load(start, t), end):
        u = at(row, MAX_ROWS * load(dof, k))
        for r in range(rows):
            store(u, r, 0.0)


@inline
def _scatter(w, p, first, present, solids):
    """Gradients of up to four stages onto W.l, Hessians into W.residual_hessian, what bends into RESIDUALS.bends."""
    columns, ld, width = p[RESIDUALS.columns], p[RESIDUALS.ld], w[W.width]
    l, H = at(floats(w, W.l), w[W.first]), floats(w, W.residual_hessian)
    g = as_floats(lanes(p, RESIDUALS.gradient))
    for lane in range(present):
        for i in range(columns):
            k = (first + lane) * width + i
            store(l, k, load(l, k) + load(g, i * WIDTH + lane))
    for i in range(columns):
        upper = i // WIDTH * WIDTH
        scatter_row(
            at(lanes(p, RESIDUALS.hessian), upper), i * ld, at(H, upper), first * columns * ld + i * ld, present,
            columns * ld, ld - upper,
        )  # fmt: skip
        if solids is not None:  # noqa: SIM102 - Numba leaves out what hangs on this alone
            if p[RESIDUALS.bending] > 0:
                scatter_row(
                    at(lanes(p, RESIDUALS.bend), upper), i * ld, at(floats(p, RESIDUALS.bends), upper),
                    first * columns * ld + i * ld, present, columns * ld, ld - upper,
                )  # fmt: skip


@jit
def quadratize_residuals(w, m, r, p, solids):
    """Add the terms' gradients to W.l of every stage and of the end, and leave their Hessians in W.residual_hessian.

    Work of the motors has its own in W.rows. solids is as in residual_cost.
    """
    w, m, r, p = pointer(w), pointer(m), pointer(r), pointer(p)
    stages, nx, x, ws = w[W.N] + 1, w[W.nx], lanes(r, MEMORY.x), lanes(r, MEMORY.links)
    weights, bounds, stride = floats(p, RESIDUALS.weight), floats(p, RESIDUALS.bound), p[RESIDUALS.stride]
    active, on, first_row = floats(p, RESIDUALS.active), floats(p, RESIDUALS.on), integers(p, RESIDUALS.first_row)
    value, columns, ld = lanes(p, RESIDUALS.value), p[RESIDUALS.columns], p[RESIDUALS.ld]
    for first in range(0, stages, WIDTH):
        if not any_less(0.0, load4(active, first)):
            continue  # their Hessians are zero for good
        gather(floats(w, W.xs), first, stages, nx, x)
        place_links(m, p, x, ws)
        place_points(p, x, ws, first, True)
        for i in range(columns):
            store(lanes(p, RESIDUALS.gradient), i, 0.0)
            for j in range(i // WIDTH * WIDTH, ld):
                store(lanes(p, RESIDUALS.hessian), i * ld + j, 0.0)
                store(lanes(p, RESIDUALS.bend), i * ld + j, 0.0)
        for t in range(p[RESIDUALS.terms]):
            if any_less(0.0, load4(on, t * stride + first)):
                measure(m, p, x, ws, t, first, True, solids)
                start, end, moved = load(first_row, t), load(first_row, t + 1), False
                for row in range(start, end):
                    k, o = row - start, row * stride + first
                    weight = load4(weights, o)
                    residual, slope = _ramped(p, row, load(value, k), load4(bounds, o))
                    store(lanes(p, RESIDUALS.factor), k, weight * slope * residual)
                    store(lanes(p, RESIDUALS.curvature), k, weight * slope * slope)
                    moved = moved or any_less(0.0, weight * slope * slope)
                if moved:
                    differentiate(m, p, ws, t, solids)
                    if solids is not None:  # noqa: SIM102 - Numba leaves out what hangs on this alone
                        if load(integers(p, RESIDUALS.bent), t) > 0:
                            add_distance_curvature(m, p, ws, t, load(lanes(p, RESIDUALS.factor), 0))
                    rows = end - start
                    if load(integers(p, RESIDUALS.kind), t) == TILT:
                        bend = load(lanes(p, RESIDUALS.factor), 0) * load(lanes(p, RESIDUALS.kept), TILT_BEND)
                        store(lanes(p, RESIDUALS.factor), rows, spread(0.0))
                        store(lanes(p, RESIDUALS.curvature), rows, select(bend, 0.0, spread(0.0), bend))
                        rows += 1
                    _add_term(p, t, rows)
        _scatter(w, p, first, min(WIDTH, stages - first), solids)
    if p[RESIDUALS.works] > 0:
        quadratize_work(w, m, r, p)
