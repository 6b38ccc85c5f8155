"""Products of small matrices in tiles of 4 x 8: eight accumulators of four doubles, which stay in registers.

Matrices are float pointers with a row length. A tile may reach past the last row or column: what lies there is read
and written, never used.
"""

from __future__ import annotations

from planner.kernels.numba.jit import inline
from planner.kernels.numba.lane_math import transpose
from planner.kernels.numba.lanes import WIDTH, load, load4, spread, store, store4


@inline
def _four_by_eight(C, A, B, n, factor, base, add):
    z = spread(0.0)
    r0, r1, r2, r3, s0, s1, s2, s3 = z, z, z, z, z, z, z, z
    p, a, lda, step = A
    q, b, ldb = B
    for _ in range(n):
        v, w = load4(q, b), load4(q, b + WIDTH)
        a0, a1, a2, a3 = load(p, a), load(p, a + step), load(p, a + 2 * step), load(p, a + 3 * step)
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
    p, c, ldc = C
    q, b, ldb = base
    _put(p, c, r0, factor, q, b, add)
    _put(p, c + WIDTH, s0, factor, q, b + WIDTH, add)
    _put(p, c + ldc, r1, factor, q, b + ldb, add)
    _put(p, c + ldc + WIDTH, s1, factor, q, b + ldb + WIDTH, add)
    _put(p, c + 2 * ldc, r2, factor, q, b + 2 * ldb, add)
    _put(p, c + 2 * ldc + WIDTH, s2, factor, q, b + 2 * ldb + WIDTH, add)
    _put(p, c + 3 * ldc, r3, factor, q, b + 3 * ldb, add)
    _put(p, c + 3 * ldc + WIDTH, s3, factor, q, b + 3 * ldb + WIDTH, add)


@inline
def _four_by_four(C, A, B, n, factor, base, add):
    z = spread(0.0)
    r0, r1, r2, r3 = z, z, z, z
    p, a, lda, step = A
    q, b, ldb = B
    for _ in range(n):
        v = load4(q, b)
        r0 += load(p, a) * v
        r1 += load(p, a + step) * v
        r2 += load(p, a + 2 * step) * v
        r3 += load(p, a + 3 * step) * v
        a += lda
        b += ldb
    p, c, ldc = C
    q, b, ldb = base
    _put(p, c, r0, factor, q, b, add)
    _put(p, c + ldc, r1, factor, q, b + ldb, add)
    _put(p, c + 2 * ldc, r2, factor, q, b + 2 * ldb, add)
    _put(p, c + 3 * ldc, r3, factor, q, b + 3 * ldb, add)


@inline
def _put(p, c, row, factor, q, b, add):
    store4(p, c, load4(q, b) + factor * row if add else factor * row)


@inline
def _from(matrix, j):
    return matrix[0], matrix[1] + j, matrix[2]


@inline
def four_rows(C, A, B, n, factor, columns, base, add):
    """Four rows of C become factor A' B, or base + factor A' B with `add`, contracted over n rows of A and B.

    C, B and base are (pointer, offset, row length); of A also what lies between its columns comes last.
    """
    j = 0
    while j + WIDTH < columns:
        _four_by_eight(_from(C, j), A, _from(B, j), n, factor, _from(base, j), add)
        j += 2 * WIDTH
    if j < columns:
        _four_by_four(_from(C, j), A, _from(B, j), n, factor, _from(base, j), add)


@inline
def two_sums(u, v, B, ldb, n, j):
    """Four columns from j, twice: the rows of B weighted by u (n) and by v (n)."""
    x0, y0, k = spread(0.0), spread(0.0), j
    for i in range(n):
        row = load4(B, k)
        x0 += load(u, i) * row
        y0 += load(v, i) * row
        k += ldb
    return x0, y0


@inline
def weighted_rows(C, base, weights, B, n, factor, columns):
    """C becomes base plus factor times the rows of B (pointer, offset, row length) weighted by `weights` (n)."""
    rows, b, ldb = B
    for j in range(0, columns, WIDTH):
        total, k = spread(0.0), b + j
        for i in range(n):
            total += load(weights, i) * load4(rows, k)
            k += ldb
        store4(C, j, load4(base, j) + factor * total)


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
