"""Derivatives of a tree's accelerations, four knots at a time.

They follow from those of inverse dynamics, da = M^-1 (dtau - Dq dq - Dv dv) (section 1.2), with the rows of
prescribed joints taken out and, with couplings, W in place of M^-1. Columns are ordered z = (u | dq | dv | dact).
"""

from __future__ import annotations

from planner.kernels.integrators import ROSENBROCK
from planner.kernels.numba.jit import inline
from planner.kernels.numba.lanes import WIDTH, at, floats, integers, lanes, load, spread, store
from planner.kernels.tree.actuator_laws import add_law_inputs, subtract_law_derivatives
from planner.kernels.tree.actuator_wrenches import add_wrench_inputs, subtract_wrench_derivatives
from planner.kernels.tree.contact import add_stop_derivatives, subtract_contact_derivatives
from planner.kernels.tree.couplings import invert_coupled
from planner.kernels.tree.forces import add_actuator_derivatives, add_passive_derivatives
from planner.kernels.tree.joint_rows import add_row_derivatives
from planner.kernels.tree.loop_derivatives import close, close_derivatives, less_bound
from planner.kernels.tree.mechanism_table import TREE
from planner.kernels.tree.memory import MEMORY
from planner.kernels.tree.pair_contact import subtract_pair_derivatives
from planner.kernels.tree.passive_forces import (
    add_tendon_derivatives,
    subtract_compensation_derivatives,
    subtract_curve_derivatives,
    subtract_drag_derivatives,
)
from planner.kernels.tree.rosenbrock import add_implicit
from planner.kernels.tree.sensitivity import inverse_dynamics_derivatives, invert
from planner.kernels.tree.soft_contact import subtract_soft_derivatives


@inline
def _minus_product(M, D, ld, i0, i1, j0, nonzero):
    """Rows i0 and i1 of -M D in four columns from j0; nonzero: a list, and from where to where D's rows are in it."""
    rows, start, stop = nonzero
    z = spread(0.0)
    a0, a1, a2, a3, b0, b1, b2, b3 = z, z, z, z, z, z, z, z
    for t in range(start, stop):
        k = load(rows, t)
        m0, m1, o = load(M, i0 * ld + k), load(M, i1 * ld + k), k * ld + j0
        d0, d1, d2, d3 = load(D, o), load(D, o + 1), load(D, o + 2), load(D, o + 3)
        a0 -= m0 * d0
        b0 -= m1 * d0
        a1 -= m0 * d1
        b1 -= m1 * d1
        a2 -= m0 * d2
        b2 -= m1 * d2
        a3 -= m0 * d3
        b3 -= m1 * d3
    return (a0, a1, a2, a3), (b0, b1, b2, b3)


@inline
def store_four(p, k, v):
    """Write four consecutive entries."""
    store(p, k, v[0])
    store(p, k + 1, v[1])
    store(p, k + 2, v[2])
    store(p, k + 3, v[3])


@inline
def acceleration_derivatives(m, r, q, v, act, a, dA, external):
    """Derivatives dA (nv, columns) of the accelerations at (q, v, act, a) by (u | q | v | act).

    The inputs u are those of MEMORY.u; external: see Model.
    """
    nv, nu, ld, columns, x0 = m[TREE.nv], m[TREE.nu], r[MEMORY.ld], r[MEMORY.columns], r[MEMORY.first]
    M, Dq, Dv, held = lanes(r, MEMORY.M), lanes(r, MEMORY.Dq), lanes(r, MEMORY.Dv), lanes(r, MEMORY.held)
    zero = spread(0.0)
    for k in range(nv * ld):
        store(M, k, zero)
        store(Dq, k, zero)
        store(Dv, k, zero)
    inverse_dynamics_derivatives(m, q, v, a, lanes(r, MEMORY.links), lanes(r, MEMORY.tau), (M, Dq, Dv), ld)
    add_passive_derivatives(m, q, Dq, Dv, ld, lanes(r, MEMORY.scratch))
    add_actuator_derivatives(m, Dq, Dv, ld)
    if external is not None:
        add_stop_derivatives(m, q, v, Dq, Dv, ld)
        subtract_curve_derivatives(m, q, Dq, ld)
        add_tendon_derivatives(m, q, Dq, Dv, ld)
        if m[TREE.laws] > 0:
            subtract_law_derivatives(m, q, v, lanes(r, MEMORY.u), act, Dq, Dv, ld)
        add_row_derivatives(m, q, v, a, M, Dq, Dv, ld)
        if r[MEMORY.integrator] == ROSENBROCK:
            add_implicit(m, r, M, ld)
        if m[TREE.gravcomp] > 0:
            subtract_compensation_derivatives(m, Dq, ld, lanes(r, MEMORY.links))
        if m[TREE.drags] > 0:
            subtract_drag_derivatives(m, Dq, Dv, ld, lanes(r, MEMORY.links))
        if m[TREE.wrenches] > 0:
            subtract_wrench_derivatives(m, lanes(r, MEMORY.u), act, Dq, ld, lanes(r, MEMORY.links))
        subtract_contact_derivatives(m, q, Dq, Dv, ld, lanes(r, MEMORY.links))
        if m[TREE.softs] > 0:
            subtract_soft_derivatives(m, q, a, M, Dq, Dv, ld, lanes(r, MEMORY.links))
        if m[TREE.pairs] > 0:
            subtract_pair_derivatives(m, q, Dq, Dv, ld, lanes(r, MEMORY.links))
        if m[TREE.loop_rows] > 0:
            close_derivatives(m, r, q, v, a, at(a, nv), Dq, ld, lanes(r, MEMORY.links))
    prescribed = integers(m, TREE.prescribed)
    for p in range(nv):
        given = load(prescribed, p)
        if given >= 0:  # its column of M acts on the others like a force; its own row says nothing
            for i in range(nv):
                store(held, given * nv + i, load(M, i * ld + p))
    for p in range(nv):
        if load(prescribed, p) >= 0:
            for i in range(nv):
                store(M, i * ld + p, zero)
                store(M, p * ld + i, zero)
                store(Dq, p * ld + i, zero)
                store(Dv, p * ld + i, zero)
            store(M, p * ld + p, zero + 1.0)
    if external is not None:
        invert_coupled(m, M, ld)
        if m[TREE.loop_rows] > 0:
            close(m, r, q, M, ld, lanes(r, MEMORY.links))
    else:
        invert(M, nv, ld)
    starts, rows = integers(m, TREE.related_start), integers(m, TREE.related_rows)
    for half in range(2):
        D = Dq if half == 0 else Dv
        for j0 in range(0, nv, WIDTH):
            nonzero = rows, load(starts, j0 // WIDTH), load(starts, j0 // WIDTH + 1)
            for i0 in range(0, nv, 2):
                i1 = min(i0 + 1, nv - 1)
                first, second = _minus_product(M, D, ld, i0, i1, j0, nonzero)
                if external is not None and m[TREE.loop_rows] > 0:
                    first, second = less_bound(m, r, (first, second), i0, i1, j0, half)
                store_four(dA, i0 * columns + x0 + half * nv + j0, first)
                store_four(dA, i1 * columns + x0 + half * nv + j0, second)
    for i in range(nv):
        for k in range(x0):
            store(dA, i * columns + k, zero)
        for k in range(x0 + 2 * nv, columns):
            store(dA, i * columns + k, zero)
    dof, index, value = integers(m, TREE.input_dof), integers(m, TREE.input_index), floats(m, TREE.input_value)
    for t in range(m[TREE.inputs]):
        k = load(index, t) if load(index, t) < nu else load(index, t) - nu + x0 + 2 * nv
        j, x = load(dof, t), load(value, t)
        for i in range(nv):
            o = i * columns + k
            store(dA, o, load(dA, o) + x * load(M, i * ld + j))
    if external is not None:
        if m[TREE.wrenches] > 0:
            add_wrench_inputs(m, M, ld, lanes(r, MEMORY.links), dA, columns, x0)
        if m[TREE.laws] > 0:
            add_law_inputs(m, q, v, lanes(r, MEMORY.u), act, M, ld, dA, columns, x0)
    for p in range(nv):
        given = load(prescribed, p)
        if given >= 0:
            for i in range(nv):
                total = zero
                for j in range(nv):
                    if load(prescribed, j) < 0:
                        total -= load(M, i * ld + j) * load(held, given * nv + j)
                for k in range(m[TREE.loop_rows]):
                    total -= load(lanes(r, MEMORY.loop_Y), k * ld + i) * load(lanes(r, MEMORY.loop_J), k * ld + p)
                store(dA, i * columns + given, total)
            store(dA, p * columns + given, zero + 1.0)
            for k in range(x0, columns):
                store(dA, p * columns + k, zero)
