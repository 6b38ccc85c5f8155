"""Accelerations of a tree on four lanes, with everything that acts on it."""

from __future__ import annotations

from planner.kernels.integrators import ROSENBROCK
from planner.kernels.numba.jit import part
from planner.kernels.numba.lanes import floats, lanes, load, store
from planner.kernels.tree.actuator_laws import add_laws
from planner.kernels.tree.actuator_wrenches import add_actuator_wrenches
from planner.kernels.tree.contact import add_stops
from planner.kernels.tree.forces import applied_forces
from planner.kernels.tree.mechanism_table import TREE
from planner.kernels.tree.memory import MEMORY
from planner.kernels.tree.passive_forces import add_compensation, add_curves, add_drag, add_tendons
from planner.kernels.tree.recursion import accelerate, move_links
from planner.kernels.tree.rounds import (
    accelerate_in_rounds,
    accelerate_once,
    add_wrenches,
    keep_guess,
    needs_rounds,
    own_armature,
)


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
        add_wrenches(m, q, links)
        if r[MEMORY.integrator] == ROSENBROCK:
            _accelerate_implicitly(m, r, q, v, tau, a)
            return
        if needs_rounds(m, r, q, links):
            own_armature(m, r)
            accelerate_in_rounds(m, r, q, v, tau, a)
        else:
            accelerate_once(m, r, q, v, tau, a, links, floats(m, TREE.armature))
        keep_guess(m, r, a)
        return
    accelerate(m, tau, a, links, floats(m, TREE.armature), False)


@part
def _accelerate_implicitly(m, r, q, v, tau, a):
    """Accelerations of a stage of kernels.tree.rosenbrock, of links that move_links has seen."""
    behind = lanes(r, MEMORY.behind)
    for i in range(m[TREE.nv]):
        store(tau, i, load(tau, i) + load(behind, i))
    own_armature(m, r)
    if needs_rounds(m, r, q, lanes(r, MEMORY.links)):
        accelerate_in_rounds(m, r, q, v, tau, a)
    else:
        accelerate_once(m, r, q, v, tau, a, lanes(r, MEMORY.links), lanes(r, MEMORY.own))
    keep_guess(m, r, a)
