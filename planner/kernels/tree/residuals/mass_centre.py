"""The centre of mass of a machine: three rows.

    c = sum m_i c_i / M,      d c / dq_i = (m v_i + w_i x h) / M,    h = sum of m_k c_k and m = sum of m_k

over the links k that i carries, i included, about the origin of i's tree. The twin is in
problem.costs.residual_functions.
"""

from __future__ import annotations

from planner.kernels.algebra.spatial import add, add3, axpy, cross, load3, load9, rotated, scaled, store3
from planner.kernels.numba.jit import part
from planner.kernels.numba.lanes import floats, integers, lanes, load, spread
from planner.kernels.tree.mechanism_table import INERTIA_SIZE, TREE
from planner.kernels.tree.recursion import PLACE, RECORD, SCREW_AXIS
from planner.kernels.tree.residuals.layout import MAX_ROWS, RESIDUALS
from planner.kernels.tree.residuals.points import constants_of

MASS_CENTRE = 9  # number of its kind
PER_MASS = 3  # offset in the constants, after where the trees stand


@part
def mass_centre_value(m, p, q, ws, t):
    """Where the centre of mass is; m_i c_i of each link goes to MOMENTS."""
    inertia, moments, term = floats(m, TREE.inertia), lanes(p, RESIDUALS.moments), constants_of(p, t)
    mass, tree = floats(m, TREE.subtree_mass), integers(p, RESIDUALS.tree_address)
    per, zero = load(term, PER_MASS), spread(0.0)
    sum_ = (zero, zero, zero)
    centre = add(sum_, load3(term, 0))
    for i in range(m[TREE.nv]):
        b, o = i * RECORD, i * INERTIA_SIZE
        h = scaled(load(inertia, o), add(load3(ws, b + PLACE), rotated(load9(ws, b), load3(inertia, o + 1))))
        store3(moments, 3 * i, h)
        sum_ = add(sum_, h)
        a = load(tree, i)
        if a >= 0:  # a floating tree is described about where it is
            centre = axpy(centre, per * load(mass, i), load3(q, a))
    store3(lanes(p, RESIDUALS.value), 0, axpy(centre, per, sum_))


@part
def mass_centre_rows(m, p, ws, t):
    """The derivative, after the value."""
    parent, mass = integers(m, TREE.parent), floats(m, TREE.subtree_mass)
    moments, row, per = lanes(p, RESIDUALS.moments), lanes(p, RESIDUALS.row), load(constants_of(p, t), PER_MASS)
    for i in range(m[TREE.nv] - 1, -1, -1):
        b, h = i * RECORD + SCREW_AXIS, load3(moments, 3 * i)
        whole = axpy(cross(load3(ws, b), h), load(mass, i), load3(ws, b + 3))
        store3(row, MAX_ROWS * i, scaled(per, whole))
        if load(parent, i) >= 0:
            add3(moments, 3 * load(parent, i), h)
