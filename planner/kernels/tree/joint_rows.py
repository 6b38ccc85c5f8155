"""Forces along rows of joint coordinates (planner.model.joint_rows), and their derivatives, on lanes."""

from __future__ import annotations

from planner.kernels.numba.jit import inline, part
from planner.kernels.numba.lanes import floats, integers, load, maximum, minimum, select, spread, store
from planner.kernels.tree.model import ROW_SIZE, TREE

BEND = 0.5  # as in planner.model.joint_rows; here too, because the cache's key covers the kernels' sources alone
STIFFNESS, LOW, HIGH, DAMPING, LOSS, SLOPE = range(ROW_SIZE)  # offsets in a row's numbers


@inline
def _along(m, k, q, v):
    """The force along row k, and its derivatives by the row's length and its rate."""
    start, dof, factor = integers(m, TREE.row_start), integers(m, TREE.row_dof), floats(m, TREE.row_factor)
    value, address, o = floats(m, TREE.row_value), integers(m, TREE.q_address), ROW_SIZE * k
    zero = spread(0.0)
    length, rate = zero, zero
    first, last = load(start, k), load(start, k + 1)
    for t in range(first, last):
        rate += load(factor, t) * load(v, load(dof, t))
    damping, stiffness = load(value, o + DAMPING), load(value, o + STIFFNESS)
    force, by_length, by_rate = zero - damping * rate, zero, zero - damping
    if stiffness > 0.0:
        for t in range(first, last):
            length += load(factor, t) * load(q, load(address, load(dof, t)))
        low, high = load(value, o + LOW), load(value, o + HIGH)
        force += stiffness * (maximum(low - length, 0.0) - maximum(length - high, 0.0))
        slack = select(low, length, 1.0, 0.0) * select(length, high, 1.0, 0.0)
        by_length = stiffness * (slack - 1.0)
    loss, slope = load(value, o + LOSS), load(value, o + SLOPE)
    if loss > 0.0:
        x = minimum(maximum(slope / loss * rate, -1.0 - BEND), 1.0 + BEND)
        above, below = maximum(x - (1.0 - BEND), 0.0), maximum(zero - x - (1.0 - BEND), 0.0)
        force -= loss * (x - (above * above - below * below) * (0.25 / BEND))
        by_rate -= slope * (1.0 - (above + below) * (0.5 / BEND))
    return force, by_length, by_rate


@part
def add_rows(m, q, v, tau):
    """The forces of the rows onto tau (nv lanes)."""
    start, dof, factor = integers(m, TREE.row_start), integers(m, TREE.row_dof), floats(m, TREE.row_factor)
    for k in range(m[TREE.rows]):
        force, _, _ = _along(m, k, q, v)
        for t in range(load(start, k), load(start, k + 1)):
            i = load(dof, t)
            store(tau, i, load(tau, i) + load(factor, t) * force)


@part
def subtract_row_derivatives(m, q, v, Dq, Dv, ld):
    """Subtract the derivatives of the rows' forces from dtau/dq and dtau/dv of inverse dynamics, (nv, ld) lanes."""
    start, dof, factor = integers(m, TREE.row_start), integers(m, TREE.row_dof), floats(m, TREE.row_factor)
    for k in range(m[TREE.rows]):
        _, by_length, by_rate = _along(m, k, q, v)
        first, last = load(start, k), load(start, k + 1)
        for s in range(first, last):
            for t in range(first, last):
                o, product = load(dof, s) * ld + load(dof, t), load(factor, s) * load(factor, t)
                store(Dq, o, load(Dq, o) - product * by_length)
                store(Dv, o, load(Dv, o) - product * by_rate)
