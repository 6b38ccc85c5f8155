"""Accelerations under forces that have the acceleration in them: of friction loss, joint stops and soft contacts.

They are the minimum of a convex function. Newton's method linearizes each force, which is then a force and an inertia
(kernels.tree.joint_rows, kernels.tree.soft_contact), the recursion finds the next accelerations, and the way to them is
cut where the function is least on it. Lanes that have met the laws keep their numbers, so that a state's acceleration
does not depend on the states beside it.
"""

from __future__ import annotations

from planner.kernels.numba.jit import part
from planner.kernels.numba.lanes import any_less, at, floats, integers, lanes, load, maximum, select, spread, store
from planner.kernels.tree.contact import add_contact_wrenches
from planner.kernels.tree.couplings import accelerate_coupled
from planner.kernels.tree.joint_rows import (
    any_stop,
    first_row_error,
    linearize_rows,
    row_error,
    row_uphill,
)
from planner.kernels.tree.loop_accelerations import accelerate_closed
from planner.kernels.tree.mechanism_table import TREE
from planner.kernels.tree.memory import MEMORY
from planner.kernels.tree.pair_contact import add_pair_wrenches
from planner.kernels.tree.recursion import accelerate, move_links
from planner.kernels.tree.soft_contact import (
    add_soft_contacts,
    any_soft_contact,
    first_soft_error,
    soft_error,
    soft_moves,
    soft_uphill,
)

MAX_ROUNDS = 30  # of Newton's method, which takes three or four
CONVERGED = 1e-12  # of a force: what is left of the law when a lane has met it
DIVERGED = 1e300
HALVINGS = 12  # of the way to the next accelerations


@part
def add_wrenches(m, q, links):
    """The wrenches of contacts that have no acceleration in them."""
    add_contact_wrenches(m, q, links)
    if m[TREE.pairs] > 0:
        add_pair_wrenches(m, q, links)


@part
def accelerate_once(m, r, q, v, tau, a, links, armature):
    """Accelerations of links that move_links has seen, with an armature (nv) of floats or lanes."""
    if m[TREE.loop_rows] > 0:
        accelerate_closed(m, r, q, v, tau, a, links, armature, at(a, m[TREE.nv]))
    elif m[TREE.dependents] > 0:
        accelerate_coupled(m, r, tau, a, links, armature)
    else:
        accelerate(m, tau, a, links, armature, False)


@part
def own_armature(m, r):
    """MEMORY.own (nv lanes): armatures without rows."""
    own, implicit = lanes(r, MEMORY.own), lanes(r, MEMORY.implicit)
    for i in range(m[TREE.nv]):
        store(own, i, load(implicit, i) + load(floats(m, TREE.armature), i))


@part
def needs_rounds(m, r, q, links):
    """Whether any force has the acceleration in it, of links that move_links has seen."""
    touches = m[TREE.softs] > 0 and any_soft_contact(m, q, links, floats(r, MEMORY.near))
    return touches or m[TREE.losses] > 0 or any_stop(m, q)


@part
def forget_guess(m, r):
    """Start the next rounds from zero acceleration, as at the beginning of a stage."""
    for i in range(m[TREE.nv]):
        store(lanes(r, MEMORY.guess), i, spread(0.0))


@part
def keep_guess(m, r, a):
    """Start the next rounds at the accelerations a."""
    for i in range(m[TREE.nv]):
        store(lanes(r, MEMORY.guess), i, load(a, i))


@part
def accelerate_in_rounds(m, r, q, v, tau, a):
    """Accelerations of links that move_links has seen, with MEMORY.own as armature.

    Rounds start at the accelerations of the step before in the same stage, MEMORY.guess, in every lane, whether it
    touches or not: a state's acceleration does not depend on those beside it.
    """
    links, armature, force = lanes(r, MEMORY.links), lanes(r, MEMORY.heavier), lanes(r, MEMORY.pushed)
    before, asked, own = lanes(r, MEMORY.before), lanes(r, MEMORY.asked), lanes(r, MEMORY.own)
    soft, near = lanes(r, MEMORY.soft), floats(r, MEMORY.near)
    guess = lanes(r, MEMORY.guess)
    for i in range(m[TREE.nv]):
        if load(integers(m, TREE.prescribed), i) < 0:
            store(a, i, load(guess, i))
    if m[TREE.softs] > 0:
        add_soft_contacts(m, q, a, links, near, soft)
    linearize_rows(m, q, v, tau, a, (own, armature), force, before)
    accelerate_once(m, r, q, v, force, a, links, armature)
    error = first_row_error(m, q, v, tau, a, (own, armature), force, asked)
    if m[TREE.softs] > 0:
        soft_moves(m, q, a, links, near, soft)
        error = maximum(error, first_soft_error(m, q, links, near, soft))
    for _ in range(MAX_ROUNDS):
        error = select(error, DIVERGED, error, 0.0)  # not a number: a state that has none
        if not any_less(CONVERGED, error):
            break
        linearize_rows(m, q, v, tau, a, (own, armature), force, before)
        move_links(m, q, v, links)
        add_wrenches(m, q, links)
        if m[TREE.softs] > 0:
            add_soft_contacts(m, q, a, links, near, soft)
        for k in range(m[TREE.loop_rows]):
            store(lanes(r, MEMORY.loop_before), k, load(a, m[TREE.nv] + k))
        accelerate_once(m, r, q, v, force, a, links, armature)
        if m[TREE.softs] > 0:
            soft_moves(m, q, a, links, near, soft)
        error = _next_error(m, r, q, v, tau, a, error)


@part
def _uphill(m, r, q, v, tau, a, part_of_way):
    """The slope of the convex function along the way from MEMORY.before to a, a part of it gone."""
    armatures = lanes(r, MEMORY.own), lanes(r, MEMORY.heavier)
    force, before, asked = lanes(r, MEMORY.pushed), lanes(r, MEMORY.before), lanes(r, MEMORY.asked)
    slope = row_uphill(m, q, v, tau, a, armatures, force, before, asked, part_of_way)
    if m[TREE.softs] > 0:
        slope += soft_uphill(m, q, lanes(r, MEMORY.links), floats(r, MEMORY.near), lanes(r, MEMORY.soft), part_of_way)
    return slope


@part
def _next_error(m, r, q, v, tau, a, error):
    """Go as far towards a as the convex function sinks; lanes whose error was met stay. The new error."""
    armatures = lanes(r, MEMORY.own), lanes(r, MEMORY.heavier)
    force, before, asked = lanes(r, MEMORY.pushed), lanes(r, MEMORY.before), lanes(r, MEMORY.asked)
    low, high = spread(0.0), spread(1.0)
    whole = _uphill(m, r, q, v, tau, a, high)
    if any_less(0.0, whole):
        for _ in range(HALVINGS):
            middle = 0.5 * (low + high)
            slope = _uphill(m, r, q, v, tau, a, middle)
            low, high = select(0.0, slope, low, middle), select(0.0, slope, middle, high)
        high = select(0.0, whole, high, 1.0)
    high = select(CONVERGED, error, high, 0.0)
    for k in range(m[TREE.loop_rows]):  # the forces of closed chains stay with the accelerations
        i = m[TREE.nv] + k
        store(a, i, select(0.0, high, load(a, i), load(lanes(r, MEMORY.loop_before), k)))
    left = row_error(m, q, v, tau, a, armatures, force, before, asked, high)
    if m[TREE.softs] > 0:
        left = maximum(
            left, soft_error(m, q, lanes(r, MEMORY.links), floats(r, MEMORY.near), lanes(r, MEMORY.soft), high)
        )
    return left
