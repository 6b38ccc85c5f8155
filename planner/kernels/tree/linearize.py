"""Exact A and B of a stage of a tree (Eq. 35), four knots at a time: the chain rule through the integrator's stages.

Of several substeps under one control the products are A = A_k A and B = A_k B + B_k. The step back onto closed chains
at a stage's end comes last.

Columns are ordered z = (u | dq | dv | dact), as in kernels.tree.derivatives.
"""

from __future__ import annotations

from planner.kernels.algebra.rotations import carried, right_jacobian_times
from planner.kernels.algebra.spatial import store3
from planner.kernels.algebra.tiles import four_rows
from planner.kernels.integrators import LEAPFROG, MAX_STAGES, ROSENBROCK, RUNGE_KUTTA, SEMI_IMPLICIT_EULER
from planner.kernels.numba.jit import inline, jit, part
from planner.kernels.numba.lane_math import transpose
from planner.kernels.numba.lanes import (
    WIDTH,
    as_floats,
    at,
    doubles,
    floats,
    integers,
    lanes,
    load,
    load4,
    pointer,
    spread,
    store,
    store4,
)
from planner.kernels.tree.derivatives import acceleration_derivatives
from planner.kernels.tree.forces import activation_rates
from planner.kernels.tree.integrator_chain_rule import (
    add_unit,
    add_unit_rows,
    euler,
    keep_turns,
    runge_kutta,
    turn_balls,
)
from planner.kernels.tree.leapfrog import end_rates, half_way, leapfrog, whole_way
from planner.kernels.tree.loop_projection import POSITIONS, VELOCITIES, step_derivatives
from planner.kernels.tree.mechanism_table import TREE
from planner.kernels.tree.memory import MEMORY
from planner.kernels.tree.rosenbrock import (
    begin_implicit,
    behind_matrix,
    end_displacement,
    end_velocity,
    rosenbrock,
    second_stage,
)
from planner.kernels.tree.step import end_activations, end_rotation, end_state, gather, moved, stage_state


@inline
def scatter_row(X, row, F, f, count, stride, width):
    """A row of lanes, width of them, to the same row of `count` knots."""
    for j0 in range(0, width, WIDTH):
        o, k = row + j0, f + j0
        e0, e1, e2, e3 = transpose((load(X, o), load(X, o + 1), load(X, o + 2), load(X, o + 3)))
        store4(F, k, e0)
        if count > 1:
            store4(F, k + stride, e1)
        if count > 2:
            store4(F, k + 2 * stride, e2)
        if count > 3:
            store4(F, k + 3 * stride, e3)


@inline
def _transport(m, r, x, a, dt, transport, first, count):
    """E's blocks of the balls, [T J] with dq+ = T dq + dt J dv+, for semi-implicit Euler."""
    balls, ball_v, v, scratch = m[TREE.nballs], integers(m, TREE.ball_v), at(x, m[TREE.nq]), lanes(r, MEMORY.scratch)
    one, zero = spread(1.0), spread(0.0)
    flat = as_floats(scratch)
    for b in range(balls):
        i = load(ball_v, b)
        t = (
            dt * (load(v, i) + dt * load(a, i)), dt * (load(v, i + 1) + dt * load(a, i + 1)),
            dt * (load(v, i + 2) + dt * load(a, i + 2)),
        )  # fmt: skip
        for half in range(2):
            for c in range(3):
                unit = (one if c == 0 else zero, one if c == 1 else zero, one if c == 2 else zero)
                d = carried(t, unit) if half == 0 else right_jacobian_times(t, unit)
                store3(scratch, 0, d)
                for lane in range(count):
                    o = ((first + lane) * balls + b) * 18 + 9 * half + c
                    store(transport, o, load(flat, lane))
                    store(transport, o + 3, load(flat, WIDTH + lane))
                    store(transport, o + 6, load(flat, 2 * WIDTH + lane))


@inline
def _gathered(m, r, xs, us, first, count):
    """States, controls and the rollout's accelerations of four stages onto lanes."""
    gather(doubles(xs), first, count, xs.shape[1], lanes(r, MEMORY.x))
    gather(doubles(us), first, count, m[TREE.nu], lanes(r, MEMORY.u))
    gather(floats(r, MEMORY.accelerations), first, count, r[MEMORY.kept], lanes(r, MEMORY.a))


@jit
def linearize_structured(m, r, dt, xs, us, F, transport, external):
    """Rows da/dz of F (N, nv, width) along xs (N+1, nx), us (N, nu), and E's blocks of the balls.

    States may have more components behind the machine's own; their columns of F are not written.

    The accelerations are those that a rollout, or `steps`, left in MEMORY.accelerations; so for linearize_dense.
    """
    m, r = pointer(m), pointer(r)
    nv, columns, count, width = m[TREE.nv], r[MEMORY.columns], us.shape[0], F.shape[2]
    x, a, dA = lanes(r, MEMORY.x), lanes(r, MEMORY.a), lanes(r, MEMORY.by_stage)
    flat, blocks, stride = doubles(F), doubles(transport), nv * width
    for first in range(0, count, WIDTH):
        present = min(WIDTH, count - first)
        _gathered(m, r, xs, us, first, count)
        acceleration_derivatives(m, r, x, at(x, m[TREE.nq]), at(x, m[TREE.nq] + nv), a, dA, external)
        for i in range(nv):
            scatter_row(dA, i * columns, flat, first * stride + i * width, present, stride, columns - WIDTH)
        _transport(m, r, x, a, dt, blocks, first, present)


@inline
def _stage_derivatives(m, r, i, state, present, width, external):
    """D of stage i at its state (q, v, act, a), (nv, width) for each of the knots present, into MEMORY.direct.

    The activations' rates there go into act_rates.
    """
    q, v, act, a = state
    dA, D, block, columns = lanes(r, MEMORY.by_stage), floats(r, MEMORY.direct), r[MEMORY.block], r[MEMORY.columns]
    acceleration_derivatives(m, r, q, v, act, a, dA, external)
    activation_rates(m, lanes(r, MEMORY.u), act, at(lanes(r, MEMORY.act_rates), i * m[TREE.na]))
    for row in range(m[TREE.nv]):
        scatter_row(dA, row * columns, D, i * WIDTH * block + row * width, present, block, width)


@inline
def _after(m, r, width, F):
    """F = (B | A) of the substeps so far becomes A_k F + (B_k | 0), with (B_k | A_k) of the next in MEMORY.step."""
    step, product = floats(r, MEMORY.step), floats(r, MEMORY.product)
    ndx, first = 2 * m[TREE.nv] + m[TREE.na], r[MEMORY.first]
    for i in range(0, ndx, WIDTH):
        C = (product, i * width, width)
        four_rows(C, (step, i * width + first, 1, width), (F, 0, width), ndx, 1.0, width, C, False)
    for i in range(ndx):
        o = i * width
        for j in range(0, first, WIDTH):
            store4(F, o + j, load4(product, o + j) + load4(step, o + j))
        for j in range(first, width, WIDTH):
            store4(F, o + j, load4(product, o + j))


@inline
def _runge_kutta_substep(m, r, x, a, dt, width, knots):
    """(B | A) of Runge-Kutta substep k, whose stages' D are kept, chained to those before; x moves to its end."""
    F, stride, present, k, length = knots
    end_rotation(m, r, x, a, length)
    keep_turns(m, r, MAX_STAGES)
    for lane in range(present):
        if k == 0:
            runge_kutta(m, r, dt, lane, width, at(F, lane * stride))
        else:
            runge_kutta(m, r, dt, lane, width, floats(r, MEMORY.step))
            _after(m, r, width, at(F, lane * stride))
    if k + 1 < r[MEMORY.substeps] or m[TREE.loop_rows] > 0:
        end_state(m, r, x, a, length, x)
        act = at(x, m[TREE.nq] + m[TREE.nv])
        end_activations(m, r, act, length, act)


@inline
def _close(m, r, x, knots, width):
    """The end x of a stage goes back onto the closed chains, and (B | A) of each knot with it."""
    F, stride, present = knots
    nv, block, columns, at_q = m[TREE.nv], r[MEMORY.block], r[MEMORY.columns], r[MEMORY.first]
    theta, v, E = lanes(r, MEMORY.theta), at(x, m[TREE.nq]), lanes(r, MEMORY.by_stage)
    direct, chained = floats(r, MEMORY.direct), floats(r, MEMORY.chained)
    step_derivatives(m, r, x, v, POSITIONS, theta, E)
    keep_turns(m, r, MAX_STAGES)
    for row in range(nv):
        scatter_row(E, row * columns, direct, row * width, present, block, width)
    moved(m, x, theta, x)
    step_derivatives(m, r, x, v, VELOCITIES, theta, E)
    for row in range(nv):
        scatter_row(E, row * columns, direct, WIDTH * block + row * width, present, block, width)
    for lane in range(present):
        by_q, by_v, A = at(direct, lane * block), at(direct, (WIDTH + lane) * block), at(F, lane * stride)
        turn_balls(m, r, MAX_STAGES, lane, width, by_q)
        add_unit_rows(m, by_q, width, at_q)
        for i in range(nv):
            add_unit(by_v, i * width + at_q + nv + i, 1.0)
        velocities = at(chained, block)
        for i in range(0, nv, WIDTH):
            C, o = (chained, i * width, width), i * width + at_q
            four_rows(C, (by_q, o, 1, width), (A, 0, width), nv, 1.0, width, C, False)
        for i in range(0, nv, WIDTH):
            C, o = (velocities, i * width, width), i * width + at_q
            four_rows(C, (by_v, o + nv, 1, width), (A, nv * width, width), nv, 1.0, width, C, False)
            four_rows(C, (by_v, o, 1, width), (chained, 0, width), nv, 1.0, width, C, True)
        for k in range(0, nv * width, WIDTH):
            store4(A, k, load4(chained, k))
            store4(A, nv * width + k, load4(velocities, k))


@part
def _rosenbrock_substep(m, r, x, a, dt, width, knots, external):
    """(B | A) of a substep of kernels.tree.rosenbrock, chained to those before; x moves to its end."""
    F, stride, present, k, length = knots
    nv, na, ld, q = m[TREE.nv], m[TREE.na], r[MEMORY.ld], lanes(r, MEMORY.q_stage)
    begin_implicit(m, r, length)
    act, act_stage, rates = at(x, m[TREE.nq] + nv), lanes(r, MEMORY.act_stage), lanes(r, MEMORY.act_rates)
    _stage_derivatives(m, r, 0, (x, at(x, m[TREE.nq]), act, a), present, width, external)
    for i in range(na):
        store(act_stage, i, load(act, i) + length * load(rates, i))
    second_stage(m, r, x, a, length)
    keep_turns(m, r, 1)
    moved(m, x, lanes(r, MEMORY.theta), q)
    state = (q, at(lanes(r, MEMORY.v_stages), nv), act_stage, at(a, nv))
    _stage_derivatives(m, r, 1, state, present, width, external)
    behind_matrix(m, r, ld)
    for row in range(nv):
        scatter_row(lanes(r, MEMORY.M), row * ld, floats(r, MEMORY.behind_rows), row * ld, present, ld * ld, ld)
    end_displacement(m, r, x, a, length)
    keep_turns(m, r, MAX_STAGES)
    for lane in range(present):
        if k == 0:
            rosenbrock(m, r, dt, lane, width, at(F, lane * stride))
        else:
            rosenbrock(m, r, dt, lane, width, floats(r, MEMORY.step))
            _after(m, r, width, at(F, lane * stride))
    if k + 1 < r[MEMORY.substeps]:
        moved(m, x, lanes(r, MEMORY.theta), x)
        end_velocity(m, x, a, length, x)
        for i in range(na):
            store(act, i, load(act, i) + 0.5 * length * (load(rates, i) + load(rates, na + i)))


@part
def _leapfrog_substep(m, r, x, a, dt, width, knots, external):
    """(B | A) of a substep of kernels.tree.leapfrog, chained to those before; x moves to its end."""
    F, stride, present, k, length = knots
    nq, nv, q, theta = m[TREE.nq], m[TREE.nv], lanes(r, MEMORY.q_stage), lanes(r, MEMORY.theta)
    act_stage, rates = lanes(r, MEMORY.act_stage), lanes(r, MEMORY.act_rates)
    activation_rates(m, lanes(r, MEMORY.u), at(x, nq + nv), rates)
    half_way(m, r, x, rates, length)
    keep_turns(m, r, 0)
    moved(m, x, theta, q)
    _stage_derivatives(m, r, 0, (q, at(x, nq), act_stage, a), present, width, external)
    whole_way(m, r, x, a, length)
    keep_turns(m, r, MAX_STAGES)
    for lane in range(present):
        if k == 0:
            leapfrog(m, r, dt, lane, width, at(F, lane * stride))
        else:
            leapfrog(m, r, dt, lane, width, floats(r, MEMORY.step))
            _after(m, r, width, at(F, lane * stride))
    if k + 1 < r[MEMORY.substeps]:
        moved(m, x, theta, x)
        end_rates(m, x, a, rates, length, x)


@jit
def linearize_dense(m, r, dt, xs, us, F, external):
    """F = (B | A) (N, ndx, width) along xs (N+1, nx), us (N, nu)."""
    m, r = pointer(m), pointer(r)
    nv, count, width = m[TREE.nv], us.shape[0], F.shape[2]
    x, v_stages, theta = lanes(r, MEMORY.x), lanes(r, MEMORY.v_stages), lanes(r, MEMORY.theta)
    dt = (1.0 / r[MEMORY.substeps]) * dt
    flat, stride, length = doubles(F), (2 * nv + m[TREE.na]) * width, spread(dt)
    for first in range(0, count, WIDTH):
        present = min(WIDTH, count - first)
        _gathered(m, r, xs, us, first, count)
        v = at(x, m[TREE.nq])
        for k in range(r[MEMORY.substeps]):
            a = at(lanes(r, MEMORY.a), k * r[MEMORY.stages] * r[MEMORY.stride])
            knots = (at(flat, first * stride), stride, present, k, length)
            if external is not None and r[MEMORY.integrator] == ROSENBROCK:
                _rosenbrock_substep(m, r, x, a, dt, width, knots, external)
                continue
            if r[MEMORY.integrator] == LEAPFROG:
                _leapfrog_substep(m, r, x, a, dt, width, knots, external)
                continue
            for i in range(r[MEMORY.stages]):
                if i == 0:
                    _stage_derivatives(m, r, 0, (x, v, at(v, nv), a), present, width, external)
                else:
                    stage_state(m, r, x, i, a, length)
                    keep_turns(m, r, i)
                    act = lanes(r, MEMORY.act_stage)
                    state = (lanes(r, MEMORY.q_stage), at(v_stages, i * nv), act, at(a, i * r[MEMORY.stride]))
                    _stage_derivatives(m, r, i, state, present, width, external)
            if r[MEMORY.integrator] == RUNGE_KUTTA:
                _runge_kutta_substep(m, r, x, a, dt, width, knots)
                continue
            for i in range(nv):
                later = dt * load(a, i) if r[MEMORY.integrator] == SEMI_IMPLICIT_EULER else spread(0.0)
                store(theta, i, dt * (load(v, i) + later))
            keep_turns(m, r, 0)
            for lane in range(present):
                euler(m, r, dt, lane, width, at(flat, (first + lane) * stride))
        if external is not None and r[MEMORY.integrator] == RUNGE_KUTTA and m[TREE.loop_rows] > 0:
            _close(m, r, x, (at(flat, first * stride), stride, present), width)
