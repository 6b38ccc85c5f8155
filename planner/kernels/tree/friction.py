"""Friction loss of joints (planner.dynamics.friction) in forward dynamics, and its derivatives, on lanes.

The force f(a, v) = -loss s(x), x = inertia (a + rate v) / loss, has the acceleration in it. Newton's method takes it for

    f(a_k, v) - inertia s'(x_k) (a - a_k),

a force and an armature, for which the recursion finds the next a. Lanes that have met the law keep their numbers, so
that a state's acceleration does not depend on the states beside it.
"""

from __future__ import annotations

from planner.kernels.numba.jit import inline, part
from planner.kernels.numba.lanes import floats, integers, load, maximum, minimum, select, spread, store
from planner.kernels.tree.model import LOSS_SIZE, TREE

BEND = 0.5  # as in planner.dynamics.friction; here too, because the cache's key covers the kernels' sources alone
MOST_ROUNDS = 30  # of Newton's method, which takes three or four
MET = 1e-12  # of the loss: what is left of the law when a lane has met it
LOSS, INERTIA, RATE = range(LOSS_SIZE)  # offsets in the numbers of a joint's friction


@inline
def _friction(m, k, v, a):
    """The degree of freedom that friction k is of, its force at (v, a) and inertia s'(x)."""
    i, value, o = load(integers(m, TREE.loss_dof), k), floats(m, TREE.loss_value), LOSS_SIZE * k
    loss, inertia = load(value, o + LOSS), load(value, o + INERTIA)
    x = inertia / loss * (load(a, i) + load(value, o + RATE) * load(v, i))
    x = minimum(maximum(x, -1.0 - BEND), 1.0 + BEND)
    above, below = maximum(x - (1.0 - BEND), 0.0), maximum(-1.0 * x - (1.0 - BEND), 0.0)
    force = (-1.0 * loss) * (x - (above * above - below * below) * (0.25 / BEND))
    return i, force, inertia * (1.0 - (above + below) * (0.5 / BEND))


@part
def begin_friction(m, v, tau, armature, force):
    """Armature and force (nv lanes each) of the first round: as if friction held every joint."""
    own = floats(m, TREE.armature)
    for i in range(m[TREE.nv]):
        store(armature, i, spread(0.0) + load(own, i))
        store(force, i, load(tau, i))
    dof, value, prescribed = integers(m, TREE.loss_dof), floats(m, TREE.loss_value), integers(m, TREE.prescribed)
    for k in range(m[TREE.losses]):
        i, inertia = load(dof, k), load(value, LOSS_SIZE * k + INERTIA)
        if load(prescribed, i) < 0:
            store(armature, i, load(armature, i) + inertia)
            store(force, i, load(force, i) - inertia * load(value, LOSS_SIZE * k + RATE) * load(v, i))


@part
def friction_is_met(m, v, tau, a, armature, force):
    """The largest difference of the force from the law (lanes), relative; armature and force of the next round."""
    own, prescribed, value = floats(m, TREE.armature), integers(m, TREE.prescribed), floats(m, TREE.loss_value)
    error = spread(0.0)
    for k in range(m[TREE.losses]):
        i, f, _ = _friction(m, k, v, a)
        if load(prescribed, i) < 0:
            taken = load(force, i) - load(tau, i) - (load(armature, i) - load(own, i)) * load(a, i)
            off = (taken - f) / load(value, LOSS_SIZE * k + LOSS)
            error = maximum(error, maximum(off, -1.0 * off))
    for k in range(m[TREE.losses]):
        i, f, inertia = _friction(m, k, v, a)
        if load(prescribed, i) < 0:
            heavier, pushed = load(own, i) + inertia, load(tau, i) + f + inertia * load(a, i)
            store(armature, i, select(MET, error, heavier, load(armature, i)))
            store(force, i, select(MET, error, pushed, load(force, i)))
    return error


@part
def add_friction_derivatives(m, v, a, M, Dv, ld):
    """Add the derivatives of friction to those of inverse dynamics by a (M) and by v, (nv, ld) lanes."""
    value = floats(m, TREE.loss_value)
    for k in range(m[TREE.losses]):
        i, _, inertia = _friction(m, k, v, a)
        o = i * ld + i
        store(M, o, load(M, o) + inertia)
        store(Dv, o, load(Dv, o) + inertia * load(value, LOSS_SIZE * k + RATE))
