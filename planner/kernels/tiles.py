"""Products of small matrices in tiles of 8 x 8: eight accumulators of eight doubles, which stay in registers.

Matrices are float pointers with a row length. A tile may reach past the last row or column: what lies there is read
and written, never used.
"""

from __future__ import annotations

from planner.kernels.jit import inline
from planner.kernels.lanes import load, load8, spread, store8


@inline
def zero_tile():
    """A tile of zeros."""
    z = spread(0.0)
    return z, z, z, z, z, z, z, z


@inline
def add_product(tile, A, a, lda, B, b, ldb, n, factor):
    """The tile plus factor A' B: A and B from offsets a and b, contracted over n rows."""
    r0, r1, r2, r3, r4, r5, r6, r7 = tile
    for _ in range(n):
        v = factor * load8(B, b)
        r0 += load(A, a) * v
        r1 += load(A, a + 1) * v
        r2 += load(A, a + 2) * v
        r3 += load(A, a + 3) * v
        r4 += load(A, a + 4) * v
        r5 += load(A, a + 5) * v
        r6 += load(A, a + 6) * v
        r7 += load(A, a + 7) * v
        a += lda
        b += ldb
    return r0, r1, r2, r3, r4, r5, r6, r7


@inline
def load_tile(C, c, ld):
    """Eight rows of eight."""
    return (
        load8(C, c), load8(C, c + ld), load8(C, c + 2 * ld), load8(C, c + 3 * ld),
        load8(C, c + 4 * ld), load8(C, c + 5 * ld), load8(C, c + 6 * ld), load8(C, c + 7 * ld),
    )  # fmt: skip


@inline
def store_tile(C, c, ld, tile):
    """Write eight rows of eight."""
    store8(C, c, tile[0])
    store8(C, c + ld, tile[1])
    store8(C, c + 2 * ld, tile[2])
    store8(C, c + 3 * ld, tile[3])
    store8(C, c + 4 * ld, tile[4])
    store8(C, c + 5 * ld, tile[5])
    store8(C, c + 6 * ld, tile[6])
    store8(C, c + 7 * ld, tile[7])
