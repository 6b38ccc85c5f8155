"""D4 carries a directional derivative through every operation, exactly: against differences in complex numbers."""

import numpy as np
import pytest
from numba import njit
from numba.core.errors import TypingError

from planner.kernels.numba.duals import duals
from planner.kernels.numba.jit import FASTMATH
from planner.kernels.numba.lane_math import sincos, sqrt
from planner.kernels.numba.lanes import WIDTH, at, lane_array, lanes, load, spread, store

# As kernels.numba.jit compiles, but not into its cache: these kernels are the test's own.
jit = njit(fastmath=set(FASTMATH), error_model="numpy")

STEP = 1e-100  # of a complex step, whose square is zero: derivatives without a subtraction, to the last bits


def tables(inputs, outputs):
    """A table of two addresses, and the two arrays (K, 8)."""
    arrays = lane_array(inputs, 2 * WIDTH), lane_array(outputs, 2 * WIDTH)
    return np.array([a.ctypes.data for a in arrays]), *arrays


@jit
def arithmetic(t, c):
    p, r = duals(t, 0), duals(t, 1)
    x, y, lane, k = load(p, 0), load(p, 1), load(lanes(t, 0), 4), 3
    store(r, 0, x + y)
    store(r, 1, x - y)
    store(r, 2, x * y)
    store(r, 3, x / y)
    store(r, 4, x + lane)
    store(r, 5, lane + x)
    store(r, 6, x - lane)
    store(r, 7, lane - x)
    store(r, 8, x * lane)
    store(r, 9, lane * x)
    store(r, 10, x / lane)
    store(r, 11, lane / x)
    store(r, 12, x + c)
    store(r, 13, c - x)
    store(r, 14, c * x)
    store(r, 15, c / x)
    store(r, 16, x + k)
    store(r, 17, k - x)
    store(r, 18, x * k)
    store(r, 19, k / x)
    x += y
    store(r, 20, x)
    x -= c
    store(r, 21, x)
    s, co = sincos(y)
    store(r, 22, s)
    store(r, 23, co)
    store(r, 24, lane)
    store(r, 25, c)
    store(at(r, 25), 1, load(at(p, 1), 0))


def expected(x, y, lane, c):
    k = 3
    return np.array([
        x + y, x - y, x * y, x / y, x + lane, lane + x, x - lane, lane - x, x * lane, lane * x, x / lane, lane / x,
        x + c, c - x, c * x, c / x, x + k, k - x, x * k, k / x, x + y, x + y - c, np.sin(y), np.cos(y), lane + 0 * x,
        c + 0 * x, y,
    ])  # fmt: skip


@pytest.mark.parametrize("scale", [1.0, 30.0])  # several turns of the sine
def test_every_operation(scale):
    table, p, r = tables(3, 27)
    rng = np.random.default_rng(0)
    p[:] = scale * rng.normal(size=p.shape)
    arithmetic(table, 0.7)
    x, y = (p[i, :WIDTH] + STEP * 1j * p[i, WIDTH:] for i in range(2))
    theirs = expected(x, y, p[2, :WIDTH], 0.7)
    np.testing.assert_allclose(r[:, :WIDTH], theirs.real, rtol=1e-14, atol=1e-15)
    of_x, of_y = expected(x, p[1, :WIDTH], p[2, :WIDTH], 0.7), expected(p[0, :WIDTH], y, p[2, :WIDTH], 0.7)
    size = (np.abs(of_x.imag) + np.abs(of_y.imag)) / STEP  # of the two parts, which may cancel
    assert np.all(np.abs(r[:, WIDTH:] - theirs.imag / STEP) <= 1e-14 * (size + 1e-2))


@jit
def branching(t, moves):
    p, r = duals(t, 0), duals(t, 1)
    pair = (spread(2.0), spread(3.0))
    if moves:
        pair = (load(p, 0), spread(3.0) * load(p, 1))
    store(r, 0, pair[0])
    store(r, 1, pair[1])


def test_lanes_become_constants_where_branches_meet():
    table, p, r = tables(2, 2)
    p[:] = np.arange(16).reshape(2, 8)
    branching(table, False)
    np.testing.assert_array_equal(r, np.repeat([[2.0, 0.0], [3.0, 0.0]], WIDTH, axis=1))
    branching(table, True)
    np.testing.assert_array_equal(r, [p[0], 3.0 * p[1]])


@jit
def rooted(t):
    store(duals(t, 1), 0, sqrt(load(duals(t, 0), 0)))


def test_an_operation_without_a_rule_does_not_compile():
    """A derivative that is silently dropped would be a wrong one."""
    with pytest.raises(TypingError):
        rooted(tables(1, 1)[0])
