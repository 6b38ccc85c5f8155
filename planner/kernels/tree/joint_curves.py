"""Torques that are exponentials of joint coordinates (planner.model.joint_curves), and their derivatives, on lanes."""

from __future__ import annotations

from planner.kernels.numba.jit import inline, part
from planner.kernels.numba.lane_math import exp
from planner.kernels.numba.lanes import floats, integers, load, maximum, minimum, spread, store
from planner.kernels.tree.model import (  # fmt: skip
    CURVE_DOF,
    CURVE_SLOPE,
    CURVE_SLOPE_DOF,
    CURVE_START,
    CURVE_VALUE,
    CURVES,
    Q_ADDRESS,
)
from planner.model.joint_curves import LARGEST


@inline
def _torque(m, k, q):
    """Of curve k."""
    start, dof, slope = integers(m, CURVE_START), integers(m, CURVE_SLOPE_DOF), floats(m, CURVE_SLOPE)
    value, address = floats(m, CURVE_VALUE), integers(m, Q_ADDRESS)
    exponent = spread(0.0) + load(value, 2 * k + 1)
    for t in range(load(start, k), load(start, k + 1)):
        exponent += load(slope, t) * load(q, load(address, load(dof, t)))
    return load(value, 2 * k) * exp(minimum(maximum(exponent, -LARGEST), LARGEST))


@part
def add_curves(m, q, tau):
    """The torques of the curves onto tau (nv lanes)."""
    for k in range(m[CURVES]):
        i = load(integers(m, CURVE_DOF), k)
        store(tau, i, load(tau, i) + _torque(m, k, q))


@part
def subtract_curve_derivatives(m, q, Dq, ld):
    """What curves take from dtau/dq of inverse dynamics, (nv, ld) lanes."""
    start, dof, slope = integers(m, CURVE_START), integers(m, CURVE_SLOPE_DOF), floats(m, CURVE_SLOPE)
    for k in range(m[CURVES]):
        row, torque = load(integers(m, CURVE_DOF), k) * ld, _torque(m, k, q)
        for t in range(load(start, k), load(start, k + 1)):
            o = row + load(dof, t)
            store(Dq, o, load(Dq, o) - load(slope, t) * torque)
