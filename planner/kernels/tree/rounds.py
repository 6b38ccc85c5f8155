"""Accelerations under forces that have the acceleration in them: of friction loss, joint stops and soft contacts.

They are the minimum of a convex function. Newton's method linearizes each force, which is then a force and an inertia
(kernels.tree.joint_rows, kernels.tree.soft_contact), the recursion finds the next accelerations, and the way to them is
cut where the function is least on it. Lanes that have met the laws keep their numbers, so that a state's acceleration
does not depend on the states beside it.

And accelerations of a tree with closed chains (planner.model.couplings): with W as M^-1 (kernels.tree.couplings),
the accelerations a0 that the tree would have, and c = J a0 + Jdot qd + 2 rate phidot + rate^2 phi what they lack of the
constraints,

    f = -N c,   qdd = a0 + W J'f,   N = (J W J')^-1
"""

from __future__ import annotations

from planner.kernels.algebra.spatial import add, axpy, cross, load3, store3, sub
from planner.kernels.numba.jit import inline, part
from planner.kernels.numba.lanes import any_less, at, floats, integers, lanes, load, maximum, select, spread, store
from planner.kernels.tree.contact import add_contact_wrenches
from planner.kernels.tree.couplings import accelerate_coupled, hold_prescribed, invert_coupled, mass_and_rest
from planner.kernels.tree.joint_rows import (
    any_stop,
    first_row_error,
    linearize_rows,
    row_error,
    row_uphill,
)
from planner.kernels.tree.loop_algebra import solve
from planner.kernels.tree.loop_rows import LEADER, cam_polynomial, constraint_rows, frame_axis, joined_frame, projected
from planner.kernels.tree.mechanism_table import TREE
from planner.kernels.tree.memory import MEMORY
from planner.kernels.tree.pair_contact import add_pair_wrenches
from planner.kernels.tree.recursion import ACCELERATION, RECORD, accelerate, move_links
from planner.kernels.tree.soft_contact import (
    add_soft_contacts,
    any_soft_contact,
    first_soft_error,
    soft_error,
    soft_moves,
    soft_uphill,
)


@inline
def _acceleration(m, link, ws):
    """The acceleration of a link, (angular, linear) at the tree's origin, without gravity's part."""
    zero, g = spread(0.0), floats(m, TREE.base_acceleration)
    aw, av = (zero, zero, zero), (zero, zero, zero)
    if link >= 0:
        b = link * RECORD + ACCELERATION
        aw, av = load3(ws, b), sub(load3(ws, b + 3), load3(g, 0))
    return aw, av


@inline
def _lacks(m, q, v, ws, c):
    """C = Jdot qd + 2 rate phidot + rate^2 phi, and J a of prescribed coordinates, from the links' accelerations."""
    rigid, row, rate = integers(m, TREE.loop_rigid), 0, load(floats(m, TREE.loop_rate), 0)
    zero = spread(0.0)
    for k in range(m[TREE.loops]):
        total, turning, turn = (zero, zero, zero), (zero, zero, zero), (zero, zero, zero)
        links = load(integers(m, TREE.joined_link), 2 * k), load(integers(m, TREE.joined_link), 2 * k + 1)
        for side in range(2):
            link, p, x, w, u = joined_frame(m, 2 * k + side, q, ws)
            sign = 1.0 - 2.0 * side
            aw, av = _acceleration(m, link, ws)
            moves = add(u, cross(w, p))
            a = add(add(av, cross(aw, p)), cross(w, moves))
            total = axpy(total, sign, axpy(axpy(a, 2.0 * rate, moves), rate * rate, x))
            turning = axpy(turning, sign, axpy(aw, 2.0 * rate, w))
        store3(c, row, total)
        row += 3
        if load(rigid, k) > 0:
            for e in range(3):
                turn = add(
                    turn, cross(frame_axis(m, 2 * k + 1, links[1], e, ws), frame_axis(m, 2 * k, links[0], e, ws))
                )
            store3(c, row, axpy(turning, 0.5 * rate * rate, turn))
            row += 3
    dof, address = integers(m, TREE.coupling_dof), integers(m, TREE.q_address)
    for k in range(m[TREE.polynomial_couplings]):
        i, j = load(dof, 2 * k), load(dof, 2 * k + LEADER)
        value, slope, curvature, _ = cam_polynomial(m, k, q)
        speed = load(v, j)
        phi, phid = load(q, load(address, i)) - value, load(v, i) - slope * speed
        lacks = (2.0 * rate) * phid + (rate * rate) * phi - curvature * (speed * speed)
        store3(c, row, (lacks, zero, zero))
        row += 3


@part
def accelerate_closed(m, r, q, v, forces, a, ws, armature, f):
    """Accelerations a (nv) under forces (nv), and the constraints' f, of links that move_links has seen.

    armature (nv) is floats or lanes.
    """
    n, prescribed, c, zero = m[TREE.nv], integers(m, TREE.prescribed), lanes(r, MEMORY.loop_c), spread(0.0)
    rest, M, ld = lanes(r, MEMORY.rest), lanes(r, MEMORY.M), r[MEMORY.ld]
    J, WJ, start = lanes(r, MEMORY.loop_J), lanes(r, MEMORY.loop_WJ), integers(m, TREE.block_start)
    first, reach, stop = integers(m, TREE.reach_start), integers(m, TREE.reach_dof), integers(m, TREE.block_stop)
    for i in range(n):
        store(rest, i, load(forces, i))
    mass_and_rest(m, rest, a, ws, armature, M, ld)
    _lacks(m, q, v, ws, c)
    for p in range(n):
        if load(prescribed, p) >= 0:
            store(rest, p, zero)
    hold_prescribed(m, M, ld)
    invert_coupled(m, M, ld)
    constraint_rows(m, q, ws, J, ld)
    projected(m, r, J, M, ld)
    for k in range(m[TREE.triples]):
        o0, o1, o2 = 3 * k * ld, (3 * k + 1) * ld, (3 * k + 2) * ld
        x, y, z = load3(c, 3 * k)
        for t in range(load(first, k), load(first, k + 1)):
            i = load(reach, t)
            x += load(WJ, o0 + i) * load(rest, i)
            y += load(WJ, o1 + i) * load(rest, i)
            z += load(WJ, o2 + i) * load(rest, i)
        store3(c, 3 * k, (x, y, z))
    solve(m, r, c, f)
    for i in range(n):
        if load(prescribed, i) < 0:
            total = zero
            for j in range(load(start, i), load(stop, i)):
                total += load(M, i * ld + j) * load(rest, j)
            store(a, i, total)
    for k in range(m[TREE.triples]):  # columns of prescribed coordinates are zero
        o0, o1, o2 = 3 * k * ld, (3 * k + 1) * ld, (3 * k + 2) * ld
        x, y, z = load3(f, 3 * k)
        for t in range(load(first, k), load(first, k + 1)):
            i = load(reach, t)
            store(a, i, load(a, i) + (load(WJ, o0 + i) * x + load(WJ, o1 + i) * y + load(WJ, o2 + i) * z))


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
