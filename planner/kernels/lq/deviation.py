"""The deviation of one state from another, one number at a time; tree_line_search has it in lanes."""

from __future__ import annotations

from planner.kernels.algebra.rotations import difference_floats
from planner.kernels.lq.workspace import W
from planner.kernels.numba.jit import inline
from planner.kernels.numba.lanes import at, integers, load, store


@inline
def deviation(w, x, reference, e):
    """Write e (ndx) = x (-) reference: differences of numbers, rotation vectors of quaternions."""
    vector_x, vector_dx = integers(w, W.vector_x), integers(w, W.vector_dx)
    for i in range(w[W.vectors]):
        a = load(vector_x, i)
        store(e, load(vector_dx, i), load(x, a) - load(reference, a))
    for b in range(w[W.quaternions]):
        a, d = load(integers(w, W.quaternion_x), b), load(integers(w, W.quaternion_dx), b)
        difference_floats(at(x, a), at(reference, a), at(e, d))
