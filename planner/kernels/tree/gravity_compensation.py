"""The force that carries a share of bodies' weight (MuJoCo's gravcomp), and its derivatives, on lanes.

It is the weight of other masses, upwards: with g the acceleration of the base, and m and h the mass that is carried and
its first moment about the tree's origin, of link i and all beyond it, link i's joint feels

    tau_i = S_i' F_i,   F = (h x g, m g).

A turn by joint j at or before i carries S_i and h with it, so that S_j' changes tau_i as if g turned back; a turn by
joint i beyond j moves h alone:

    dtau_i/dq_j = S_i' (h_i x z_j, m_i z_j),   z_j = g x w_j          dtau_j/dq_i = w_j' ((w_i x h_i + m_i v_i) x g)
"""

from __future__ import annotations

from planner.kernels.algebra.spatial import add3, axpy, cross, dot, load3, rotated, scaled, store3
from planner.kernels.numba.jit import inline, part
from planner.kernels.numba.lanes import floats, integers, load, spread, store
from planner.kernels.tree.mechanism_table import TREE
from planner.kernels.tree.passive_force_arrays import LIFTED_SIZE
from planner.kernels.tree.recursion import PLACE, RECORD, SCREW_AXIS

MOMENT = 81  # offset in a link's record, beyond those of kernels.tree.recursion and of sensitivity


@inline
def _gather_moments(m, ws):
    """The first moment of each link and all beyond it, into the links' records; their poses are known."""
    gravcomp, parent = floats(m, TREE.gravcomp_value), integers(m, TREE.parent)
    for i in range(m[TREE.nv]):
        o, b = LIFTED_SIZE * i, i * RECORD
        R = (
            load(ws, b), load(ws, b + 1), load(ws, b + 2), load(ws, b + 3), load(ws, b + 4), load(ws, b + 5),
            load(ws, b + 6), load(ws, b + 7), load(ws, b + 8),
        )  # fmt: skip
        own = rotated(R, (load(gravcomp, o + 1), load(gravcomp, o + 2), load(gravcomp, o + 3)))
        store3(ws, b + MOMENT, axpy(own, load(gravcomp, o), load3(ws, b + PLACE)))
    for i in range(m[TREE.nv] - 1, -1, -1):
        p = load(parent, i)
        if p >= 0:
            add3(ws, p * RECORD + MOMENT, load3(ws, i * RECORD + MOMENT))


@inline
def _base_acceleration(m):
    g, zero = floats(m, TREE.base_acceleration), spread(0.0)
    return zero + load(g, 0), zero + load(g, 1), zero + load(g, 2)


@part
def add_compensation(m, ws, tau):
    """The force on the joints, of links whose poses and screws are known, onto tau (nv lanes)."""
    g, mass = _base_acceleration(m), floats(m, TREE.gravcomp_mass)
    _gather_moments(m, ws)
    for i in range(m[TREE.nv]):
        b = i * RECORD
        sw, sv = load3(ws, b + SCREW_AXIS), load3(ws, b + SCREW_AXIS + 3)
        moment = cross(load3(ws, b + MOMENT), g)
        store(tau, i, load(tau, i) + dot(sw, moment) + load(mass, i) * dot(sv, g))


@part
def subtract_compensation_derivatives(m, Dq, ld, ws):
    """Subtract the derivatives of that force from dtau/dq of inverse dynamics, (nv, ld) lanes."""
    g, mass = _base_acceleration(m), floats(m, TREE.gravcomp_mass)
    parent, first = integers(m, TREE.parent), integers(m, TREE.first)
    _gather_moments(m, ws)
    for i in range(m[TREE.nv]):
        b = i * RECORD
        sw, sv, h = load3(ws, b + SCREW_AXIS), load3(ws, b + SCREW_AXIS + 3), load3(ws, b + MOMENT)
        own, start = cross(g, sw), load(first, i)
        moment, force = cross(h, own), scaled(load(mass, i), own)
        lifts = cross(axpy(cross(sw, h), load(mass, i), sv), g)
        j = i
        while j >= 0:
            t, ij, ji = j * RECORD + SCREW_AXIS, i * ld + j, j * ld + i
            rw, rv = load3(ws, t), load3(ws, t + 3)
            z = cross(g, rw)
            if j >= start:  # the axes of a ball turn together
                store(Dq, ji, load(Dq, ji) - dot(rw, moment) - dot(rv, force))
            else:
                store(Dq, ji, load(Dq, ji) - dot(rw, lifts))
            if j < i:
                store(Dq, ij, load(Dq, ij) - dot(sw, cross(h, z)) - load(mass, i) * dot(sv, z))
            j = load(parent, j)
