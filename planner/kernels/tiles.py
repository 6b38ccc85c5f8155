"""Products of small matrices in tiles of 4 x 8: eight accumulators of four doubles, which stay in registers.

Matrices are float pointers with a row length. A tile may reach past the last row or column: what lies there is read
and written, never used.
"""

from __future__ import annotations

from planner.kernels.jit import inline
from planner.kernels.lane_math import transpose
from planner.kernels.lanes import WIDTH, load, load4, spread, store, store4


@inline
def _four_by_eight(C, c, ldc, A, a, lda, B, b, ldb, n, factor, add):
    z = spread(0.0)
    r0, r1, r2, r3, s0, s1, s2, s3 = z, z, z, z, z, z, z, z
    for _ in range(n):
        v, w = load4(B, b), load4(B, b + WIDTH)
        a0, a1, a2, a3 = load(A, a), load(A, a + 1), load(A, a + 2), load(A, a + 3)
        r0 += a0 * v
        s0 += a0 * w
        r1 += a1 * v
        s1 += a1 * w
        r2 += a2 * v
        s2 += a2 * w
        r3 += a3 * v
        s3 += a3 * w
        a += lda
        b += ldb
    _put(C, c, r0, factor, add)
    _put(C, c + WIDTH, s0, factor, add)
    _put(C, c + ldc, r1, factor, add)
    _put(C, c + ldc + WIDTH, s1, factor, add)
    _put(C, c + 2 * ldc, r2, factor, add)
    _put(C, c + 2 * ldc + WIDTH, s2, factor, add)
    _put(C, c + 3 * ldc, r3, factor, add)
    _put(C, c + 3 * ldc + WIDTH, s3, factor, add)


@inline
def _four_by_four(C, c, ldc, A, a, lda, B, b, ldb, n, factor, add):
    z = spread(0.0)
    r0, r1, r2, r3 = z, z, z, z
    for _ in range(n):
        v = load4(B, b)
        r0 += load(A, a) * v
        r1 += load(A, a + 1) * v
        r2 += load(A, a + 2) * v
        r3 += load(A, a + 3) * v
        a += lda
        b += ldb
    _put(C, c, r0, factor, add)
    _put(C, c + ldc, r1, factor, add)
    _put(C, c + 2 * ldc, r2, factor, add)
    _put(C, c + 3 * ldc, r3, factor, add)


@inline
def _put(C, c, row, factor, add):
    store4(C, c, load4(C, c) + factor * row if add else factor * row)


@inline
def four_rows(C, c, ldc, A, a, lda, B, b, ldb, n, factor, columns, add):
    """Four rows of C, from offset c, become factor A' B (or gain it): A and B from a and b, contracted over n rows."""
    j = 0
    while j + WIDTH < columns:
        _four_by_eight(C, c + j, ldc, A, a, lda, B, b + j, ldb, n, factor, add)
        j += 2 * WIDTH
    if j < columns:
        _four_by_four(C, c + j, ldc, A, a, lda, B, b + j, ldb, n, factor, add)


@inline
def one_row(C, c, A, a, lda, B, b, ldb, n, factor, columns):
    """One row of C, from offset c, gains factor times the rows of B weighted by A[a], A[a + lda], ..."""
    j = 0
    z = spread(0.0)
    while j + 3 * WIDTH < columns:
        r0, r1, r2, r3, k = z, z, z, z, b + j
        for i in range(n):
            f = load(A, a + i * lda)
            r0 += f * load4(B, k)
            r1 += f * load4(B, k + WIDTH)
            r2 += f * load4(B, k + 2 * WIDTH)
            r3 += f * load4(B, k + 3 * WIDTH)
            k += ldb
        _put(C, c + j, r0, factor, True)
        _put(C, c + j + WIDTH, r1, factor, True)
        _put(C, c + j + 2 * WIDTH, r2, factor, True)
        _put(C, c + j + 3 * WIDTH, r3, factor, True)
        j += 4 * WIDTH
    while j < columns:
        r0, k = z, b + j
        for i in range(n):
            r0 += load(A, a + i * lda) * load4(B, k)
            k += ldb
        _put(C, c + j, r0, factor, True)
        j += WIDTH


@inline
def mirror(C, c, ld, i, columns):
    """Copy what four rows have above the diagonal, from the block at (i, i) on, to below it."""
    o = c + i * ld + i
    store(C, o + ld, load(C, o + 1))
    for j in range(2):
        store(C, o + 2 * ld + j, load(C, o + j * ld + 2))
    for j in range(3):
        store(C, o + 3 * ld + j, load(C, o + j * ld + 3))
    for j in range(i + WIDTH, columns, WIDTH):
        o = c + i * ld + j
        b0, b1, b2, b3 = transpose((load4(C, o), load4(C, o + ld), load4(C, o + 2 * ld), load4(C, o + 3 * ld)))
        o = c + j * ld + i
        store4(C, o, b0)
        store4(C, o + ld, b1)
        store4(C, o + 2 * ld, b2)
        store4(C, o + 3 * ld, b3)
