"""Forces of actuators whose moment depends on the pose, such as thrusters, and their exact derivatives, on lanes.

An actuator of force f acts on a link at p with the force F and the torque T, both per unit of f, that are constant in
the axes of the link or of another one (planner.model.actuators.ActuatorWrench). With J_i = v_i + w_i x p the velocity
of p per rate of dof i (its screw (w_i, v_i) at the tree's origin),

    tau_j = f S_j' W,   W = (p x F + T, F)

    turned_i = (p x (w_i x F) + w_i x T, w_i x F)    dW where dof i turns the axes
    shifted_i = (J_i x F, 0)                         dW where it carries the place

and a dof j that i carries has in addition dS_j' W = -S_j' (turned_i + shifted_i).
"""

from __future__ import annotations

from planner.kernels.algebra.spatial import add, cross, dot, load3, load9, rotated
from planner.kernels.numba.jit import inline, part
from planner.kernels.numba.lanes import floats, integers, load, spread, store
from planner.kernels.tree.actuator_arrays import WRENCH_SIZE
from planner.kernels.tree.mechanism_table import TREE
from planner.kernels.tree.recursion import PLACE, RECORD, SCREW_AXIS

FORCE, TORQUE, GAIN, CONSTANT = 3, 6, 9, 10  # offsets in a wrench's numbers, behind its place


@inline
def _wrench(m, k, ws):
    """Place, force, torque, and moment about the tree's origin, of wrench k per unit of its actuator's force."""
    value, o = floats(m, TREE.wrench_value), WRENCH_SIZE * k
    b, frame, zero = (
        load(integers(m, TREE.wrench_link), k) * RECORD,
        load(integers(m, TREE.wrench_frame), k),
        spread(0.0),
    )
    p, F, T = load3(value, o), load3(value, o + FORCE), load3(value, o + TORQUE)
    p = add(load3(ws, b + PLACE), rotated(load9(ws, b), p))
    if frame >= 0:
        R = load9(ws, frame * RECORD)
        F, T = rotated(R, F), rotated(R, T)
    else:
        F, T = (zero + F[0], zero + F[1], zero + F[2]), (zero + T[0], zero + T[1], zero + T[2])
    return p, F, T, add(cross(p, F), T)


@inline
def _force(m, k, u, act):
    """The force of wrench k's actuator."""
    value, o, i = floats(m, TREE.wrench_value), WRENCH_SIZE * k, load(integers(m, TREE.wrench_input), k)
    given = load(u, i) if i < m[TREE.nu] else load(act, i - m[TREE.nu])
    return load(value, o + GAIN) * given + load(value, o + CONSTANT)


@inline
def _along(ws, i, moment, force):
    """The power of a wrench per rate of dof i."""
    b = i * RECORD + SCREW_AXIS
    return dot(load3(ws, b), moment) + dot(load3(ws, b + 3), force)


@part
def add_actuator_wrenches(m, u, act, ws, tau):
    """The forces on the joints, of links whose poses and screws are known, onto tau (nv lanes)."""
    start, dof = integers(m, TREE.wrench_start), integers(m, TREE.wrench_dof)
    for k in range(m[TREE.wrenches]):
        _, F, _, moment = _wrench(m, k, ws)
        f = _force(m, k, u, act)
        for t in range(load(start, k), load(start, k + 1)):
            j = load(dof, t)
            store(tau, j, load(tau, j) + f * _along(ws, j, moment, F))


@part
def subtract_wrench_derivatives(m, u, act, Dq, ld, ws):
    """Subtract the derivatives of those forces from dtau/dq of inverse dynamics, (nv, ld) lanes."""
    start, dof, first = integers(m, TREE.wrench_start), integers(m, TREE.wrench_dof), integers(m, TREE.first)
    frame_start, frame_dof = integers(m, TREE.wrench_frame_start), integers(m, TREE.wrench_frame_dof)
    link, frame = integers(m, TREE.wrench_link), integers(m, TREE.wrench_frame)
    for k in range(m[TREE.wrenches]):
        p, F, T, _ = _wrench(m, k, ws)
        f, own = _force(m, k, u, act), load(link, k) == load(frame, k)
        for t in range(load(start, k), load(start, k + 1)):
            i = load(dof, t)
            sw, sv = load3(ws, i * RECORD + SCREW_AXIS), load3(ws, i * RECORD + SCREW_AXIS + 3)
            turning = cross(sw, F)
            turned = add(cross(p, turning), cross(sw, T))
            shifted = cross(add(sv, cross(sw, p)), F)
            for s in range(load(start, k), load(start, k + 1)):
                j = load(dof, s)
                carried, e = j >= load(first, i), j * ld + i
                if own and not carried:
                    store(Dq, e, load(Dq, e) - f * _along(ws, j, add(turned, shifted), turning))
                elif not own and carried:
                    store(Dq, e, load(Dq, e) + f * _along(ws, j, turned, turning))
                elif not own:
                    store(Dq, e, load(Dq, e) - f * dot(load3(ws, j * RECORD + SCREW_AXIS), shifted))
        for t in range(load(frame_start, k), load(frame_start, k + 1)):
            i = load(frame_dof, t)
            sw = load3(ws, i * RECORD + SCREW_AXIS)
            turning = cross(sw, F)
            turned = add(cross(p, turning), cross(sw, T))
            for s in range(load(start, k), load(start, k + 1)):
                j = load(dof, s)
                store(Dq, j * ld + i, load(Dq, j * ld + i) - f * _along(ws, j, turned, turning))


@part
def add_wrench_inputs(m, M, ld, ws, dA, columns, x0):
    """Add the accelerations per input to columns of dA (nv, columns) lanes; M (nv, ld) maps forces to accelerations."""
    start, dof, prescribed = integers(m, TREE.wrench_start), integers(m, TREE.wrench_dof), integers(m, TREE.prescribed)
    nv, nu = m[TREE.nv], m[TREE.nu]
    for k in range(m[TREE.wrenches]):
        _, F, _, moment = _wrench(m, k, ws)
        i, gain = load(integers(m, TREE.wrench_input), k), load(floats(m, TREE.wrench_value), WRENCH_SIZE * k + GAIN)
        column = i if i < nu else i - nu + x0 + 2 * nv
        for t in range(load(start, k), load(start, k + 1)):
            j = load(dof, t)
            if load(prescribed, j) < 0:
                x = gain * _along(ws, j, moment, F)
                for row in range(nv):
                    o = row * columns + column
                    store(dA, o, load(dA, o) + x * load(M, row * ld + j))
