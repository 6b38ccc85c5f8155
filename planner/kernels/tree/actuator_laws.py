"""Forces by the force laws of actuators (kernels.force_laws) on a tree, and their exact derivatives, on lanes."""

from __future__ import annotations

from planner.kernels.force_laws import LAW_SIZE, evaluate
from planner.kernels.numba.jit import inline, part
from planner.kernels.numba.lanes import floats, integers, load, spread, store
from planner.kernels.tree.mechanism_table import BALL, BALL_NEXT, TREE


@inline
def _terms(m, k, q, v, u, act):
    """Force and derivatives of law k."""
    start, dof, factor = integers(m, TREE.law_start), integers(m, TREE.law_dof), floats(m, TREE.law_factor)
    address, kind, i = integers(m, TREE.q_address), integers(m, TREE.kind), load(integers(m, TREE.law_input), k)
    given, length, rate = load(u, i) if i < m[TREE.nu] else load(act, i - m[TREE.nu]), spread(0.0), spread(0.0)
    for t in range(load(start, k), load(start, k + 1)):
        j = load(dof, t)
        rate += load(factor, t) * load(v, j)
        if load(kind, j) != BALL and load(kind, j) != BALL_NEXT:
            length += load(factor, t) * load(q, load(address, j))
    value, o = floats(m, TREE.law_value), LAW_SIZE * k
    p = load(value, o), load(value, o + 1), load(value, o + 2), load(value, o + 3)
    return evaluate(load(integers(m, TREE.law_kind), k), given, length, rate, p)


@part
def add_laws(m, q, v, u, act, tau):
    """The forces of the laws onto tau (nv lanes)."""
    start, dof, push = integers(m, TREE.law_start), integers(m, TREE.law_dof), floats(m, TREE.law_push)
    for k in range(m[TREE.laws]):
        force = _terms(m, k, q, v, u, act)[0]
        for t in range(load(start, k), load(start, k + 1)):
            store(tau, load(dof, t), load(tau, load(dof, t)) + load(push, t) * force)


@part
def subtract_law_derivatives(m, q, v, u, act, Dq, Dv, ld):
    """Subtract the derivatives of those forces from dtau/dq and dtau/dv of inverse dynamics, (nv, ld) lanes."""
    start, dof, push = integers(m, TREE.law_start), integers(m, TREE.law_dof), floats(m, TREE.law_push)
    factor, kind = floats(m, TREE.law_factor), integers(m, TREE.kind)
    for k in range(m[TREE.laws]):
        _, _, by_length, by_rate = _terms(m, k, q, v, u, act)
        for s in range(load(start, k), load(start, k + 1)):
            for t in range(load(start, k), load(start, k + 1)):
                j, product = load(dof, t), load(push, s) * load(factor, t)
                e = load(dof, s) * ld + j
                store(Dv, e, load(Dv, e) - product * by_rate)
                if load(kind, j) != BALL and load(kind, j) != BALL_NEXT:
                    store(Dq, e, load(Dq, e) - product * by_length)


@part
def add_law_inputs(m, q, v, u, act, M, ld, dA, columns, x0):
    """Add the accelerations per input to columns of dA (nv, columns) lanes; M (nv, ld) maps forces to accelerations."""
    start, dof, push = integers(m, TREE.law_start), integers(m, TREE.law_dof), floats(m, TREE.law_push)
    nv, nu = m[TREE.nv], m[TREE.nu]
    for k in range(m[TREE.laws]):
        i, by_given = load(integers(m, TREE.law_input), k), _terms(m, k, q, v, u, act)[1]
        column = i if i < nu else i - nu + x0 + 2 * nv
        for t in range(load(start, k), load(start, k + 1)):
            x = load(push, t) * by_given
            for row in range(nv):
                o = row * columns + column
                store(dA, o, load(dA, o) + x * load(M, row * ld + load(dof, t)))
