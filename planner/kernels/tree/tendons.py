"""Forces of fixed tendons (planner.model.passive_forces), and their derivatives, on lanes."""

from __future__ import annotations

from planner.kernels.numba.jit import inline, part
from planner.kernels.numba.lanes import floats, integers, load, maximum, select, spread, store
from planner.kernels.tree.mechanism_table import TREE
from planner.kernels.tree.passive_force_arrays import TENDON_SIZE

STIFFNESS, LOW, HIGH, DAMPING = range(TENDON_SIZE)  # offsets in a tendon's numbers


@inline
def _length(m, k, q):
    """The length of tendon k."""
    start, dof, factor = integers(m, TREE.tendon_start), integers(m, TREE.tendon_dof), floats(m, TREE.tendon_factor)
    address, length = integers(m, TREE.q_address), spread(0.0)
    for t in range(load(start, k), load(start, k + 1)):
        length += load(factor, t) * load(q, load(address, load(dof, t)))
    return length


@part
def add_tendons(m, q, v, tau):
    """The forces of the tendons onto tau (nv lanes)."""
    start, dof, factor = integers(m, TREE.tendon_start), integers(m, TREE.tendon_dof), floats(m, TREE.tendon_factor)
    value = floats(m, TREE.tendon_value)
    for k in range(m[TREE.tendons]):
        o, length, rate = TENDON_SIZE * k, _length(m, k, q), spread(0.0)
        for t in range(load(start, k), load(start, k + 1)):
            rate += load(factor, t) * load(v, load(dof, t))
        pull = maximum(load(value, o + LOW) - length, 0.0) - maximum(length - load(value, o + HIGH), 0.0)
        force = load(value, o + STIFFNESS) * pull - load(value, o + DAMPING) * rate
        for t in range(load(start, k), load(start, k + 1)):
            i = load(dof, t)
            store(tau, i, load(tau, i) + load(factor, t) * force)


@part
def add_tendon_derivatives(m, q, Dq, Dv, ld):
    """Add the derivatives of the tendons' forces to dtau/dq and dtau/dv of inverse dynamics, (nv, ld) lanes."""
    start, dof, factor = integers(m, TREE.tendon_start), integers(m, TREE.tendon_dof), floats(m, TREE.tendon_factor)
    value = floats(m, TREE.tendon_value)
    for k in range(m[TREE.tendons]):
        o, length = TENDON_SIZE * k, _length(m, k, q)
        slack = select(load(value, o + LOW), length, 1.0, 0.0) * select(length, load(value, o + HIGH), 1.0, 0.0)
        stiffness, damping = load(value, o + STIFFNESS) * (1.0 - slack), load(value, o + DAMPING)
        for s in range(load(start, k), load(start, k + 1)):
            for t in range(load(start, k), load(start, k + 1)):
                e, product = load(dof, s) * ld + load(dof, t), load(factor, s) * load(factor, t)
                store(Dq, e, load(Dq, e) + product * stiffness)
                store(Dv, e, load(Dv, e) + product * damping)
