"""V4 does in each of its eight lanes what a float does, bit for bit."""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numba import njit

from planner.kernels.hopper.step import push, spring, step
from planner.kernels.integrators import EULER, RUNGE_KUTTA, SEMI_IMPLICIT_EULER
from planner.kernels.numba.jit import FASTMATH
from planner.kernels.numba.lanes import (
    WIDTH,
    any_less,
    lane_array,
    load,
    load4,
    maximum,
    minimum,
    neighbors,
    padded,
    pointer,
    select,
    spread,
    store,
    store4,
)

# As kernels.numba.jit compiles, but not into its cache: these kernels are the test's own.
jit = njit(fastmath=set(FASTMATH), error_model="numpy")

# No contraction can touch these: each result below is one rounded operation.
AWKWARD = [0.0, -0.0, 1.0, -1.5, np.inf, -np.inf, np.nan, 1e308, -1e308, 5e-324, 1e-308, np.pi]
lane = st.sampled_from(AWKWARD) | st.floats(allow_nan=False, width=64)
lanes = arrays(np.float64, WIDTH, elements=lane)


def bits(a):
    """What must agree: the bits, save a NaN's payload and the sign of zero (nsz)."""
    a = np.where(a == 0.0, 0.0, a)
    return np.where(np.isnan(a), np.nan, a).view(np.int64)


def assert_same_bits(ours, theirs):
    np.testing.assert_array_equal(bits(np.ascontiguousarray(ours)), bits(np.ascontiguousarray(theirs)))


@jit
def arithmetic(a, b, c, out):
    p, q, r = pointer(a), pointer(b), pointer(out)
    x, y = load(p, 0), load(q, 0)
    store(r, 0, x + y)
    store(r, 1, x - y)
    store(r, 2, x * y)
    store(r, 3, x / y)
    store(r, 4, x + c)
    store(r, 5, c - x)
    store(r, 6, x * c)
    store(r, 7, c / x)
    store(r, 8, x + 3)
    store(r, 9, 3 - x)
    store(r, 10, maximum(x, y))
    store(r, 11, minimum(x, y))
    store(r, 12, maximum(x, c))
    store(r, 13, minimum(x, c))
    store(r, 14, maximum(x, 0))
    store(r, 15, spread(c))
    store(r, 16, c)
    x += y
    store(r, 17, x)
    x = load(p, 0)
    x -= c
    store(r, 18, x)


def larger(a, b):
    """The definition: b where a < b, else a, so that a NaN in a survives."""
    return np.where(a < b, b, a)


def smaller(a, b):
    return np.where(a > b, b, a)


@settings(max_examples=200, deadline=None)
@given(lanes, lanes, lane)
def test_operations_are_those_of_numpy(a, b, c):
    x, y, out = lane_array(1, WIDTH), lane_array(1, WIDTH), lane_array(19, WIDTH)
    x[0], y[0] = a, b
    arithmetic(x, y, c, out)
    with np.errstate(all="ignore"):
        expected = [
            a + b, a - b, a * b, a / b, a + c, c - a, a * c, c / a, a + 3.0, 3.0 - a, larger(a, b), smaller(a, b),
            larger(a, c), smaller(a, c), larger(a, 0.0), np.full(WIDTH, c), np.full(WIDTH, c), a + b, a - c,
        ]  # fmt: skip
    # A division may become the product with a reciprocal (arcp), and lose the smallest and largest numbers by it.
    quotients = [3, 7]
    for i, (ours, theirs) in enumerate(zip(out, expected, strict=True)):
        if i in quotients:
            finite = np.isfinite(theirs) & (np.abs(theirs) > 1e-300) & (np.abs(theirs) < 1e300)
            np.testing.assert_allclose(ours[finite], theirs[finite], rtol=4e-16)
            np.testing.assert_array_equal(np.isnan(ours), np.isnan(theirs))
        else:
            assert_same_bits(ours, theirs)


@jit
def extremes(a, b, out):
    p, q, r = pointer(a), pointer(b), pointer(out)
    store(r, 0, maximum(load(p, 0), load(q, 0)))
    store(r, 1, minimum(load(p, 0), load(q, 0)))


@pytest.mark.parametrize("shape", [(1, WIDTH), (1,)])
def test_a_nan_survives_the_spring(shape):
    """A state that ran away must not be clipped to a number that looks sound."""
    out = lane_array(2, *shape[1:])
    nan, one = np.full(shape, np.nan), np.full(shape, 1.0)
    extremes(nan, one, out)
    assert np.isnan(out).all()
    springs(nan, out)
    assert np.isnan(out).all()


@jit
def springs(e, out):
    p, r = pointer(e), pointer(out)
    force, slope = spring(load(p, 0), 100.0, 0.1)
    store(r, 0, force)
    store(r, 1, slope)


@jit
def copy8(source, target, at, to):
    store4(pointer(target), to, 2.0 * load4(pointer(source), at))


@given(st.integers(0, 16), st.integers(0, 16))
@settings(deadline=None)
def test_eight_consecutive_doubles_from_any_offset(at, to):
    source, target = np.arange(24.0) + 1.0, np.zeros(24)
    copy8(source, target, at, to)
    expected = np.zeros(24)
    expected[to : to + WIDTH] = 2.0 * source[at : at + WIDTH]
    np.testing.assert_array_equal(target, expected)


@jit
def stages(integrator, z, dt, out):
    """Ends, slopes and changes of K stages, from rows (y, v, p, u) of floats or of lanes."""
    p, r = pointer(z), pointer(out)
    for i in range(z.shape[0] // 4):
        y, v, x, u = load(p, 4 * i), load(p, 4 * i + 1), load(p, 4 * i + 2), load(p, 4 * i + 3)
        (a, b, c), slopes = step(integrator, (y, v, x), u, dt, (100.0, 0.1, 386.4))
        store(r, 7 * i, a)
        store(r, 7 * i + 1, b)
        store(r, 7 * i + 2, c)
        store(r, 7 * i + 3, slopes[3])
        a, b, c = push(integrator, (y, v, x), u, slopes, dt)
        store(r, 7 * i + 4, a)
        store(r, 7 * i + 5, b)
        store(r, 7 * i + 6, c)


@pytest.mark.parametrize("integrator", [EULER, SEMI_IMPLICIT_EULER, RUNGE_KUTTA])
@settings(max_examples=50, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(seed=st.integers(0, 2**32 - 1), spread_of=st.sampled_from([1e-7, 1e-2, 1.0, 100.0]))
def test_one_source_two_builds_same_bits(integrator, seed, spread_of):
    """On (K,) arrays the kernel of a stage runs on floats, on (K, 8) arrays on lanes: no lane may differ."""
    rng = np.random.default_rng(seed)
    z = lane_array(8, WIDTH)  # two stages of (y, v, p, u)
    z[:] = spread_of * rng.normal(size=z.shape)
    z[2] = z[0] + rng.uniform(-0.05, 0.15, WIDTH)  # p - y on all three pieces of the spring
    out = lane_array(14, WIDTH)
    stages(integrator, z, 0.005, out)
    for k in range(WIDTH):
        single, one = np.ascontiguousarray(z[:, k]), np.zeros(14)
        stages(integrator, single, 0.005, one)
        assert_same_bits(one, out[:, k])


@given(st.lists(st.integers(1, 9), min_size=1, max_size=3))
def test_lane_arrays_start_on_a_cache_line(shape):
    a = lane_array(*shape)
    assert a.shape == tuple(shape)
    assert a.flags.c_contiguous
    assert a.ctypes.data % 64 == 0  # bytes of eight doubles
    assert not a.any()


def test_neighbors_are_side_by_side_on_cache_lines():
    """None lies over another, and gaps are less than a line: else their distance would be chance."""
    counts = {"one": 5, "lines": 16, "none": 0, "last": 9}
    arrays = neighbors(**counts)
    assert {name: array.shape for name, array in arrays.items()} == {name: (n,) for name, n in counts.items()}
    one, lines, last = (arrays[name].ctypes.data for name in ("one", "lines", "last"))
    assert one % 64 == 0  # bytes of eight doubles
    assert (lines - one, last - one) == (64, 64 + 128)
    assert not any(array.any() for array in arrays.values())


@given(st.integers(0, 1000))
def test_padding_is_the_next_whole_lane(n):
    assert padded(n) % WIDTH == 0
    assert n <= padded(n) < n + WIDTH


@jit
def chosen(a, b, out):
    p, q, r = pointer(a), pointer(b), pointer(out)
    x, y = load(p, 0), load(q, 0)
    store(r, 0, select(x, y, 1.0, y))
    store(r, 1, select(0.0, x, x, 2.0))
    return any_less(x, y), any_less(0.0, x)


@given(a=lanes, b=lanes)
@settings(max_examples=200, deadline=None, derandomize=True)
def test_choices_by_comparison(a, b):
    """In each lane its own; and any_less is on the safe side of a NaN."""
    one, two, out = lane_array(1, WIDTH), lane_array(1, WIDTH), lane_array(2, WIDTH)
    one[0], two[0] = a, b
    either, positive = chosen(one, two, out)
    assert_same_bits(out[0], np.where(a < b, 1.0, b))
    assert_same_bits(out[1], np.where(a > 0.0, a, 2.0))
    assert either == bool(np.any(~(a >= b)))
    assert positive == bool(np.any(~(a <= 0.0)))
