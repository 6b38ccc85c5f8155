"""Friction loss of joints (planner.dynamics.joint_forces) in forward dynamics, and derivatives, on lanes.

The force f(a, v) = -loss s(x), x = inertia (a + rate v) / loss, has the acceleration in it. Newton's method takes it
for

    f(a_k, v) - inertia s'(x_k) (a - a_k),

a force and an armature, for which the recursion finds the next a. The accelerations are the minimum of a convex
function whose gradient is T - f, T = M a + bias - tau being the force that friction would have to give; T is linear in
a, so the way to the next a is cut where the function is least on it: see kernels.tree.rounds.
"""

from __future__ import annotations

from planner.kernels.numba.jit import inline, part
from planner.kernels.numba.lanes import floats, integers, load, maximum, minimum, select, spread, store
from planner.kernels.tree.mechanism_table import TREE
from planner.kernels.tree.passive_force_arrays import LOSS_SIZE

FRICTION_SMOOTHING = (
    0.08  # as in planner.dynamics.joint_forces; here too, because the cache's key covers the kernels' sources alone
)
LOSS, INERTIA, RATE = range(LOSS_SIZE)  # offsets in the numbers of a joint's friction


@inline
def _friction(m, k, v, a):
    """The degree of freedom that friction k is of, its force at the velocities v and acceleration a, inertia s'(x)."""
    i, value, o = load(integers(m, TREE.loss_dof), k), floats(m, TREE.loss_value), LOSS_SIZE * k
    loss, inertia = load(value, o + LOSS), load(value, o + INERTIA)
    x = inertia / loss * (a + load(value, o + RATE) * load(v, i))
    x = minimum(maximum(x, -1.0 - FRICTION_SMOOTHING), 1.0 + FRICTION_SMOOTHING)
    above, below = maximum(x - (1.0 - FRICTION_SMOOTHING), 0.0), maximum(-1.0 * x - (1.0 - FRICTION_SMOOTHING), 0.0)
    force = (-1.0 * loss) * (x - (above * above - below * below) * (0.25 / FRICTION_SMOOTHING))
    return force, inertia * (1.0 - (above + below) * (0.5 / FRICTION_SMOOTHING))


@part
def begin_friction(m, v, tau, own, armature, force):
    """Armature and force (nv lanes each) of the first round: as if friction held every joint; own: without it."""
    dof, value = integers(m, TREE.loss_dof), floats(m, TREE.loss_value)
    for i in range(m[TREE.nv]):
        store(armature, i, load(own, i))
        store(force, i, load(tau, i))
    for k in range(m[TREE.losses]):
        i, inertia = load(dof, k), load(value, LOSS_SIZE * k + INERTIA)
        store(armature, i, load(armature, i) + inertia)
        store(force, i, load(force, i) - inertia * load(value, LOSS_SIZE * k + RATE) * load(v, i))


@part
def linearize_friction(m, v, tau, a, armatures, force, before):
    """Armature and force of the next round; `before` keeps a. Armatures: without friction, and with it."""
    (own, armature), dof = armatures, integers(m, TREE.loss_dof)
    for i in range(m[TREE.nv]):
        store(before, i, load(a, i))
    for k in range(m[TREE.losses]):
        i = load(dof, k)
        f, inertia = _friction(m, k, v, load(a, i))
        store(armature, i, load(own, i) + inertia)
        store(force, i, load(tau, i) + f + inertia * load(a, i))


@inline
def _asked(m, k, tau, a, armatures, force):
    """T of friction k at the accelerations a that armature and force have given."""
    (own, armature), i = armatures, load(integers(m, TREE.loss_dof), k)
    return load(force, i) - load(tau, i) - (load(armature, i) - load(own, i)) * load(a, i)


@inline
def _error(m, k, v, a, asked):
    """How far friction k is from its law, relative to it or to rounding."""
    i, value, o = load(integers(m, TREE.loss_dof), k), floats(m, TREE.loss_value), LOSS_SIZE * k
    f, _ = _friction(m, k, v, load(a, i))
    off, size = asked - f, load(value, o + INERTIA) * load(a, i)
    return maximum(off, -1.0 * off) / (load(value, o + LOSS) + maximum(size, -1.0 * size))


@part
def first_error(m, v, tau, a, armatures, force, asked):
    """The largest error (lanes) of the first round, whose T is left in `asked`."""
    error, prescribed = spread(0.0), integers(m, TREE.prescribed)
    for k in range(m[TREE.losses]):
        store(asked, k, _asked(m, k, tau, a, armatures, force))
        if load(prescribed, load(integers(m, TREE.loss_dof), k)) < 0:
            error = maximum(error, _error(m, k, v, a, load(asked, k)))
    return error


@part
def friction_uphill(m, v, tau, a, armatures, force, before, asked, part_of_way):
    """The slope of the convex function along the way from `before` to a, a part of it gone."""
    slope, dof = spread(0.0), integers(m, TREE.loss_dof)
    for k in range(m[TREE.losses]):
        i = load(dof, k)
        step = load(a, i) - load(before, i)
        f, _ = _friction(m, k, v, load(before, i) + part_of_way * step)
        now = load(asked, k) + part_of_way * (_asked(m, k, tau, a, armatures, force) - load(asked, k))
        slope += step * (now - f)
    return slope


@part
def friction_error(m, v, tau, a, armatures, force, before, asked, gone):
    """Go a part (lanes) of the way from `before` to a; the largest error (lanes) there."""
    error, prescribed = spread(0.0), integers(m, TREE.prescribed)
    for k in range(m[TREE.losses]):
        store(asked, k, load(asked, k) + gone * (_asked(m, k, tau, a, armatures, force) - load(asked, k)))
    for i in range(m[TREE.nv]):
        cut = load(before, i) + gone * (load(a, i) - load(before, i))
        store(a, i, select(gone, 1.0, cut, load(a, i)))  # the whole way without rounding
    for k in range(m[TREE.losses]):
        if load(prescribed, load(integers(m, TREE.loss_dof), k)) < 0:
            error = maximum(error, _error(m, k, v, a, load(asked, k)))
    return error


@part
def add_friction_derivatives(m, v, a, M, Dv, ld):
    """Add the derivatives of friction to those of inverse dynamics by a (M) and by v, (nv, ld) lanes."""
    value = floats(m, TREE.loss_value)
    for k in range(m[TREE.losses]):
        i = load(integers(m, TREE.loss_dof), k)
        _, inertia = _friction(m, k, v, load(a, i))
        o = i * ld + i
        store(M, o, load(M, o) + inertia)
        store(Dv, o, load(Dv, o) + inertia * load(value, LOSS_SIZE * k + RATE))
