"""Torques that are exponentials of joint coordinates (model.passive_forces), with derivatives, in lanes."""

from __future__ import annotations

from planner.kernels.numba.jit import inline, part
from planner.kernels.numba.lane_math import exp
from planner.kernels.numba.lanes import floats, integers, load, maximum, minimum, spread, store
from planner.kernels.tree.mechanism_table import TREE

# as in planner.model.passive_forces; here too, because the cache's key covers the kernels' sources alone
LARGEST = 700.0


@inline
def _torque(m, k, q):
    """The torque of curve k."""
    start, dof, slope = integers(m, TREE.curve_start), integers(m, TREE.curve_slope_dof), floats(m, TREE.curve_slope)
    value, address = floats(m, TREE.curve_value), integers(m, TREE.q_address)
    exponent = spread(0.0) + load(value, 2 * k + 1)
    for t in range(load(start, k), load(start, k + 1)):
        exponent += load(slope, t) * load(q, load(address, load(dof, t)))
    return load(value, 2 * k) * exp(minimum(maximum(exponent, -LARGEST), LARGEST))


@part
def add_curves(m, q, tau):
    """The torques of the curves onto tau (nv lanes)."""
    for k in range(m[TREE.curves]):
        i = load(integers(m, TREE.curve_dof), k)
        store(tau, i, load(tau, i) + _torque(m, k, q))


@inline
def subtract_curve_derivatives(m, q, Dq, ld):
    """Subtract the derivatives of the curves' torques from dtau/dq of inverse dynamics, (nv, ld) lanes."""
    start, dof, slope = integers(m, TREE.curve_start), integers(m, TREE.curve_slope_dof), floats(m, TREE.curve_slope)
    for k in range(m[TREE.curves]):
        row, torque = load(integers(m, TREE.curve_dof), k) * ld, _torque(m, k, q)
        for t in range(load(start, k), load(start, k + 1)):
            o = row + load(dof, t)
            store(Dq, o, load(Dq, o) - load(slope, t) * torque)
