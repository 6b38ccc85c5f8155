"""Friction loss of joints and stops with a lead in forward dynamics, and derivatives, on lanes.

Friction is planner.dynamics.joint_forces's, -loss s(x), x = inertia (a + rate v) / loss. A stop pushes its joint back
by model.contact.laws's law with a lead, a function of the coordinate and of v + lead a. Both have the acceleration in
them. A joint's row is the sum f(a) of what acts on it. Newton's method takes it for

    f(a_k) + f'(a_k) (a - a_k),

a force and an armature -f', for which the recursion finds the next a. The accelerations are the minimum of a convex
function whose gradient is T - f, T = M a + bias - tau being the force that the rows would have to give; T is linear in
a, so the way to the next a is cut where the function is least on it: see kernels.tree.rounds.
"""

from __future__ import annotations

from planner.kernels.algebra.ramp import ramp
from planner.kernels.numba.jit import inline, part
from planner.kernels.numba.lanes import any_less, floats, integers, load, maximum, minimum, select, spread, store
from planner.kernels.tree.mechanism_table import TREE
from planner.kernels.tree.passive_force_arrays import LOWER, ROW_SIZE, STOP_END, STOP_LAW, STOP_SIZE
from planner.kernels.tree.soft_contact_law import DAMPING, FORCE, LEAD, PER_FORCE, STIFFNESS, pressing

FRICTION_SMOOTHING = (
    0.08  # as in planner.dynamics.joint_forces; here too, because the cache's key covers the kernels' sources alone
)
LOSS, INERTIA, RATE = range(3)  # offsets in a row's numbers
_MIN_FORCE = 1e-30  # N m, N


@inline
def _friction(value, o, v, a):
    """The friction of the row whose numbers begin at o, and inertia s'(x)."""
    loss, inertia = load(value, o + LOSS), load(value, o + INERTIA)
    x = inertia / loss * (a + load(value, o + RATE) * v)
    x = minimum(maximum(x, -1.0 - FRICTION_SMOOTHING), 1.0 + FRICTION_SMOOTHING)
    above, below = maximum(x - (1.0 - FRICTION_SMOOTHING), 0.0), maximum(-1.0 * x - (1.0 - FRICTION_SMOOTHING), 0.0)
    force = (-1.0 * loss) * (x - (above * above - below * below) * (0.25 / FRICTION_SMOOTHING))
    return force, inertia * (1.0 - (above + below) * (0.5 / FRICTION_SMOOTHING))


@inline
def _stop(value, o, side, q):
    """The penetration of the stop whose numbers begin at o, beyond the end on this side."""
    return side * (q - load(value, o + STOP_END))


@inline
def _pushed(value, o, side, e, v, a):
    """A stop's force, minus its derivatives by a, v and q, and what an error of it is relative to."""
    law = o + STOP_LAW
    pressed, pressed_e, s, ds = pressing(value, law, e)
    B, lead = load(value, law + DAMPING), load(value, law + LEAD)
    x = side * (v + lead * a)
    force, slope = ramp(pressed + B * (s * x), load(value, law + FORCE), load(value, law + PER_FORCE))
    damping = slope * (B * s)
    size = load(value, law + STIFFNESS) * maximum(e, 0.0) + B * maximum(x, -1.0 * x)
    size = select(0.0, e, size + force, 0.0)  # lanes beside it are not at this stop
    return (-side) * force, lead * damping, damping, slope * (pressed_e + B * (ds * x)), size


@inline
def _row(m, k, q, v, a):
    """Row k at coordinates, velocities and its joint's acceleration.

    Its degree of freedom, its force, minus the force's derivatives by a, v and q, and what an error is relative to.
    """
    i, value, o = load(integers(m, TREE.row_dof), k), floats(m, TREE.row_value), ROW_SIZE * k
    zero = spread(0.0)
    f, by_a, by_v, by_q, size = zero, zero, zero, zero, zero + _MIN_FORCE
    vi, qi = load(v, i), load(q, load(integers(m, TREE.q_address), i))
    if load(value, o + LOSS) > 0.0:
        f, by_a = _friction(value, o, vi, a)
        by_v = load(value, o + RATE) * by_a
        sticking = load(value, o + INERTIA) * a
        size = load(value, o + LOSS) + maximum(sticking, -1.0 * sticking)
    for end in range(2):
        b, side = o + LOWER + STOP_SIZE * end, 2.0 * end - 1.0
        if load(value, b + STOP_LAW + STIFFNESS) > 0.0:
            e = _stop(value, b, side, qi)
            if any_less(0.0, e):
                push, push_a, push_v, push_q, force_size = _pushed(value, b, side, e, vi, a)
                f, by_a, by_v, by_q = f + push, by_a + push_a, by_v + push_v, by_q + push_q
                size = size + force_size
    return i, f, by_a, by_v, by_q, size


@part
def any_stop(m, q):
    """Whether a joint is at a stop with a lead in any lane."""
    value = floats(m, TREE.row_value)
    for k in range(m[TREE.rows]):
        qi = load(q, load(integers(m, TREE.q_address), load(integers(m, TREE.row_dof), k)))
        for end in range(2):
            b = ROW_SIZE * k + LOWER + STOP_SIZE * end
            stiff = load(value, b + STOP_LAW + STIFFNESS) > 0.0
            if stiff and any_less(0.0, _stop(value, b, 2.0 * end - 1.0, qi)):
                return True
    return False


@part
def linearize_rows(m, q, v, tau, a, armatures, force, before):
    """Armature and force of the next round; `before` keeps a. Armatures: without rows, and with them."""
    own, armature = armatures
    for i in range(m[TREE.nv]):
        store(before, i, load(a, i))
        store(armature, i, load(own, i))
        store(force, i, load(tau, i))
    for k in range(m[TREE.rows]):
        i, f, inertia, _, _, _ = _row(m, k, q, v, load(a, load(integers(m, TREE.row_dof), k)))
        store(armature, i, load(own, i) + inertia)
        store(force, i, load(tau, i) + f + inertia * load(a, i))


@inline
def _asked(m, k, tau, a, armatures, force):
    """T of row k at the accelerations a that armature and force have given."""
    (own, armature), i = armatures, load(integers(m, TREE.row_dof), k)
    return load(force, i) - load(tau, i) - (load(armature, i) - load(own, i)) * load(a, i)


@inline
def _error(m, k, q, v, a, asked):
    """How far row k is from its law, relative to it or to rounding."""
    _, f, _, _, _, size = _row(m, k, q, v, load(a, load(integers(m, TREE.row_dof), k)))
    off = asked - f
    return maximum(off, -1.0 * off) / size


@part
def first_row_error(m, q, v, tau, a, armatures, force, asked):
    """The largest error (lanes) of the first round, whose T is left in `asked`."""
    error, prescribed = spread(0.0), integers(m, TREE.prescribed)
    for k in range(m[TREE.rows]):
        store(asked, k, _asked(m, k, tau, a, armatures, force))
        if load(prescribed, load(integers(m, TREE.row_dof), k)) < 0:
            error = maximum(error, _error(m, k, q, v, a, load(asked, k)))
    return error


@part
def row_uphill(m, q, v, tau, a, armatures, force, before, asked, part_of_way):
    """The slope of the convex function along the way from `before` to a, a part of it gone."""
    slope, dof = spread(0.0), integers(m, TREE.row_dof)
    for k in range(m[TREE.rows]):
        i = load(dof, k)
        step = load(a, i) - load(before, i)
        _, f, _, _, _, _ = _row(m, k, q, v, load(before, i) + part_of_way * step)
        now = load(asked, k) + part_of_way * (_asked(m, k, tau, a, armatures, force) - load(asked, k))
        slope += step * (now - f)
    return slope


@part
def row_error(m, q, v, tau, a, armatures, force, before, asked, gone):
    """Go a part (lanes) of the way from `before` to a; the largest error (lanes) there."""
    error, prescribed = spread(0.0), integers(m, TREE.prescribed)
    for k in range(m[TREE.rows]):
        store(asked, k, load(asked, k) + gone * (_asked(m, k, tau, a, armatures, force) - load(asked, k)))
    for i in range(m[TREE.nv]):
        cut = load(before, i) + gone * (load(a, i) - load(before, i))
        store(a, i, select(gone, 1.0, cut, load(a, i)))  # the whole way without rounding
    for k in range(m[TREE.rows]):
        if load(prescribed, load(integers(m, TREE.row_dof), k)) < 0:
            error = maximum(error, _error(m, k, q, v, a, load(asked, k)))
    return error


@part
def add_row_derivatives(m, q, v, a, M, Dq, Dv, ld):
    """Add the derivatives of rows to those of inverse dynamics by a (M), q and v, (nv, ld) lanes."""
    for k in range(m[TREE.rows]):
        i, _, by_a, by_v, by_q, _ = _row(m, k, q, v, load(a, load(integers(m, TREE.row_dof), k)))
        o = i * ld + i
        store(M, o, load(M, o) + by_a)
        store(Dq, o, load(Dq, o) + by_q)
        store(Dv, o, load(Dv, o) + by_v)
