"""The dynamics of a tree for batches of states: arrays in and out, four states at a time."""

from __future__ import annotations

from planner.kernels.numba.jit import inline, jit
from planner.kernels.numba.lanes import WIDTH, as_floats, at, doubles, floats, lanes, load, pointer, spread, store
from planner.kernels.tree.forces import add_passive, add_passive_derivatives
from planner.kernels.tree.mechanism_table import TREE
from planner.kernels.tree.memory import MEMORY
from planner.kernels.tree.passive_forces import (
    add_compensation,
    add_drag,
    add_tendon_derivatives,
    add_tendons,
    subtract_compensation_derivatives,
    subtract_drag_derivatives,
)
from planner.kernels.tree.recursion import RECORD, accelerate, inverse_dynamics, move_links, place_all
from planner.kernels.tree.sensitivity import inverse_dynamics_derivatives
from planner.kernels.tree.step import gather, scatter


@inline
def _gathered(m, r, q, v, third, first, destination):
    """Four states onto MEMORY.x, and four rows (nv) of a third array onto lanes of their own."""
    K = q.shape[0]
    gather(doubles(q), first, K, m[TREE.nq], lanes(r, MEMORY.x))
    gather(doubles(v), first, K, m[TREE.nv], at(lanes(r, MEMORY.x), m[TREE.nq]))
    gather(doubles(third), first, K, m[TREE.nv], destination)


@inline
def _passive(m, r, x, v):
    """What the mechanism itself does to its joints, in MEMORY.theta; the links' poses, screws and twists are known."""
    passive = lanes(r, MEMORY.theta)
    for i in range(m[TREE.nv]):
        store(passive, i, spread(0.0))
    add_passive(m, x, v, passive, lanes(r, MEMORY.scratch))
    add_tendons(m, x, v, passive)
    if m[TREE.gravcomp] > 0:
        add_compensation(m, lanes(r, MEMORY.links), passive)
    if m[TREE.drags] > 0:
        add_drag(m, lanes(r, MEMORY.links), passive)
    return passive


@jit
def forward(m, r, q, v, inputs, a, tau):
    """Accelerations a and forces tau (K, nv) from inputs (K, nv): forces or, where prescribed, accelerations."""
    m, r = pointer(m), pointer(r)
    nq, nv, K = m[TREE.nq], m[TREE.nv], q.shape[0]
    x, total, acceleration = lanes(r, MEMORY.x), lanes(r, MEMORY.tau), lanes(r, MEMORY.a)
    rate = at(x, nq)
    for first in range(0, K, WIDTH):
        _gathered(m, r, q, v, inputs, first, total)
        move_links(m, x, rate, lanes(r, MEMORY.links))
        passive = _passive(m, r, x, rate)
        for i in range(nv):
            store(acceleration, i, load(total, i))
            store(total, i, load(total, i) + load(passive, i))
        accelerate(m, total, acceleration, lanes(r, MEMORY.links), floats(m, TREE.armature), True)
        for i in range(nv):
            store(total, i, load(total, i) - load(passive, i))
        scatter(acceleration, first, K, nv, doubles(a))
        scatter(total, first, K, nv, doubles(tau))


@jit
def inverse(m, r, q, v, a, tau):
    """Applied forces tau (K, nv) for accelerations a (K, nv)."""
    m, r = pointer(m), pointer(r)
    nq, nv, K = m[TREE.nq], m[TREE.nv], q.shape[0]
    x, total, acceleration = lanes(r, MEMORY.x), lanes(r, MEMORY.tau), lanes(r, MEMORY.a)
    rate = at(x, nq)
    for first in range(0, K, WIDTH):
        _gathered(m, r, q, v, a, first, acceleration)
        inverse_dynamics(m, x, rate, acceleration, total, lanes(r, MEMORY.links))
        passive = _passive(m, r, x, rate)
        for i in range(nv):
            store(total, i, load(total, i) - load(passive, i))
        scatter(total, first, K, nv, doubles(tau))


@jit
def derivatives(m, r, q, v, a, M, Dq, Dv):
    """M = dtau/da, dtau/dq and dtau/dv (K, nv, nv) of inverse dynamics."""
    m, r = pointer(m), pointer(r)
    nq, nv, K, ld = m[TREE.nq], m[TREE.nv], q.shape[0], r[MEMORY.ld]
    x, acceleration = lanes(r, MEMORY.x), lanes(r, MEMORY.a)
    rate = at(x, nq)
    blocks = (lanes(r, MEMORY.M), lanes(r, MEMORY.Dq), lanes(r, MEMORY.Dv))
    for first in range(0, K, WIDTH):
        _gathered(m, r, q, v, a, first, acceleration)
        for block in blocks:
            for k in range(nv * ld):
                store(block, k, spread(0.0))
        inverse_dynamics_derivatives(m, x, rate, acceleration, lanes(r, MEMORY.links), lanes(r, MEMORY.tau), blocks, ld)
        add_passive_derivatives(m, x, blocks[1], blocks[2], ld, lanes(r, MEMORY.scratch))
        add_tendon_derivatives(m, x, blocks[1], blocks[2], ld)
        if m[TREE.gravcomp] > 0:
            subtract_compensation_derivatives(m, blocks[1], ld, lanes(r, MEMORY.links))
        if m[TREE.drags] > 0:
            subtract_drag_derivatives(m, blocks[1], blocks[2], ld, lanes(r, MEMORY.links))
        for i in range(nv):
            for j in range(nv):
                for lane in range(min(WIDTH, K - first)):
                    k = (i * ld + j) * WIDTH + lane
                    M[first + lane, i, j] = load(as_floats(blocks[0]), k)
                    Dq[first + lane, i, j] = load(as_floats(blocks[1]), k)
                    Dv[first + lane, i, j] = load(as_floats(blocks[2]), k)


@jit
def places(m, r, q, poses):
    """Per link (K, nv, 18): rotation (9), position (3) and screw (6), about the tree's origin."""
    m, r = pointer(m), pointer(r)
    nq, K = m[TREE.nq], q.shape[0]
    x, ws = lanes(r, MEMORY.x), lanes(r, MEMORY.links)
    for first in range(0, K, WIDTH):
        gather(doubles(q), first, K, nq, x)
        place_all(m, x, ws)
        for i in range(m[TREE.nv]):
            for k in range(18):
                for lane in range(min(WIDTH, K - first)):
                    poses[first + lane, i, k] = load(as_floats(ws), (i * RECORD + k) * WIDTH + lane)
