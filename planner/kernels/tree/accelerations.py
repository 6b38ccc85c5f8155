"""Accelerations of a tree on four lanes, with everything that acts on it."""

from __future__ import annotations

from planner.kernels.integrators import ROSENBROCK
from planner.kernels.numba.jit import part
from planner.kernels.numba.lanes import any_less, at, floats, lanes, load, store
from planner.kernels.tree.actuator_laws import add_laws
from planner.kernels.tree.actuator_wrenches import add_actuator_wrenches
from planner.kernels.tree.contact import add_contact_wrenches, add_stops
from planner.kernels.tree.couplings import accelerate_coupled
from planner.kernels.tree.fluid import add_drag
from planner.kernels.tree.forces import applied_forces
from planner.kernels.tree.friction import (  # fmt: skip
    FRICTION_CONVERGED,
    MAX_ROUNDS,
    begin_friction,
    first_error,
    linearize_friction,
    next_error,
)
from planner.kernels.tree.gravity_compensation import add_compensation
from planner.kernels.tree.joint_curves import add_curves
from planner.kernels.tree.loop_accelerations import accelerate_closed
from planner.kernels.tree.mechanism_table import TREE
from planner.kernels.tree.memory import MEMORY
from planner.kernels.tree.pair_contact import add_pair_wrenches
from planner.kernels.tree.recursion import accelerate, move_links
from planner.kernels.tree.tendons import add_tendons


@part
def accelerations(m, r, q, v, u, act, a, external):
    """Accelerations a (nv lanes) under inputs u and activations act, and behind them the forces of closed chains.

    With `external` None the machine has none of what Model.external names, and its code is left out.
    """
    tau, links = lanes(r, MEMORY.tau), lanes(r, MEMORY.links)
    applied_forces(m, q, v, u, act, tau, a, lanes(r, MEMORY.scratch))
    if external is not None:
        add_stops(m, q, v, tau)
        add_curves(m, q, tau)
        add_tendons(m, q, v, tau)
        if m[TREE.laws] > 0:
            add_laws(m, q, v, u, act, tau)
    move_links(m, q, v, links)
    if external is not None:
        if m[TREE.gravcomp] > 0:
            add_compensation(m, links, tau)
        if m[TREE.drags] > 0:
            add_drag(m, links, tau)
        if m[TREE.wrenches] > 0:
            add_actuator_wrenches(m, u, act, links, tau)
        _add_wrenches(m, q, links)
        if r[MEMORY.integrator] == ROSENBROCK:
            _accelerate_implicitly(m, r, q, v, tau, a)
            return
        if m[TREE.losses] > 0:
            _own_armature(m, r)
            _accelerate_with_friction(m, r, q, v, tau, a)
            return
        if m[TREE.loop_rows] > 0:
            accelerate_closed(m, r, q, v, tau, a, links, floats(m, TREE.armature), at(a, m[TREE.nv]))
            return
        if m[TREE.dependents] > 0:
            accelerate_coupled(m, r, tau, a, links, floats(m, TREE.armature))
            return
    accelerate(m, tau, a, links, floats(m, TREE.armature), False)


@part
def _own_armature(m, r):
    """MEMORY.own (nv lanes): armatures without friction."""
    own, implicit = lanes(r, MEMORY.own), lanes(r, MEMORY.implicit)
    for i in range(m[TREE.nv]):
        store(own, i, load(implicit, i) + load(floats(m, TREE.armature), i))


@part
def _accelerate_implicitly(m, r, q, v, tau, a):
    """Accelerations of a stage of kernels.tree.rosenbrock, of links that move_links has seen."""
    behind = lanes(r, MEMORY.behind)
    for i in range(m[TREE.nv]):
        store(tau, i, load(tau, i) + load(behind, i))
    _own_armature(m, r)
    if m[TREE.losses] > 0:
        _accelerate_with_friction(m, r, q, v, tau, a)
    else:
        _accelerate_again(m, r, q, v, tau, a, lanes(r, MEMORY.links), lanes(r, MEMORY.own))


@part
def _add_wrenches(m, q, links):
    add_contact_wrenches(m, q, links)
    if m[TREE.pairs] > 0:
        add_pair_wrenches(m, q, links)


@part
def _accelerate_again(m, r, q, v, tau, a, links, armature):
    """Accelerations with another armature (nv lanes)."""
    if m[TREE.loop_rows] > 0:
        accelerate_closed(m, r, q, v, tau, a, links, armature, at(a, m[TREE.nv]))
    elif m[TREE.dependents] > 0:
        accelerate_coupled(m, r, tau, a, links, armature)
    else:
        accelerate(m, tau, a, links, armature, False)


@part
def _accelerate_with_friction(m, r, q, v, tau, a):
    """Accelerations of a machine with friction loss, of links that move_links has seen; see kernels.tree.friction."""
    links, armature, force = lanes(r, MEMORY.links), lanes(r, MEMORY.heavier), lanes(r, MEMORY.pushed)
    before, asked, own = lanes(r, MEMORY.before), lanes(r, MEMORY.asked), lanes(r, MEMORY.own)
    begin_friction(m, v, tau, own, armature, force)
    _accelerate_again(m, r, q, v, force, a, links, armature)
    error = first_error(m, v, tau, a, (own, armature), force, asked)
    for _ in range(MAX_ROUNDS):
        if not any_less(FRICTION_CONVERGED, error):
            break
        linearize_friction(m, v, tau, a, (own, armature), force, before)
        move_links(m, q, v, links)
        _add_wrenches(m, q, links)
        _accelerate_again(m, r, q, v, force, a, links, armature)
        error = next_error(m, v, tau, a, (own, armature), force, before, asked, error)
