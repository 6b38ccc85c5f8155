"""Signed distances of round lines, round boxes and planes: one row each. The twin is model.contact.signed_distance.

A term's constants are both solids' axes in their links' frames and half lengths, what is taken off the distance of the
cores, and the radius of the balls around both together. With the direction n and the point p, which the value leaves in
KEPT, the derivative is that of a force n at p on the first and -n on the second: for a dof with the screw (w, v), about
its tree's origin, w'(p x n) + v'n.

A term is one-sided, so it need not be known how far apart solids are that are farther than they must be: where that
holds of the balls around them in all lanes, the balls' distance stands for theirs.
"""

from __future__ import annotations

from planner.kernels.algebra.spatial import add, axpy, cross, dot, load3, load9, rotated, scaled, store3, sub
from planner.kernels.numba.jit import inline, part
from planner.kernels.numba.lane_math import sqrt
from planner.kernels.numba.lanes import (
    any_less,
    floats,
    integers,
    lanes,
    load,
    maximum,
    minimum,
    select,
    spread,
    store,
)
from planner.kernels.tree.mechanism_table import TREE
from planner.kernels.tree.recursion import RECORD, SCREW_AXIS
from planner.kernels.tree.residuals.layout import MAX_ROWS, PLACE_SIZE, RESIDUALS
from planner.kernels.tree.residuals.points import constants_of, point_of, stage_value

LINE_BOX, BOXES, OVER_PLANE = range(12, 15)  # numbers of kinds
FIRST_AXES, FIRST_HALF, SECOND_AXES, SECOND_HALF, TAKEN_OFF, REACH = 0, 9, 12, 21, 24, 25
"""Offsets in the constants of two solids: axes in their links and half lengths, what is taken off the distance of their
cores, and the radius of the balls around both cores together (of a plane only the other's)."""
TOUCHING, PARALLEL, TINY = 1e-9, 1e-12, 1e-300  # as the twin's
FLAT = 1e-12  # of a direction's components, below which a face or edge lies across it
R_, X_ = 6, 15  # in KEPT, after n and p: the first's axes and place as the second's frame has them


@inline
def _size(x):
    return maximum(x, 0.0 - x)


@inline
def _side(x):
    """-1 below 0, else 1."""
    return select(x, 0.0, -1.0, 1.0)


@inline
def _sign(x):
    """-1, 0 or 1, 0 where it is 0 to rounding."""
    return select(x, -FLAT, -1.0, select(FLAT, x, 1.0, 0.0))


@inline
def _clipped(y, h):
    return (
        minimum(maximum(y[0], 0.0 - h[0]), h[0]), minimum(maximum(y[1], 0.0 - h[1]), h[1]),
        minimum(maximum(y[2], 0.0 - h[2]), h[2]),
    )  # fmt: skip


@inline
def _chosen(a, b, v, w):
    """Vector v where a < b, else w."""
    return select(a, b, v[0], w[0]), select(a, b, v[1], w[1]), select(a, b, v[2], w[2])


@inline
def _combined(u, a, b, c):
    """u[0] a + u[1] b + u[2] c."""
    return axpy(axpy(scaled(u[0], a), u[1], b), u[2], c)


@inline
def _slope(x, d, h, s):
    """Half the derivative of the squared distance of a box and the point x + s d."""
    y = axpy(x, s, d)
    return dot(d, sub(y, _clipped(y, h)))


@inline
def _narrowed(bracket, x, d, h, x_i, d_i, edge):
    """A bracket (low, slope there, high, slope there) cut where the line crosses a side of a slab."""
    low, g_low, high, g_high = bracket
    across = select(_size(d_i), TINY, TINY, d_i)
    s = minimum(maximum((edge - x_i) / across, -1.0), 1.0)
    g = _slope(x, d, h, s)
    up = select(low, s, g, 1.0)  # not above 0 where s is a better lower end
    g_low, low = select(0.0, up, g_low, g), select(0.0, up, low, s)
    down = select(s, high, g, -1.0)
    g_high, high = select(down, 0.0, g_high, g), select(down, 0.0, high, s)
    return low, g_low, high, g_high


@part
def _line_from_box(x, d, h):
    """The least vector from a box to a line x + s d, |s| <= 1, and s."""
    one = spread(1.0)
    low, high = 0.0 - one, one
    g_low, g_high = _slope(x, d, h, low), _slope(x, d, h, high)
    high, g_high = select(g_low, 0.0, high, low), select(g_low, 0.0, g_high, g_low)
    low, g_low = select(0.0, g_high, low, high), select(0.0, g_high, g_low, g_high)
    bracket = (low, g_low, high, g_high)
    bracket = _narrowed(bracket, x, d, h, x[0], d[0], h[0])
    bracket = _narrowed(bracket, x, d, h, x[0], d[0], 0.0 - h[0])
    bracket = _narrowed(bracket, x, d, h, x[1], d[1], h[1])
    bracket = _narrowed(bracket, x, d, h, x[1], d[1], 0.0 - h[1])
    bracket = _narrowed(bracket, x, d, h, x[2], d[2], h[2])
    bracket = _narrowed(bracket, x, d, h, x[2], d[2], 0.0 - h[2])
    low, g_low, high, g_high = bracket
    s = low + (high - low) * (0.5 * TINY - g_low) / (g_high - g_low + TINY)
    s = minimum(maximum(s, -1.0), 1.0)
    y = axpy(x, s, d)
    e = sub(y, _clipped(y, h))
    return e[0], e[1], e[2], s


@inline
def _unit(i):
    return 1.0 if i == 0 else 0.0, 1.0 if i == 1 else 0.0, 1.0 if i == 2 else 0.0


@inline
def _reach(p, m):
    """Components of a direction m along the first's axes."""
    kept = lanes(p, RESIDUALS.kept)
    return dot(load3(kept, R_), m), dot(load3(kept, R_ + 3), m), dot(load3(kept, R_ + 6), m)


@inline
def _corner(p, a, signs):
    """The first's corner, edge or face against these signs along its axes."""
    kept = lanes(p, RESIDUALS.kept)
    u = (a[0] * signs[0], a[1] * signs[1], a[2] * signs[2])
    return sub(load3(kept, X_), _combined(u, load3(kept, R_), load3(kept, R_ + 3), load3(kept, R_ + 6)))


@part
def _apart_along(p, m, a, b, free_a, free_b, best, n, at):
    """The greatest separation so far with that along a unit direction m (or 0 for none): (best, n, at), seven lanes.

    free_a, free_b: which axis of each is an edge that m is across; -1 for the face of the first, -2 of the second.
    """
    x = load3(lanes(p, RESIDUALS.kept), X_)
    exists = dot(m, m)
    m = scaled(_side(dot(m, x)), m)
    r = _reach(p, m)
    found = (
        dot(m, x) - (_size(r[0]) * a[0] + _size(r[1]) * a[1] + _size(r[2]) * a[2])
        - (_size(m[0]) * b[0] + _size(m[1]) * b[1] + _size(m[2]) * b[2])
    )  # fmt: skip
    found = select(0.5, exists, found, -1e300)
    sa, sb = (_sign(r[0]), _sign(r[1]), _sign(r[2])), (_sign(m[0]), _sign(m[1]), _sign(m[2]))
    zero = spread(0.0)
    if free_a >= 0:
        sa = (zero if free_a == 0 else sa[0], zero if free_a == 1 else sa[1], zero if free_a == 2 else sa[2])
        sb = (zero if free_b == 0 else sb[0], zero if free_b == 1 else sb[1], zero if free_b == 2 else sb[2])
    of_a, of_b = _corner(p, a, sa), (b[0] * sb[0], b[1] * sb[1], b[2] * sb[2])
    there = of_a
    if free_a == -1:
        there = of_b
    if free_a >= 0:  # where the two edges pass each other
        f, k = load3(lanes(p, RESIDUALS.kept), R_ + 3 * free_a), cross(m, _unit(free_b))
        along = dot(k, f)
        s = dot(k, sub(of_b, of_a)) / select(_size(along), TINY, 1.0, along)
        there = axpy(of_a, s, f)
    n, at = _chosen(best, found, m, n), _chosen(best, found, there, at)
    return maximum(best, found), n[0], n[1], n[2], at[0], at[1], at[2]


@part
def _within(p, a, b, edges_only):
    """The greatest separation of cores that overlap over all separating axes: (best, n, at), seven lanes.

    With edges_only the first is a line, its third axis alone counts.
    """
    kept, zero = lanes(p, RESIDUALS.kept), spread(0.0)
    best, n, at = spread(-1e300), (zero, zero, zero), load3(kept, X_)
    for i in range(3):
        u = _unit(i)
        m = (zero + u[0], zero + u[1], zero + u[2])
        best, n0, n1, n2, a0, a1, a2 = _apart_along(p, m, a, b, -2, -2, best, n, at)
        n, at = (n0, n1, n2), (a0, a1, a2)
        if not edges_only:
            best, n0, n1, n2, a0, a1, a2 = _apart_along(p, load3(kept, R_ + 3 * i), a, b, -1, -1, best, n, at)
            n, at = (n0, n1, n2), (a0, a1, a2)
        for j in range(2 if edges_only else 0, 3):
            m = cross(u, load3(kept, R_ + 3 * j))
            mm = dot(m, m)
            m = scaled(select(PARALLEL, mm, 1.0, 0.0) / sqrt(maximum(mm, PARALLEL)), m)
            best, n0, n1, n2, a0, a1, a2 = _apart_along(p, m, a, b, j, i, best, n, at)
            n, at = (n0, n1, n2), (a0, a1, a2)
    return best, n[0], n[1], n[2], at[0], at[1], at[2]


@inline
def _nearer(best, e, at, e_new, at_new):
    length = dot(e_new, e_new)
    return minimum(best, length), _chosen(length, best, e_new, e), _chosen(length, best, at_new, at)


@part
def _box_from_box(p, a, b):
    """The least vector from the second box to the first, and where on the first: six lanes."""
    kept, zero = lanes(p, RESIDUALS.kept), spread(0.0)
    x = load3(kept, X_)
    best, e, at = spread(1e300), (zero, zero, zero), x
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        half_i = a[0] if i == 0 else a[1] if i == 1 else a[2]
        half_j = a[0] if j == 0 else a[1] if j == 1 else a[2]
        half_k = a[0] if k == 0 else a[1] if k == 1 else a[2]
        d = scaled(half_i, load3(kept, R_ + 3 * i))
        for corner in range(4):
            sj, sk = half_j if corner % 2 == 0 else -half_j, half_k if corner < 2 else -half_k
            middle = axpy(axpy(x, sj, load3(kept, R_ + 3 * j)), sk, load3(kept, R_ + 3 * k))
            e0, e1, e2, s = _line_from_box(middle, d, b)
            best, e, at = _nearer(best, e, at, (e0, e1, e2), axpy(middle, s, d))
    for corner in range(8):
        c = (b[0] if corner % 2 == 0 else -b[0], b[1] if corner // 2 % 2 == 0 else -b[1], b[2] if corner < 4 else -b[2])
        c = (zero + c[0], zero + c[1], zero + c[2])
        y = _reach(p, sub(c, x))
        back = sub(_clipped(y, a), y)
        w = _combined(back, load3(kept, R_), load3(kept, R_ + 3), load3(kept, R_ + 6))
        best, e, at = _nearer(best, e, at, w, c)
    return e[0], e[1], e[2], at[0], at[1], at[2]


@inline
def axes_of(p, ws, t, k, offset):
    """Axes of solid k of a term in the world, by rows."""
    link, term = load(integers(p, RESIDUALS.point_link), point_of(p, t, k)), constants_of(p, t)
    zero, C = spread(0.0), load9(term, offset)
    a, b, c = (C[0], C[3], C[6]), (C[1], C[4], C[7]), (C[2], C[5], C[8])
    x, y, z = (
        (zero + a[0], zero + a[1], zero + a[2]), (zero + b[0], zero + b[1], zero + b[2]),
        (zero + c[0], zero + c[1], zero + c[2]),
    )  # fmt: skip
    if link >= 0:
        R = load9(ws, link * RECORD)
        x, y, z = rotated(R, a), rotated(R, b), rotated(R, c)
    return x, y, z


@part
def solid_value(p, ws, t, kind, n, knots):
    """How far apart the solids of term t are; the direction and the place go to KEPT."""
    places, term, kept = lanes(p, RESIDUALS.places), constants_of(p, t), lanes(p, RESIDUALS.kept)
    i, j = PLACE_SIZE * point_of(p, t, 0) + 3, PLACE_SIZE * point_of(p, t, 1) + 3
    way, off = sub(load3(places, i), load3(places, j)), load(term, TAKEN_OFF)
    a, b = load3(term, FIRST_HALF), load3(term, SECOND_HALF)
    row = load(integers(p, RESIDUALS.first_row), t) * p[RESIDUALS.stride] + n
    asked = stage_value(floats(p, RESIDUALS.bound), row, knots)
    if kind != OVER_PLANE:
        far = sqrt(dot(way, way)) - load(term, REACH)
        if any_less(far - off, asked):
            bx, by, bz = axes_of(p, ws, t, 1, SECOND_AXES)
            ax, ay, az = axes_of(p, ws, t, 0, FIRST_AXES)
            store3(kept, R_, (dot(bx, ax), dot(by, ax), dot(bz, ax)))
            store3(kept, R_ + 3, (dot(bx, ay), dot(by, ay), dot(bz, ay)))
            store3(kept, R_ + 6, (dot(bx, az), dot(by, az), dot(bz, az)))
            x = (dot(bx, way), dot(by, way), dot(bz, way))
            store3(kept, X_, x)
            if kind == LINE_BOX:
                d = scaled(a[2], load3(kept, R_ + 6))
                e0, e1, e2, s = _line_from_box(x, d, b)
                e, at = (e0, e1, e2), axpy(x, s, d)
            else:
                e0, e1, e2, a0, a1, a2 = _box_from_box(p, a, b)
                e, at = (e0, e1, e2), (a0, a1, a2)
            far = sqrt(dot(e, e))
            normal = scaled(1.0 / maximum(far, TOUCHING), e)
            if any_less(far, TOUCHING):
                inner, n0, n1, n2, a0, a1, a2 = _within(p, a, b, kind == LINE_BOX)
                normal = _chosen(far, TOUCHING, (n0, n1, n2), normal)
                at = _chosen(far, TOUCHING, (a0, a1, a2), at)
                far = select(far, TOUCHING, inner, far)
            store3(kept, 0, _combined(normal, bx, by, bz))
            store3(kept, 3, add(load3(places, j), _combined(at, bx, by, bz)))
    else:
        _, _, normal = axes_of(p, ws, t, 1, SECOND_AXES)
        far = dot(normal, way) - load(term, REACH)
        if any_less(far - off, asked):
            ax, ay, az = axes_of(p, ws, t, 0, FIRST_AXES)
            r = (a[0] * dot(ax, normal), a[1] * dot(ay, normal), a[2] * dot(az, normal))
            far = dot(normal, way) - (_size(r[0]) + _size(r[1]) + _size(r[2]))
            u = (0.0 - a[0] * _sign(r[0]), 0.0 - a[1] * _sign(r[1]), 0.0 - a[2] * _sign(r[2]))
            store3(kept, 0, normal)
            store3(kept, 3, add(load3(places, i), _combined(u, ax, ay, az)))
    store(lanes(p, RESIDUALS.value), 0, far - off)


@part
def solid_row(m, p, ws, t):
    """The derivative of a signed distance, after its value."""
    parent, link = integers(m, TREE.parent), integers(p, RESIDUALS.point_link)
    places, kept, row = lanes(p, RESIDUALS.places), lanes(p, RESIDUALS.kept), lanes(p, RESIDUALS.row)
    n, there = load3(kept, 0), load3(kept, 3)
    for k in range(2):
        i = point_of(p, t, k)
        j = load(link, i)
        if j >= 0:
            o = PLACE_SIZE * i
            about = add(sub(there, load3(places, o + 3)), load3(places, o))  # the tree's origin
            g = scaled(1.0 if k == 0 else -1.0, n)
            moment = cross(about, g)
            while j >= 0:
                b, at = j * RECORD + SCREW_AXIS, MAX_ROWS * j
                store(row, at, load(row, at) + dot(load3(ws, b), moment) + dot(load3(ws, b + 3), g))
                j = load(parent, j)
