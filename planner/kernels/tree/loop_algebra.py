"""Products and eliminations of the rows of closed chains, three by three (kernels.tree.loop_arrays).

With N = A B' of rows A and B, such as J W J' or J J': its lower half (`gram`), -N^-1 c (`solve`), its inverse
(`invert_independent`), and the products with it that derivatives take.

Equations that say the same twice, as those of a planar machine do, make N singular. Elimination leaves out a row whose
pivot falls below a share of the largest diagonal entry of its kind: its force is zero, and the others keep it too.
Which row of three that is follows from their pivots: a row that is nearly along a planar chain's axis would bind the
chain by a small part of itself, which is slow to close it, or opens it, where the axis turns.
"""

from __future__ import annotations

from planner.kernels.numba.jit import inline
from planner.kernels.numba.lanes import integers, lanes, load, maximum, select, spread, store
from planner.kernels.tree.mechanism_table import TREE
from planner.kernels.tree.memory import MEMORY


@inline
def gram(m, r, A, B, ld, independent):
    """N: the lower half of A B' (both rows of ld), and the least pivots that count, a share `independent`."""
    start, dof = integers(m, TREE.shared_start), integers(m, TREE.shared_dof)
    rows, pair, kinds = m[TREE.loop_rows], 0, integers(m, TREE.triple_kind)
    N, least, zero = lanes(r, MEMORY.loop_N), lanes(r, MEMORY.loop_least), spread(0.0)
    for kind in range(3):
        store(least, kind, zero)
    for k in range(m[TREE.triples]):
        a0, a1, a2 = 3 * k * ld, (3 * k + 1) * ld, (3 * k + 2) * ld
        largest = zero
        for l in range(k + 1):
            b0, b1, b2 = 3 * l * ld, (3 * l + 1) * ld, (3 * l + 2) * ld
            n00, n01, n02, n10, n11, n12, n20, n21, n22 = zero, zero, zero, zero, zero, zero, zero, zero, zero
            for t in range(load(start, pair), load(start, pair + 1)):
                i = load(dof, t)
                x, y, z = load(A, a0 + i), load(A, a1 + i), load(A, a2 + i)
                u, v, w = load(B, b0 + i), load(B, b1 + i), load(B, b2 + i)
                n00 += x * u
                n01 += x * v
                n02 += x * w
                n10 += y * u
                n11 += y * v
                n12 += y * w
                n20 += z * u
                n21 += z * v
                n22 += z * w
            pair += 1
            o = 3 * (k * rows + l)
            _store_three(N, o, n00, n01, n02)
            _store_three(N, o + rows, n10, n11, n12)
            _store_three(N, o + 2 * rows, n20, n21, n22)
            largest = maximum(n00, maximum(n11, n22))  # of the last, which lies on the diagonal
        kind = load(kinds, k)
        store(least, kind, maximum(load(least, kind), independent * largest))


@inline
def _store_three(p, o, x, y, z):
    store(p, o, x)
    store(p, o + 1, y)
    store(p, o + 2, z)


@inline
def _swapped(swap, x, y):
    """(y, x) in lanes where `swap` is above zero, and (x, y) in the others."""
    return select(0.0, swap, y, x), select(0.0, swap, x, y)


@inline
def _block_inverse(m, N, o, least, k):
    """The inverse of block k of N on the diagonal, at o: its entries 00, 10, 11, 20, 21, 22.

    By elimination from the largest pivot on; what remains at the end is left out where it is too small. So it is the
    row that says least: in a planar chain the one nearest to its axis, whichever way the chain is turned.
    """
    rows, e = m[TREE.loop_rows], load(least, load(integers(m, TREE.triple_kind), k))
    a, b, d = load(N, o), load(N, o + rows), load(N, o + rows + 1)
    c, g, f = load(N, o + 2 * rows), load(N, o + 2 * rows + 1), load(N, o + 2 * rows + 2)
    first = d - a
    a, d = _swapped(first, a, d)
    c, g = _swapped(first, c, g)
    second = f - a
    a, f = _swapped(second, a, f)
    b, g = _swapped(second, b, g)
    p = select(e, a, 1.0 / a, 0.0)
    x, y = b * p, c * p
    d, g, f = d - x * b, g - y * b, f - y * c
    third = f - d
    d, f = _swapped(third, d, f)
    x, y = _swapped(third, x, y)
    q = select(e, d, 1.0 / d, 0.0)
    z = g * q
    f = f - z * g
    s = select(e, f, 1.0 / f, 0.0)
    w = x * z - y  # the rows of L^-1 are (1, 0, 0), (-x, 1, 0), (w, -z, 1)
    n00, n10, n20 = p + q * x * x + s * w * w, 0.0 - q * x - s * w * z, s * w
    n11, n21, n22 = q + s * z * z, 0.0 - s * z, s
    n11, n22 = _swapped(third, n11, n22)
    n10, n20 = _swapped(third, n10, n20)
    n00, n22 = _swapped(second, n00, n22)
    n10, n21 = _swapped(second, n10, n21)
    n00, n11 = _swapped(first, n00, n11)
    n20, n21 = _swapped(first, n20, n21)
    return n00, n10, n11, n20, n21, n22


@inline
def _store_block(N, rows, o, block):
    """The lower half of a block on the diagonal."""
    store(N, o, block[0])
    store(N, o + rows, block[1])
    store(N, o + rows + 1, block[2])
    _store_three(N, o + 2 * rows, block[3], block[4], block[5])


@inline
def _times(block, x, y, z):
    """A symmetric block, entries as in _block_inverse, times a vector."""
    n00, n10, n11, n20, n21, n22 = block
    return n00 * x + n10 * y + n20 * z, n10 * x + n11 * y + n21 * z, n20 * x + n21 * y + n22 * z


@inline
def solve(m, r, c, f):
    """F = -N^-1 c (rows) by block elimination, in place of N's lower half and of c; dependent rows have no force."""
    N, rows, least = lanes(r, MEMORY.loop_N), m[TREE.loop_rows], lanes(r, MEMORY.loop_least)
    for k in range(m[TREE.triples]):
        first, after = 3 * k, 3 * k + 3
        o = first * (rows + 1)
        block = _block_inverse(m, N, o, least, k)
        _store_block(N, rows, o, block)
        c0, c1, c2 = load(c, first), load(c, first + 1), load(c, first + 2)
        for i in range(after, rows):
            t = i * rows
            u0, u1, u2 = _times(block, load(N, t + first), load(N, t + first + 1), load(N, t + first + 2))
            store(c, i, load(c, i) - (u0 * c0 + u1 * c1 + u2 * c2))
            for j in range(after, i + 1):
                b = j * rows + first
                total = u0 * load(N, b) + u1 * load(N, b + 1) + u2 * load(N, b + 2)
                store(N, t + j, load(N, t + j) - total)
    for k in range(m[TREE.triples] - 1, -1, -1):
        first = 3 * k
        o, t0, t1, t2 = first * (rows + 1), load(c, first), load(c, first + 1), load(c, first + 2)
        for i in range(first + 3, rows):
            t, g = i * rows + first, load(f, i)
            t0 += load(N, t) * g
            t1 += load(N, t + 1) * g
            t2 += load(N, t + 2) * g
        block = (
            load(N, o), load(N, o + rows), load(N, o + rows + 1),
            load(N, o + 2 * rows), load(N, o + 2 * rows + 1), load(N, o + 2 * rows + 2),
        )  # fmt: skip
        t0, t1, t2 = _times(block, t0, t1, t2)
        _store_three(f, first, 0.0 - t0, 0.0 - t1, 0.0 - t2)


@inline
def _column(N, rows, i, first):
    """Row i of three columns of a symmetric N that has its lower half."""
    o, step = i * rows + first, 1
    if i < first:
        o, step = first * rows + i, rows
    return o, step, load(N, o), load(N, o + step), load(N, o + 2 * step)


@inline
def invert_independent(m, r):
    """N becomes the inverse of its independent rows and columns, and zero in the others, by sweeps of three."""
    N, rows, least = lanes(r, MEMORY.loop_N), m[TREE.loop_rows], lanes(r, MEMORY.loop_least)
    for k in range(m[TREE.triples]):
        first, after = 3 * k, 3 * k + 3
        o = first * (rows + 1)
        block = _block_inverse(m, N, o, least, k)
        for i in range(rows):
            if i < first or i >= after:
                _, _, u0, u1, u2 = _column(N, rows, i, first)
                f0, f1, f2 = _times(block, u0, u1, u2)
                t = i * rows
                for j in range(min(i + 1, first)):
                    n = first * rows + j
                    total = f0 * load(N, n) + f1 * load(N, n + rows) + f2 * load(N, n + 2 * rows)
                    store(N, t + j, load(N, t + j) - total)
                for j in range(after, i + 1):
                    n = j * rows + first
                    total = f0 * load(N, n) + f1 * load(N, n + 1) + f2 * load(N, n + 2)
                    store(N, t + j, load(N, t + j) - total)
        for i in range(rows):
            if i < first or i >= after:
                n, step, u0, u1, u2 = _column(N, rows, i, first)
                u0, u1, u2 = _times(block, u0, u1, u2)
                store(N, n, u0)
                store(N, n + step, u1)
                store(N, n + 2 * step, u2)
        n00, n10, n11, n20, n21, n22 = block
        _store_block(N, rows, o, (0.0 - n00, 0.0 - n10, 0.0 - n11, 0.0 - n20, 0.0 - n21, 0.0 - n22))
    for i in range(rows):
        for j in range(i + 1):
            n = 0.0 - load(N, i * rows + j)
            store(N, i * rows + j, n)
            store(N, j * rows + i, n)


@inline
def times_inverse(m, r, X, width, Y, ld):
    """Y = N X (rows, ld) of an inverted N and X (rows, width), which is zero but at each triple's reach."""
    start, dof = integers(m, TREE.reach_start), integers(m, TREE.reach_dof)
    rows, N, zero = m[TREE.loop_rows], lanes(r, MEMORY.loop_N), spread(0.0)
    for k in range(rows * ld):
        store(Y, k, zero)
    for k in range(m[TREE.triples]):
        y0, y1, y2 = 3 * k * ld, (3 * k + 1) * ld, (3 * k + 2) * ld
        for l in range(m[TREE.triples]):
            o, x0, x1, x2 = 3 * (k * rows + l), 3 * l * width, (3 * l + 1) * width, (3 * l + 2) * width
            a, b, c = load(N, o), load(N, o + 1), load(N, o + 2)
            o += rows
            d, e, f = load(N, o), load(N, o + 1), load(N, o + 2)
            o += rows
            g, h, i = load(N, o), load(N, o + 1), load(N, o + 2)
            for t in range(load(start, l), load(start, l + 1)):
                j = load(dof, t)
                x, y, z = load(X, x0 + j), load(X, x1 + j), load(X, x2 + j)
                store(Y, y0 + j, load(Y, y0 + j) + (a * x + b * y + c * z))
                store(Y, y1 + j, load(Y, y1 + j) + (d * x + e * y + f * z))
                store(Y, y2 + j, load(Y, y2 + j) + (g * x + h * y + i * z))


@inline
def subtract(m, lists, A, Y, ld, E, place, half):
    """E, at `place` = (row length, first column), less A'Y of A and Y (rows, ld); A is zero but where `lists` are.

    With `half` only what lies on and below E's diagonal.
    """
    start, dof = lists
    columns, offset = place
    for k in range(m[TREE.triples]):
        y0, y1, y2 = 3 * k * ld, (3 * k + 1) * ld, (3 * k + 2) * ld
        for t in range(load(start, k), load(start, k + 1)):
            i = load(dof, t)
            x, y, z, o = load(A, y0 + i), load(A, y1 + i), load(A, y2 + i), i * columns + offset
            for j in range(i + 1 if half else m[TREE.nv]):
                total = x * load(Y, y0 + j) + y * load(Y, y1 + j) + z * load(Y, y2 + j)
                store(E, o + j, load(E, o + j) - total)
