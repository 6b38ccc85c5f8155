"""Three-vectors, rotations and symmetric matrices as tuples of floats or V4, inlined into kernels.

A symmetric matrix is the tuple (xx, xy, xz, yy, yz, zz), a rotation the tuple of its nine entries by rows.
"""

from __future__ import annotations

from planner.kernels.numba.jit import inline
from planner.kernels.numba.lanes import load, store


@inline
def load3(p, k):
    """Three consecutive entries."""
    return load(p, k), load(p, k + 1), load(p, k + 2)


@inline
def load6(p, k):
    """Six consecutive entries."""
    return load(p, k), load(p, k + 1), load(p, k + 2), load(p, k + 3), load(p, k + 4), load(p, k + 5)


@inline
def load9(p, k):
    """Nine consecutive entries: a rotation."""
    return (
        load(p, k), load(p, k + 1), load(p, k + 2), load(p, k + 3), load(p, k + 4), load(p, k + 5),
        load(p, k + 6), load(p, k + 7), load(p, k + 8),
    )  # fmt: skip


@inline
def store3(p, k, v):
    """Write three consecutive entries."""
    store(p, k, v[0])
    store(p, k + 1, v[1])
    store(p, k + 2, v[2])


@inline
def store6(p, k, v):
    """Write six consecutive entries."""
    store3(p, k, (v[0], v[1], v[2]))
    store3(p, k + 3, (v[3], v[4], v[5]))


@inline
def add3(p, k, v):
    """Add to three consecutive entries."""
    store(p, k, load(p, k) + v[0])
    store(p, k + 1, load(p, k + 1) + v[1])
    store(p, k + 2, load(p, k + 2) + v[2])


@inline
def add6(p, k, v):
    """Add to six consecutive entries."""
    add3(p, k, (v[0], v[1], v[2]))
    add3(p, k + 3, (v[3], v[4], v[5]))


@inline
def cross(a, b):
    """Cross product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@inline
def add(a, b):
    """Sum."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@inline
def sub(a, b):
    """Difference."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@inline
def axpy(a, s, b):
    """Sum of a and s times b."""
    return a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]


@inline
def scaled(s, a):
    """Product with a number."""
    return s * a[0], s * a[1], s * a[2]


@inline
def dot(a, b):
    """Inner product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inline
def symmetric(J, v):
    """Product of a symmetric matrix and a vector."""
    return (
        J[0] * v[0] + J[1] * v[1] + J[2] * v[2],
        J[1] * v[0] + J[3] * v[1] + J[4] * v[2],
        J[2] * v[0] + J[4] * v[1] + J[5] * v[2],
    )


@inline
def rotated(R, v):
    """Product of a rotation and a vector."""
    return (
        R[0] * v[0] + R[1] * v[1] + R[2] * v[2],
        R[3] * v[0] + R[4] * v[1] + R[5] * v[2],
        R[6] * v[0] + R[7] * v[1] + R[8] * v[2],
    )


@inline
def row_times(r, a, b, c):
    """Row r times the matrix with rows a, b, c."""
    return (
        r[0] * a[0] + r[1] * b[0] + r[2] * c[0],
        r[0] * a[1] + r[1] * b[1] + r[2] * c[1],
        r[0] * a[2] + r[1] * b[2] + r[2] * c[2],
    )
